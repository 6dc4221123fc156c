"""Bounded reading of regular files, and atomic and durable file replacement."""

from __future__ import annotations

import contextlib
import errno
import glob
import json
import os
import shutil
import stat
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

MAX_FILE_BYTES = 16 * 2**20
"""Default limit of the size of a file that is read whole, in bytes."""
MAX_JSON_DEPTH = 100
"""Maximum nesting of JSON from a file or a peer. Interpreters fail at different depths from about 300 on."""

CURRENT = "..data"
"""Symbolic link to the directory with the current set of files, as in the kubelet's Secret volumes."""


class UnsuitableFile(OSError):
    """The path is not a regular file (for example a FIFO or a device), or the file is too large."""


def open_regular(path: Path, flags: int = os.O_RDONLY, mode: int = 0o600) -> int:
    """Open a regular file and return its descriptor. Symbolic links are followed.

    Opening never blocks. A FIFO would block until it has a writer, and a device may react to being opened.

    Raises:
        UnsuitableFile: The path is not a regular file.
        IsADirectoryError: The path is a directory.
        OSError: The file cannot be opened.
    """
    with contextlib.suppress(FileNotFoundError):
        _check_regular(path, path.stat())
    descriptor = os.open(path, flags | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC, mode)
    try:
        _check_regular(path, os.fstat(descriptor))  # the path may have been replaced since the first check
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def open_file(path: Path) -> IO[bytes]:
    """Open a regular file for reading. See `open_regular`."""
    return os.fdopen(open_regular(path), "rb")


def check_regular(path: Path) -> None:
    """Check a file that a library opens by its path. See `open_regular`."""
    _check_regular(path, path.stat())


def read_file(path: Path, max_bytes: int = MAX_FILE_BYTES) -> bytes:
    """Return the content of a regular file. See `open_regular`.

    Args:
        path: File to read.
        max_bytes: Maximum size.

    Raises:
        UnsuitableFile: The path is not a regular file, or the file is too large.
        OSError: The file cannot be read.
    """
    with open_file(path) as file:
        too_large = os.fstat(file.fileno()).st_size > max_bytes
        content = b"" if too_large else file.read(max_bytes + 1)
    if too_large or len(content) > max_bytes:
        raise UnsuitableFile(errno.EFBIG, f"is larger than {max_bytes} bytes", str(path))
    return content


def read_json(path: Path, max_bytes: int = MAX_FILE_BYTES) -> Any:
    """Return the JSON value in a regular file. See `read_file` and `parse_json`.

    Raises:
        OSError: The file cannot be read.
        ValueError: The content is not JSON, or is nested too deeply.
    """
    return parse_json(read_file(path, max_bytes))


def parse_json(content: bytes | str) -> Any:
    """Return a JSON value from a file or a peer.

    Raises:
        ValueError: The content is not JSON, or is nested more than `MAX_JSON_DEPTH` levels deep.
    """
    try:
        value = json.loads(content)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    level = [value]
    for _ in range(MAX_JSON_DEPTH):
        collections = [item for item in level if isinstance(item, dict | list)]
        if not collections:
            return value
        level = [child for item in collections for child in (item.values() if isinstance(item, dict) else item)]
    if any(isinstance(item, dict | list) for item in level):
        raise ValueError("nested too deeply")
    return value


def list_files(directory: Path, suffix: str) -> list[Path]:
    """Return the files of a directory whose names end with a suffix, in the order of their names.

    `Path.glob` is not used, because it lists a directory that cannot be read as empty.

    Raises:
        OSError: The directory cannot be listed.
    """
    with os.scandir(directory) as entries:
        return sorted(directory / entry.name for entry in entries if entry.name.endswith(suffix))


def path_text(path: Path | str) -> str:
    """Return a path as text that can be logged and sent. Bytes of a name that is not UTF-8 are escaped."""
    return os.fsencode(path).decode(errors="backslashreplace")


def _check_regular(path: Path, status: os.stat_result) -> None:
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(status.st_mode):
        raise UnsuitableFile(errno.EINVAL, "is not a regular file", str(path))


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


def remove_temporary_files(directory: Path) -> None:
    """Remove the temporary files of all files of a directory. Call it only from the only writer of the directory."""
    for leftover in directory.glob(".*.tmp"):
        with contextlib.suppress(OSError):
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
    # If `former` was already a name of the same file, the rename had no effect and `spare` still exists.
    spare.unlink(missing_ok=True)


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

    Each name is a symbolic link through `..data`. Replacing that link changes all files at once. If the directory has the
    set-group-ID bit, its owner shares the files with its group, so the group may read them.

    Raises:
        OSError: The disk is full, read-only or missing. The old set is unchanged.
    """
    directory.mkdir(parents=True, exist_ok=True)
    shared = bool(directory.stat().st_mode & stat.S_ISGID)
    if shared:
        mode |= stat.S_IRGRP
    fresh = directory / f"..{uuid.uuid4().hex}"
    try:
        fresh.mkdir(mode=0o750 if shared else 0o700)
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
        return {name: read_file(current / name) for name in names}
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
