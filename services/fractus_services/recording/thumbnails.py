"""Prints thumbnails of recorded pictures: `python3 -m fractus_services.recording.thumbnails DIRECTORY`.

`fractus view --pictures` runs this program on a node. Recordings contain pictures as components receive them, after privacy
filters, and only their thumbnails leave the node.
"""

from __future__ import annotations

import json
import os
import time
from base64 import b64decode, b64encode
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import click
from fractus_runtime.mcap_tail import DamagedFile, Tail
from fractus_runtime.thumbnails import thumbnail

MAX_PER_SCAN = 6
"""Number of pictures of one scan that are printed. The page shows as many."""

SCAN_INTERVAL_S = 5.0
"""Interval between two scans of the directory, in seconds."""

MAX_CURRENT_AGE_S = 60.0
"""Time without writes, in seconds, after which a recording counts as part of an earlier flight."""


class PictureScanner:
    """Finds new pictures in the recordings of a directory.

    Args:
        directory: Directory of the camera service's recordings.
        after_ms: Omit pictures up to this time, in Unix milliseconds.
    """

    def __init__(self, directory: Path, after_ms: int) -> None:
        self._directory = directory
        self._after_ms = after_ms
        self._tails: dict[Path, Tail] = {}

    def scan(self) -> Iterator[tuple[int, bytes]]:
        """Yield time and thumbnail of the latest new pictures, oldest first. Damaged files and pictures are omitted."""
        latest: deque[tuple[int, str]] = deque(maxlen=MAX_PER_SCAN)
        for path in sorted(self._directory.glob("*.mcap")):
            with suppress(DamagedFile, OSError):
                if path not in self._tails and time.time() - path.stat().st_mtime > MAX_CURRENT_AGE_S:
                    continue
                for message in self._tails.setdefault(path, Tail(path)).read():
                    data = message.content.get("data")
                    is_picture = message.schema == "foxglove.CompressedImage" and isinstance(data, str)
                    if is_picture and message.time_ms > self._after_ms:
                        latest.append((message.time_ms, str(data)))
        for time_ms, data in latest:
            self._after_ms = max(self._after_ms, time_ms)
            with suppress(ValueError):
                small = thumbnail(b64decode(data, validate=True))
                if small is not None:
                    yield time_ms, small


@click.command()
@click.argument("directory", type=click.Path(path_type=Path))
@click.option("--after", "after_ms", default=0, help="Omit pictures up to this time, in Unix milliseconds.")
@click.option(
    "--seconds", default=120.0, help="End after this time, because a lost connection may not end this program."
)
def main(directory: Path, after_ms: int, seconds: float) -> None:
    """Print the thumbnails of new pictures as lines of JSON."""
    if not directory.is_dir():
        raise click.ClickException("the camera service does not record pictures; set camera.recordings.enabled=true")
    os.nice(19)  # Leave the processor to the services of the flight.
    end_s = time.monotonic() + seconds
    scanner = PictureScanner(directory, after_ms)
    while True:
        for time_ms, jpeg in scanner.scan():
            click.echo(json.dumps({"time_ms": time_ms, "jpeg": b64encode(jpeg).decode()}))
        if time.monotonic() + SCAN_INTERVAL_S > end_s:
            return
        time.sleep(SCAN_INTERVAL_S)


if __name__ == "__main__":
    main()
