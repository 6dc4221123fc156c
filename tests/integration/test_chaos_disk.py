"""A disk of a node's own, and what chaos makes of it."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from pathlib import Path
from random import Random
from types import SimpleNamespace
from typing import cast

import pytest
from control_plane import wait_for
from fractus_cluster.disk import mount_disk, unmount_below
from fractus_sim.chaos.chaos_cluster import Stage
from fractus_sim.chaos.chaos_faults import FAULTS, broken
from fractus_sim.errors import ExperimentError

pytestmark = [pytest.mark.slow, pytest.mark.root]


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A mounted disk of 16 MiB."""
    target = tmp_path / "var-lib" / "fractus"
    try:
        mount_disk(tmp_path / "disk.img", target, 16 * 2**20)
        yield target
    finally:
        unmount_below(tmp_path)
        assert str(tmp_path) not in Path("/proc/self/mountinfo").read_text()


def stage_on(state: Path) -> Stage:
    return cast("Stage", SimpleNamespace(state=state, drone="drone-1"))


def append(path: Path, size: int) -> None:
    with path.open("ab") as file:
        file.write(bytes(size))


def refuses(path: Path) -> bool:
    """Whether a file may not grow by a block."""
    try:
        append(path, 4096)
    except OSError as error:
        assert error.errno == errno.ENOSPC
        return True
    return False


def test_a_full_disk_takes_nothing_until_it_is_healed(disk: Path) -> None:
    append(disk / "log", 100_000)
    append(disk / "old", 1_000_000)
    with broken(FAULTS["disk-full"], stage_on(disk), Random(1)) as said:
        assert "drone-1" in said
        assert refuses(disk / "log")
        # What is freed is taken, too.
        (disk / "old").unlink()
        wait_for(lambda: refuses(disk / "log") and os.statvfs(disk).f_bavail == 0, "the disk to be full again")
    append(disk / "log", 1_000_000)
    assert [path.name for path in disk.iterdir() if path.is_file()] == ["log"]


def test_a_disk_that_is_mounted_keeps_what_is_on_it(disk: Path, tmp_path: Path) -> None:
    append(disk / "log", 10)
    mount_disk(tmp_path / "disk.img", disk, 64 * 2**20)
    unmount_below(tmp_path)
    assert not (disk / "log").exists()
    mount_disk(tmp_path / "disk.img", disk, 64 * 2**20)
    assert (disk / "log").stat().st_size == 10


def test_the_machine_s_own_disk_is_never_filled(tmp_path: Path) -> None:
    with (
        pytest.raises(ExperimentError, match="no disk of its own"),
        broken(FAULTS["disk-full"], stage_on(tmp_path), Random(1)),
    ):
        pass
    assert list(tmp_path.iterdir()) == []
