"""Invariants of chaos runs, as pure functions of audit logs, vehicle telemetry and remaining objects."""

from __future__ import annotations

import bisect
import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from fractus_core.api.grants import GrantSpec
from fractus_core.policy.compiled_grant import CompiledGrant, compile_grant
from fractus_core.policy.decision_types import Call, GotoArgs, Home, Situation
from fractus_core.policy.engine import judge

Entry = Mapping[str, Any]

AUTHORITY_GAP_S = 12.0
"""The autopilot's failsafe acts after five seconds without messages. The margin is for a busy machine."""

FAILSAFE_MODES = frozenset({"RTL", "SMART_RTL", "LAND", "BRAKE"})
"""Modes in which the autopilot itself lands the drone or returns it."""

CORRECTION_M = 1.0
HOME_M = 8.0


@dataclass(frozen=True, slots=True)
class Broken:
    """Violation of an invariant: name, Unix time in seconds (0 for the end of the run) and description."""

    invariant: str
    time_s: float
    found: str


@dataclass(frozen=True, slots=True)
class Seen:
    """A telemetry sample of the vehicle. Units: degrees, metres above home."""

    time_s: float
    lat: float
    lon: float
    flying: bool
    mode: str


def time_of(entry: Entry) -> float:
    """Return the Unix time of an entry in seconds."""
    return datetime.fromisoformat(str(entry["time"])).timestamp()


def steadily_timed(entries: Iterable[Entry], started_s: float) -> Iterator[Entry]:
    """Yield entries with corrected times, independent of clock steps of their service.

    Args:
        entries: Entries of an audit log.
        started_s: Boot time of the machine, Unix seconds.
    """
    for entry in entries:
        yield {**entry, "time": datetime.fromtimestamp(started_s + float(entry["boot_s"]), UTC).isoformat()}


def without_authority(seen: Sequence[Seen], entries: Iterable[Entry]) -> list[Broken]:
    """Return the times in the air without a control authority.

    The authority is the controller in the audit log if an entry names it every few seconds, or the autopilot once its
    failsafe returns or lands the drone.
    """
    named: list[float] = []
    broken: list[Broken] = []
    for entry in entries:
        if entry.get("kind") == "state":
            if entry.get("controller"):
                named.append(time_of(entry))
            elif entry.get("in_air"):
                broken.append(Broken("authority", time_of(entry), "audit log entry without controller in flight"))
    begun: Seen | None = None
    for sample in seen:
        at = bisect.bisect_right(named, sample.time_s)
        silent_s = sample.time_s - named[at - 1] if at else math.inf
        alone = sample.flying and silent_s > AUTHORITY_GAP_S and sample.mode not in FAILSAFE_MODES
        if alone and begun is None:
            found = f"in the air in mode {sample.mode} without audit log entry for {silent_s:.0f} s"
            broken.append(Broken("authority", sample.time_s, found))
        begun = sample if alone else None
    return broken


def in_two_applications(entries: Iterable[Entry], grants: Mapping[str, GrantSpec]) -> list[Broken]:
    """Return the times in the air when drivers of several applications had Grants for the drone.

    Args:
        entries: Entries of the audit log of the mobility service.
        grants: Grants by key.
    """
    broken: list[Broken] = []
    live: dict[str, str] = {}
    for entry in entries:
        _follow(live, entry)
        if entry.get("kind") == "state" and entry.get("in_air"):
            specs = {key: grants[key] for key in live if key in grants}
            drivers = sorted({spec.application.name for spec in specs.values() if spec.class_ == "driver"})
            if len(drivers) > 1:
                broken.append(Broken("one application", time_of(entry), f"drivers of {', '.join(drivers)} had Grants"))
    return broken


def _follow(live: dict[str, str], entry: Entry) -> None:
    """Update the identities of active Grants by key."""
    match entry:
        case {"kind": "started"}:
            live.clear()
        case {"kind": "grant", "change": "removed", "key": str(key)}:
            live.pop(key, None)
        case {"kind": "grant", "key": str(key), "identity": str(identity)}:
            live[key] = identity


