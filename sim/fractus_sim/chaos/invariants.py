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
"""Maximum time in the air without an authority. The failsafe acts after 5 s. The rest is margin for a busy machine."""

FAILSAFE_MODES = frozenset({"RTL", "SMART_RTL", "LAND", "BRAKE"})
"""Modes in which the autopilot itself lands the drone or returns it."""

MAX_CORRECTION_M = 1.0
"""Maximum altitude correction in a repeated evaluation. Not all inputs of the original decision are known exactly."""

MAX_LANDING_ERROR_M = 8.0
METRES_PER_DEGREE = 111_195


@dataclass(frozen=True, slots=True)
class Violation:
    """Violation of an invariant: name, Unix time in seconds (0 for the end of the run) and description."""

    invariant: str
    time_s: float
    description: str


@dataclass(frozen=True, slots=True)
class TelemetrySample:
    """A telemetry sample of the vehicle. Units: degrees, metres above home."""

    time_s: float
    lat: float
    lon: float
    flying: bool
    mode: str


def entry_time_s(entry: Entry) -> float:
    """Return the Unix time of an entry in seconds."""
    return datetime.fromisoformat(str(entry["time"])).timestamp()


def with_corrected_times(entries: Iterable[Entry], boot_time_s: float) -> Iterator[Entry]:
    """Yield entries with times that are computed from the boot time. Clock steps of the service do not affect them.

    Args:
        entries: Entries of an audit log.
        boot_time_s: Boot time of the machine, Unix seconds.
    """
    for entry in entries:
        yield {**entry, "time": datetime.fromtimestamp(boot_time_s + float(entry["boot_s"]), UTC).isoformat()}


def flights_without_authority(samples: Sequence[TelemetrySample], entries: Iterable[Entry]) -> list[Violation]:
    """Return a violation for each time in the air without a control authority.

    The control authority is the controller that an audit log entry names every few seconds. Without such an entry, it
    is the autopilot if its failsafe returns or lands the drone.
    """
    named_s: list[float] = []
    violations: list[Violation] = []
    for entry in entries:
        if entry.get("kind") == "state":
            if entry.get("controller"):
                named_s.append(entry_time_s(entry))
            elif entry.get("in_air"):
                violations.append(
                    Violation("authority", entry_time_s(entry), "audit log entry without controller in flight")
                )
    in_violation = False
    for sample in samples:
        index = bisect.bisect_right(named_s, sample.time_s)
        silent_s = sample.time_s - named_s[index - 1] if index else math.inf
        unattended = sample.flying and silent_s > AUTHORITY_GAP_S and sample.mode not in FAILSAFE_MODES
        if unattended and not in_violation:
            text = f"in the air in mode {sample.mode} without audit log entry for {silent_s:.0f} s"
            violations.append(Violation("authority", sample.time_s, text))
        in_violation = unattended
    return violations


def flights_of_several_applications(entries: Iterable[Entry], grants: Mapping[str, GrantSpec]) -> list[Violation]:
    """Return a violation for each entry in the air at which drivers of several applications had Grants for the drone.

    Args:
        entries: Entries of the audit log of the mobility service.
        grants: Grants by key.
    """
    violations: list[Violation] = []
    active: dict[str, str] = {}
    for entry in entries:
        _update_active_grants(active, entry)
        if entry.get("kind") == "state" and entry.get("in_air"):
            specs = {key: grants[key] for key in active if key in grants}
            drivers = sorted({spec.application.name for spec in specs.values() if spec.class_ == "driver"})
            if len(drivers) > 1:
                violations.append(
                    Violation("one application", entry_time_s(entry), f"drivers of {', '.join(drivers)} had Grants")
                )
    return violations


def _update_active_grants(active: dict[str, str], entry: Entry) -> None:
    """Apply an audit log entry to the active Grants (identities by key)."""
    match entry:
        case {"kind": "started"}:
            active.clear()
        case {"kind": "grant", "change": "removed", "key": str(key)}:
            active.pop(key, None)
        case {"kind": "grant", "key": str(key), "identity": str(identity)}:
            active[key] = identity


