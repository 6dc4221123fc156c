"""Counts of taken and refused pictures, which the agent reports with the outcome of a mission."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterable
from pathlib import Path

from fractus_runtime.files import read_json, write_file

_MAX_BYTES = 64 * 1024

log = logging.getLogger(__name__)


class PictureCounts:
    """Counts pictures by Grant in a file. The counts of a Grant continue after a restart, and are dropped with the Grant.

    Args:
        file: JSON object: numbers of taken and refused pictures by key of the Grant.
        active: Returns the keys of the Grants in force.
    """

    def __init__(self, file: Path, active: Callable[[], Iterable[str]]) -> None:
        self._file = file
        self._active = active
        self._counts: dict[str, list[int]] = {}
        try:
            known = read_json(file, _MAX_BYTES)
            self._counts = {str(key): [int(taken), int(refused)] for key, (taken, refused) in known.items()}
        except FileNotFoundError:
            pass
        except (OSError, ValueError, TypeError, AttributeError) as error:
            log.warning("pictures: counts of the former process not read (error=%s)", error)

    def count(self, key: str, *, refused: bool) -> None:
        """Count a picture. A failure to write the file does not affect the picture."""
        active = {key, *self._active()}
        self._counts = {known: counts for known, counts in self._counts.items() if known in active}
        self._counts.setdefault(key, [0, 0])[refused] += 1
        try:
            write_file(self._file, json.dumps(self._counts).encode(), durable=False)
        except OSError as error:
            log.warning("pictures: counts not written (error=%s)", error)
