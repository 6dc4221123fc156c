"""Data of one flight: objects of the cluster, and the audit log with its telemetry samples."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from fractus_core.api import Application, DeploymentPlan, Depot, Drone, EdgeNode, Policy, Resource, Zone
from fractus_core.api.geometry import Point
from fractus_core.geo import LocalFrame
from fractus_core.policy.selectors import node_attributes, policy_selects

from fractus_sim.report.track import Place, Sample, Track

OBJECTS = "objects.json"
AUDIT = "audit"
PICTURES = "pictures"
_DECIDED = {"correct", "deny", "takeover"}
_KINDS: tuple[type[Resource], ...] = (Application, DeploymentPlan, Depot, Drone, EdgeNode, Policy, Zone)


@dataclass(frozen=True, slots=True)
class Judgement:
    """A call that a policy corrected, denied, or answered with a takeover.

    Attributes:
        asked: Requested position for calls that fly to a position. Missing lat and lon are the position of the drone.
        flown: Position that was flown instead.
        detail: Requested arguments as text.
        count: Number of consecutive identical calls.
    """

    time_s: float
    component: str
    method: str
    action: str
    code: str
    reason: str
    policies: tuple[str, ...]
    detail: str
    asked: Place | None
    flown: Place | None
    at: Place | None
    count: int = 1

    @property
    def refused(self) -> bool:
        """True if no part of the call was executed."""
        return self.action != "correct"


@dataclass(frozen=True, slots=True)
class PathChange:
    """A change of traffic to or from a direct link. Times are Unix seconds."""

    time_s: float
    node: str
    direct: bool
    why: str


@dataclass(frozen=True, slots=True)
class Pod:
    """A pod of the application. Times are Unix seconds, or None if unknown."""

    name: str
    component: str
    node: str
    created_s: float
    running_s: float | None
    restarts: int


@dataclass(frozen=True)
class Record:
    """All data of the report. Pictures are listed by file name."""

    application: Application
    plan: DeploymentPlan | None
    drone: Drone | None
    depots: tuple[Depot, ...]
    edge_nodes: tuple[EdgeNode, ...]
    policies: tuple[Policy, ...]
    zones: tuple[Zone, ...]
    pods: tuple[Pod, ...]
    events: tuple[Mapping[str, Any], ...]
    samples: tuple[Sample, ...]
    judgements: tuple[Judgement, ...]
    calls: int
    results: int = 0
    audit: Mapping[str, Any] = field(default_factory=dict)
    times: Mapping[str, float] = field(default_factory=dict)
    pictures: tuple[str, ...] = ()
    links: tuple[PathChange, ...] = ()

    @classmethod
    def read(cls, folder: Path) -> Record:
        """Read the files that the demo wrote to a folder.

        Raises:
            OSError: A file is missing.
            ValueError: The content of a file is invalid.
        """
        content = json.loads((folder / OBJECTS).read_text())
        applied_s = content.get("times", {}).get("applied", 0.0)
        entries = [entry for path in sorted((folder / AUDIT).glob("*.jsonl")) for entry in _entries(path, applied_s)]
        pictures = tuple(sorted(path.name for path in (folder / PICTURES).glob("*.jpg")))
        return replace(cls.of(content, entries), pictures=pictures)

    @classmethod
    def of(cls, content: Mapping[str, Any], audit: Iterable[Mapping[str, Any]]) -> Record:
        """Create the record from parsed JSON.

        Args:
            content: `objects` (manifests from the API server), `pods`, `events`, `times`, `audit`.
            audit: Entries of the drone's audit logs: calls, takeovers, and telemetry samples.
        """
        found: dict[str, list[Any]] = {kind.KIND: [] for kind in _KINDS}
        parsers = {kind.KIND: kind for kind in _KINDS}
        for body in content["objects"]:
            if body["kind"] in parsers:
                found[body["kind"]].append(parsers[body["kind"]].from_body(body))
        plans = found["DeploymentPlan"]
        chosen = plans[0].spec.drone.node if plans and plans[0].spec.drone else None
        entries = sorted(audit, key=lambda e: str(e.get("time", "")))
        return cls(
            application=found["Application"][0],
            plan=plans[0] if plans else None,
            drone=next((d for d in found["Drone"] if d.name == chosen), None),
            depots=tuple(found["Depot"]),
            edge_nodes=tuple(sorted(found["EdgeNode"], key=lambda n: n.name)),
            policies=tuple(sorted(found["Policy"], key=lambda p: p.name)),
            zones=tuple(sorted(found["Zone"], key=lambda z: z.name)),
            pods=tuple(sorted((_pod(body) for body in content.get("pods", ())), key=lambda p: (p.component, p.name))),
            events=tuple(content.get("events", ())),
            samples=_flight(_sample(e) for e in entries if _has_state(e)),
            judgements=judgements_of(entries),
            calls=sum(e.get("kind") == "call" for e in entries),
            results=content.get("results", 0),
            audit=content.get("audit", {}),
            times=content.get("times", {}),
            links=tuple(
                PathChange(c["time"], c["node"], c["traffic"] == "direct", c["why"]) for c in content.get("links", ())
            ),
        )

    @property
    def policies_in_force(self) -> tuple[Policy, ...]:
        """Policies that apply to a component of the application on the drone that flew."""
        if self.drone is None:
            return self.policies
        attributes = node_attributes(self.drone)
        components = self.application.spec.components
        return tuple(
            p for p in self.policies if any(policy_selects(p.spec, self.application, c, attributes) for c in components)
        )

    @property
    def track(self) -> Track:
        """Flight of the drone."""
        return Track(self.drone.name if self.drone else "no drone", self.samples)

    @property
    def home(self) -> Place | None:
        """Takeoff position."""
        return self.track.home

    @property
    def takeoff_s(self) -> float | None:
        """Takeoff time."""
        return self.track.takeoff_s

    @property
    def landing_s(self) -> float | None:
        """Landing time. None while in flight."""
        return self.track.landing_s

    @property
    def frame(self) -> LocalFrame:
        """Local frame in metres east and north of home, or of the depot if home is unknown."""
        home = self.home
        if home is not None:
            return LocalFrame(home.lat, home.lon)
        at = self.depots[0].spec.location if self.depots else Point(lat=0, lon=0)
        return LocalFrame.at(at)


def of_mission(line: bytes, applied_s: float) -> bool:
    """Return True if a line of an audit log is an entry made after the application was applied."""
    try:
        return _time(json.loads(line)["time"]) >= applied_s
    except (ValueError, KeyError, TypeError):  # # incomplete last line
        return False


def taken_s(picture: str) -> float:
    """Return the time of a picture from its file name."""
    return datetime.strptime(picture[:17], "%Y%m%d%H%M%S%f").replace(tzinfo=UTC).timestamp()


def _entries(path: Path, applied_s: float) -> list[dict[str, Any]]:
    with path.open("rb") as file:
        return [json.loads(line) for line in file if of_mission(line, applied_s)]


def _time(text: str) -> float:
    return datetime.fromisoformat(text).timestamp()


def _has_state(entry: Mapping[str, Any]) -> bool:
    """Return True if an entry contains the position of the drone: telemetry samples and landing entries."""
    return entry.get("kind") == "state" or (entry.get("kind") == "control" and entry.get("action") == "landed")


def _sample(entry: Mapping[str, Any]) -> Sample:
    return Sample(
        time_s=_time(entry["time"]),
        place=Place(entry.get("lat") or 0.0, entry.get("lon") or 0.0, entry.get("alt") or 0.0),
        speed_mps=entry.get("speed", 0.0),
        mode=entry.get("mode", ""),
        in_air=bool(entry.get("in_air")),
        battery=entry.get("battery", 0.0),
    )


def _flight(samples: Iterable[Sample]) -> tuple[Sample, ...]:
    """Return the samples in order, from shortly before the first takeoff to shortly after the last landing."""
    ordered = sorted((s for s in samples if s.place.lat or s.place.lon), key=lambda s: s.time_s)
    flying = [s.time_s for s in ordered if s.in_air]
    if not flying:
        return ()
    return tuple(s for s in ordered if flying[0] - 3.0 <= s.time_s <= flying[-1] + 3.0)


def judgements_of(entries: Iterable[Mapping[str, Any]]) -> tuple[Judgement, ...]:
    """Return the calls that policies changed, in order. Repetitions within a short time count as one."""
    ordered = sorted(entries, key=lambda e: str(e.get("time", "")))
    return _merged([j for e in ordered if (j := _judgement(e)) is not None])


def _judgement(entry: Mapping[str, Any]) -> Judgement | None:
    """Return the judgement of a call, monitor or takeover entry. Return None if nothing was changed."""
    kind = entry.get("kind")
    if kind not in {"call", "monitor", "takeover"} or (kind != "takeover" and entry.get("action") not in _DECIDED):
        return None
    at = _place(entry, None)
    args = entry.get("args") or {}
    return Judgement(
        time_s=_time(entry["time"]),
        component=_component(entry.get("caller", "")) if kind == "call" else "the system",
        method=entry["method"] if kind == "call" else entry.get("action", kind),
        action=entry["action"] if entry.get("action") in _DECIDED else "takeover",
        code=entry.get("code", ""),
        reason=entry.get("reason", ""),
        policies=tuple(entry.get("policies", ())),
        detail=_words(args),
        asked=_place(args, at),
        flown=_place(entry.get("result"), at),
        at=at,
    )


def _component(identity: str) -> str:
    parts = identity.split("/")
    return parts[parts.index("component") + 1] if "component" in parts[:-1] else identity


def _place(value: Mapping[str, Any] | None, base: Place | None) -> Place | None:
    """Return the position of a mapping. Missing coordinates are replaced by the position of the drone."""
    value = value or {}
    lat = value.get("lat")
    lon = value.get("lon")
    alt = value.get("alt", value.get("altitude_m"))
    if lat is None and alt is None:
        return None
    if lat is None or lon is None:
        return Place(base.lat, base.lon, float(alt)) if base is not None and alt is not None else None
    return Place(float(lat), float(lon), float(alt) if alt is not None else base.alt_m if base else 0.0)


_UNITS = {"speed_mps": "{:.1f} m/s", "altitude_m": "{:.0f} m", "alt": "{:.0f} m"}


def _words(args: Mapping[str, Any]) -> str:
    lat = args.get("lat")
    lon = args.get("lon")
    where = [f"{lat:.6f}, {lon:.6f}"] if isinstance(lat, float) and isinstance(lon, float) else []
    figures = [shape.format(args[key]) for key, shape in _UNITS.items() if isinstance(args.get(key), int | float)]
    return ", ".join([*where, *figures])


def _merged(judged: Iterable[Judgement]) -> tuple[Judgement, ...]:
    """Merge identical calls of a component with the same verdict within one minute, also if they are interleaved."""
    kept: list[Judgement] = []
    last: dict[tuple[str, ...], tuple[int, float]] = {}
    for one in judged:
        key = (one.component, one.method, one.action, one.code, one.detail, *one.policies)
        index, time_s = last.get(key, (-1, -math.inf))
        if index >= 0 and one.time_s - time_s < 60.0:
            kept[index] = replace(kept[index], count=kept[index].count + 1)
        else:
            index = len(kept)
            kept.append(one)
        last[key] = (index, one.time_s)
    return tuple(kept)


def _pod(body: Mapping[str, Any]) -> Pod:
    metadata = body["metadata"]
    status = body.get("status", {})
    labels = metadata.get("labels", {})
    ready = [c for c in status.get("conditions", ()) if c["type"] == "Ready" and c["status"] == "True"]
    starts = [
        c["state"]["running"]["startedAt"]
        for c in status.get("containerStatuses", ())
        if "running" in c.get("state", {})
    ]
    return Pod(
        name=metadata["name"],
        component=labels.get("fractus.dev/component", ""),
        node=body.get("spec", {}).get("nodeName", ""),
        created_s=_time(metadata["creationTimestamp"]),
        running_s=max(map(_time, starts)) if ready and starts else None,
        restarts=sum(c.get("restartCount", 0) for c in status.get("containerStatuses", ())),
    )
