"""Mapping of InterUSS' flights to FlightPlans, and the check of U-space flight authorisations."""

from __future__ import annotations

import random
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from fractus_core.airspace import Volume4D as ReservedAirspace
from fractus_core.airspace.plan_status import reserved_volume
from fractus_core.api.geometry import Area
from fractus_core.geo import LocalFrame, area_polygon
from fractus_management.app import create_app
from fractus_management.interuss import messages
from fractus_management.interuss.flight_authorisation import (
    authorisation_problems,
    is_operator_number,
    is_serial_number,
)
from fractus_management.interuss.plan_mapping import (
    Unplannable,
    altitude_problem,
    flight_plan_spec,
    notifications_of,
    priority_class,
    refusal_of,
    reserves_in,
    response_of,
)
from fractus_management.interuss.routes import PREFIX
from fractus_management.settings import AutomatedTesting, Settings
from pydantic import ValidationError
from starlette.routing import Match
from uas_standards.ansi_cta_2063_a import SerialNumber
from uas_standards.en4709_02 import OperatorRegistrationNumber
from uas_standards.interuss.automated_testing.flight_planning.v1 import api

Body = dict[str, Any]
START = datetime(2026, 12, 1, 10, tzinfo=UTC)
CORNERS = [{"lat": 39.36, "lng": 22.93}, {"lat": 39.36, "lng": 22.932}, {"lat": 39.361, "lng": 22.93}]
AUTHORISATION: Body = {
    "uas_serial_number": "1AF49UL5CC5J6K",
    "operation_category": "Open",
    "operation_mode": "Vlos",
    "uas_class": "C0",
    "identification_technologies": ["ASTMNetRID"],
    "connectivity_methods": ["cellular"],
    "endurance_minutes": 30,
    "emergency_procedure_url": "https://uav.example.com/emergency",
    "operator_id": "CHEo5kut30e0mt01-qwe",
    "uas_id": "",
}


def circle(lat: float = 39.36, lon: float = 22.93, radius: float = 50) -> Body:
    return {"outline_circle": {"center": {"lat": lat, "lng": lon}, "radius": {"value": radius, "units": "M"}}}


def polygon() -> Body:
    return {"outline_polygon": {"vertices": CORNERS}}


def volume(outline: Body, *, begin: float = 0, end: float = 10, upper: Body | None = None) -> Body:
    times = {
        name: {"value": (START + timedelta(minutes=minutes)).isoformat(), "format": "RFC3339"}
        for name, minutes in (("time_start", begin), ("time_end", end))
    }
    highest = upper or {"value": 60, "reference": "W84", "units": "M"}
    return {"volume": outline | {"altitude_upper": highest}, **times}


def flight(*volumes: Body, usage: str = "Planned", state: str = "Nominal", **more: Any) -> messages.FlightPlanMessage:
    area = list(volumes) or [volume(circle())]
    basic = {"usage_state": usage, "uas_state": state, "area": area, "description": "ignored"}
    return messages.FlightPlanMessage.model_validate({"basic_information": basic, "telemetry": {}, **more})


def spec_of(plan: messages.FlightPlanMessage, now: datetime = START) -> Body:
    return flight_plan_spec(plan, "patrol", now.timestamp()).to_dict()


# -- requests --


def test_circle_becomes_region_and_window() -> None:
    spec = spec_of(flight(usage="InUse"))
    assert spec["region"] == {"circle": {"center": {"lat": 39.36, "lon": 22.93}, "radius": 50}}
    assert datetime.fromisoformat(spec["window"]["start"]) == START
    assert (spec["window"]["duration"], spec["template"], spec["stay"], spec["use"]) == (10, "patrol", 1, "InUse")


def test_polygon_keeps_its_corners() -> None:
    exterior = spec_of(flight(volume(polygon())))["region"]["polygon"]["exterior"]
    assert exterior == [{"lat": each["lat"], "lon": each["lng"]} for each in CORNERS]


