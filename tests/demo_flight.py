"""A synthetic flight of the traffic monitoring example, as the demo would have recorded it."""

from __future__ import annotations

import datetime as dt
import functools
import itertools
import math
from pathlib import Path
from typing import Any

import yaml
from fractus_core.api import Application, Depot, Drone, EdgeNode, Policy, Zone
from fractus_core.planning import Host, Inventory, plan

EXAMPLE = Path(__file__).parents[1] / "examples" / "traffic-monitoring"
APPLIED_S = 1_800_000_000.0
TAKEOFF_S = APPLIED_S + 14.0
HOME = (50.8637, 4.6785)
DRIVER = (
    "spiffe://fractus.dev/ns/default/app/traffic-monitoring/component/Navigator/instance/traffic-monitoring-navigator"
)
VIEWER = DRIVER.replace("Navigator", "AerialViewer").replace("navigator", "aerial-viewer")

GRANT = """
apiVersion: fractus.dev/v1alpha1
kind: Grant
metadata: {name: default.survey-navigator, uid: flight-1}
spec:
  node: drone-1
  application: {namespace: default, name: survey, uid: survey-1}
  component: Navigator
  instance: survey-navigator
  class: driver
  control: full
  services:
    - {service: mobility, methods: [Arm, Goto]}
  operationArea:
    - circle: {center: {lat: 39.36, lon: 22.95}, radius: 200}
  policies:
    - name: pool
      spec: {type: GeofenceControl, kind: exclusion, selector: {zones: [pool]}}
      zones:
        - {name: pool, area: {circle: {center: {lat: 39.3610, lon: 22.9510}, radius: 20}}}
"""


def stamp(seconds: float) -> str:
    return dt.datetime.fromtimestamp(seconds, dt.UTC).isoformat(timespec="milliseconds")


def documents(name: str) -> list[dict[str, Any]]:
    return list(yaml.safe_load_all((EXAMPLE / name).read_text()))


@functools.cache
def objects() -> tuple[dict[str, Any], ...]:
    """The example's objects with a plan that the planner made."""
    (application,) = documents("application.yaml")
    application["status"] = {"phase": "Completed", "message": "the mission is complete", "drone": "drone-1"}
    ready = {"type": "Ready", "status": "True", "reason": "Ok", "lastTransitionTime": stamp(APPLIED_S)}
    (drone,) = documents("drone.yaml")
    drone["status"] = {"battery": {"remaining": 1.0}, "conditions": [ready]}
    names = ("drone-1", "edge-1", "edge-2", "edge-3", "cloud-1")
    hosts = {
        name: Host(
            name, {"fractus.dev/class": name[:-2]}, {"cpu": 4, "memory": 1e10, "fractus.dev/gpu": 1}, {}, True, True
        )
        for name in names
    }
    edges = documents("edge-nodes.yaml")
    zones = documents("zones.yaml")
    policies = documents("policies.yaml")
    (depot,) = documents("depot.yaml")
    spec = plan(
        Application.from_body(application),
        Inventory(
            hosts=hosts,
            drones={"drone-1": Drone.from_body(drone)},
            edge_nodes={e["metadata"]["name"]: EdgeNode.from_body(e) for e in edges},
            depots={"depot-1": Depot.from_body(depot)},
            zones={z["metadata"]["name"]: Zone.from_body(z) for z in zones},
            policies={p["metadata"]["name"]: Policy.from_body(p) for p in policies},
            claimed={},
        ),
    )
    made = {
        "apiVersion": "fractus.dev/v1alpha1",
        "kind": "DeploymentPlan",
        "metadata": {"name": "traffic-monitoring", "namespace": "default"},
        "spec": spec.to_dict(),
    }
    return (application, drone, depot, made, *edges, *zones, *policies)


def pods() -> list[dict[str, Any]]:
    (made,) = [o for o in objects() if o["kind"] == "DeploymentPlan"]
    return [
        {
            "metadata": {
                "name": f"{p['instance']}-x1",
                "creationTimestamp": stamp(APPLIED_S + 1),
                "labels": {"fractus.dev/component": p["component"]},
            },
            "spec": {"nodeName": p.get("node", "cloud-1")},
            "status": {
                "conditions": [{"type": "Ready", "status": "True"}],
                "containerStatuses": [
                    {"restartCount": 0, "state": {"running": {"startedAt": stamp(APPLIED_S + 4 + i)}}}
                ],
            },
        }
        for i, p in enumerate(made["spec"]["placements"])
    ]


