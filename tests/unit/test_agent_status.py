"""Status that the agent writes to its node object, and intervals between the writes."""

from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from fractus_agent.registration.node_status import (
    DRONE_INTERVALS,
    EDGE_INTERVALS,
    FLIGHT_INTERVALS,
    NodeObservation,
    StatusReporter,
    due_s,
    node_status,
    ready_condition,
    report_intervals,
)
from fractus_agent.store import KubeError
from fractus_agent.telemetry import TelemetrySnapshot, parse_telemetry
from fractus_core.api.conditions import ConditionUpdate
from fractus_core.api.names import CONTROL_TAKEN
from fractus_core.api.nodes import DroneStatus, EdgeNodeStatus
from fractus_core.control import Outcome, OutcomeKind
from fractus_proto.v1.mobility_pb2 import MissionOutcome, Telemetry
from fractus_proto.v1.types_pb2 import AltitudeReference, Position

NOW = datetime(2026, 5, 1, 12, 0, 0, tzinfo=UTC)
ISSUED = ConditionUpdate("Certified", "True", "Issued", "Valid.")


def telemetry(**changes: Any) -> TelemetrySnapshot:
    facts: dict[str, Any] = {
        "flight_state": "flying",
        "controller": "system",
        "connected": True,
        "ready": True,
        "in_air": True,
        "mode": "GUIDED",
        "position": (39.36, 22.94, 20.0, "home"),
        "battery_remaining": 0.83,
        "battery_voltage_v": 15.9,
        "battery_current_a": 12.1,
    }
    return TelemetrySnapshot(**(facts | changes))


def observed(**changes: Any) -> NodeObservation:
    facts: dict[str, Any] = {
        "kind": "Drone",
        "has_mobility": True,
        "needs_certificate": True,
        "certified": ISSUED,
        "snapshot": telemetry(),
    }
    return NodeObservation(**(facts | changes))


def test_telemetry_is_converted_to_a_valid_drone_status() -> None:
    message = Telemetry(
        position=Position(
            latitude_deg=39.36, longitude_deg=22.94, altitude_m=20.0,
            altitude_reference=AltitudeReference.ALTITUDE_REFERENCE_AMSL,
        ),
        battery_remaining=0.834, battery_voltage_v=15.93, battery_current_a=12.14, in_air=True, mode="GUIDED",
        flight_state="flying", controller="spiffe://fractus.dev/ns/a/app/b/component/c/instance/d",
        autopilot_connected=True, ready=True, missions={"x": MissionOutcome(kind=99, reason="new")},
    )  # fmt: skip
    status = node_status(observed(snapshot=parse_telemetry(message)), {}, 3, NOW)
    assert parse_telemetry(message).missions == {"x": Outcome(OutcomeKind.FAILED, "new")}, (
        "an unknown kind counts as failed"
    )
    parsed = DroneStatus.model_validate(status)
    assert parsed.flight_state == "flying"
    assert parsed.controller == "c"
    assert parsed.position is not None
    assert parsed.position.to_dict() == {"lat": 39.36, "lon": 22.94, "alt": 20.0, "altitudeReference": "amsl"}
    assert parsed.battery is not None
    assert parsed.battery.to_dict() == {"remaining": 0.83, "voltage": 15.9, "current": 12.1}
    assert parsed.last_seen == NOW
    assert {(c.type, c.status, c.observed_generation) for c in parsed.conditions} == {
        ("Ready", "True", 3),
        ("Certified", "True", 3),
    }


@pytest.mark.parametrize(("changes", "expected"), [
    ({}, ("SystemInControl", "policy campus forbids it")), ({"controller": "pilot"}, ("PilotInControl", "policy campus forbids it")),
    ({"controller_reason": ""}, None), ({"controller": "spiffe://fractus.dev/a"}, None), ({"in_air": False}, None),
    ({"connected": False}, None),
])  # fmt: skip
def test_airborne_drone_reports_why_no_driver_has_control(
    changes: dict[str, Any], expected: tuple[str, str] | None
) -> None:
    assert parse_telemetry(Telemetry(controller_reason="x")).controller_reason == "x"
    status = node_status(
        observed(snapshot=telemetry(**{"controller_reason": "policy campus forbids it", **changes})), {}, 1, NOW
    )
    taken = [(c["reason"], c["message"]) for c in status["conditions"] if c["type"] == CONTROL_TAKEN]
    assert taken == ([expected] if expected else [])


