"""Data of one mission: objects of the cluster, and the audit logs of the drone with telemetry samples and calls."""

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
from fractus_core.api.names import component_name
from fractus_core.geo import LocalFrame
from fractus_core.policy.selectors import node_attributes, policy_selects
from fractus_runtime.audit_chain import entries

from fractus_sim.report.track import Place, Sample, Track

OBJECTS = "objects.json"
AUDIT = "audit"
PICTURES = "pictures"
_CHANGING_ACTIONS = frozenset({"correct", "deny", "takeover"})
_FLIGHT_MARGIN_S = 3.0
_IDENTITIES = ("identity", "caller", "controller")
"""Fields of audit log entries with the identity of an instance."""
_MERGE_S = 60.0
"""Maximum time between identical calls that are merged into one."""

_KINDS: tuple[type[Resource], ...] = (Application, DeploymentPlan, Depot, Drone, EdgeNode, Policy, Zone)


@dataclass(frozen=True, slots=True)
class JudgedCall:
    """A call with its verdict, or an action of the system.

    Attributes:
        time_s: Time of the call, seconds. The clock depends on the report.
        caller: Component, or the system.
        method: Service method, or the name of the system's action.
        action: allow, correct, deny, or takeover (denied, and control revoked). Empty for an action of the system.
        requested: Requested position, for calls that fly to a position.
        flown: Position that was flown.
        position: Position of the drone.
        arguments: Requested arguments as text.
        count: Number of identical calls that are merged into this one.
    """

    time_s: float
    caller: str
    method: str
    action: str
    code: str
    reason: str
    policies: tuple[str, ...]
    requested: Place | None
    flown: Place | None
    position: Place | None
    arguments: str = ""
    count: int = 1

    @property
    def refused(self) -> bool:
        """True if no part of the call was executed."""
        return self.action in {"deny", "takeover"}


