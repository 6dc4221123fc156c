"""Removal of the state of a node when Fractus is uninstalled."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from fractus_agent import wipe as module
from fractus_agent.wipe import main, wipe


@pytest.fixture
def state(tmp_path: Path) -> Path:
    """Create a state directory with symbolic links to files of another program."""
    state = tmp_path / "fractus"
    other = tmp_path / "other"
    for folder in (state / "tls", state / "camera" / "albums", other):
        folder.mkdir(parents=True)
    for path in (state / "tls" / "tls.key", state / "camera" / "albums" / "1.jpg", state / ".hidden", other / "kept"):
        path.write_text("x")
    (state / "tls").chmod(0o500 if os.geteuid() == 0 else 0o700)
    (state / "link").symlink_to(other)
    (state / "camera" / "link").symlink_to(other / "kept")
    (state / "dangling").symlink_to(tmp_path / "nothing")
    return state


def test_wipe_removes_all_except_the_directory_and_link_targets(state: Path) -> None:
    assert main([str(state)]) == 0
    assert list(state.iterdir()) == []
    assert (state.parent / "other" / "kept").read_text() == "x"
    assert main([str(state)]) == 0, "a second run, for example after a container restart, succeeds"


def test_wipe_reports_files_that_cannot_be_removed(
    state: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def unlink(path: str, *_: object, **__: object) -> None:
        raise PermissionError(1, "Operation not permitted", path)

    monkeypatch.setattr(module.os, "unlink", unlink)
    assert state / "tls" / "tls.key" in wipe(state)
    assert main([str(state)]) == 1
    output = capsys.readouterr()
    assert f"wipe: cannot remove {state}/tls/tls.key: " in output.err
    assert f"wipe: cannot remove {state}/.hidden: " in output.err
    assert "directories left in" in output.out


@pytest.fixture
def unprivileged(state: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Run the test without root privileges, like the wipe pod."""
    monkeypatch.chdir(tmp_path)  # the test uses relative paths, because other users cannot access the absolute path
    (state / "tls").chmod(0o700)
    if os.geteuid() != 0:
        yield
        return
    for path in (tmp_path, *tmp_path.rglob("*")):
        os.lchown(path, 65534, 65534)
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)


@pytest.mark.parametrize("folder", ["tls", "camera/albums", "."])
def test_wipe_reports_directories_that_cannot_be_read(
    state: Path, folder: str, unprivileged: None, capsys: pytest.CaptureFixture[str]
) -> None:
    """The directory is not readable, like a directory of another user with mode 0700."""
    (state.relative_to(Path.cwd()) / folder).chmod(0)
    try:
        assert main(["fractus"]) == 1
        output = capsys.readouterr()
        directory = f"fractus/{folder}".removesuffix("/.")
        assert f"wipe: cannot remove {directory}: " in output.err
        assert "is empty" not in output.out
    finally:
        (Path("fractus") / folder).chmod(0o700)


@pytest.mark.parametrize(("number", "code"), [(errno.EBUSY, 0), (errno.EPERM, 1)])
def test_wipe_reports_remaining_directories_except_mount_points(
    state: Path, monkeypatch: pytest.MonkeyPatch, number: int, code: int
) -> None:
    """The mount point of a disk cannot be removed (EBUSY), so only the data on the disk is removed."""
    rmdir = os.rmdir

    def refused(path: str, *, dir_fd: int | None = None) -> None:
        if Path(path).name == "albums":
            raise OSError(number, os.strerror(number), path)
        rmdir(path, dir_fd=dir_fd)

    monkeypatch.setattr(module.os, "rmdir", refused)
    assert main([str(state)]) == code
    assert [path for path in state.rglob("*") if not path.is_dir()] == []


def test_wipe_requires_an_existing_directory(tmp_path: Path) -> None:
    assert main([]) == 2
    assert main([str(tmp_path / "missing")]) == 2
