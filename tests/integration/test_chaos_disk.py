"""The separate disk of a node, and the chaos fault that fills it."""

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
from fractus_sim.chaos.chaos_cluster import ChaosTarget
from fractus_sim.chaos.chaos_faults import FAULTS, inject
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


def target_on(state: Path) -> ChaosTarget:
    return cast("ChaosTarget", SimpleNamespace(state=state, drone="drone-1"))


def append(path: Path, size: int) -> None:
    with path.open("ab") as file:
        file.write(bytes(size))


def is_full(path: Path) -> bool:
    """Return True if a file cannot grow by a block."""
    try:
        append(path, 4096)
    except OSError as error:
        assert error.errno == errno.ENOSPC
        return True
    return False


def test_chaos_disk_fault_leaves_no_space_until_it_ends(disk: Path) -> None:
    append(disk / "log", 100_000)
    append(disk / "old", 1_000_000)
    with inject(FAULTS["disk-full"], target_on(disk), Random(1)) as description:
        assert "drone-1" in description
        assert is_full(disk / "log")
        # Space that is freed during the fault is filled as well.
        (disk / "old").unlink()
        wait_for(lambda: is_full(disk / "log") and os.statvfs(disk).f_bavail == 0, "the disk to be full again")
    append(disk / "log", 1_000_000)
    assert [path.name for path in disk.iterdir() if path.is_file()] == ["log"]


def test_node_disk_keeps_its_content_when_mounted_again(disk: Path, tmp_path: Path) -> None:
    append(disk / "log", 10)
    mount_disk(tmp_path / "disk.img", disk, 64 * 2**20)
    unmount_below(tmp_path)
    assert not (disk / "log").exists()
    mount_disk(tmp_path / "disk.img", disk, 64 * 2**20)
    assert (disk / "log").stat().st_size == 10


def test_chaos_disk_fault_is_rejected_on_the_disk_of_the_machine(tmp_path: Path) -> None:
    with (
        pytest.raises(ExperimentError, match="has no separate disk"),
        inject(FAULTS["disk-full"], target_on(tmp_path), Random(1)),
    ):
        pass
    assert list(tmp_path.iterdir()) == []