@dataclass(frozen=True, slots=True)
class PathChange:
    """A change of traffic to or from a direct link. Times are Unix seconds."""

    time_s: float
    node: str
    direct: bool
    reason: str


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
class FlightRecord:
    """All data of the report.

    Attributes:
        decisions: Calls that policies changed, in order.
        calls: Number of calls of components.
        results: Number of pictures that were checked and kept.
        audit: Numbers of audit log entries, and the violation of the hash chain if there is one.
        times: Unix seconds of events of the mission.
        pictures: File names of pictures.
    """

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
    decisions: tuple[JudgedCall, ...]
    calls: int
    results: int = 0
    audit: Mapping[str, Any] = field(default_factory=dict)
    times: Mapping[str, float] = field(default_factory=dict)
    pictures: tuple[str, ...] = ()
    links: tuple[PathChange, ...] = ()

    @classmethod
    def read(cls, folder: Path) -> FlightRecord:
        """Read the files that the demo wrote to a folder.

        Raises:
            OSError: A file is missing.
            ValueError: The content of a file is invalid.
        """
        content = json.loads((folder / OBJECTS).read_text())
        times = content.get("times", {})
        window = TimeWindow(times.get("applied", 0.0), times.get("over", math.inf))
        audit: list[dict[str, Any]] = []
        for path in sorted((folder / AUDIT).glob("*.jsonl")):
            with path.open("rb") as file:
                audit += [entry for entry in entries(file) if window.contains(entry)]
        pictures = tuple(sorted(path.name for path in (folder / PICTURES).glob("*.jpg")))
        return replace(cls.of(content, audit), pictures=pictures)

    @classmethod
    def of(cls, content: Mapping[str, Any], audit: Iterable[Mapping[str, Any]]) -> FlightRecord:
        """Create the record from parsed JSON.

        Args:
            content: `objects` (manifests from the API server), `pods`, `events`, `times`, `audit`.
            audit: Entries of the drone's audit logs: calls, takeovers, and telemetry samples.
        """
        objects: dict[str, list[Any]] = {kind.KIND: [] for kind in _KINDS}
        parsers = {kind.KIND: kind for kind in _KINDS}
        for body in content["objects"]:
            if body["kind"] in parsers:
                objects[body["kind"]].append(parsers[body["kind"]].from_body(body))
        plans = objects["DeploymentPlan"]
        drones = objects["Drone"]
        if plans:
            drone_name = plans[0].spec.drone.node if plans[0].spec.drone else None
            drones = [drone for drone in drones if drone.name == drone_name]
        ordered = sorted(audit, key=lambda e: str(e.get("time", "")))
        return cls(
            application=objects["Application"][0],
            plan=plans[0] if plans else None,
            drone=drones[0] if len(drones) == 1 else None,
            depots=tuple(objects["Depot"]),
            edge_nodes=tuple(sorted(objects["EdgeNode"], key=lambda n: n.name)),
            policies=tuple(sorted(objects["Policy"], key=lambda p: p.name)),
            zones=tuple(sorted(objects["Zone"], key=lambda z: z.name)),
            pods=tuple(sorted((_pod(body) for body in content.get("pods", ())), key=lambda p: (p.component, p.name))),
            events=tuple(content.get("events", ())),
            samples=_flight(_sample(e) for e in ordered if _has_state(e)),
            decisions=policy_decisions(ordered),
            calls=sum(e.get("kind") == "call" for e in ordered),
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
    def frame(self) -> LocalFrame:
        """Local frame in metres east and north of home, or of the depot if home is unknown."""
        home = self.track.home
        if home is not None:
            return LocalFrame(home.lat, home.lon)
        return LocalFrame.at(self.depots[0].spec.location if self.depots else Point(lat=0, lon=0))


@dataclass(frozen=True, slots=True)
class TimeWindow:
    """Time of a mission in the audit log of its drone. Times are Unix seconds."""

    begin_s: float
    end_s: float = math.inf

    def contains(self, entry: Mapping[str, Any]) -> bool:
        """Return True if an audit log entry was written in this time. False for an entry without time."""
        try:
            return self.begin_s <= _time_s(entry["time"]) <= self.end_s
        except (ValueError, KeyError, TypeError):
            return False


def last_mission(audit: Iterable[Mapping[str, Any]], namespace: str, application: str) -> TimeWindow | None:
    """Return the time of the last mission of an application on a drone, or None if there was none.

    A mission begins when its Grants are added. It ends with the landing after its driver had control, because calls of its
    other components may follow the landing. Without a landing, it ends when another driver gets control.

    Args:
        audit: Entries of the audit log of the drone's mobility service, in order.
        namespace: Namespace of the application.
        application: Name of the application.
    """
    log = list(audit)
    marker = f"/ns/{namespace}/app/{application}/"
    own = [entry for entry in log if any(marker in str(entry.get(key, "")) for key in _IDENTITIES)]
    grants = [entry for entry in own if entry.get("kind") == "grant" and entry.get("change") == "added"]
    if not grants:
        return None
    # A service that restarts adds the Grants of the mission again.
    mission = _mission_uid(grants[-1])
    begin_s = min(_time_s(entry["time"]) for entry in grants if _mission_uid(entry) == mission)
    controlled_s = max((_time_s(entry["time"]) for entry in own if entry.get("kind") == "control"), default=begin_s)
    for entry in log:
        if entry.get("kind") != "control" or _time_s(entry["time"]) <= controlled_s:
            continue
        if entry.get("action") == "landed":
            last_s = max(_time_s(each["time"]) for each in own)
            return TimeWindow(begin_s, max(_time_s(entry["time"]), last_s) + _FLIGHT_MARGIN_S)
        if entry.get("action") == "granted":
            return TimeWindow(begin_s, _time_s(entry["time"]))
    return TimeWindow(begin_s)


def _mission_uid(grant: Mapping[str, Any]) -> str:
    return str(grant.get("key", "")).rpartition("#")[2]


def picture_time_s(picture: str) -> float:
    """Return the time of a picture from its file name, Unix seconds."""
    return datetime.strptime(picture[:17], "%Y%m%d%H%M%S%f").replace(tzinfo=UTC).timestamp()


def _time_s(text: str) -> float:
    return datetime.fromisoformat(text).timestamp()


def _has_state(entry: Mapping[str, Any]) -> bool:
    """Return True if an entry contains the position of the drone. It is then a telemetry sample, or the motors stopped."""
    stops = entry.get("kind") == "control" and entry.get("action") in {"landed", "stopped"}
    return entry.get("kind") == "state" or stops


def _sample(entry: Mapping[str, Any]) -> Sample:
    return Sample(
        time_s=_time_s(entry["time"]),
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
    begin_s = flying[0] - _FLIGHT_MARGIN_S
    end_s = flying[-1] + _FLIGHT_MARGIN_S
    return tuple(s for s in ordered if begin_s <= s.time_s <= end_s)


def policy_decisions(audit: Iterable[Mapping[str, Any]]) -> tuple[JudgedCall, ...]:
    """Return the calls that policies changed, in order. Identical calls within a short time are merged.

    Args:
        audit: Entries of audit logs in any order.
    """
    ordered = sorted(audit, key=lambda e: str(e.get("time", "")))
    return _merged(call for entry in ordered if (call := _policy_decision(entry)) is not None)


def _policy_decision(entry: Mapping[str, Any]) -> JudgedCall | None:
    """Return the call of an audit log entry if policies changed the call. Return None for all other entries."""
    kind = entry.get("kind")
    changed = kind == "takeover" or (kind in {"call", "monitor"} and entry.get("action") in _CHANGING_ACTIONS)
    return judged_call(entry) if changed else None


def judged_call(entry: Mapping[str, Any]) -> JudgedCall:
    """Return the call, or the action of the system, of an audit log entry of kind call, monitor or takeover."""
    kind = entry["kind"]
    action = entry.get("action")
    position = _place(entry, None)
    args = entry.get("args") or {}
    return JudgedCall(
        time_s=_time_s(entry["time"]),
        caller=component_name(entry.get("caller", "")) if kind == "call" else "the system",
        method=entry["method"] if kind == "call" else entry.get("action", kind),
        action=str(action) if kind == "call" or action in _CHANGING_ACTIONS else "takeover",
        code=entry.get("code", ""),
        reason=entry.get("reason", ""),
        policies=tuple(entry.get("policies", ())),
        requested=_place(args, position),
        flown=_place(entry.get("result"), position),
        position=position,
        arguments=_format_arguments(args),
    )


def _place(value: Mapping[str, Any] | None, base: Place | None) -> Place | None:
    """Return the position in a mapping. Missing coordinates are taken from `base`, the position of the drone."""
    value = value or {}
    lat = value.get("lat")
    lon = value.get("lon")
    alt = value.get("alt", value.get("altitude_m"))
    if lat is None and alt is None:
        return None
    if lat is None or lon is None:
        return Place(base.lat, base.lon, float(alt)) if base is not None and alt is not None else None
    if alt is not None:
        return Place(float(lat), float(lon), float(alt))
    return Place(float(lat), float(lon), base.alt_m if base is not None else 0.0)


_ARGUMENT_FORMATS = {"speed_mps": "{:.1f} m/s", "altitude_m": "{:.0f} m", "alt": "{:.0f} m"}


def _format_arguments(args: Mapping[str, Any]) -> str:
    lat = args.get("lat")
    lon = args.get("lon")
    position = [f"{lat:.6f}, {lon:.6f}"] if isinstance(lat, float) and isinstance(lon, float) else []
    values = [
        template.format(args[key])
        for key, template in _ARGUMENT_FORMATS.items()
        if isinstance(args.get(key), int | float)
    ]
    return ", ".join([*position, *values])


def _merged(calls: Iterable[JudgedCall]) -> tuple[JudgedCall, ...]:
    """Merge identical calls of a component with the same verdict within one minute.

    Other calls may lie between them.
    """
    merged: list[JudgedCall] = []
    last: dict[tuple[str, ...], tuple[int, float]] = {}
    for call in calls:
        key = (call.caller, call.method, call.action, call.code, call.arguments, *call.policies)
        index, time_s = last.get(key, (-1, -math.inf))
        if index >= 0 and call.time_s - time_s < _MERGE_S:
            merged[index] = replace(merged[index], count=merged[index].count + 1)
        else:
            index = len(merged)
            merged.append(call)
        last[key] = (index, call.time_s)
    return tuple(merged)


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
        created_s=_time_s(metadata["creationTimestamp"]),
        running_s=max(map(_time_s, starts)) if ready and starts else None,
        restarts=sum(c.get("restartCount", 0) for c in status.get("containerStatuses", ())),
    )
