"""`python -m fractus_agent.wipe DIRECTORY`: removes what Fractus keeps on a node, before Fractus leaves it."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path


def wipe(directory: Path) -> list[Path]:
    """Remove all that is in a directory, not the directory itself. What links lead to stays, and the links go.

    Returns:
        The files that are left, which could not be removed; why is said on standard error.
    """
    for entry in os.scandir(directory):
        if entry.is_dir(follow_symlinks=False):
            shutil.rmtree(entry.path, onerror=lambda _, path, raised: _tell(path, raised[1]))
        else:
            try:
                Path(entry.path).unlink()
            except OSError as error:
                _tell(entry.path, error)
    # An empty directory may be where a disk is mounted: it stays, and says nothing of anyone.
    return sorted(Path(folder, name) for folder, _, names in os.walk(directory) for name in names)


def _tell(path: str, error: BaseException) -> None:
    print(f"wipe: {path} is not removed: {error}", file=sys.stderr)


def main(arguments: Sequence[str] = sys.argv[1:]) -> int:
    """Wipe the directory that is named; returns the exit code."""
    if len(arguments) != 1 or not Path(arguments[0]).is_dir():
        print("usage: python -m fractus_agent.wipe DIRECTORY", file=sys.stderr)
        return 2
    left = wipe(Path(arguments[0]))
    print(f"wipe: {arguments[0]}: {len(left)} files are left" if left else f"wipe: {arguments[0]} is empty")
    return 1 if left else 0


if __name__ == "__main__":
    sys.exit(main())
