"""What uninstalling removes on a node, and what not."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from fractus_agent import wipe as module
from fractus_agent.wipe import main, wipe


@pytest.fixture
def state(tmp_path: Path) -> Path:
    """A node's directory, beside what is not Fractus's and that it has links to."""
    state, other = tmp_path / "fractus", tmp_path / "other"
    for folder in (state / "tls", state / "camera" / "albums", other):
        folder.mkdir(parents=True)
    for path in (state / "tls" / "tls.key", state / "camera" / "albums" / "1.jpg", state / ".hidden", other / "kept"):
        path.write_text("x")
    (state / "tls").chmod(0o500 if os.geteuid() == 0 else 0o700)
    (state / "link").symlink_to(other)
    (state / "camera" / "link").symlink_to(other / "kept")
    (state / "dangling").symlink_to(tmp_path / "nothing")
    return state


def test_all_goes_but_the_directory_and_what_links_lead_to(state: Path) -> None:
    assert main([str(state)]) == 0
    assert list(state.iterdir()) == []
    assert (state.parent / "other" / "kept").read_text() == "x"
    assert main([str(state)]) == 0, "again, after a container that was restarted"


def test_what_cannot_be_removed_is_told(
    state: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def unlink(path: str, *_: object, **__: object) -> None:
        raise PermissionError(1, "Operation not permitted", path)

    monkeypatch.setattr(module.os, "unlink", unlink)
    assert state / "tls" / "tls.key" in wipe(state)
    assert main([str(state)]) == 1
    said = capsys.readouterr()
    assert "tls.key is not removed" in said.err
    assert ".hidden is not removed" in said.err
    assert "files are left" in said.out


def test_it_takes_a_directory(tmp_path: Path) -> None:
    assert main([]) == 2
    assert main([str(tmp_path / "missing")]) == 2
