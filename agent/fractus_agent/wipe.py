"""Remove the state of Fractus from a node before uninstallation: `python -m fractus_agent.wipe DIRECTORY`."""

from __future__ import annotations

import errno
import os
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path


def wipe(directory: Path) -> list[Path]:
    """Remove the content of a directory. Symbolic links are removed, their targets stay.

    Errors are printed to stderr.

    Returns:
        Paths that could not be removed or read. Empty mount points stay, and are not included.
    """
    remaining: set[Path] = set()

    def on_error(path: str, error: BaseException) -> None:
        print(f"wipe: cannot remove {path}: {error}", file=sys.stderr)
        # For a directory that is not empty, its content is reported instead.
        if not (isinstance(error, OSError) and error.errno in {errno.EBUSY, errno.ENOTEMPTY}):
            remaining.add(Path(path))

    try:
        entries = list(os.scandir(directory))
    except OSError as error:
        on_error(str(directory), error)
        return sorted(remaining)
    for entry in entries:
        if entry.is_dir(follow_symlinks=False):
            shutil.rmtree(entry.path, onerror=lambda _, path, raised: on_error(path, raised[1]))
        else:
            try:
                Path(entry.path).unlink()
            except OSError as error:
                on_error(entry.path, error)
    for folder, _, names in os.walk(directory, onerror=lambda error: remaining.add(Path(error.filename))):
        remaining.update(Path(folder, name) for name in names)
    return sorted(remaining)


def main(arguments: Sequence[str] = sys.argv[1:]) -> int:
    """Wipe the given directory, and return the exit code."""
    if len(arguments) != 1 or not Path(arguments[0]).is_dir():
        print("usage: python -m fractus_agent.wipe DIRECTORY", file=sys.stderr)
        return 2
    remaining = wipe(Path(arguments[0]))
    if remaining:
        print(f"wipe: {len(remaining)} files or directories left in {arguments[0]}")
    else:
        print(f"wipe: {arguments[0]} is empty")
    return 1 if remaining else 0


if __name__ == "__main__":
    sys.exit(main())
