"""The Navigator of the example, as a process, flies a simulated vehicle through the real mobility service."""

from __future__ import annotations

import itertools
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
import yaml
from cryptography import x509
from fractus_cluster.ports import free_port
from fractus_core.api import Application, Depot, Drone, Grant, Policy, Zone
from fractus_core.api.model import Metadata
from fractus_core.api.plans import DeploymentPlanSpec, PlannedInstance
from fractus_core.planning import Inventory
from fractus_core.planning.grant_compiler import compile_grants
from fractus_core.policy.grant_signatures import sign
from fractus_runtime.audit_chain import verify
from mobility_rig import issue_signer
from sdk_service import Authority

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "traffic-monitoring"
SPEEDUP = 3.0
"""Vehicle time per real time. It must be below 5: one heartbeat per real second, failsafe after 5 s of vehicle time."""
pytestmark = pytest.mark.timeout(300)


def documents(name: str) -> list[dict[str, Any]]:
    return list(yaml.safe_load_all((EXAMPLE / name).read_text()))


def application(waypoints: int) -> Application:
    """Return the application of the example, with the first waypoints of its path."""
    (body,) = documents("application.yaml")
    point = body["spec"]["components"][0]["controlPoints"][0]
    point["path"] = point["path"][:waypoints]
    return Application.from_body(body)


def navigator_grant(application: Application) -> Grant:
    """Return the Grant that the operator would compile for the Navigator."""
    placed = PlannedInstance(
        component="Navigator", instance="traffic-navigator", node="drone-1", placement="drone", role="drone"
    )
    inventory = Inventory(
        hosts={},
        drones={d["metadata"]["name"]: Drone.from_body(d) for d in documents("drone.yaml")},
        edge_nodes={},
        depots={d["metadata"]["name"]: Depot.from_body(d) for d in documents("depot.yaml")},
        zones={z["metadata"]["name"]: Zone.from_body(z) for z in documents("zones.yaml")},
        policies={p["metadata"]["name"]: Policy.from_body(p) for p in documents("policies.yaml")},
        claimed={},
    )
    (spec,) = compile_grants(
        application, DeploymentPlanSpec(application=application.name, placements=(placed,)), inventory
    )
    return Grant(metadata=Metadata(name="default.traffic-navigator", uid="uid-1"), spec=spec)


