"""Duration of one policy check, against the method of the thesis (ch. 8.9.1, Fig. 8.9).

The comparator does what the thesis describes: for each call it requests the position from the autopilot over MAVLink, and
tests the position against the area of each policy in turn. The autopilot is a simulated ArduCopter in another process,
connected over loopback TCP with pymavlink.

A check never waits. It is therefore timed with both a processor clock and a wall clock, and the smaller duration
counts. Other programs can only lengthen a duration. The comparator waits for the autopilot, so its durations are
wall-clock time. The table also shows the area tests of the comparator alone, with a known position.
"""

from __future__ import annotations

import functools
import math
import random
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import shapely
from fractus_cluster.ports import free_port
from fractus_core.api.grants import GrantSpec
from fractus_core.geo import LocalFrame
from fractus_core.policy.compiled_grant import compile_grant
from fractus_core.policy.decision_types import Airframe, Call, GotoArgs, Home, Situation, VelocityArgs
from fractus_core.policy.engine import judge
from fractus_core.policy.monitoring import monitor
from fractus_core.policy.route_search import find_route
from harness import Processes, Report, durations_us, parser, print_table, quantile
from pymavlink import mavutil

HOME = Home(39.36, 22.95, 100.0)
FRAME = LocalFrame(HOME.lat, HOME.lon)
METHODS = ["Goto", "SetVelocity", "Hover", "GetPosition"]
NOW = Situation(time_s=0, lat=HOME.lat, lon=HOME.lon, altitude_m=10, home=HOME, armed=True, in_air=True)


def square(x: float, y: float, half: float) -> dict[str, Any]:
    """Return a square area around a point, in metres from home."""
    corners = ((x - half, y - half), (x + half, y - half), (x + half, y + half), (x - half, y + half))
    return {"polygon": {"exterior": [dict(zip(("lat", "lon"), FRAME.latlon(*c), strict=True)) for c in corners]}}


def grant(policies: list[dict[str, Any]]) -> GrantSpec:
    """Return the Grant of a driver with some policies."""
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
    """Return policies that each deny a call in one of many scattered areas. No area contains home."""
    policies = []
    for i in range(count):
        angle = rng.uniform(0, 2 * math.pi)
        distance_m = rng.uniform(200, 4000)
        area = square(distance_m * math.cos(angle), distance_m * math.sin(angle), rng.uniform(20, 90))
        spec = {"type": "AccessControl", "kind": "denial", "methods": ["Hover"], "selector": {"zones": [f"z{i}"]}}
        policies.append({"name": f"p{i}", "spec": spec, "zones": [{"name": f"z{i}", "area": area}]})
    return policies


def fence_and_limit() -> list[dict[str, Any]]:
    """Return one geofence and one altitude limit."""
    return [
        {
            "name": "fence", "zones": [{"name": "f", "area": square(300, 300, 50)}],
            "spec": {"type": "GeofenceControl", "kind": "exclusion", "action": "ignore", "selector": {"zones": ["f"]}},
        },
        {"name": "limit", "spec": {"type": "LimitControl", "kind": "altitude", "lowerLimit": 5, "upperLimit": 50}},
    ]  # fmt: skip


def fences(count: int, rng: random.Random) -> list[dict[str, Any]]:
    """Return one policy with many exclusion zones on a grid of several kilometres, none of them near home."""
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
    """MAVLink connection to a simulated ArduCopter that listens on a loopback port."""

    def __init__(self, port: int) -> None:
        self._link = mavutil.mavlink_connection(f"tcp:127.0.0.1:{port}", retries=20)
        if self._link.wait_heartbeat(timeout=20) is None:
            raise SystemExit("bench: the simulated vehicle sends no heartbeat")
        deadline_s = time.monotonic() + 30
        while self.position()[0] == 0.0:
            if time.monotonic() > deadline_s:
                raise SystemExit("bench: the simulated vehicle has no position after 30 s")

    def position(self) -> tuple[float, float, float]:
        """Request the position and wait for it."""
        mav = mavutil.mavlink
        while self._link.recv_msg() is not None:
            pass
        message_id = mav.MAVLINK_MSG_ID_GLOBAL_POSITION_INT
        self._link.mav.command_long_send(1, 1, mav.MAV_CMD_REQUEST_MESSAGE, 0, message_id, 0, 0, 0, 0, 0, 0)
        message = self._link.recv_match(type="GLOBAL_POSITION_INT", blocking=True, timeout=5)
        if message is None:
            raise SystemExit("bench: the simulated vehicle sent no position within 5 s")
        return message.lat / 1e7, message.lon / 1e7, message.relative_alt / 1e3


