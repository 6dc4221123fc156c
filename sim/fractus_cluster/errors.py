"""Errors of the embedded cluster."""

from __future__ import annotations


class ClusterError(Exception):
    """An error of the embedded cluster. The message contains the problem, its place and a remedy."""

    exit_code = 1
    """Exit code of the command."""


class PrerequisiteError(ClusterError):
    """A prerequisite of the embedded cluster is missing on the machine."""

    exit_code = 3