@pytest.mark.parametrize(
    ("facts", "reason"),
    [
        ({"certified": ConditionUpdate("Certified", "False", "Denied", "no")}, "NoCertificate"),
        ({"telemetry_problem": "The mobility service is unreachable: x."}, "MobilityUnreachable"),
        ({"snapshot": None}, "MobilityUnreachable"),
        ({"snapshot": telemetry(connected=False)}, "AutopilotDisconnected"),
        ({"snapshot": telemetry(ready=False, in_air=False)}, "AutopilotNotReady"),
    ],
)
def test_drone_is_not_ready_if_a_requirement_is_missing(facts: dict[str, Any], reason: str) -> None:
    ready = ready_condition(observed(**facts))
    assert (ready.status, ready.reason) == ("False", reason)
    assert ready.message


def test_flying_drone_is_ready_even_if_it_would_not_arm() -> None:
    assert ready_condition(observed(snapshot=telemetry(ready=False, in_air=True))).status == "True"


def test_edge_node_without_services_is_ready_without_certificate() -> None:
    bare = observed(
        kind="EdgeNode", has_mobility=False, needs_certificate=False, snapshot=None,
        certified=ConditionUpdate("Certified", "False", "Requested", "waits"),
    )  # fmt: skip
    status = node_status(bare, {}, 1, NOW)
    EdgeNodeStatus.model_validate(status)
    assert "flightState" not in status
    assert ready_condition(bare).status == "True"


@pytest.mark.parametrize(
    "blind", [{"snapshot": None, "telemetry_problem": "gone"}, {"snapshot": telemetry(connected=False)}]
)
def test_flight_state_is_unknown_without_telemetry_and_position_is_kept(blind: dict[str, Any]) -> None:
    status = node_status(observed(), {}, 1, NOW)
    assert (status["flightState"], status["lastFlightState"]) == ("flying", "flying")
    position = status["position"]
    for second in (9, 18):
        status = node_status(observed(**blind), status, 1, NOW + timedelta(seconds=second))
        assert (status["flightState"], status["lastFlightState"]) == ("unknown", "flying")
        assert status["position"] == position
        assert DroneStatus.model_validate(status).in_air
        assert report_intervals("Drone", status) is FLIGHT_INTERVALS
        assert status["conditions"][0]["status"] == "False"
    assert "controller" not in node_status(observed(snapshot=None), status, 1, NOW), (
        "without telemetry, the control authority is unknown, too"
    )


def test_drone_without_any_telemetry_has_no_last_flight_state() -> None:
    status = node_status(observed(snapshot=None), {}, 1, NOW)
    assert status["flightState"] == "unknown"
    assert "lastFlightState" not in status
    assert report_intervals("Drone", status) is DRONE_INTERVALS


def test_transition_time_changes_only_with_the_condition_status() -> None:
    first = node_status(observed(), {}, 1, NOW)
    later = node_status(observed(), first, 2, NOW + timedelta(minutes=1))
    assert later["conditions"][0]["lastTransitionTime"] == "2026-05-01T12:00:00Z"
    worse = node_status(observed(telemetry_problem="gone"), later, 2, NOW + timedelta(minutes=2))
    assert worse["conditions"][0]["lastTransitionTime"] == "2026-05-01T12:02:00Z"


def moved(north_m: float) -> dict[str, Any]:
    return node_status(
        observed(snapshot=telemetry(position=(39.36 + north_m / 111_320, 22.94, 20.0, "home"))), {}, 1, NOW
    )


def test_write_interval_depends_on_the_kind_of_change() -> None:
    base = moved(0)
    assert due_s(None, base, 0.0, DRONE_INTERVALS) == 0.0
    assert due_s(base, base, 4.0, DRONE_INTERVALS) == DRONE_INTERVALS.idle_s - 4.0
    assert due_s(base, base, 4.0, EDGE_INTERVALS) == EDGE_INTERVALS.idle_s - 4.0
    assert due_s(base, moved(50.0), 4.0, DRONE_INTERVALS) == 6.0
    assert due_s(base, moved(50.0), 10.0, DRONE_INTERVALS) == 0.0
    assert due_s(base, moved(1.0), 10.0, DRONE_INTERVALS) == 20.0
    landing = node_status(observed(snapshot=telemetry(flight_state="landing")), {}, 1, NOW)
    assert due_s(base, landing, 1.0, DRONE_INTERVALS) == 0.0
    assert due_s(base, landing, 0.2, DRONE_INTERVALS) == pytest.approx(0.8)
    drained = node_status(observed(snapshot=telemetry(battery_remaining=0.82)), {}, 1, NOW)
    assert due_s(base, drained, 5.0, DRONE_INTERVALS) == 5.0


class FakeStore:
    """Fake store that records writes. It can be unreachable, or have no object."""

    def __init__(self) -> None:
        self.writes: list[dict[str, Any]] = []
        self.down = False
        self.absent = False

    async def apply_status(self, kind: str, name: str, status: dict[str, Any]) -> dict[str, Any] | None:
        if self.down:
            raise KubeError(0, "Unreachable", "down")
        if self.absent:
            return None
        self.writes.append(status)
        return {"kind": kind, "metadata": {"name": name, "uid": "1", "generation": 1}, "status": status}


