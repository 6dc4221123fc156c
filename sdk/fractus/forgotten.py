"""Detection of motions and missions that a program creates and forgets to await."""

from __future__ import annotations

import os
import sys
import warnings
from pathlib import Path

from fractus.errors import InvalidRequest

_PACKAGE = f"{Path(__file__).parent}{os.sep}"


class Pending:
    """Warns if it is discarded before `begin` was called.

    Args:
        name: Name of the call, for the warning.
        forgotten: List to which the text of the warning is added.
    """

    def __init__(self, name: str, forgotten: list[str]) -> None:
        self._begun = False
        self._name = name
        self._forgotten = forgotten
        self._file, self._line = _caller()

    def begin(self) -> None:
        """Record that the call was awaited or iterated."""
        self._begun = True

    def __del__(self) -> None:
        if self._begun or sys.is_finalizing():
            return
        text = (
            f"{self._name} was not awaited, so the drone does not carry it out: write `await drone.{self._name}(...)`"
        )
        self._forgotten.append(f"{self._file}:{self._line}: {text}")
        warnings.warn_explicit(text, RuntimeWarning, self._file, self._line)


def check_forgotten(forgotten: list[str]) -> None:
    """Check that no call was forgotten. Each forgotten call is reported once.

    Raises:
        InvalidRequest: A call was forgotten.
    """
    if forgotten:
        text = "; ".join(forgotten)
        forgotten.clear()
        raise InvalidRequest(text)


def _caller() -> tuple[str, int]:
    """Return file and line of the call from outside of the SDK."""
    frame = sys._getframe(1)
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_PACKAGE):
        frame = frame.f_back
    return frame.f_code.co_filename, frame.f_lineno
