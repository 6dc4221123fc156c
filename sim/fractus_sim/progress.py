"""Progress output of runs: one line per event, and a status line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


def ignore(_line: str) -> None:
    """Discard a progress line."""


@dataclass(frozen=True)
class Progress:
    """Callbacks for the progress of a run.

    Attributes:
        report: Called with one line per event.
        show: Called with the current state a few times per second.
    """

    report: Callable[[str], None] = ignore
    show: Callable[[str], None] = ignore
