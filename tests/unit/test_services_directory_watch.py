"""Changes of a directory, as the kernel tells them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

import pytest
from fractus_services.directory_watch import DirectoryWatch


def written(path: Path) -> None:
    path.write_text("again")


def replaced(path: Path) -> None:
    other = path.with_suffix(".new")
    other.write_text("other")
    other.rename(path)


def removed(path: Path) -> None:
    path.unlink()


@pytest.mark.parametrize("change", [written, replaced, removed])
async def test_a_change_is_told_once(tmp_path: Path, change: Callable[[Path], None]) -> None:
    file = tmp_path / "grant.json"
    file.write_text("first")
    with DirectoryWatch(tmp_path) as watch:
        await watch.changed(0.0)
        change(file)
        async with asyncio.timeout(30.0):
            await watch.changed(3600.0)
        told_again = asyncio.ensure_future(watch.changed(3600.0))
        done, _ = await asyncio.wait([told_again], timeout=0.3)
        assert not done
        told_again.cancel()
        await asyncio.gather(told_again, return_exceptions=True)


async def test_a_directory_that_was_made_again_is_watched(tmp_path: Path) -> None:
    directory = tmp_path / "grants"
    directory.mkdir()
    with DirectoryWatch(directory) as watch:
        await watch.changed(0.0)
        directory.rmdir()
        async with asyncio.timeout(30.0):
            directory.mkdir()
            await watch.changed(3600.0)
            later = asyncio.ensure_future(watch.changed(3600.0))
            while not later.done():
                (directory / "grant.json").write_text("first")
                await asyncio.wait([later], timeout=0.2)


async def test_what_is_not_there_cannot_be_watched(tmp_path: Path) -> None:
    with DirectoryWatch(tmp_path / "grants") as watch, pytest.raises(FileNotFoundError, match="grants"):
        await watch.changed(1.0)