def test_several_volumes_become_one_region_that_covers_all() -> None:
    first = volume(circle(), begin=2, end=5)
    second = volume(circle(39.362), begin=4, end=9)
    third = volume(polygon(), begin=3, end=4)
    spec = spec_of(flight(first, second, third))
    frame = LocalFrame.at(Area.model_validate(spec["region"]).polygon.exterior[0])
    whole = area_polygon(frame, Area.model_validate(spec["region"])).buffer(0.01)
    for part in (first, second, third):
        single = Area.model_validate(spec_of(flight(part))["region"])
        assert whole.covers(area_polygon(frame, single))
    assert datetime.fromisoformat(spec["window"]["start"]) == START + timedelta(minutes=2)
    assert spec["window"]["duration"] == 7


def test_flight_may_select_fields_of_its_plan() -> None:
    own = {"template": "camera", "drone": "drone-2", "stay": 3, "parameters": {"a": 1}}
    spec = spec_of(flight(additional_information={"fractus": own, "other": {"x": 1}}))
    assert {name: spec[name] for name in own} == own


@pytest.mark.parametrize(
    ("priority", "expected"),
    [(-5, "normal"), (0, "normal"), (1, "elevated"), (99, "elevated"), (100, "emergency"), (1000, "emergency")],
)
def test_priority_selects_the_class(priority: int, expected: str) -> None:
    assert priority_class(priority) == expected
    assert spec_of(flight(astm_f3548_21={"priority": priority}))["priorityClass"] == expected


@pytest.mark.parametrize(
    ("plan", "result", "sentence"),
    [
        (flight(state="OffNominal"), "NotSupported", "users cannot report an off-nominal state"),
        (flight(state="Contingent", usage="InUse"), "NotSupported", "users cannot report an off-nominal state"),
        (flight(volume({})), "Rejected", "either outline_circle or outline_polygon"),
        (flight(volume(circle() | polygon())), "Rejected", "either outline_circle or outline_polygon"),
        (flight({"volume": circle()}), "Rejected", "no time_start or time_end"),
        (flight(volume(circle(), begin=5, end=5)), "Rejected", "window.duration"),
        (flight(volume(circle(), end=1441)), "Rejected", "window.duration"),
        (flight(volume(circle(), begin=1), usage="InUse"), "Rejected", "has not begun"),
        (flight(additional_information={"fractus": {"use": "InUse"}}), "Rejected", "may have the fields"),
        (flight(additional_information={"fractus": []}), None, ""),
        (flight(additional_information={"fractus": {"stay": -1}}), "Rejected", "stay"),
        (flight(uspace_flight_authorisation={}), "Rejected", "uas_serial_number must be"),
        (flight(uspace_flight_authorisation=AUTHORISATION), None, ""),
    ],
)
def test_flight_that_cannot_be_planned_gets_result_and_reason(
    plan: messages.FlightPlanMessage, result: str | None, sentence: str
) -> None:
    if result is None:
        assert spec_of(plan)
        return
    with pytest.raises(Unplannable, match=sentence) as problem:
        spec_of(plan)
    assert problem.value.result == result


def test_empty_area_is_rejected() -> None:
    plan = messages.FlightPlanMessage.model_validate({"basic_information": {"usage_state": "Planned", "area": []}})
    with pytest.raises(Unplannable, match="area is empty"):
        spec_of(plan)


@pytest.mark.parametrize(
    "wrong",
    [
        {"value": float("nan"), "reference": "W84"},
        {"value": 60, "reference": "AMSL"},
        {"value": 60, "reference": "W84", "units": "FT"},
    ],
)
def test_altitude_with_unknown_meaning_is_no_valid_request(wrong: Body) -> None:
    with pytest.raises(ValidationError):
        flight(volume(circle(), upper=wrong))


# -- altitudes --


