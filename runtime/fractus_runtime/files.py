"""Atomic and durable file replacement."""

from __future__ import annotations

import contextlib
import glob
import os
import shutil
import uuid
from collections.abc import Mapping
from pathlib import Path

CURRENT = "..data"
"""Symbolic link to the directory with the current set of files, as in the kubelet's Secret volumes."""


def write_file(
    path: Path, content: bytes, mode: int = 0o600, *, former: Path | None = None, durable: bool = True
) -> None:
    """Replace a file atomically and wait until it is on disk.

    Each call writes a temporary file whose name begins with a dot and ends in .tmp. `remove_temporary` removes temporary files
    that a killed process left.

    Args:
        path: File to replace. If several processes write it at the same time, the last one wins.
        content: New content.
        mode: Permissions, independent of the umask.
        former: Path that keeps the previous file, if there was one. `path` exists all the time.
        durable: False to replace atomically without waiting for the disk, for content that can be recreated.

    Raises:
        OSError: The disk is full, read-only or missing. The old content is unchanged.
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
    """Remove the temporary files that killed writers of a file left. Call it only from the only writer of the file."""
    with contextlib.suppress(OSError):
        for leftover in path.parent.glob(f".{glob.escape(path.name)}.*.tmp"):
            leftover.unlink(missing_ok=True)


def _keep(path: Path, former: Path) -> None:
    """Give a file a second name atomically."""
    spare = _temporary(path)
    try:
        spare.hardlink_to(path)
    except FileNotFoundError:
        raise
    except OSError:  # a file system without hard links
        path.replace(former)
        return
    spare.replace(former)
    spare.unlink(missing_ok=True)  # the rename had no effect if both were names of the same file


def remove_file(path: Path) -> bool:
    """Remove a file and wait until the removal is on disk. Return False if the file did not exist."""
    try:
        path.unlink()
    except FileNotFoundError:
        return False
    _sync_directory(path.parent)
    return True


def write_set(directory: Path, files: Mapping[str, bytes], mode: int = 0o600) -> None:
    """Replace a set of files atomically.

    Each name is a symbolic link through `..data`. Replacing that link changes all files at once.

    Raises:
        OSError: The disk is full, read-only or missing. The old set is unchanged.
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
        # Failed attempts must not leave copies of a key.
        shutil.rmtree(fresh, ignore_errors=True)
        raise
    for name in files:
        target = f"{CURRENT}/{name}"
        if not (directory / name).is_symlink() or str((directory / name).readlink()) != target:
            _link(directory / name, target)
    _sync_directory(directory)
    for leftover in directory.glob("..*"):
        if leftover.is_dir() and not leftover.is_symlink() and leftover != fresh:
            shutil.rmtree(leftover, ignore_errors=True)


def read_set(directory: Path, names: tuple[str, ...]) -> dict[str, bytes] | None:
    """Return the files of a set that were written together, or None if a file is missing."""
    try:
        current = (directory / CURRENT).resolve(strict=True)
        return {name: (current / name).read_bytes() for name in names}
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
