"""Writing files in one step, and waiting until they are on the disk."""

from __future__ import annotations

import contextlib
import glob
import os
import shutil
import uuid
from collections.abc import Mapping
from pathlib import Path

CURRENT = "..data"
"""Symbolic link to the directory that holds the current set of files (as kubelet does for Secret volumes)."""


def write_file(
    path: Path, content: bytes, mode: int = 0o600, *, former: Path | None = None, durable: bool = True
) -> None:
    """Replace a file in one step and wait until it is on the disk.

    Temporary files begin with a dot and end in .tmp; each call has its own. What a kill leaves of them, `remove_temporary`
    removes.

    Args:
        path: The file; one process writes it at a time, unless it does not matter whose content stays.
        content: What it will hold.
        mode: Its permissions, whatever the umask.
        former: Where the file as it was is kept, unless there was none; meanwhile the file is there, too.
        durable: False for what can be made again: in one step, but without waiting for the disk.

    Raises:
        OSError: the disk is full, read-only or gone; the old content is untouched.
    """
    temporary = _temporary(path)
    try:
        _write_new(temporary, content, mode, durable=durable)
        if former is not None:
            with contextlib.suppress(FileNotFoundError):
                _keep(path, former)
        temporary.replace(path)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise
    if durable:
        _sync_directory(path.parent)


def remove_temporary(path: Path) -> None:
    """Remove what killed writers of a file left beside it, where that can be; only its one writer may ask for it."""
    with contextlib.suppress(OSError):
        for left in path.parent.glob(f".{glob.escape(path.name)}.*.tmp"):
            left.unlink(missing_ok=True)


def _keep(path: Path, former: Path) -> None:
    """Give a file a second name, in one step."""
    spare = _temporary(path)
    try:
        spare.hardlink_to(path)
    except FileNotFoundError:
        raise
    except OSError:  # a file system without hard links
        path.replace(former)
        return
    spare.replace(former)
    spare.unlink(missing_ok=True)  # where both were the same file already, nothing was renamed


def remove_file(path: Path) -> bool:
    """Remove a file and wait until that is on the disk; False when it was not there."""
    try:
        path.unlink()
    except FileNotFoundError:
        return False
    _sync_directory(path.parent)
    return True


def write_set(directory: Path, files: Mapping[str, bytes], mode: int = 0o600) -> None:
    """Replace several files that belong together in one step.

    Each name becomes a symbolic link through `..data`, and the swap of that one link changes all of them at once.
    """
    directory.mkdir(parents=True, exist_ok=True)
    fresh = directory / f"..{uuid.uuid4().hex}"
    try:
        fresh.mkdir(mode=0o700)
        for name, content in files.items():
            _write_new(fresh / name, content, mode)
        _sync_directory(fresh)
        _link(directory / CURRENT, fresh.name)
    except OSError:
        # A key must not be left behind by each attempt.
        shutil.rmtree(fresh, ignore_errors=True)
        raise
    for name in files:
        target = f"{CURRENT}/{name}"
        if not (directory / name).is_symlink() or str((directory / name).readlink()) != target:
            _link(directory / name, target)
    _sync_directory(directory)
    for left in directory.glob("..*"):
        if left.is_dir() and not left.is_symlink() and left != fresh:
            shutil.rmtree(left, ignore_errors=True)


def read_set(directory: Path, names: tuple[str, ...]) -> dict[str, bytes] | None:
    """Read files written together; None when one of them is missing."""
    try:
        home = (directory / CURRENT).resolve(strict=True)
        return {name: (home / name).read_bytes() for name in names}
    except FileNotFoundError:
        return None


def _temporary(path: Path) -> Path:
    return path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")


def _write_new(path: Path, content: bytes, mode: int, *, durable: bool = True) -> None:
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW, mode)
    try:
        os.fchmod(handle, mode)
        view = memoryview(content)
        while view:
            view = view[os.write(handle, view) :]
        if durable:
            os.fsync(handle)
    finally:
        os.close(handle)


def _link(path: Path, target: str) -> None:
    temporary = path.with_name(f"{path.name}_tmp")
    temporary.unlink(missing_ok=True)
    temporary.symlink_to(target)
    temporary.replace(path)


def _sync_directory(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
