"""The disk of a node: a file system of its own, which can be full without the machine's disk being so."""

from __future__ import annotations

from pathlib import Path

from fractus_cluster.commands import run


def mount_disk(image: Path, target: Path, size_bytes: int) -> None:
    """Mount a file as a disk, and make it where it is missing; a no-op where it is mounted.

    Root has no blocks of its own on it: it can be filled to the last one.

    Args:
        image: The file; it keeps its size.
        target: Where its content is; a directory that need not be there.
        size_bytes: How large it is made.

    Raises:
        ClusterError: The machine has no loop devices, or no room.
    """
    if target.is_mount():
        return
    if not image.exists():
        making = image.with_suffix(".making")
        with making.open("wb") as file:
            file.truncate(size_bytes)
        run(["mkfs.ext4", "-q", "-F", "-m", "0", making])
        making.replace(image)
    target.mkdir(parents=True, exist_ok=True)
    run(["mount", "-o", "loop,nosuid,nodev", image, target])


def unmount_below(directory: Path) -> None:
    """Unmount all that is mounted below a directory, also by a command that was interrupted.

    Raises:
        ClusterError: Something cannot be unmounted.
    """
    lines = Path("/proc/self/mountinfo").read_text().splitlines()
    mounted = [Path(line.split(" ")[4].replace("\\040", " ")) for line in lines]
    for target in reversed(mounted):
        if target.is_relative_to(directory):
            # Lazily: a program that still has a file of it open must not keep the rest from being taken away.
            run(["umount", "--lazy", target])
