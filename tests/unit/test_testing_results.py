"""Results analyzer: violations, status, resources, comparisons and checks of a record, without a flight."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import demo_flight
import pytest
from fractus_sim.report.track import Place, Sample
from fractus_sim.runner.telemetry_recording import Flight
from fractus_sim.testbeds.resource_meter import ProgramUsage
from fractus_testing import ABORTED, FAILED, RUNNING, SUCCESS, ExperimentError, Resources, Results
from fractus_testing.records import RunRecord
from fractus_testing.triggers import until, waypoints_reached

CALLER = "spiffe://fractus.dev/ns/default/app/a/component/App/instance/a-app"
WAYPOINTS = ((50.0, 4.0, 10.0), (50.001, 4.0, 10.0))


def entry(
    code: str = "", action: str = "deny", *, kind: str = "call", at: float = 1.0, **fields: Any
) -> dict[str, Any]:
    return {
        "kind": kind, "time": "2026-01-01T00:00:00+00:00", "time_s": at, "caller": CALLER, "method": "Goto",
        "action": action, "code": code, "reason": f"because of {code}", "policies": ["p"], **fields,
    }  # fmt: skip


def flight(name: str = "vdrone-1", *, landed: bool = True) -> Flight:
    states = [False, True, True, not landed]
    samples = [
        Sample(float(t), Place(50.0, 4.0, 10.0 * in_air), 2.0, "GUIDED", in_air, 0.9) for t, in_air in enumerate(states)
    ]
    return Flight(name, samples)


def results(*entries: Mapping[str, Any], declared: Resources | None = None, **fields: Any) -> Results:
    record = RunRecord(Path("x"), {"vdrone-1": flight()}, {"vdrone-1": entries}, **fields)
    return Results(lambda: record, {"vdrone-1": declared} if declared else {})


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        ("OutsideOperationArea", "flight_path"),
        ("LegThroughExclusionZone", "no_fly"),
        ("AltitudeAboveLimit", "altitude"),
        ("SpeedAboveLimit", "speed"),
        ("PrivacyZone", "camera"),
        ("MethodNotGranted", "access"),
    ],
)
def test_violations_have_a_type(code: str, expected: str) -> None:
    (violation,) = results(entry(code)).get_violations("vDrone-1")
    assert violation.type == expected
    assert violation.caller == "App"
    assert violation.policies == ("p",)


@pytest.mark.parametrize(
    ("reason", "expected"),
    [
        ("the target is 9.0 m outside zone town (policy keep-in); the leg ends at the last legal point", "flight_path"),
        ("the leg leaves zone town (policy keep-in); the leg ends at the last legal point", "flight_path"),
        ("the target is 9.0 m inside zone hospital of policy h; the leg ends at the last legal point", "no_fly"),
    ],
)
def test_shortened_legs_have_the_type_of_their_fence(reason: str, expected: str) -> None:
    (violation,) = results(entry("LegShortened", "correct", reason=reason)).get_violations("vDrone-1")
    assert violation.type == expected


def test_permitted_calls_and_states_of_the_drone_are_no_violations() -> None:
    record = results(
        entry(action="allow"),
        entry("TerrainAssumedFlat", "allow"),
        entry("PositionUnknown"),
        entry("ControlHeld"),
        entry("", "granted", kind="control"),
    )
    assert record.get_violations("vDrone-1") == []
    record.check_no_violations("vDrone-1")


def test_record_without_audit_log_does_not_show_that_policies_were_kept() -> None:
    record = results()
    for query in (record.get_violations, record.check_no_violations, record.requests):
        with pytest.raises(ExperimentError, match="vDrone-1 has no audit log entries, so its calls are unknown"):
            query("vDrone-1")
    with pytest.raises(AssertionError, match=r"call: .* does not hold: no audit log"):
        record.check("call", action="deny", absent=True)


def test_takeover_counts_once_with_the_call_that_caused_it() -> None:
    call = entry("InsideExclusionZone", "takeover", at=5.0)
    effect = entry("InsideExclusionZone", "returnToLaunch", kind="takeover", at=5.2)
    later = entry("InsideExclusionZone", "land", kind="takeover", at=60.0)
    assert [v.time_s for v in results(call, effect, later).get_violations("vDrone-1")] == [5.0, 60.0]


def test_motion_that_the_monitor_stops_is_a_violation_of_the_system() -> None:
    stop = entry("OperationAreaBorderAhead", "brake", kind="control")
    unknown_position = entry("PositionUnknown", "brake", kind="control")
    (violation,) = results(stop, unknown_position).get_violations("vDrone-1")
    assert (violation.type, violation.action, violation.caller) == ("flight_path", "brake", "the system")


def test_check_violations_lists_what_happened() -> None:
    record = results(entry("SpeedAboveLimit", "correct", at=7.0))
    record.check_violations("vDrone-1", type="speed", count=1)
    with pytest.raises(AssertionError, match=r"at least one violation of type no_fly, observed 0; .* speed at 7\.0 s"):
        record.check_violations("vDrone-1", type="no_fly")
    with pytest.raises(AssertionError, match="expected 0 violations, observed 1"):
        record.check_no_violations("vDrone-1")


def test_requests_contain_permitted_and_refused_calls() -> None:
    record = results(entry(action="allow"), entry("SpeedAboveLimit"), entry("", "granted", kind="control"))
    assert [call.action for call in record.requests("vDrone-1")] == ["allow", "deny"]
    assert record.requests("vDrone-1", method="Land") == []


@pytest.mark.parametrize(
    ("codes", "entries", "expected"),
    [
        ({"p": 0}, (), SUCCESS),
        ({"p": 0, "q": 2}, (), FAILED),
        ({"p": 0, "q": None}, (), RUNNING),
        ({"p": 1}, (entry("x", "returnToLaunch", kind="takeover"),), ABORTED),
        ({"p": 1}, (entry("x", "landAt", kind="takeover"),), ABORTED),
        ({"p": 1}, (entry("DriverLost", "returnToLaunch", kind="takeover"),), FAILED),
        ({"p": 0}, (entry("DriverLost", "returnToLaunch", kind="takeover"),), ABORTED),
        (
            {"p": 1},
            (entry("DriverLost", "returnToLaunch", kind="takeover"), entry("x", "land", kind="takeover")),
            ABORTED,
        ),
        ({"p": 0}, (entry("x", "hover", kind="takeover"),), SUCCESS),
    ],
)
def test_status_of_programs(codes: dict[str, int | None], entries: tuple[dict[str, Any], ...], expected: Any) -> None:
    record = results(*entries, programs=codes)
    assert record.get_app_status("vDrone-1") == expected
    record.check_app_status("vDrone-1", expected)
    with pytest.raises(AssertionError, match=f"expected application status .*, observed {expected}"):
        record.check_app_status("vDrone-1", FAILED if expected != FAILED else SUCCESS)


@pytest.mark.parametrize(("phase", "expected"), [("Completed", SUCCESS), ("Failed", FAILED), ("Flying", RUNNING)])
def test_status_of_a_cluster_is_the_phase_of_its_application(phase: str, expected: str) -> None:
    assert results(phases={"vdrone-1": phase}).get_app_status("vDrone-1") == expected


def test_resources_are_compared_with_the_declared_ones() -> None:
    usage = ProgramUsage("vdrone-1", 5.0, 10.0, 50.0, 60.0)
    record = results(usages={"p": usage}, declared=Resources(cpu="600m", memory="64Mi"))
    assert record.get_app_resources("vDrone-1").cpu == 0.5
    record.check_app_resources("vDrone-1")
    with pytest.raises(AssertionError, match=r"used 0\.50 processor cores; declared: 0\.4"):
        record.check_app_resources("vDrone-1", Resources(cpu="400m"))
    with pytest.raises(AssertionError, match="used 60 MiB of memory; declared: 50 MiB"):
        record.check_app_resources("vDrone-1", Resources(memory="50Mi"))
    with pytest.raises(ExperimentError, match="contains no resources"):
        results().get_app_resources("vDrone-1")


def test_compare_accepts_a_tolerance_and_names_each_difference() -> None:
    record = results()
    usage = ProgramUsage("vdrone-1", 5.0, 10.0, 50.0, 60.0)
    record.compare(100, 108, tolerance=0.1)
    record.compare(usage, {"cpu_s": 5.2, "vehicle": "vdrone-1"})
    with pytest.raises(AssertionError, match="cpu_s: expected 8 within 10%, observed 5; vehicle: expected 'x'"):
        record.compare(usage, {"cpu_s": 8, "vehicle": "x"})
    with pytest.raises(AssertionError, match="no field speed; known: vehicle, cpu_s"):
        record.compare(usage, {"speed": 1})


def test_checks_of_experiment_files_are_available() -> None:
    record = results(audit_problems={"vdrone-1/mobility.jsonl": "line 3 changed"})
    record.check("landed", "vDrone-1", near_home=3)
    record.check_landed("vDrone-1", near_home=3)
    with pytest.raises(AssertionError, match="altitude: max 5 does not hold: maximum 10"):
        record.check("altitude", max=5)
    with pytest.raises(AssertionError, match="line 3 changed"):
        record.check_audit()
    with pytest.raises(ExperimentError, match="near_hom"):
        record.check("landed", near_hom=3)
    with pytest.raises(ExperimentError, match="unknown zone hospital; known: none"):
        record.check("outsideZone", zone="hospital")


def test_unknown_drone_is_named_with_the_known_ones() -> None:
    with pytest.raises(ExperimentError, match="unknown drone vDrone-2; known: vdrone-1"):
        results().track("vDrone-2")


def test_folder_of_the_demo_is_read(tmp_path: Path) -> None:
    (tmp_path / "objects.json").write_text(json.dumps(demo_flight.content()))
    (tmp_path / "audit").mkdir()
    lines = [json.dumps(line) for line in demo_flight.audit()]
    (tmp_path / "audit" / "mobility.jsonl").write_text("\n".join(lines) + "\n")
    demo = Results.read(tmp_path)
    (drone,) = demo.drones
    takeoff_s = demo.track(drone).takeoff_s
    assert takeoff_s == pytest.approx(demo_flight.TAKEOFF_S - demo_flight.APPLIED_S)
    assert demo.requests(drone)
    violations = demo.get_violations(drone)
    assert {violation.type for violation in violations} >= {"no_fly"}
    assert all(violation.time_s > 0 for violation in violations)
    demo.check("landed", drone)


def test_folder_without_a_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ExperimentError, match="specify the output folder of a run"):
        Results.read(tmp_path)


def sample(lat: float, alt: float = 10.0, *, in_air: bool = True) -> Sample:
    return Sample(0.0, Place(lat, 4.0, alt), 1.0, "GUIDED", in_air, 1.0)


@pytest.mark.parametrize(
    ("samples", "expected"),
    [
        ([], 0),
        ([sample(50.0)], 1),
        ([sample(50.001)], 0),
        ([sample(50.0), sample(50.0005), sample(50.001)], 2),
        ([sample(50.0, alt=5.0)], 0),
        ([sample(50.0, in_air=False)], 0),
    ],
)
def test_waypoints_are_counted_in_order(samples: list[Sample], expected: int) -> None:
    assert waypoints_reached(samples, WAYPOINTS) == expected


class Observed:
    """A drone with a fixed flight."""

    name = "vDrone-1"
    waypoints = WAYPOINTS
    samples = (sample(50.0),)
    plan_samples = samples
    now_s = 12.0


def test_triggers_fire_at_their_moment() -> None:
    assert until(Observed(), reached=1).fired()
    assert not until(Observed(), reached=2).fired()
    assert until(Observed(), altitude=9).fired()
    assert not until(Observed(), altitude=11).fired()
    assert until(Observed(), time=12).fired()
    assert not until(Observed(), time=13).fired()


def test_trigger_needs_one_condition_that_can_come() -> None:
    with pytest.raises(ExperimentError, match="exactly one of reached, altitude and time"):
        until(Observed())
    with pytest.raises(ExperimentError, match="exactly one of reached, altitude and time"):
        until(Observed(), reached=1, time=2)
    with pytest.raises(ExperimentError, match="the flight plan of vDrone-1 has 2 waypoints"):
        until(Observed(), reached=3)