def forbidden_calls(entries: Iterable[Entry], grants: Mapping[str, GrantSpec], home: Home | None) -> list[Broken]:
    """Return the permitted calls that no Grant of the caller allows.

    Each call is evaluated again for a drone at rest with an exact position, the situation in which policies are least
    restrictive.

    Args:
        entries: Entries of the audit log of a service.
        grants: All Grants that were on the node, by key.
        home: Home of the drone. None on a node without drone.
    """
    broken: list[Broken] = []
    live: dict[str, str] = {}
    compiled: dict[str, CompiledGrant] = {}
    for entry in entries:
        _follow(live, entry)
        if entry.get("kind") != "call" or entry.get("action") not in {"allow", "correct"}:
            continue
        keys = [key for key, identity in live.items() if identity == entry.get("caller")]
        for key in keys:
            if key in grants and key not in compiled:
                compiled[key] = compile_grant(grants[key])
        known = [compiled[key] for key in keys if key in compiled]
        refusals = [_refusal(entry, grant, home) for grant in known]
        if not all(refusals) and refusals:
            continue
        reason = refusals[0] if refusals else ("its Grant was never on the node" if keys else "it had no Grant")
        found = f"{entry.get('method')} of {entry.get('caller')} was permitted: {reason}"
        broken.append(Broken("calls within Grants", time_of(entry), found))
    return broken


def _refusal(entry: Entry, grant: CompiledGrant, home: Home | None) -> str:
    """Return the reason why a permitted call should have been denied, or an empty string.

    The log does not contain all inputs of the decision on calls other than Goto. For these, check only that the Grant
    includes the method.
    """
    method = str(entry.get("method"))
    if method not in grant.methods:
        return f"its Grant does not include {method}"
    if method != "Goto" or home is None or entry.get("lat") is None:
        return ""
    now = Situation(
        time_of(entry), lat=entry["lat"], lon=entry["lon"], altitude_m=float(entry["alt"]), home=home, armed=True,
        in_air=True, position_error_m=0.0, altitude_error_m=0.0, latency_s=0.0,
    )  # fmt: skip
    requested = GotoArgs(**dict(entry["result"]))
    verdict = judge(Call(method, requested), now, grant)
    corrected = verdict.args
    if verdict.permits and isinstance(corrected, GotoArgs):
        moved_m = abs((corrected.alt or 0.0) - (requested.alt or 0.0))
        return verdict.reason if moved_m > CORRECTION_M else ""
    return verdict.reason


def not_ended(missions: Mapping[str, tuple[str, str]]) -> list[Broken]:
    """Return missions that are neither Completed nor Failed with a message. Values are phase and message by name."""
    return [
        Broken("missions end", 0.0, f"{name} is {phase or 'missing'}: {message or 'no message'}")
        for name, (phase, message) in missions.items()
        if phase != "Completed" and not (phase == "Failed" and message)
    ]


def landed_elsewhere(seen: Sequence[Seen], home: Home) -> list[Broken]:
    """Return landings away from home, and a drone that is in the air at the end."""
    broken: list[Broken] = []
    for before, after in itertools.pairwise(seen):
        if before.flying and not after.flying:
            north_m = (after.lat - home.lat) * 111_195
            east_m = (after.lon - home.lon) * 111_195 * math.cos(math.radians(home.lat))
            if math.hypot(north_m, east_m) > HOME_M:
                off_m = math.hypot(north_m, east_m)
                broken.append(Broken("drones come home", after.time_s, f"landed {off_m:.0f} m from home"))
    if seen and seen[-1].flying:
        broken.append(Broken("drones come home", seen[-1].time_s, "in the air at the end"))
    return broken


def left_over(objects: Iterable[Mapping[str, Any]]) -> list[Broken]:
    """Return objects that remain of deleted applications."""
    names = sorted(map(_described, objects))
    return [Broken("no orphans", 0.0, f"remaining objects: {', '.join(names)}")] if names else []


def _described(body: Mapping[str, Any]) -> str:
    """Describe an object with its owners and finalizers."""
    meta = body["metadata"]
    owners = [f"{owner['kind']}/{owner['name']}" for owner in meta.get("ownerReferences") or ()]
    ends = [f"deleted at {meta['deletionTimestamp']}"] if "deletionTimestamp" in meta else []
    kept = [f"owned by {' and '.join(owners)}"] if owners else []
    held = [f"finalizers {' and '.join(meta['finalizers'])}"] if meta.get("finalizers") else []
    return f"{body['kind']}/{meta['name']} ({'; '.join(['exists', *ends, *kept, *held])})"
