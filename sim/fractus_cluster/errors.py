"""What can go wrong with an embedded cluster, as one exception whose text says what to do."""

from __future__ import annotations


class ClusterError(Exception):
    """Something the caller can act on: what was wrong, where, and what to do about it."""

    exit_code = 1
    """Of the command that it ends."""


class PrerequisiteError(ClusterError):
    """The machine lacks something that the embedded cluster needs."""

    exit_code = 3
