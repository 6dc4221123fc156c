"""How well a program's detections agree with what the camera world had in view when it took its pictures."""

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
    """Something that was somewhere: an object in a picture, or what a program took for one."""

    kind: str
    lat: float
    lon: float
    name: str = ""


@dataclass(frozen=True, slots=True)
class Score:
    """Counts: detections, those that are objects, objects that were in view, those of them that were detected."""

    detections: int
    right: int
    objects: int
    found: int

    @property
    def precision(self) -> float:
        """Share of detections that are objects; 1 when there are none."""
        return self.right / self.detections if self.detections else 1.0

    @property
    def recall(self) -> float:
        """Share of objects that were detected; 1 when there were none."""
        return self.found / self.objects if self.objects else 1.0


def score(detections: Sequence[Seen], truths: Sequence[Seen], kind: str, radius_m: float) -> Score:
    """Match detections of a class with objects of it, wherever these were while in view.

    Args:
        detections: What the program said.
        truths: Each object of each picture; one that moved is there at each of its places.
        kind: The class that counts.
        radius_m: How near a detection must be.
    """
    wanted = [truth for truth in truths if truth.kind == kind]
    given = [detection for detection in detections if detection.kind == kind]
    hits = [{truth.name for truth in wanted if _apart_m(truth, one) <= radius_m} for one in given]
    found = set().union(*hits) if hits else set()
    return Score(len(given), sum(bool(hit) for hit in hits), len({truth.name for truth in wanted}), len(found))


def _apart_m(one: Seen, other: Seen) -> float:
    return geodesic_m(Point(lat=one.lat, lon=one.lon), Point(lat=other.lat, lon=other.lon))


def read_detections(lines: Iterable[str]) -> list[Seen]:
    """What programs wrote, a JSON object a line; a line that is none is passed over with a warning."""
    found = []
    for number, line in enumerate(lines, 1):
        try:
            entry = json.loads(line)
            found.append(Seen(str(entry["class"]), float(entry["lat"]), float(entry["lon"])))
        except (ValueError, KeyError, TypeError) as error:
            log.warning("experiment: no detection in a line (file=%s, line=%d, error=%s)", FILE, number, error)
    return found


class TruthWatch:
    """Keeps what a camera world had in view at each snapshot, asking twice a second."""

    def __init__(self, url: str, path: Path) -> None:
        self.seen: list[Seen] = []
        self._url = f"{url}/truth.json"
        self._path = path
        self._last: object = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="truth", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ask no more."""
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
        """The truth of the last snapshot; None while there is none, or the world does not answer."""
        try:
            with urllib.request.urlopen(self._url, timeout=ANSWER_S) as answer:  # nosec B310  # noqa: S310 - our own loopback URL
                content: Mapping[str, Any] = json.load(answer)
                return content
        except (OSError, ValueError, urllib.error.URLError) as error:
            log.debug("experiment: no truth (url=%s, error=%s)", self._url, error)
            return None


def seen_in(truth: Mapping[str, Any]) -> list[Seen]:
    """The objects in one truth.json."""
    return [Seen(o["class"], o["lat"], o["lon"], str(o["id"])) for o in truth.get("objects", ())]
