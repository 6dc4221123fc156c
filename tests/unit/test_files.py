"""Atomic file replacement despite kills, full disks and power failures."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from fractus_runtime import files as module
from fractus_runtime.files import read_set, remove_temporary, write_file, write_set


def stopped_at(call: int, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Raise KeyboardInterrupt at the given file operation, as if the process was killed there.

    Return the list to which completed operations are added.
    """
    steps: list[str] = []

    def step(name: str, real: Callable[..., object]) -> Callable[..., object]:
        def run(*args: object, **named: object) -> object:
            if len(steps) == call:
                raise KeyboardInterrupt
            steps.append(name)
            return real(*args, **named)

        return run

    for name in ("replace", "hardlink_to", "unlink"):
        monkeypatch.setattr(module.Path, name, step(name, getattr(Path, name)))
    return steps


def test_write_file_never_leaves_the_path_without_a_file(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    former = tmp_path / "a.last.json"
    for call in range(10):
        for file in tmp_path.iterdir():
            file.unlink()
        write_file(path, b"1", former=former)
        write_file(path, b"2", former=former)
        with pytest.MonkeyPatch.context() as patch:
            steps = stopped_at(call, patch)
            try:
                write_file(path, b"3", former=former)
            except KeyboardInterrupt:
                done = False
            else:
                done = True
        assert path.read_bytes() in {b"2", b"3"}, steps
        assert former.read_bytes() in {b"1", b"2"}, steps
        write_file(path, b"4", former=former)
        assert former.read_bytes() in {b"2", b"3"}
        remove_temporary(path)
        assert sorted(file.name for file in tmp_path.iterdir()) == ["a.json", "a.last.json"]
        if done:
            return
    raise AssertionError("write_file did not complete with any number of operations")


def test_write_file_keeps_the_previous_file_without_hard_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(module.Path, "hardlink_to", refuse)
    path = tmp_path / "a"
    former = tmp_path / "b"
    for content in (b"1", b"2", b"3"):
        write_file(path, content, former=former)
    assert (path.read_bytes(), former.read_bytes()) == (b"3", b"2")


def test_remove_temporary_removes_only_files_of_its_path(tmp_path: Path) -> None:
    others = [".b.json.1.tmp", ".a.json", "a.json", "a.json.tmp", ".aXjson.1.tmp"]
    for name in (".a.json.1.tmp", ".a.json.2.tmp", *others):
        (tmp_path / name).touch()
    remove_temporary(tmp_path / "a.json")
    assert sorted(file.name for file in tmp_path.iterdir()) == sorted(others)
    remove_temporary(tmp_path / "none" / "a.json")


@pytest.mark.parametrize("failing", ["write", "fsync", "symlink"])
def test_write_set_leaves_no_copy_of_a_key_on_a_full_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    names = ("tls.key", "tls.crt")
    write_set(tmp_path, dict.fromkeys(names, b"old"))
    before = sorted(tmp_path.rglob("*"))

    def full(*_: object, **_named: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        if failing == "symlink":
            patch.setattr(module.Path, "symlink_to", full)
        else:
            patch.setattr(module.os, failing, full)
        for _ in range(3):
            with pytest.raises(OSError, match="No space left"):
                write_set(tmp_path, dict.fromkeys(names, b"new"))
    assert sorted(tmp_path.rglob("*")) == before
    assert read_set(tmp_path, names) == dict.fromkeys(names, b"old")
    write_set(tmp_path, dict.fromkeys(names, b"new"))
    assert read_set(tmp_path, names) == dict.fromkeys(names, b"new")
    assert len([path for path in tmp_path.iterdir() if path.is_dir() and not path.is_symlink()]) == 1
    assert (tmp_path / "tls.key").stat().st_mode & 0o777 == 0o600


def test_write_set_lets_the_group_of_a_shared_directory_read(tmp_path: Path) -> None:
    tmp_path.chmod(0o2755)
    write_set(tmp_path, {"tls.key": b"key"})
    assert (tmp_path / "tls.key").stat().st_mode & 0o777 == 0o640
    assert (tmp_path / "tls.key").resolve().parent.stat().st_mode & 0o777 == 0o750
