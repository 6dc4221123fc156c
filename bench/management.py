"""Time from `POST /v1/plans` until the response with the decision, with a real API server, operator and management API.

Many other plans are open. They use other times, so that the requested plan is accepted. The operator has just started again, so it
also judges the open plans again. Everything runs on one machine without nodes. The comparator is one write to the same API server.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "integration"))

import chart
from control_plane import ControlPlane, programs, wait_for
from harness import Report, parser, quantile
from management_server import ManagementServer, User, plan, user_token
from operator_world import FRACTUS, OperatorProcess, World, approved_template, at, fresh_namespace

Body = dict[str, Any]

NAMESPACE = "bench"
DRONES = 20
SPACING_S = 240.0
"""Time between the starts of two open plans. The last of 10,000 starts in 28 days."""

_EDITOR = ("fractus-flightplan-editor",)
_VIEWER = ("fractus-drone-viewer", "fractus-applicationtemplate-viewer")
_TIMEOUT_S = 600.0


def open_plan(number: int) -> Body:
    """Return an accepted plan. Each number has its own place and time."""
    start = datetime.now(UTC) + timedelta(seconds=86_400 + number * SPACING_S)
    drone = f"drone-{1 + number % DRONES}"
    north_m = 2000 + 200 * (number % 100)
    east_m = 200 * (number // 100)
    corners = [at(north_m + dx, east_m + dy) for dx, dy in ((0, 0), (0, 100), (100, 100), (100, 0))]
    message = f"{drone} is reserved"
    condition = {
        "type": "Accepted", "status": "True", "reason": "Accepted", "message": message, "observedGeneration": 1,
        "lastTransitionTime": "2026-01-01T00:00:00Z",
    }  # fmt: skip
    volume = {
        "areas": [{"polygon": {"exterior": corners}}], "upper": 100.0, "begin": start.isoformat(),
        "end": (start + timedelta(minutes=15)).isoformat(),
    }  # fmt: skip
    status = {
        "state": "Accepted", "observedGeneration": 1, "decidedFor": 1, "drone": drone, "message": message,
        "priorityClass": "normal", "volumes": [volume], "conditions": [condition],
    }  # fmt: skip
    spec = plan(waypoints=[at(north_m, east_m, alt=20)]) | {
        "window": {"start": start.strftime("%Y-%m-%dT%H:%M:%SZ"), "duration": 15}
    }
    header = {"apiVersion": "fractus.dev/v1alpha1", "kind": "FlightPlan", "metadata": {"name": f"open-{number}"}}
    return {**header, "spec": spec, "status": status}


def add_open_plans(plane: ControlPlane, numbers: range) -> None:
    """Store accepted plans at the API server, while no operator runs that would decide on them."""
    path = f"{FRACTUS}/namespaces/{NAMESPACE}/flightplans"

    def add(part: range) -> None:
        api = World(plane).api
        for number in part:
            body = open_plan(number)
            created = api.call("POST", path, body)
            created["status"] = body["status"]
            api.call("PUT", f"{path}/{body['metadata']['name']}/status", created)

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(add, (numbers[first::4] for first in range(4))))


def decision_ms(user: User, world: World, count: int, first: int) -> tuple[list[float], list[float]]:
    """Return the times of submissions until their decisions, and the times of single writes."""
    times_ms = []
    writes_ms = []
    path = f"/api/v1/namespaces/{NAMESPACE}/configmaps/bench"
    for number in range(first, first + count):
        body = plan(in_s=3600 + 1020 * number)
        begin_s = time.perf_counter()
        reply = user("POST", "/v1/plans", body)
        times_ms.append((time.perf_counter() - begin_s) * 1000)
        assert reply.status == 201, reply
        assert reply.body["status"]["state"] == "Accepted", reply.body["status"]
        begin_s = time.perf_counter()
        header = {"apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": "bench"}}
        world.api.apply(path, {**header, "data": {"number": str(number)}})
        writes_ms.append((time.perf_counter() - begin_s) * 1000)
    return times_ms, writes_ms


@contextmanager
def cluster(directory: Path) -> Iterator[tuple[ControlPlane, World, OperatorProcess, ManagementServer]]:
    """Run an API server, the operator and the management API."""
    plane = ControlPlane(programs(), directory)
    operator = OperatorProcess(plane.kubeconfig, directory / "operator.log")
    try:
        plane.start()
        world = World(plane)
        world.furnish()
        for number in range(2, DRONES + 1):
            world.add_drone(f"drone-{number}")
        chart.install(world)
        approved_template(world)
        operator.start()
        wait_for(world.is_labelled, operator.log, _TIMEOUT_S)
        server = ManagementServer(plane, directory / "management.log")
        try:
            yield plane, world, operator, server
        finally:
            server.stop()
    finally:
        if operator.running:
            operator.stop()
        plane.stop()


def main() -> int:
    arguments = parser(__doc__, quick="10 decisions, 100 open plans")
    arguments.add_argument("--plans", type=int, nargs="+", default=[1000, 10_000], help="numbers of open plans")
    arguments.add_argument("--decisions", type=int, default=35, help="decisions for each number of open plans")
    options = arguments.parse_args()
    counts = [100] if options.quick else options.plans
    decisions = 10 if options.quick else options.decisions
    report = Report("management", options)
    with (
        tempfile.TemporaryDirectory(prefix="fractus-management-") as directory,
        cluster(Path(directory)) as (plane, world, operator, server),
        fresh_namespace(world, NAMESPACE),
    ):
        user = User(server, user_token(world, NAMESPACE, "pilot", _EDITOR, _VIEWER), NAMESPACE)
        wait_for(lambda: user("GET", "/v1/plans").status == 200, "the role of the user", _TIMEOUT_S)
        present = 0
        for index, count in enumerate(counts):
            begin_s = time.monotonic()
            operator.stop()
            add_open_plans(plane, range(present, count))
            operator.start()
            present = count
            wait_for(lambda: user("POST", "/v1/plans:check", plan()).status == 200, "the operator", _TIMEOUT_S)
            print(f"{count} open plans after {time.monotonic() - begin_s:.0f} s", flush=True)
            times_ms, writes_ms = decision_ms(user, world, decisions, index * decisions)
            for claim, share in (("decision", 0.5), ("decision_p95", 0.95)):
                report.add(claim, quantile(times_ms, share) / 1000, quantile(writes_ms, share) / 1000, count=count)
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