class Thesis:
    """Method of the thesis: request the position for each check, and test the areas one after the other."""

    def __init__(self, spec: GrantSpec, position: Callable[[], tuple[float, float, float]]) -> None:
        self._policies = [
            (p.spec, [shapely.Polygon([(q.lon, q.lat) for q in z.area.polygon.exterior]) for z in p.zones if z.area.polygon])
            for p in spec.policies
        ]  # fmt: skip
        self._position = position

    def check(self, call: Call) -> bool:
        """Return True if the call is allowed."""
        lat, lon, _ = self._position()
        position = shapely.Point(lon, lat)
        target = shapely.Point(call.args.lon, call.args.lat) if isinstance(call.args, GotoArgs) else position
        for spec, areas in self._policies:
            point = target if spec.type == "GeofenceControl" else position
            if areas and not any(area.contains(point) for area in areas):
                continue
            if spec.type in {"AccessControl", "GeofenceControl"} and (not spec.methods or call.method in spec.methods):
                return False
        return True


@dataclass(frozen=True, slots=True)
class Case:
    """A call to check under some policies. `claim` is the key of its claim."""

    claim: str
    policies: list[dict[str, Any]]
    call: Call


def cases() -> list[Case]:
    """Return the cases to measure."""
    rng = random.Random(8)
    goto = Call("Goto", GotoArgs(*FRAME.latlon(60, 80), 20))
    velocity = Call("SetVelocity", VelocityArgs(3.0, 4.0))
    return [
        Case("access", access_policies(100, rng), Call("Hover")),
        Case("goto", fence_and_limit(), goto),
        Case("goto_many", fences(10_000, rng), goto),
        Case("access_many", access_policies(10_000, rng), Call("Hover")),
        Case("velocity", fence_and_limit(), velocity),
    ]


def check_durations_us(work: Callable[[], object], runs: int) -> tuple[float, float]:
    """Return median and 99th percentile of the duration of a check, each from the clock with the smaller value."""
    warm_up = max(runs // 10, 5)
    clocks = (time.thread_time_ns, time.perf_counter_ns)
    taken = [durations_us(work, runs, warm_up=warm_up, clock=clock) for clock in clocks]
    return min(map(statistics.median, taken)), min(quantile(values, 0.99) for values in taken)


def measure(report: Report, runs: int, autopilot: Autopilot) -> None:
    """Measure each case with Fractus and with the method of the thesis."""
    request_us = statistics.median(durations_us(autopilot.position, max(runs // 20, 50)))
    rows = [("one position over MAVLink", request_us, 0.0)]
    for case in cases():
        spec = grant(case.policies)
        compiled = compile_grant(spec)
        verdict = judge(case.call, NOW, compiled)
        assert verdict.action == "allow", verdict
        thesis = Thesis(spec, autopilot.position)
        areas = Thesis(spec, lambda: (HOME.lat, HOME.lon, 0.0))
        assert thesis.check(case.call)
        p50, p99 = check_durations_us(functools.partial(judge, case.call, NOW, compiled), runs)
        few = max(runs // (100 if len(spec.policies) > 1000 else 20), 20)
        reference = statistics.median(durations_us(functools.partial(thesis.check, case.call), few, warm_up=5))
        alone = statistics.median(durations_us(functools.partial(areas.check, case.call), few, warm_up=5))
        rows.append((case.claim, reference, alone))
        report.add(case.claim, p50, reference, p99=p99)
        if case.claim == "access":
            report.add("access_tail", p99)
    compiled = compile_grant(grant(fence_and_limit()))
    tick_us, _ = check_durations_us(lambda: monitor(NOW, compiled), runs)
    report.add("monitor", tick_us)
    print_table(("method of the thesis", "us", "areas alone"), rows)


def measure_route(report: Report, runs: int) -> None:
    """Measure the search for a route between a thousand zones."""
    compiled = compile_grant(grant(fences(1000, random.Random(8))))
    situation = Situation(
        time_s=0, lat=HOME.lat, lon=HOME.lon, altitude_m=10, home=HOME, airframe=Airframe(retraces=True)
    )
    search = functools.partial(find_route, (0.0, 0.0), (800.0, 700.0), situation, compiled, 20.0)
    route = search()
    assert route is not None
    taken = durations_us(search, runs, warm_up=5, clock=time.thread_time_ns)
    report.add("route", statistics.median(taken) / 1e3, legs=len(route))


def main() -> int:
    options = parser(__doc__, quick="a tenth of the repetitions").parse_args()
    runs = 1000 if options.quick else 10_000
    report = Report("policy", options)
    port = free_port()
    with tempfile.TemporaryDirectory() as directory, Processes(Path(directory)) as processes:
        place = f"{HOME.lat},{HOME.lon},{HOME.amsl_m}"
        link = f"tcp:127.0.0.1:{port}"
        processes.start("vehicle", sys.executable, "-m", "fractus_vehicle", "--listen", link, "--home", place)
        measure(report, runs, Autopilot(port))
    measure_route(report, max(runs // 500, 5))
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