def states() -> list[dict[str, Any]]:
    """Two samples a second along the waypoints at 9 m/s, then home by RTL and down."""
    path = documents("application.yaml")[0]["spec"]["components"][0]["controlPoints"][0]["path"]
    stops = [(*HOME, 0.0), (*HOME, 20.0), *((w["lat"], w["lon"], min(w["alt"], 50.0)) for w in path)]
    stops += [(*HOME, 25.0), (*HOME, 0.0)]
    lines = [_line(TAKEOFF_S - 2, *HOME, 0.0, "GUIDED", flying=False)]
    now = TAKEOFF_S
    for i, (start, end) in enumerate(itertools.pairwise(stops)):
        over_m = math.dist(_metres(start), _metres(end))
        steps = max(int(2 * max(over_m / 9.0, abs(end[2] - start[2]) / 2.5)), 2)
        mode = "RTL" if i >= len(stops) - 3 else "GUIDED"
        for step in range(steps):
            share = 0.5 - 0.5 * math.cos(math.pi * step / steps)
            lat, lon, alt = (a + (b - a) * share for a, b in zip(start, end, strict=True))
            lines.append(_line(now, lat, lon, max(alt, 0.6), mode, flying=True, speed=9.0 if over_m > 1 else 0.0))
            now += 0.5
    return [*lines, _line(now, *HOME, 0.0, "RTL", flying=False)]


def audit() -> list[dict[str, Any]]:
    return [*calls(), *states()]


def calls() -> list[dict[str, Any]]:
    """Calls of driver and passenger; the last two refusals are the same request."""
    wp3 = {"lat": 50.865633, "lon": 4.680631, "alt": 70.0}
    at = {"lat": 50.865228, "lon": 4.679352, "alt": 20.0}
    refused = {"action": "deny", "code": "InsideExclusionZone", "policies": ["no-fly-hospital", "operation-area"]}
    return [
        _call(TAKEOFF_S - 1, DRIVER, "Arm", action="allow"),
        _call(
            TAKEOFF_S + 8, DRIVER, "SetSpeed", action="correct", code="SpeedAboveLimit", args={"speed_mps": 12.0},
            policies=["town-speed"], at={"lat": HOME[0], "lon": HOME[1], "alt": 20.0},
            reason="speed 12.0 m/s is above the limit of policy town-speed; corrected to 9.5 m/s (limit 10.0 less 0.5 for overshoot)",
        ),
        _call(TAKEOFF_S + 9, DRIVER, "Goto", action="allow"),
        _call(
            TAKEOFF_S + 29.5, DRIVER, "Goto", args={"lat": 50.865992, "lon": 4.679565, "alt": 20.0}, at=at, **refused,
            reason="the target is 21.8 m inside zone hospital of policy no-fly-hospital",
        ),
        _call(
            TAKEOFF_S + 30, DRIVER, "Goto", action="correct", code="AltitudeAboveLimit", args=wp3, at=at,
            policies=["town-altitude"], result={**wp3, "alt": 50.0},
            reason="altitude 70.0 m above home is above the limit of policy town-altitude; corrected to 50.0 m above home",
        ),
        *(
            _call(
                TAKEOFF_S + seconds, VIEWER, "CaptureImage", action="deny", code="MethodDenied",
                policies=["no-pictures-of-the-schoolyard"], at={"lat": 50.86487, "lon": 4.68223, "alt": 33.0},
                reason="policy no-pictures-of-the-schoolyard denies CaptureImage here",
            )
            for seconds in (66, 68)
        ),
        {"kind": "control", "time": stamp(TAKEOFF_S + 80), "state": "returned"},
    ]  # fmt: skip


def content() -> dict[str, Any]:
    return {
        "objects": list(objects()),
        "pods": pods(),
        "events": [],
        "audit": {"entries": 40, "kept": 9, "problem": ""},
        "times": {
            "applied": APPLIED_S,
            "planned": APPLIED_S + 0.8,
            "running": APPLIED_S + 11,
            "ended": TAKEOFF_S + 130,
        },
    }


def _metres(stop: tuple[float, ...]) -> tuple[float, float]:
    return (stop[0] * 111_229.0, stop[1] * 70_300.0)


def _line(
    seconds: float, lat: float, lon: float, alt: float, mode: str, *, flying: bool, speed: float = 0.0
) -> dict[str, Any]:
    return {
        "kind": "state",
        "time": stamp(seconds),
        "lat": lat,
        "lon": lon,
        "alt": alt,
        "speed": speed,
        "mode": mode,
        "battery": 0.9,
        "in_air": flying,
    }


def _call(seconds: float, caller: str, method: str, at: dict[str, float] | None = None, **rest: Any) -> dict[str, Any]:
    place = at or {"lat": HOME[0], "lon": HOME[1], "alt": 0.0}
    return {"kind": "call", "time": stamp(seconds), "caller": caller, "method": method, "args": {}, **place, **rest}