@pytest.mark.parametrize(
    ("value", "reference", "home_m", "geoid_m", "problem"),
    [
        (72, "W84", None, 0, ""),
        (73, "W84", None, 0, "73 m (W84) is 73 m above mean sea level, but the template permits only 72 m"),
        (120, "W84", None, 48, ""),
        (121, "W84", None, 48, "121 m (W84) is 73 m"),
        (43, "W84", None, -30, "43 m (W84) is 73 m"),
        (60, "SFC", 12, 48, ""),
        (61, "Takeoff", 12, 0, "61 m (Takeoff) is 73 m"),
        (10, "SFC", None, 0, "the ground elevation is unknown"),
    ],
)
def test_altitude_above_the_reserved_volumes_is_a_problem(
    value: float, reference: str, home_m: float | None, geoid_m: float, problem: str
) -> None:
    upper = {"value": value, "reference": reference, "units": "M"}
    plan = flight(volume(circle(), upper=upper))
    found = altitude_problem(plan.basic_information.area or (), [{"upper": 72}], home_m, geoid_m)
    assert found.startswith(problem)
    assert bool(found) == bool(problem)


def test_volume_without_upper_altitude_is_a_problem() -> None:
    plan = flight({**volume(circle()), "volume": circle()})
    assert "no altitude_upper" in altitude_problem(plan.basic_information.area or (), [{"upper": 72}], 0, 0)


# -- clear area --


@pytest.mark.parametrize(
    ("extent", "state", "expected"),
    [
        (volume(circle()), "Accepted", True),
        (volume(circle(), begin=10, end=20), "Accepted", True),
        (volume(circle(), begin=11, end=20), "Accepted", False),
        (volume(circle(39.37)), "Accepted", False),
        ({"volume": circle()}, "Contingent", True),
        (volume(circle()), "Rejected", False),
        (volume(circle()), "Ended", False),
    ],
)
def test_plan_is_cleared_if_it_reserves_airspace_in_the_extent(extent: Body, state: str, expected: bool) -> None:
    reserved = ReservedAirspace.of_area(
        Area.model_validate({"circle": {"center": {"lat": 39.36, "lon": 22.93}, "radius": 50}}),
        lower_m=0, upper_m=70, begin_s=START.timestamp(), end_s=START.timestamp() + 600,
    )  # fmt: skip
    plan = {
        "kind": "FlightPlan",
        "metadata": {"name": "a", "namespace": "tests"},
        "spec": spec_of(flight()),
        "status": {"state": state, "volumes": [reserved_volume(reserved).to_dict()]},
    }
    assert reserves_in(plan, messages.Volume4D.model_validate(extent)) is expected


# -- responses --


@pytest.mark.parametrize(
    ("state", "expected"),
    [
        (None, "NotPlanned"), ("Draft", "NotPlanned"), ("Rejected", "NotPlanned"), ("Accepted", "Planned"),
        ("Activated", "OkToFly"), ("Nonconforming", "OffNominal"), ("Contingent", "OffNominal"), ("Ended", "Closed"),
    ],
)  # fmt: skip
def test_state_of_the_plan_is_reported(state: str | None, expected: str) -> None:
    plan = {"status": {"state": state}} if state else None
    response = response_of(plan, "Completed")
    assert response.flight_plan_status == api.FlightPlanStatus(expected)
    assert response.includes_advisories == api.AdvisoryInclusion.NoAdvisoriesOrConditions


def test_advisories_are_reported_with_their_messages() -> None:
    plan = {"status": {"state": "Accepted", "advisories": [{"reason": "PolicyConflict", "message": "camera refused"}]}}
    response = response_of(plan, "Completed")
    assert response.includes_advisories == api.AdvisoryInclusion.AtLeastOneAdvisoryOrCondition
    assert response.notes == "camera refused"


@pytest.mark.parametrize(
    ("condition", "result"),
    [
        (("Accepted", "False", "NoDrone"), "Rejected"),
        (("ActionNeeded", "True", "ChoicesMissing"), "Rejected"),
        (("ChangeRefused", "True", "Conflict"), "Rejected"),
        (("ChangeRefused", "True", "ChangeNotPermitted"), "NotSupported"),
        (("Startable", "False", "NoDrone"), "Rejected"),
        (("Accepted", "True", "Accepted"), None),
        (("ChangeRefused", "False", "Accepted"), None),
    ],
)
def test_refused_version_gets_its_result(condition: tuple[str, str, str], result: str | None) -> None:
    type_, status, reason = condition
    plan = {"status": {"conditions": [{"type": type_, "status": status, "reason": reason, "message": "because"}]}}
    refusal = refusal_of(plan)
    assert (refusal.result if refusal is not None else None) == result
    assert result is None or str(refusal) == "because"