class ReporterBench:
    """Test bench of the status reporter, with a simulated clock and telemetry at 1 Hz."""

    def __init__(self) -> None:
        self.store = FakeStore()
        self.seconds = 0.0
        self.observed = observed()
        self.body: dict[str, Any] | None = {"kind": "Drone", "metadata": {"name": "d", "uid": "1", "generation": 1}}
        self.returned: list[Any] = []
        self.reporter = StatusReporter(
            self.store,
            body=lambda: self.body,
            observe=lambda _: self.observed,
            on_written=self.returned.append,
            wall=lambda: NOW + timedelta(seconds=self.seconds),
            monotonic=lambda: self.seconds,
        )

    async def second(self, snapshot: TelemetrySnapshot) -> None:
        self.seconds += 1.0
        self.observed = observed(snapshot=snapshot)
        await self.reporter.step()


async def test_reporter_waits_for_the_first_telemetry_after_start() -> None:
    bench = ReporterBench()
    for _ in range(4):
        bench.seconds += 1.0
        bench.observed = observed(snapshot=None)
        await bench.reporter.step()
    assert not bench.store.writes, "a new agent waits for telemetry before it writes an unknown flight state"
    await bench.second(telemetry())
    assert bench.store.writes[0]["flightState"] == "flying"
    silent = ReporterBench()
    silent.seconds = 5.0
    silent.observed = observed(snapshot=None)
    await silent.reporter.step()
    assert silent.store.writes[0]["flightState"] == "unknown"


async def test_status_of_flying_drone_is_written_every_five_seconds() -> None:
    bench = ReporterBench()
    for second in range(60):
        await bench.second(telemetry(position=(39.36 + second * 1e-4, 22.94, 20.0, "home")))
    assert len(bench.store.writes) == 12


async def test_change_of_flight_state_is_written_at_once() -> None:
    bench = ReporterBench()
    await bench.second(telemetry(flight_state="takingOff"))
    await bench.second(telemetry(flight_state="flying"))
    assert [w["flightState"] for w in bench.store.writes] == ["takingOff", "flying"]


async def test_status_of_standing_drone_is_written_every_thirty_seconds() -> None:
    bench = ReporterBench()
    for second in range(120):
        jitter = (second % 3) * 3e-6
        await bench.second(
            telemetry(flight_state="inactive", in_air=False, position=(39.36 + jitter, 22.94, 0.0, "home"))
        )
    assert len(bench.store.writes) == 4


async def test_change_during_an_outage_is_written_afterwards() -> None:
    bench = ReporterBench()
    await bench.second(telemetry(flight_state="flying"))
    bench.store.down = True
    with pytest.raises(KubeError):
        await bench.second(telemetry(flight_state="landing"))
    bench.store.down = False
    await bench.second(telemetry(flight_state="landing"))
    assert bench.store.writes[-1]["flightState"] == "landing"


async def test_deleted_object_is_reported_and_recreated_object_gets_the_status() -> None:
    bench = ReporterBench()
    await bench.second(telemetry())
    bench.store.absent = True
    bench.seconds += 60
    await bench.second(telemetry())
    assert bench.returned[-1] is None
    bench.store.absent = False
    bench.body = {"kind": "Drone", "metadata": {"name": "d", "uid": "2", "generation": 1}}
    await bench.second(telemetry())
    assert len(bench.store.writes) == 2


async def test_recreated_object_gets_its_status_at_once() -> None:
    bench = ReporterBench()
    await bench.second(telemetry())
    bench.body = {"kind": "Drone", "metadata": {"name": "d", "uid": "2", "generation": 1}}
    await bench.second(telemetry())
    assert len(bench.store.writes) == 2


@pytest.mark.parametrize(("kind", "model"), [("Drone", DroneStatus), ("EdgeNode", EdgeNodeStatus)])
def test_audit_heads_are_reported_and_kept(kind: str, model: Any) -> None:
    heads = ["mobility:7:" + "a" * 64]
    first = node_status(observed(kind=kind, audit_heads=heads), {}, 1, NOW)
    assert model.model_validate(first).audit == tuple(heads)
    assert node_status(observed(kind=kind), first, 1, NOW)["audit"] == heads, (
        "the reported head of a log is kept if the log is missing"
    )
    assert "audit" not in node_status(observed(kind=kind), {}, 1, NOW)
    assert due_s(first, first | {"audit": ["mobility:8:" + "b" * 64]}, 0.0, EDGE_INTERVALS) == EDGE_INTERVALS.idle_s
