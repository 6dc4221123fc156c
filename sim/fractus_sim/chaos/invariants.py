"""What must hold whatever fails: pure functions of what services wrote, what the vehicle said and what was left behind."""

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
"""The autopilot's failsafe acts after five seconds of silence; the rest is for a machine that is busy."""

FAILSAFE_MODES = frozenset({"RTL", "SMART_RTL", "LAND", "BRAKE"})
"""Modes in which the autopilot itself brings the drone down."""

CORRECTION_M = 1.0
HOME_M = 8.0


@dataclass(frozen=True, slots=True)
class Broken:
    """An invariant that did not hold: which, when (Unix seconds; 0 for the end), and what was found."""

    invariant: str
    time_s: float
    found: str


@dataclass(frozen=True, slots=True)
class Seen:
    """What the vehicle said of itself at a moment: degrees, metres above home."""

    time_s: float
    lat: float
    lon: float
    flying: bool
    mode: str


def time_of(entry: Entry) -> float:
    """When an entry was made, Unix seconds."""
    return datetime.fromisoformat(str(entry["time"])).timestamp()


def steadily_timed(entries: Iterable[Entry], started_s: float) -> Iterator[Entry]:
    """Entries with the times at which they were made, whatever the clock of their service said.

    Args:
        entries: of an audit log.
        started_s: when the machine started, Unix seconds.
    """
    for entry in entries:
        yield {**entry, "time": datetime.fromtimestamp(started_s + float(entry["boot_s"]), UTC).isoformat()}


def without_authority(seen: Sequence[Seen], entries: Iterable[Entry]) -> list[Broken]:
    """Times in the air for which no one was responsible.

    Responsible is whom the audit log names, as long as it names someone every few seconds, or the autopilot once its failsafe
    brings the drone home.
    """
    named: list[float] = []
    broken: list[Broken] = []
    for entry in entries:
        if entry.get("kind") == "state":
            if entry.get("controller"):
                named.append(time_of(entry))
            elif entry.get("in_air"):
                broken.append(
                    Broken("authority", time_of(entry), "an entry of the audit log names no controller in flight")
                )
    begun: Seen | None = None
    for sample in seen:
        at = bisect.bisect_right(named, sample.time_s)
        silent_s = sample.time_s - named[at - 1] if at else math.inf
        alone = sample.flying and silent_s > AUTHORITY_GAP_S and sample.mode not in FAILSAFE_MODES
        if alone and begun is None:
            found = f"in the air in mode {sample.mode} while the audit log has been silent for {silent_s:.0f} s"
            broken.append(Broken("authority", sample.time_s, found))
        begun = sample if alone else None
    return broken


def in_two_applications(entries: Iterable[Entry], grants: Mapping[str, GrantSpec]) -> list[Broken]:
    """Moments in the air at which drivers of several applications had Grants of the drone.

    Args:
        entries: of the mobility service's audit log.
        grants: by key.
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
    """Keep which Grants a service has: identities by key."""
    match entry:
        case {"kind": "started"}:
            live.clear()
        case {"kind": "grant", "change": "removed", "key": str(key)}:
            live.pop(key, None)
        case {"kind": "grant", "key": str(key), "identity": str(identity)}:
            live[key] = identity


def forbidden_calls(entries: Iterable[Entry], grants: Mapping[str, GrantSpec], home: Home | None) -> list[Broken]:
    """Calls that were let through though no Grant that the service had allows them.

    Each is judged again by the engine for a drone at rest that knows exactly where it is, of which policies ask least.

    Args:
        entries: of the audit log of a service.
        grants: by key, of all that were on the node.
        home: of its drone; None on a node without one.
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
        why = refusals[0] if refusals else ("its Grant was never on the node" if keys else "it had no Grant")
        found = f"{entry.get('method')} of {entry.get('caller')} was let through: {why}"
        broken.append(Broken("calls within Grants", time_of(entry), found))
    return broken


def _refusal(entry: Entry, grant: CompiledGrant, home: Home | None) -> str:
    """Why a call that was let through should not have been; empty when it may.

    Of calls other than Goto the log does not tell all that they are judged by: here the Grant must have their method.
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
    told = GotoArgs(**dict(entry["result"]))
    verdict = judge(Call(method, told), now, grant)
    corrected = verdict.args
    if verdict.permits and isinstance(corrected, GotoArgs):
        moved_m = abs((corrected.alt or 0.0) - (told.alt or 0.0))
        return verdict.reason if moved_m > CORRECTION_M else ""
    return verdict.reason


def not_ended(missions: Mapping[str, tuple[str, str]]) -> list[Broken]:
    """Missions that ended neither Completed nor Failed with a sentence that says why: phase and message by name."""
    return [
        Broken("missions end", 0.0, f"{name} is {phase or 'not heard of'}: {message or 'no message'}")
        for name, (phase, message) in missions.items()
        if phase != "Completed" and not (phase == "Failed" and message)
    ]


def landed_elsewhere(seen: Sequence[Seen], home: Home) -> list[Broken]:
    """Landings away from home, and a drone that is in the air at the end."""
    broken: list[Broken] = []
    for before, after in itertools.pairwise(seen):
        if before.flying and not after.flying:
            north_m = (after.lat - home.lat) * 111_195
            east_m = (after.lon - home.lon) * 111_195 * math.cos(math.radians(home.lat))
            if math.hypot(north_m, east_m) > HOME_M:
                off_m = math.hypot(north_m, east_m)
                broken.append(Broken("drones come home", after.time_s, f"it landed {off_m:.0f} m from home"))
    if seen and seen[-1].flying:
        broken.append(Broken("drones come home", seen[-1].time_s, "it is in the air at the end"))
    return broken


def left_over(objects: Iterable[Mapping[str, Any]]) -> list[Broken]:
    """Objects of applications that were deleted."""
    names = sorted(map(_described, objects))
    return [Broken("no orphans", 0.0, f"left behind: {', '.join(names)}")] if names else []


def _described(body: Mapping[str, Any]) -> str:
    """An object, and what keeps it."""
    meta = body["metadata"]
    owners = [f"{owner['kind']}/{owner['name']}" for owner in meta.get("ownerReferences") or ()]
    ends = [f"ends since {meta['deletionTimestamp']}"] if "deletionTimestamp" in meta else []
    kept = [f"owned by {' and '.join(owners)}"] if owners else []
    held = [f"held by {' and '.join(meta['finalizers'])}"] if meta.get("finalizers") else []
    return f"{body['kind']}/{meta['name']} ({'; '.join(['there', *ends, *kept, *held])})"