def forbidden_calls(entries: Iterable[Entry], grants: Mapping[str, GrantSpec], home: Home | None) -> list[Violation]:
    """Return the permitted calls that no Grant of the caller allows.

    Each call is evaluated again for a drone at rest with an exact position. Policies are least restrictive in this
    case.

    Args:
        entries: Entries of the audit log of a service.
        grants: All Grants that were on the node, by key.
        home: Home of the drone. None for a node without a drone.
    """
    violations: list[Violation] = []
    active: dict[str, str] = {}
    compiled: dict[str, CompiledGrant] = {}
    for entry in entries:
        _update_active_grants(active, entry)
        if entry.get("kind") != "call" or entry.get("action") not in {"allow", "correct"}:
            continue
        keys = [key for key, identity in active.items() if identity == entry.get("caller")]
        for key in keys:
            if key in grants and key not in compiled:
                compiled[key] = compile_grant(grants[key])
        refusals = [_refusal(entry, compiled[key], home) for key in keys if key in compiled]
        if refusals and not all(refusals):
            continue
        if refusals:
            reason = refusals[0]
        elif keys:
            reason = "its Grant was never on the node"
        else:
            reason = "it had no Grant"
        text = f"{entry.get('method')} of {entry.get('caller')} was permitted: {reason}"
        violations.append(Violation("calls within Grants", entry_time_s(entry), text))
    return violations


def _refusal(entry: Entry, grant: CompiledGrant, home: Home | None) -> str:
    """Return the reason why a permitted call should have been denied, or an empty string.

    Only Goto calls are evaluated again, because the log does not contain all inputs for other calls. For other calls,
    check only that the Grant includes the method.
    """
    method = str(entry.get("method"))
    if method not in grant.methods:
        return f"its Grant does not include {method}"
    if method != "Goto" or home is None or entry.get("lat") is None:
        return ""
    now = Situation(
        entry_time_s(entry), lat=entry["lat"], lon=entry["lon"], altitude_m=float(entry["alt"]), home=home, armed=True,
        in_air=True, position_error_m=0.0, altitude_error_m=0.0, latency_s=0.0,
    )  # fmt: skip
    requested = GotoArgs(**dict(entry["result"]))
    verdict = judge(Call(method, requested), now, grant)
    corrected = verdict.args
    if verdict.permits and isinstance(corrected, GotoArgs):
        moved_m = abs((corrected.alt or 0.0) - (requested.alt or 0.0))
        return verdict.reason if moved_m > MAX_CORRECTION_M else ""
    return verdict.reason


def unfinished_missions(missions: Mapping[str, tuple[str, str]]) -> list[Violation]:
    """Return missions that are neither Completed nor Failed with a message.

    Args:
        missions: Phase and message by name.
    """
    return [
        Violation("missions end", 0.0, f"{name} is {phase or 'missing'}: {message or 'no message'}")
        for name, (phase, message) in missions.items()
        if phase != "Completed" and not (phase == "Failed" and message)
    ]


def landings_away_from_home(samples: Sequence[TelemetrySample], home: Home) -> list[Violation]:
    """Return a violation for each landing away from home, and one if the drone is in the air at the end."""
    violations: list[Violation] = []
    for before, after in itertools.pairwise(samples):
        if before.flying and not after.flying:
            north_m = (after.lat - home.lat) * METRES_PER_DEGREE
            east_m = (after.lon - home.lon) * METRES_PER_DEGREE * math.cos(math.radians(home.lat))
            distance_m = math.hypot(north_m, east_m)
            if distance_m > MAX_LANDING_ERROR_M:
                violations.append(Violation("drones come home", after.time_s, f"landed {distance_m:.0f} m from home"))
    if samples and samples[-1].flying:
        violations.append(Violation("drones come home", samples[-1].time_s, "in the air at the end"))
    return violations


def orphans(objects: Iterable[Mapping[str, Any]]) -> list[Violation]:
    """Return a violation that lists objects without an application, if there are any."""
    names = sorted(map(_describe, objects))
    return [Violation("no orphans", 0.0, f"remaining objects: {', '.join(names)}")] if names else []


def _describe(body: Mapping[str, Any]) -> str:
    """Describe an object with its owners and finalizers."""
    meta = body["metadata"]
    owners = [f"{owner['kind']}/{owner['name']}" for owner in meta.get("ownerReferences") or ()]
    details = ["exists"]
    if "deletionTimestamp" in meta:
        details.append(f"deleted at {meta['deletionTimestamp']}")
    if owners:
        details.append(f"owned by {' and '.join(owners)}")
    if meta.get("finalizers"):
        details.append(f"finalizers {' and '.join(meta['finalizers'])}")
    return f"{body['kind']}/{meta['name']} ({'; '.join(details)})"
