"""The policy engine against the method of the thesis (ch. 8.9.1, Fig. 8.9): how long one check takes.

The stand-in does what the thesis describes: for each call it fetches the position over MAVLink (a request and the answer
on a loopback TCP connection) and tests the position against every policy's area in turn. Both run in this process.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import socket
import statistics
import struct
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import shapely
from fractus_core.api.plans import GrantSpec
from fractus_core.geo import LocalFrame
from fractus_core.policy.compiled import CompiledGrant, compile_grant
from fractus_core.policy.engine import judge
from fractus_core.policy.monitoring import monitor
from fractus_core.policy.values import Call, GotoArgs, Home, Situation

HOME = Home(39.36, 22.95, 100.0)
FRAME = LocalFrame(HOME.lat, HOME.lon)
METHODS = ["Goto", "Hover", "GetPosition"]


def square(x: float, y: float, half: float) -> dict[str, Any]:
    corners = ((x - half, y - half), (x + half, y - half), (x + half, y + half), (x - half, y + half))
    return {"polygon": {"exterior": [dict(zip(("lat", "lon"), FRAME.latlon(*c), strict=True)) for c in corners]}}


def grant(policies: list[dict[str, Any]]) -> GrantSpec:
    return GrantSpec.model_validate(
        {
            "node": "drone", "application": {"namespace": "d", "name": "a", "uid": "u"}, "component": "Navigator",
            "instance": "a-navigator", "class": "driver", "control": "full", "policies": policies,
            "services": [{"service": "mobility", "methods": METHODS}],
            "operationArea": [square(0, 0, 5000)], "home": {"lat": HOME.lat, "lon": HOME.lon},
            "limits": {"maxAltitude": 120, "maxSpeed": 15},
        }
    )  # fmt: skip


def access_policies(count: int, rng: random.Random) -> list[dict[str, Any]]:
    """Denials in scattered areas; none holds at home."""
    found = []
    for i in range(count):
        angle, away = rng.uniform(0, 2 * math.pi), rng.uniform(200, 4000)
        zone = {"name": f"z{i}", "area": square(away * math.cos(angle), away * math.sin(angle), rng.uniform(20, 90))}
        spec = {"type": "AccessControl", "kind": "denial", "methods": ["Hover"], "selector": {"zones": [f"z{i}"]}}
        found.append({"name": f"p{i}", "spec": spec, "zones": [zone]})
    return found


def fence_and_limit() -> list[dict[str, Any]]:
    return [
        {
            "name": "fence", "zones": [{"name": "f", "area": square(300, 300, 50)}],
            "spec": {"type": "GeofenceControl", "kind": "exclusion", "action": "ignore", "selector": {"zones": ["f"]}},
        },
        {"name": "limit", "spec": {"type": "LimitControl", "kind": "altitude", "lowerLimit": 5, "upperLimit": 50}},
    ]  # fmt: skip


def fences(count: int, rng: random.Random) -> list[dict[str, Any]]:
    """One policy with many exclusion zones in thousands of metres around."""
    zones = []
    side = math.ceil(math.sqrt(count))
    for i in range(count):
        x, y = (i % side - side / 2 + 0.5) * 90, (i // side - side / 2 + 0.5) * 90
        if math.hypot(x, y) < 300:
            x += 20_000
        zones.append({"name": f"z{i}", "area": square(x, y, rng.uniform(10, 40))})
    spec = {"type": "GeofenceControl", "kind": "exclusion", "selector": {"zones": [f"z{i}" for i in range(1000)]}}
    return [{"name": "many", "spec": spec, "zones": zones}]


class PositionServer:
    """Stands for the autopilot behind a MAVLink router: answers each request with a position."""

    def __init__(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        threading.Thread(target=self._serve, daemon=True).start()
        self._client = socket.create_connection(self._listener.getsockname())
        self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def _serve(self) -> None:
        peer, _ = self._listener.accept()
        peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        while peer.recv(64):
            peer.sendall(
                struct.pack("<IiiiihhhH", 1, int(HOME.lat * 1e7), int(HOME.lon * 1e7), 110000, 10000, 0, 0, 0, 0)
            )

    def fetch(self) -> tuple[float, float, float]:
        self._client.sendall(b"\xfd position please")
        _, lat, lon, _, alt, *_ = struct.unpack("<IiiiihhhH", self._client.recv(64))
        return lat / 1e7, lon / 1e7, alt / 1e3


class Thesis:
    """Position fetched for each check, areas tested one after the other."""

    def __init__(self, spec: GrantSpec, server: PositionServer) -> None:
        self._policies = [
            (
                p.spec,
                [shapely.Polygon([(q.lon, q.lat) for q in z.area.polygon.exterior]) for z in p.zones if z.area.polygon],
            )
            for p in spec.policies
        ]
        self._server = server

    def check(self, call: Call) -> bool:
        lat, lon, _ = self._server.fetch()
        here = shapely.Point(lon, lat)
        target = shapely.Point(call.args.lon, call.args.lat) if isinstance(call.args, GotoArgs) else here
        for spec, areas in self._policies:
            point = target if spec.type == "GeofenceControl" else here
            if areas and not any(area.contains(point) for area in areas):
                continue
            if spec.type in {"AccessControl", "GeofenceControl"} and (not spec.methods or call.method in spec.methods):
                return False
        return True


def timed(work: Callable[[], object], runs: int) -> tuple[float, float]:
    """Median and 99th percentile of one call, in microseconds."""
    for _ in range(max(runs // 10, 5)):
        work()
    taken = []
    for _ in range(runs):
        begun = time.perf_counter_ns()
        work()
        taken.append(time.perf_counter_ns() - begun)
    taken.sort()
    return statistics.median(taken) / 1e3, taken[min(int(len(taken) * 0.99), len(taken) - 1)] / 1e3


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a tenth of the runs")
    parser.add_argument("--json", type=Path, help="write the claims to a file")
    options = parser.parse_args()
    runs = 1000 if options.quick else 10_000
    rng = random.Random(8)
    now = Situation(time_s=0, lat=HOME.lat, lon=HOME.lon, altitude_m=10, home=HOME, armed=True, in_air=True)
    server = PositionServer()
    goto = Call("Goto", GotoArgs(*FRAME.latlon(60, 80), 20))
    cases: tuple[tuple[str, list[dict[str, Any]], Call, float], ...] = (
        ("100 AccessControl policies", access_policies(100, rng), Call("Hover"), 25.0),
        ("Goto, one geofence and one limit", fence_and_limit(), goto, 200.0),
        ("Goto, 10,000 exclusion zones", fences(10_000, rng), goto, 150.0),
        ("Access, 10,000 denial zones", access_policies(10_000, rng), Call("Hover"), 150.0),
    )
    claims = []
    print(f"{'check':36} {'ours p50':>10} {'p99':>9} {'thesis way':>11} {'ratio':>7} {'target':>8}")
    for name, policies, call, target_us in cases:
        spec = grant(policies)
        compiled: CompiledGrant = compile_grant(spec)
        assert judge(call, now, compiled).action == "allow"
        thesis = Thesis(spec, server)
        assert thesis.check(call)
        p50, p99 = timed(lambda c=call, g=compiled: judge(c, now, g), runs)  # type: ignore[misc]
        theirs, _ = timed(
            lambda c=call, t=thesis: t.check(c), max(runs // (100 if len(spec.policies) > 1000 else 10), 20)
        )  # type: ignore[misc]
        holds = p50 < target_us and (target_us != 25.0 or p99 < 100.0)
        print(
            f"{name:36} {p50:8.1f}us {p99:7.1f}us {theirs:9.1f}us {theirs / p50:6.1f}x {target_us:6.0f}us{'' if holds else '  MISSED'}"
        )
        claims.append(
            {
                "name": name,
                "ours": p50,
                "theirs": theirs,
                "unit": "us",
                "ratio": theirs / p50,
                "target": target_us,
                "holds": holds,
                "p99": p99,
            }
        )
    watched = compile_grant(grant(fence_and_limit()))
    watch, _ = timed(lambda: monitor(now, watched), runs)
    print(f"one tick of the motion monitor: {watch:.1f} us, {watch * 20 / 1e4:.2f} % of a core at 20 Hz")
    if options.json:
        options.json.write_text(json.dumps({"claims": claims}, indent=1))
    return 0 if all(claim["holds"] for claim in claims) else 1


if __name__ == "__main__":
    sys.exit(main())
