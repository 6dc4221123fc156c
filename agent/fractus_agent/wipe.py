"""`python -m fractus_agent.wipe DIRECTORY`: removes what Fractus keeps on a node, before Fractus leaves it."""

from __future__ import annotations

import errno
import os
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path


def wipe(directory: Path) -> list[Path]:
    """Remove all that is in a directory, not the directory itself. What links lead to stays, and the links go.

    Returns:
        What is left, for it could not be removed, or not even be read; why is said on standard error. Empty directories where
        disks are mounted stay, and are not among it.
    """
    left: set[Path] = set()

    def refused(path: str, error: BaseException) -> None:
        print(f"wipe: {path} is not removed: {error}", file=sys.stderr)
        # Of a directory that is not empty, what is in it counts.
        if not (isinstance(error, OSError) and error.errno in {errno.EBUSY, errno.ENOTEMPTY}):
            left.add(Path(path))

    try:
        entries = list(os.scandir(directory))
    except OSError as error:
        refused(str(directory), error)
        return sorted(left)
    for entry in entries:
        if entry.is_dir(follow_symlinks=False):
            shutil.rmtree(entry.path, onerror=lambda _, path, raised: refused(path, raised[1]))
        else:
            try:
                Path(entry.path).unlink()
            except OSError as error:
                refused(entry.path, error)
    for folder, _, names in os.walk(directory, onerror=lambda error: left.add(Path(error.filename))):
        left.update(Path(folder, name) for name in names)
    return sorted(left)


def main(arguments: Sequence[str] = sys.argv[1:]) -> int:
    """Wipe the directory that is named; returns the exit code."""
    if len(arguments) != 1 or not Path(arguments[0]).is_dir():
        print("usage: python -m fractus_agent.wipe DIRECTORY", file=sys.stderr)
        return 2
    left = wipe(Path(arguments[0]))
    print(f"wipe: {arguments[0]}: {len(left)} files or folders are left" if left else f"wipe: {arguments[0]} is empty")
    return 1 if left else 0


if __name__ == "__main__":
    sys.exit(main())