# -- service --


@pytest.mark.parametrize("testing", [None, AutomatedTesting("patrol")])
def test_interface_is_served_only_for_automated_testing(testing: AutomatedTesting | None) -> None:
    app = create_app(Settings(automated_testing=testing))
    scope = {"type": "http", "method": "GET", "path": f"{PREFIX}/status", "headers": []}
    matches = [route.matches(scope)[0] for route in app.routes]
    assert (Match.FULL in matches) is (testing is not None)
    assert not any(PREFIX in path for path in app.openapi()["paths"])


# -- flight authorisations --


def test_complete_flight_authorisation_has_no_problems() -> None:
    assert list(authorisation_problems(AUTHORISATION)) == []


@pytest.mark.parametrize(
    ("field", "values"),
    [
        ("uas_serial_number", ["My serial number", None, 5]),
        ("operation_category", ["Unknown", "open", None]),
        ("operation_mode", ["Undeclared", "", 1]),
        ("uas_class", ["C7", None]),
        ("identification_technologies", [[], None, [""], "ASTMNetRID"]),
        ("connectivity_methods", [[], [None]]),
        ("endurance_minutes", [0, -1, "30", None, True]),
        ("emergency_procedure_url", ["", "uav.example.com", "ftp://example.com", "http://", "http://[", None]),
        ("operator_id", ["CHEo5kut30e0mt02-qwe", "CHEo5kut30e0mt01", None]),
    ],
)
def test_wrong_field_of_a_flight_authorisation_is_named(field: str, values: list[Any]) -> None:
    for value in values:
        (problem,) = authorisation_problems(AUTHORISATION | {field: value})
        assert problem.startswith(field)


def test_other_class_needs_a_type_certificate() -> None:
    (problem,) = authorisation_problems(AUTHORISATION | {"uas_class": "Other"})
    assert problem.startswith("uas_type_certificate")
    assert not list(authorisation_problems(AUTHORISATION | {"uas_class": "Other", "uas_type_certificate": "X"}))


@pytest.mark.parametrize(
    ("is_valid", "oracle", "generate", "change"),
    [
        (
            is_serial_number,
            lambda text: SerialNumber(text).valid,
            SerialNumber.generate_valid,
            lambda text, source: SerialNumber(text).make_invalid_by_changing_payload_length(source),
        ),
        (
            is_operator_number,
            lambda text: OperatorRegistrationNumber(text).valid,
            lambda source: OperatorRegistrationNumber.generate_valid("CHE", source),
            lambda text, source: OperatorRegistrationNumber(text).make_invalid_by_changing_final_control_string(source),
        ),
    ],
    ids=["serial", "operator"],
)
def test_numbers_are_judged_as_by_uas_standards(
    is_valid: Callable[[str], bool],
    oracle: Callable[[str], bool],
    generate: Callable[[random.Random], str],
    change: Callable[[str, random.Random], str],
) -> None:
    source = random.Random(7)
    for _ in range(300):
        valid = str(generate(source))
        assert is_valid(valid)
        assert oracle(valid)
        assert not is_valid(str(change(valid, source)))
        i = source.randrange(len(valid))
        other = valid[:i] + source.choice("019AZaz-") + valid[i + 1 :]
        # uas-standards does not check the letters of the country, and permits more letters in serial numbers.
        assert not is_valid(other) or oracle(other)


def test_notifications_since_the_first_representable_time_are_listed() -> None:
    at = "2026-12-01T10:00:00Z"
    condition = {"type": "ConflictArose", "status": "True", "lastTransitionTime": at, "message": "overlap"}
    (found,) = notifications_of({"status": {"conditions": [condition]}}, datetime.min.replace(tzinfo=UTC), None)
    assert found["observed_at"]["value"] == at
