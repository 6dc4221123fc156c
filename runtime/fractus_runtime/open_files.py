"""Limit of open files of this process. Every connection takes one descriptor, and a process without any cannot read files."""

from __future__ import annotations

import contextlib
import resource

REQUIRED = 1_024
"""Minimum limit of a server: its connections take about half of it."""
_SUFFICIENT = 65_536


class TooFewOpenFiles(Exception):
    """The limit of open files is too low for a server. The message contains the remedy."""


def raise_open_files() -> int:
    """Raise the limit of open files as far as this process may, and return it.

    Raises:
        TooFewOpenFiles: The limit is below `REQUIRED`.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _SUFFICIENT if hard == resource.RLIM_INFINITY else min(hard, _SUFFICIENT)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
            soft = wanted
    limit = _SUFFICIENT if soft == resource.RLIM_INFINITY else soft
    if limit < REQUIRED:
        raise TooFewOpenFiles(
            f"the limit of open files is {limit}; raise it to at least {REQUIRED} (`ulimit -n`, or LimitNOFILE= of systemd)"
        )
    return limit
