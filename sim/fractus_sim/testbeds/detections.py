"""Comparison of a program's detections with the objects in view of the camera world."""

from __future__ import annotations

import json
import logging
import threading
import urllib.error
import urllib.request
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fractus_core.api.geometry import Point
from fractus_core.geo import geodesic_m

FILE = "detections.jsonl"
VARIABLE = "FRACTUS_EXPERIMENT_DETECTIONS"
POLL_S = 0.5
ANSWER_S = 2.0
log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Seen:
    """An object in a picture, or a detection of a program."""

    kind: str
    lat: float
    lon: float
    name: str = ""


@dataclass(frozen=True, slots=True)
class Score:
    """Numbers of detections, matching detections, objects in view, and detected objects."""

    detections: int
    right: int
    objects: int
    found: int

    @property
    def precision(self) -> float:
        """Share of detections that match an object. 1 if there are no detections."""
        return self.right / self.detections if self.detections else 1.0

    @property
    def recall(self) -> float:
        """Share of objects that were detected. 1 if there are no objects."""
        return self.found / self.objects if self.objects else 1.0


def score(detections: Sequence[Seen], truths: Sequence[Seen], kind: str, radius_m: float) -> Score:
    """Match detections of one class with the objects of that class.

    Args:
        detections: Detections of the program.
        truths: Objects of each picture. A moving object appears once per position.
        kind: Class to compare.
        radius_m: Maximum distance between a detection and its object.
    """
    wanted = [truth for truth in truths if truth.kind == kind]
    given = [detection for detection in detections if detection.kind == kind]
    hits = [{truth.name for truth in wanted if _apart_m(truth, one) <= radius_m} for one in given]
    found = set().union(*hits) if hits else set()
    return Score(len(given), sum(bool(hit) for hit in hits), len({truth.name for truth in wanted}), len(found))


def _apart_m(one: Seen, other: Seen) -> float:
    return geodesic_m(Point(lat=one.lat, lon=one.lon), Point(lat=other.lat, lon=other.lon))


def read_detections(lines: Iterable[str]) -> list[Seen]:
    """Parse detections, one JSON object per line. Malformed lines are logged and ignored."""
    found = []
    for number, line in enumerate(lines, 1):
        try:
            entry = json.loads(line)
            found.append(Seen(str(entry["class"]), float(entry["lat"]), float(entry["lon"])))
        except (ValueError, KeyError, TypeError) as error:
            log.warning("experiment: malformed detection ignored (file=%s line=%d error=%s)", FILE, number, error)
    return found


class TruthWatch:
    """Records the objects in view of a camera world at each snapshot, polling twice a second."""

    def __init__(self, url: str, path: Path) -> None:
        self.seen: list[Seen] = []
        self._url = f"{url}/truth.json"
        self._path = path
        self._last: object = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="truth", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop polling."""
        self._stop.set()
        self._thread.join(2 * ANSWER_S)

    def _run(self) -> None:
        with self._path.open("w") as file:
            while not self._stop.wait(POLL_S):
                truth = self._ask()
                if truth is not None and truth.get("snapshot") != self._last:
                    self._last = truth.get("snapshot")
                    file.write(json.dumps(truth) + "\n")
                    file.flush()
                    self.seen += seen_in(truth)

    def _ask(self) -> Mapping[str, Any] | None:
        """Return the truth of the last snapshot, or None if there is no snapshot or the request fails."""
        try:
            with urllib.request.urlopen(self._url, timeout=ANSWER_S) as answer:  # nosec B310  # noqa: S310 - loopback URL
                content: Mapping[str, Any] = json.load(answer)
                return content
        except (OSError, ValueError, urllib.error.URLError) as error:
            log.debug("experiment: camera world did not respond (url=%s error=%s)", self._url, error)
            return None


def seen_in(truth: Mapping[str, Any]) -> list[Seen]:
    """Return the objects of a truth.json document."""
    return [Seen(o["class"], o["lat"], o["lon"], str(o["id"])) for o in truth.get("objects", ())]
