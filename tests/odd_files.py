"""Paths that are not readable regular files, for tests of all functions that read files."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable
from pathlib import Path

import pytest


def _fifo(path: Path) -> None:
    os.mkfifo(path)


def _linked_fifo(path: Path) -> None:
    os.mkfifo(path.with_name("target-of-link"))
    path.symlink_to("target-of-link")


def _linked_device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def _huge(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(10**10)  # a sparse file takes no space


def _socket(path: Path) -> None:
    os.mknod(path, stat.S_IFSOCK | 0o600)


ODD: dict[str, Callable[[Path], None]] = {
    "fifo": _fifo,
    "link-to-fifo": _linked_fifo,
    "link-to-device": _linked_device,
    "huge": _huge,
    "socket": _socket,
}

odd_files = pytest.mark.parametrize("make_odd", ODD.values(), ids=ODD.keys())
"""Run a test with each kind of odd file. The argument `make_odd` creates it at a path."""
