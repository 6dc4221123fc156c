"""Builders of grants and situations in metres around a home, for tests of the policy engine."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from fractus_core.api.grants import GrantSpec
from fractus_core.geo import LocalFrame
from fractus_core.policy.compiled_grant import CompiledGrant, compile_grant
from fractus_core.policy.decision_types import Call, GotoArgs, Home, Lens, Situation, Verdict
from fractus_core.policy.engine import judge

HOME = Home(39.36, 22.95, 100.0)
FRAME = LocalFrame(HOME.lat, HOME.lon)
NOW = datetime(2026, 6, 1, 12, tzinfo=UTC).timestamp()
METHODS = [
    "Arm",
    "Disarm",
    "Takeoff",
    "Land",
    "SetSpeed",
    "GetSpeed",
    "Goto",
    "Hover",
    "GetPosition",
    "ReturnToLaunch",
    "PointGimbal",
]
CAMERA = ["CaptureImage", "RetrieveImage"]
DOWN = Lens(90.0, 90.0, stabilised=True, error_deg=0.0)
"""Lens that looks straight down. While the yaw is unknown it sees a disc of altitude times the square root of two."""

Corners = list[tuple[float, float]]


def commanded_mps(limit_mps: float) -> float:
    """Return the highest speed that may be commanded under a speed limit (table in docs/mobility.md)."""
    if limit_mps > 10.0:
        return 0.95 * limit_mps
    return limit_mps - 0.5 if limit_mps > 0.5 / 0.15 else 0.85 * limit_mps


def ring(corners: Corners) -> dict[str, Any]:
    return {"polygon": {"exterior": [dict(zip(("lat", "lon"), FRAME.latlon(x, y), strict=True)) for x, y in corners]}}


def box(x0: float, y0: float, x1: float, y1: float) -> dict[str, Any]:
    return ring([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])


def zone(name: str, area: dict[str, Any], **band: Any) -> dict[str, Any]:
    return {"name": name, "area": area, **({"altitude": band} if band else {})}


def policy(
    name: str, kind: str, which: str, zones: list[dict[str, Any]] | None = None, **fields: Any
) -> dict[str, Any]:
    spec: dict[str, Any] = {"type": kind, "kind": which, **fields}
    if zones:
        spec["selector"] = {"zones": [z["name"] for z in zones]}
    return {"name": name, "spec": spec, "zones": zones or []}


def exclusion(area: dict[str, Any], action: str = "ignore", name: str = "no-fly", **more: Any) -> dict[str, Any]:
    band = {k: more.pop(k) for k in ("lower", "upper", "reference") if k in more}
    return policy(name, "GeofenceControl", "exclusion", [zone(f"{name}-zone", area, **band)], action=action, **more)


def inclusion(area: dict[str, Any], action: str = "ignore", name: str = "keep-in", **more: Any) -> dict[str, Any]:
    band = {k: more.pop(k) for k in ("lower", "upper", "reference") if k in more}
    return policy(name, "GeofenceControl", "inclusion", [zone(f"{name}-zone", area, **band)], action=action, **more)


def altitude(name: str = "altitudes", zones: list[dict[str, Any]] | None = None, **fields: Any) -> dict[str, Any]:
    return policy(name, "LimitControl", "altitude", zones, **fields)


def speed(name: str = "speeds", zones: list[dict[str, Any]] | None = None, **fields: Any) -> dict[str, Any]:
    return policy(name, "LimitControl", "speed", zones, **fields)


def spec(*policies: dict[str, Any], **changes: Any) -> GrantSpec:
    body = {
        "node": "drone-1",
        "application": {"namespace": "default", "name": "app", "uid": "u"},
        "component": "Navigator",
        "instance": "app-navigator",
        "class": "driver",
        "control": "full",
        "services": [{"service": "mobility", "methods": METHODS}, {"service": "camera", "methods": CAMERA}],
        "operationArea": [box(-200, -200, 200, 200)],
        "home": {"lat": HOME.lat, "lon": HOME.lon, "alt": HOME.amsl_m, "altitudeReference": "amsl"},
        "limits": {"maxAltitude": 120, "maxSpeed": 15},
        "policies": list(policies),
        **changes,
    }
    return GrantSpec.model_validate(body)


def compiled(*policies: dict[str, Any], flat_terrain: bool = False, **changes: Any) -> CompiledGrant:
    return compile_grant(spec(*policies, **changes), flat_terrain=flat_terrain)


def at(x: float = 0.0, y: float = 0.0, alt: float = 10.0, **more: Any) -> Situation:
    lat, lon = FRAME.latlon(x, y)
    state: dict[str, Any] = {"time_s": NOW, "home": HOME, "armed": True, "in_air": True, "lens": DOWN, **more}
    return Situation(lat=lat, lon=lon, altitude_m=alt, **state)


def goto(x: float, y: float, alt: float | None = 10.0, **more: Any) -> Call:
    lat, lon = FRAME.latlon(x, y)
    return Call("Goto", GotoArgs(lat, lon, alt, **more))


def ask(grant: CompiledGrant, call: Call, now: Situation | None = None) -> Verdict:
    return judge(call, now or at(), grant)


def target(verdict: Verdict) -> tuple[float, float]:
    assert isinstance(verdict.args, GotoArgs)
    return FRAME.xy(verdict.args.lat, verdict.args.lon)
