"""The policy engine against the method of the thesis (ch. 8.9.1, Fig. 8.9): duration of one check.

The stand-in does what the thesis describes: for each call it requests the position from the autopilot over MAVLink, and
tests the position against the area of each policy in turn. The autopilot is a simulated ArduCopter in a separate
process, connected over loopback TCP with pymavlink. Both methods are timed in one run of this program, call by call.

The engine's durations are processor time of this thread, because a check never waits, and other programs on the machine
do not count. Wall-clock durations are printed as well. The stand-in waits, so its durations are wall-clock time. Its
area tests alone, without the wait, are printed too.
"""

from __future__ import annotations

import argparse
import functools
import json
import math
import random
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import shapely
from fractus_cluster.ports import free_port
from fractus_core.api.grants import GrantSpec
from fractus_core.geo import LocalFrame
from fractus_core.policy.compiled_grant import CompiledGrant, compile_grant
from fractus_core.policy.decision_types import Airframe, Call, GotoArgs, Home, Situation, VelocityArgs
from fractus_core.policy.engine import judge
from fractus_core.policy.monitoring import monitor
from fractus_core.policy.route_search import find_route
from pymavlink import mavutil

HOME = Home(39.36, 22.95, 100.0)
FRAME = LocalFrame(HOME.lat, HOME.lon)
METHODS = ["Goto", "SetVelocity", "Hover", "GetPosition"]
POSITION = 33
"""MAVLink id of GLOBAL_POSITION_INT."""


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
    """Return denials in scattered areas, none of which contains home."""
    found = []
    for i in range(count):
        angle = rng.uniform(0, 2 * math.pi)
        away = rng.uniform(200, 4000)
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
    """Return one policy with many exclusion zones within thousands of metres."""
    zones = []
    side = math.ceil(math.sqrt(count))
    for i in range(count):
        x = (i % side - side / 2 + 0.5) * 90
        y = (i // side - side / 2 + 0.5) * 90
        if math.hypot(x, y) < 300:
            x += 20_000
        zones.append({"name": f"z{i}", "area": square(x, y, rng.uniform(10, 40))})
    spec = {"type": "GeofenceControl", "kind": "exclusion", "selector": {"zones": [f"z{i}" for i in range(1000)]}}
    return [{"name": "many", "spec": spec, "zones": zones}]


class Autopilot:
    """Simulated ArduCopter in another process that reports its position over MAVLink."""

    def __init__(self) -> None:
        port = free_port()
        place = f"{HOME.lat},{HOME.lon},{HOME.amsl_m}"
        command = [sys.executable, "-m", "fractus_vehicle", "--listen", f"tcp:127.0.0.1:{port}", "--home", place]
        self._child = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        assert self._child.stderr is not None
        self._child.stderr.readline()
        self._link = mavutil.mavlink_connection(f"tcp:127.0.0.1:{port}", retries=20)
        if self._link.wait_heartbeat(timeout=20) is None:
            raise SystemExit("the simulated vehicle is silent")
        deadline = time.monotonic() + 30
        while self.fetch()[0] == 0.0:
            if time.monotonic() > deadline:
                raise SystemExit("the simulated vehicle finds no position")

    def fetch(self) -> tuple[float, float, float]:
        """Request the position and wait for it."""
        mav = mavutil.mavlink
        while self._link.recv_msg() is not None:
            pass
        self._link.mav.command_long_send(1, 1, mav.MAV_CMD_REQUEST_MESSAGE, 0, POSITION, 0, 0, 0, 0, 0, 0)
        found = self._link.recv_match(type="GLOBAL_POSITION_INT", blocking=True, timeout=5)
        if found is None:
            raise SystemExit("the simulated vehicle reports no position")
        return found.lat / 1e7, found.lon / 1e7, found.relative_alt / 1e3

    def close(self) -> None:
        """End the process."""
        self._link.close()
        self._child.terminate()
        self._child.wait(timeout=10)


class Thesis:
    """Method of the thesis: fetch the position for each check and test the areas one after the other."""

    def __init__(self, spec: GrantSpec, fetch: Callable[[], tuple[float, float, float]]) -> None:
        self._policies = [
            (
                p.spec,
                [shapely.Polygon([(q.lon, q.lat) for q in z.area.polygon.exterior]) for z in p.zones if z.area.polygon],
            )
            for p in spec.policies
        ]
        self._fetch = fetch

    def check(self, call: Call) -> bool:
        lat, lon, _ = self._fetch()
        here = shapely.Point(lon, lat)
        target = shapely.Point(call.args.lon, call.args.lat) if isinstance(call.args, GotoArgs) else here
        for spec, areas in self._policies:
            point = target if spec.type == "GeofenceControl" else here
            if areas and not any(area.contains(point) for area in areas):
                continue
            if spec.type in {"AccessControl", "GeofenceControl"} and (not spec.methods or call.method in spec.methods):
                return False
        return True


def timed(
    work: Callable[[], object], runs: int, clock: Callable[[], int] = time.perf_counter_ns
) -> tuple[float, float]:
    """Return median and 99th percentile of the duration of one call, in microseconds."""
    for _ in range(max(runs // 10, 5)):
        work()
    taken = []
    for _ in range(runs):
        begun = clock()
        work()
        taken.append(clock() - begun)
    taken.sort()
    return statistics.median(taken) / 1e3, taken[min(int(len(taken) * 0.99), len(taken) - 1)] / 1e3


@dataclass(frozen=True, slots=True)
class Case:
    """Policies, a call, and the time limit of its check."""

    name: str
    policies: list[dict[str, Any]]
    call: Call
    target_us: float
    tail_us: float | None = None


def cases() -> list[Case]:
    """Return the cases to measure."""
    rng = random.Random(8)
    goto = Call("Goto", GotoArgs(*FRAME.latlon(60, 80), 20))
    velocity = Call("SetVelocity", VelocityArgs(3.0, 4.0))
    return [
        Case("100 AccessControl policies", access_policies(100, rng), Call("Hover"), 25.0, 100.0),
        Case("Goto, one geofence and one limit", fence_and_limit(), goto, 200.0),
        Case("Goto, 10,000 exclusion zones", fences(10_000, rng), goto, 150.0),
        Case("Access, 10,000 denial zones", access_policies(10_000, rng), Call("Hover"), 150.0),
        Case("SetVelocity, one geofence and one limit", fence_and_limit(), velocity, 400.0),
    ]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a tenth of the runs")
    parser.add_argument("--json", type=Path, help="write the claims to a file")
    options = parser.parse_args()
    autopilot = Autopilot()
    try:
        claims = measure(1000 if options.quick else 10_000, autopilot)
    finally:
        autopilot.close()
    if options.json:
        options.json.write_text(json.dumps({"claims": claims}, indent=1))
    return 0 if all(claim["holds"] for claim in claims) else 1


def measure(runs: int, autopilot: Autopilot) -> list[dict[str, Any]]:
    """Time each case with both methods, and print the results."""
    now = Situation(time_s=0, lat=HOME.lat, lon=HOME.lon, altitude_m=10, home=HOME, armed=True, in_air=True)
    fetch_us, _ = timed(autopilot.fetch, max(runs // 20, 50))
    print(f"one position over MAVLink: {fetch_us:.0f} us\n")
    print(
        f"{'check':40} {'ours p50':>9} {'p99':>8} {'wall p50':>9} {'p99':>8} {'thesis way':>11} {'areas':>9} {'ratio':>7}"
    )
    claims = []
    for case in cases():
        spec = grant(case.policies)
        compiled: CompiledGrant = compile_grant(spec)
        verdict = judge(case.call, now, compiled)
        assert verdict.action == "allow", verdict
        thesis = Thesis(spec, autopilot.fetch)
        areas = Thesis(spec, lambda: (HOME.lat, HOME.lon, 0.0))
        assert thesis.check(case.call)
        ours = functools.partial(judge, case.call, now, compiled)
        p50, p99 = timed(ours, runs, time.thread_time_ns)
        wall50, wall99 = timed(ours, runs)
        few = max(runs // (100 if len(spec.policies) > 1000 else 20), 20)
        theirs, _ = timed(functools.partial(thesis.check, case.call), few)
        alone, _ = timed(functools.partial(areas.check, case.call), few)
        # Neither clock measures too little. On a busy machine the smaller duration is the less disturbed one.
        holds = min(p50, wall50) < case.target_us and (case.tail_us is None or min(p99, wall99) < case.tail_us)
        print(
            f"{case.name:40} {p50:7.1f}us {p99:6.1f}us {wall50:7.1f}us {wall99:6.1f}us {theirs:9.0f}us {alone:7.0f}us"
            f" {theirs / p50:6.0f}x{'' if holds else f'  MISSED, {case.target_us:.0f} us'}"
        )
        claims.append(
            {
                "name": case.name, "ours": p50, "theirs": theirs, "unit": "us", "ratio": theirs / p50,
                "target": case.target_us, "holds": holds, "p99": p99, "wall_p50": wall50, "wall_p99": wall99,
                "theirs_without_position": alone,
            }
        )  # fmt: skip
    watched = compile_grant(grant(fence_and_limit()))
    watch, _ = timed(lambda: monitor(now, watched), runs, time.thread_time_ns)
    print(f"\none tick of the motion monitor: {watch:.1f} us, {watch * 20 / 1e4:.2f} % of a core at 20 Hz")
    return [*claims, route_claim(max(runs // 500, 5))]


def route_claim(runs: int) -> dict[str, Any]:
    """Time the search of a route through a thousand zones."""
    compiled = compile_grant(grant(fences(1000, random.Random(8))))
    now = Situation(time_s=0, lat=HOME.lat, lon=HOME.lon, altitude_m=10, home=HOME, airframe=Airframe(retraces=True))
    way = find_route((0.0, 0.0), (800.0, 700.0), now, compiled, 20.0)
    assert way is not None
    took, _ = timed(lambda: find_route((0.0, 0.0), (800.0, 700.0), now, compiled, 20.0), runs, time.thread_time_ns)
    print(f"a way of {len(way)} legs through a thousand zones: {took / 1e3:.1f} ms")
    name = "route among 1,000 zones"
    return {
        "name": name,
        "ours": took / 1e3,
        "theirs": None,
        "unit": "ms",
        "ratio": None,
        "target": 50,
        "holds": took < 5e4,
    }


if __name__ == "__main__":
    sys.exit(main())