class Stage:
    """Vehicle, mobility service and Navigator as processes."""

    def __init__(self, folder: Path, waypoints: int) -> None:
        self.folder = folder
        self.application = application(waypoints)
        self.grant = navigator_grant(self.application)
        self.audit = folder / "audit.jsonl"
        self.autopilot = f"tcp:127.0.0.1:{free_port()}"
        self.address = f"127.0.0.1:{free_port()}"
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        authority = Authority()
        node = "spiffe://fractus.dev/node/drone-1"
        authority.issue(
            folder / "node-tls", [x509.UniformResourceIdentifier(node), x509.DNSName("drone-1.node.fractus.dev")]
        )
        authority.issue(folder / "driver-tls", [x509.UniformResourceIdentifier(self.grant.spec.identity)])
        (folder / "grants").mkdir()
        # The service has identified its vehicle in an earlier run. Otherwise it would observe the vehicle for three seconds.
        (folder / "state").mkdir()
        known = {"link": self.autopilot, "system": 1, "component": 1}
        (folder / "state" / "vehicle.json").write_text(json.dumps(known))
        signer = issue_signer(authority.certificate, authority.key)
        signed = sign(self.grant.to_dict(), *signer, datetime.now(UTC))
        (folder / "grants" / "navigator.json").write_text(json.dumps(signed))

    def start_vehicle(self, speedup: float) -> None:
        """Start the vehicle. It lands three times as fast as with ArduCopter's default, so that tests wait less."""
        depot = documents("depot.yaml")[0]["spec"]["location"]
        self._start(
            "vehicle", "-m", "fractus_vehicle", "--listen", self.autopilot, "--speedup", str(speedup),
            "--ready-after", "2", "--throttle", "1500", "--param", "LAND_SPEED=150", "--home", f"{depot['lat']},{depot['lon']},25",
        )  # fmt: skip

    def start_service(self) -> None:
        self._start(
            "service", "-m", "fractus_services.mobility", "serve", "--grants", str(self.folder / "grants"),
            "--tls", str(self.folder / "node-tls"), "--state", str(self.folder / "state"), "--audit", str(self.audit),
            "--node", "drone-1", "--autopilot", self.autopilot, "--listen", self.address,
            "--description", str(self.folder / "none.yaml"), "--driver-grace", "5",
        )  # fmt: skip

    def start_navigator(self) -> None:
        driver = self.application.spec.driver
        assert driver is not None
        points = json.dumps([point.to_dict() for point in driver.control_points])
        self._start(
            "navigator", str(EXAMPLE / "navigator.py"),
            FRACTUS_NODE="drone-1", FRACTUS_MOBILITY_ADDRESS=self.address, FRACTUS_CONTROL_POINTS=points,
            FRACTUS_TLS_DIR=str(self.folder / "driver-tls"), KUBERNETES_SERVICE_HOST="as in a pod",
            **{e.name: e.value for e in driver.container.env},
        )  # fmt: skip

    def _start(self, name: str, *arguments: str, **environment: str) -> None:
        with (self.folder / f"{name}.log").open("ab") as log:
            self.processes[name] = subprocess.Popen(
                [sys.executable, *arguments], stdout=log, stderr=log, env={**os.environ, **environment}
            )

    def kill(self, name: str) -> None:
        self.processes[name].send_signal(signal.SIGKILL)
        self.processes[name].wait(10)

    def log(self, name: str) -> str:
        path = self.folder / f"{name}.log"
        return path.read_text() if path.exists() else ""

    def entries(self) -> list[dict[str, Any]]:
        lines = self.audit.read_bytes().splitlines(keepends=True) if self.audit.exists() else []
        return [json.loads(line) for line in lines if line.endswith(b"\n")]

    def wait(self, description: str, condition: Callable[[], bool], timeout_s: float = 90.0) -> None:
        deadline = time.monotonic() + timeout_s
        probe = subprocess.Popen(["tail", "-f", "/dev/null"])
        try:
            while not condition():
                assert time.monotonic() < deadline, (
                    f"waited {timeout_s} s for {description}\n{self.log('navigator')}\n{self.log('service')}"
                )
                try:
                    probe.wait(0.1)
                except subprocess.TimeoutExpired:
                    continue
        finally:
            probe.kill()
            probe.wait(10)

    def is_logged(self, action: str) -> bool:
        """Return True if the audit log contains a change of control with this action."""
        return any(e["kind"] == "control" and e["action"] == action for e in self.entries())

    def close(self) -> None:
        for process in self.processes.values():
            if process.poll() is None:
                process.kill()
                process.wait(10)


def running_stage(folder: Path, waypoints: int, speedup: float = SPEEDUP) -> Iterator[Stage]:
    stage = Stage(folder, waypoints)
    try:
        stage.start_vehicle(speedup)
        stage.start_service()
        yield stage
    finally:
        stage.close()


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    """A mission with the whole path of the example."""
    yield from running_stage(tmp_path, 5)


@pytest.fixture
def short(tmp_path: Path) -> Iterator[Stage]:
    """A mission with the first two waypoints only."""
    yield from running_stage(tmp_path, 2)


@pytest.fixture
def slow(tmp_path: Path) -> Iterator[Stage]:
    """A mission with two waypoints in real time. The service can restart before the failsafe acts."""
    yield from running_stage(tmp_path, 2, 1.0)


def calls(stage: Stage) -> list[tuple[str, str, str]]:
    """Return method, action and code of each call. Consecutive verdicts on the same call count once."""
    entries = [e for e in stage.entries() if e["kind"] == "call"]
    judgements = [list(group) for _, group in itertools.groupby(entries, lambda e: (e["method"], e["args"]))]
    return [(last["method"], last["action"], last["code"]) for *_, last in judgements]


# `make test` shows this with test_traffic_monitoring_flies_under_policies, which flies the same path on a cluster.
@pytest.mark.slow
def test_navigator_flies_path_with_corrections_and_refusals(stage: Stage) -> None:
    stage.start_navigator()
    stage.wait("landing", lambda: stage.is_logged("landed"))

    judged = [call for call in calls(stage) if call[0] in {"SetSpeed", "Goto", "Takeoff"}]
    assert judged == [
        ("Takeoff", "allow", ""),
        ("SetSpeed", "correct", "SpeedAboveLimit"),
        ("Goto", "allow", ""),
        ("Goto", "allow", ""),
        ("Goto", "deny", "InsideExclusionZone"),
        ("Goto", "correct", "AltitudeAboveLimit"),
        ("Goto", "allow", ""),
        ("Goto", "allow", ""),
    ]
    heights = [e["alt"] for e in stage.entries() if e["kind"] == "state"]
    assert 48.0 < max(heights) < 51.0
    log = stage.log("navigator")
    assert "flying at 9.5 m/s: speed 12.0 m/s is above the limit of policy town-speed" in log
    assert "detour refused, continuing: the target is" in log
    assert "waypoint 3/5 reached: 50.865633, 4.680631, 49.8 m (corrected: altitude 70.0 m" in log
    stage.wait("return of control", lambda: "control returned (mission_complete=True)" in stage.log("navigator"), 10)
    with stage.audit.open("rb") as lines:
        assert not verify(lines).problem


