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

DETECTIONS_FILE = "detections.jsonl"
DETECTIONS_VARIABLE = "FRACTUS_EXPERIMENT_DETECTIONS"
POLL_S = 0.5
RESPONSE_TIMEOUT_S = 2.0
log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ObservedObject:
    """An object in a picture, or a detection of a program."""

    kind: str
    lat: float
    lon: float
    name: str = ""


@dataclass(frozen=True, slots=True)
class Score:
    """Numbers of detections and objects in view, and the numbers of matches among them."""

    detections: int
    correct_detections: int
    objects: int
    detected_objects: int

    @property
    def precision(self) -> float:
        """Share of detections that match an object. 1 if there are no detections."""
        return self.correct_detections / self.detections if self.detections else 1.0

    @property
    def recall(self) -> float:
        """Share of objects that were detected. 1 if there are no objects."""
        return self.detected_objects / self.objects if self.objects else 1.0


def score_detections(
    detections: Sequence[ObservedObject], truths: Sequence[ObservedObject], kind: str, radius_m: float
) -> Score:
    """Match detections of one class with the objects of that class.

    Args:
        detections: Detections of the program.
        truths: Objects in all pictures. An object appears once for each picture.
        kind: Class to compare.
        radius_m: Maximum distance between a detection and its object.
    """
    objects = [truth for truth in truths if truth.kind == kind]
    of_kind = [detection for detection in detections if detection.kind == kind]
    matches = [{item.name for item in objects if _distance_m(item, detection) <= radius_m} for detection in of_kind]
    detected: set[str] = set().union(*matches)
    correct = sum(bool(names) for names in matches)
    return Score(len(of_kind), correct, len({item.name for item in objects}), len(detected))


def _distance_m(one: ObservedObject, other: ObservedObject) -> float:
    return geodesic_m(Point(lat=one.lat, lon=one.lon), Point(lat=other.lat, lon=other.lon))


def read_detections(lines: Iterable[str]) -> list[ObservedObject]:
    """Parse detections, one JSON object per line. Malformed lines are logged and ignored."""
    detections = []
    for number, line in enumerate(lines, 1):
        try:
            entry = json.loads(line)
            detections.append(ObservedObject(str(entry["class"]), float(entry["lat"]), float(entry["lon"])))
        except (ValueError, KeyError, TypeError) as error:
            log.warning(
                "experiment: malformed detection ignored (file=%s line=%d error=%s)", DETECTIONS_FILE, number, error
            )
    return detections


class TruthWatch:
    """Records the objects in view at each snapshot of a camera world. Polls the camera world twice a second."""

    def __init__(self, url: str, path: Path) -> None:
        self.objects: list[ObservedObject] = []
        self._url = f"{url}/truth.json"
        self._path = path
        self._last_snapshot: object = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="truth", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop polling."""
        self._stop.set()
        self._thread.join(2 * RESPONSE_TIMEOUT_S)

    def _run(self) -> None:
        with self._path.open("w") as file:
            while not self._stop.wait(POLL_S):
                truth = self._request_truth()
                if truth is not None and truth.get("snapshot") != self._last_snapshot:
                    self._last_snapshot = truth.get("snapshot")
                    file.write(json.dumps(truth) + "\n")
                    file.flush()
                    self.objects += _objects(truth)

    def _request_truth(self) -> Mapping[str, Any] | None:
        """Return the truth of the last snapshot, or None if there is no snapshot or the request fails."""
        try:
            with urllib.request.urlopen(self._url, timeout=RESPONSE_TIMEOUT_S) as response:  # nosec B310  # noqa: S310 - loopback URL
                content: Mapping[str, Any] = json.load(response)
                return content
        except (OSError, ValueError, urllib.error.URLError) as error:
            log.debug("experiment: camera world did not respond (url=%s error=%s)", self._url, error)
            return None


def _objects(truth: Mapping[str, Any]) -> list[ObservedObject]:
    """Return the objects of a truth.json document."""
    return [ObservedObject(o["class"], o["lat"], o["lon"], str(o["id"])) for o in truth.get("objects", ())]
