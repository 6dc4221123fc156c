"""Disk of a node: a separate file system that can be full while the machine's disk is not."""

from __future__ import annotations

from pathlib import Path

from fractus_cluster.commands import run


def mount_disk(image: Path, target: Path, size_bytes: int) -> None:
    """Mount an image file as a disk unless the target is already a mount point. Create the file if it is missing.

    No blocks are reserved for root, so the disk can be filled completely.

    Args:
        image: Image file. An existing file keeps its size.
        target: Mount point. It is created if it is missing.
        size_bytes: Size of a new file.

    Raises:
        ClusterError: No loop device or no space is available.
    """
    if target.is_mount():
        return
    if not image.exists():
        new = image.with_suffix(".new")
        with new.open("wb") as file:
            file.truncate(size_bytes)
        run(["mkfs.ext4", "-q", "-F", "-m", "0", new])
        new.replace(image)
    target.mkdir(parents=True, exist_ok=True)
    run(["mount", "-o", "loop,nosuid,nodev", image, target])


def unmount_below(directory: Path) -> None:
    """Unmount everything that is mounted below a directory, including mounts of an interrupted command.

    Raises:
        ClusterError: A file system cannot be unmounted.
    """
    lines = Path("/proc/self/mountinfo").read_text().splitlines()
    mounted = [Path(line.split(" ")[4].replace("\\040", " ")) for line in lines]
    for target in reversed(mounted):
        if target.is_relative_to(directory):
            # With --lazy, a program that has a file open cannot prevent the removal of the cluster.
            run(["umount", "--lazy", target])