def test_killed_navigator_continues_mission_and_keeps_running_after_it(short: Stage) -> None:
    short.start_navigator()
    short.wait("first waypoint", lambda: "waypoint 1/2 reached" in short.log("navigator"))
    short.kill("navigator")
    short.start_navigator()
    short.wait("return", lambda: "control returned" in short.log("navigator"))
    log = short.log("navigator")
    assert "control granted (control_point=1 waypoints_reached=1)" in log
    assert log.count("waypoint 1/2 reached") == 1
    assert "waypoint 2/2 reached" in log
    assert short.is_logged("driver lost")

    short.kill("navigator")
    short.start_navigator()
    short.wait("report of the complete mission", lambda: "run: mission complete" in short.log("navigator"), 20)
    assert short.processes["navigator"].poll() is None


# `make test` shows this with test_killed_navigator_continues_mission_and_keeps_running_after_it and
# test_second_process_continues_when_the_connection_of_the_first_one_ends.
@pytest.mark.slow
def test_navigator_killed_at_each_stage_completes_mission(short: Stage) -> None:
    def has_called(method: str, times: int) -> bool:
        return [entry["method"] for entry in short.entries() if entry["kind"] == "call"].count(method) >= times

    stages: dict[str, Callable[[], bool]] = {
        "control": lambda: "control granted" in short.log("navigator"),
        "armed": lambda: "armed; taking off" in short.log("navigator"),
        "climb": lambda: any(e["kind"] == "state" and e["alt"] > 5 for e in short.entries()),
        "first leg": lambda: has_called("Goto", 1),
        "second leg": lambda: "waypoint 1/2 reached" in short.log("navigator"),
    }
    for stage, reached in stages.items():
        short.start_navigator()
        short.wait(stage, reached)
        short.kill("navigator")
    short.start_navigator()
    short.wait("return", lambda: "run: mission complete" in short.log("navigator"))
    log = short.log("navigator")
    assert log.count("waypoint 1/2 reached") == 1
    assert log.count("waypoint 2/2 reached") == 1
    assert "control granted (control_point=1 waypoints_reached=1)" in log
    short.wait("landing", lambda: short.is_logged("landed"))


# `make test` shows this with test_sdk_mission_survives_service_restart_and_takeover.
@pytest.mark.slow
def test_navigator_reconnects_to_killed_service(slow: Stage) -> None:
    slow.start_navigator()
    slow.wait("first waypoint", lambda: "waypoint 1/2 reached" in slow.log("navigator"))
    slow.kill("service")
    slow.start_service()
    slow.wait("return", lambda: "control returned" in slow.log("navigator"))
    log = slow.log("navigator")
    assert "connection to the mobility service lost" in log
    takeovers = [entry for entry in slow.entries() if entry["kind"] in ("takeover", "control")]
    assert log.count("control granted") == 1, f"the process requested control again\n{log}\n{takeovers}"
    assert "waypoint 2/2 reached" in log


def test_sigterm_stops_navigator_and_system_flies_home(short: Stage) -> None:
    short.start_navigator()
    short.wait("takeoff", lambda: "takeoff reached" in short.log("navigator"))
    short.processes["navigator"].terminate()
    assert short.processes["navigator"].wait(10) == 0
    assert "run: stopping" in short.log("navigator")
    short.wait("landing", lambda: short.is_logged("landed"))


def test_telemetry_command_prints_json_lines(short: Stage) -> None:
    def read() -> list[dict[str, Any]]:
        result = subprocess.run(
            [
                sys.executable, "-m", "fractus_cli", "telemetry", "--node", "drone-1", "--address", short.address,
                "--tls", str(short.folder / "node-tls"), "--interval", "0.1", "--count", "3", "-o", "json",
            ],
            capture_output=True, text=True, timeout=40, check=False,
        )  # fmt: skip
        assert result.returncode == 0, result.stderr
        return [json.loads(line) for line in result.stdout.splitlines()]

    short.wait("position", lambda: read()[-1]["position"] is not None)
    lines = read()
    assert len(lines) == 3
    assert lines[-1]["flight_state"] == "inactive"
    assert lines[-1]["position"]["reference"] == "home"
