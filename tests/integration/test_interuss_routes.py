"""InterUSS' flight planning interface of the management API, on a real API server with the operator."""

from __future__ import annotations

import threading
import uuid
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from control_plane import ControlPlane, wait_for
from implicitdict import ImplicitDict
from management_server import ManagementServer, Reply, user_token
from operator_world import (
    FRACTUS,
    LAT,
    LON,
    OperatorProcess,
    World,
    approved_region_template,
    fractus_object,
    fresh_namespace,
)
from uas_standards.interuss.automated_testing.flight_planning.v1 import api

Body = dict[str, Any]
Send = Callable[..., Reply]
HOME_M = 12
"""Ground elevation of the home of the drones above mean sea level."""


@pytest.fixture(scope="module")
def tests(control_plane: ControlPlane) -> Iterator[str]:
    """Namespace for the flights of the tests."""
    with fresh_namespace(World(control_plane), "interuss") as name:
        yield name


@pytest.fixture(scope="module")
def server(
    control_plane: ControlPlane, tests: str, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[ManagementServer]:
    log = tmp_path_factory.mktemp("management") / "log"
    server = ManagementServer(control_plane, log, "-n", tests, "--automated-testing", "patrol")
    yield server
    assert server.stop() == 0


@pytest.fixture
def reporting(world: World) -> Iterator[None]:
    """Let the drones report that they are on the ground, as their agents do. A flight that was in use ends with such a report."""
    world.add_drone("drone-2")
    stopped = threading.Event()

    def report(last_seen: str | None) -> None:
        for name in ("drone-1", "drone-2"):
            world.api.merge(f"{FRACTUS}/drones/{name}/status", {"status": {"lastSeen": last_seen}})

    def run() -> None:
        while not stopped.wait(0.5):
            report(datetime.now(UTC).isoformat())

    thread = threading.Thread(target=run)
    thread.start()
    yield
    stopped.set()
    thread.join()
    # The drones of the other tests have never reported.
    report(None)


@pytest.fixture
def send(
    world: World, operator: OperatorProcess, server: ManagementServer, tests: str, reporting: None
) -> Iterator[Send]:
    """Send requests to the interface with the token of an administrator."""
    approved_region_template(world)
    valid = user_token(world, tests, "qualifier", (), ("cluster-admin",))

    def call(method: str, path: str, body: Any = None, *, token: str = valid) -> Reply:
        return server.send(method, f"/flight_planning/v1{path}", body, token=token)

    wait_for(lambda: call("GET", "/user_notifications?after=2026-01-01T00:00:00Z").status == 200, "the role")
    yield call
    collection = f"{FRACTUS}/namespaces/{tests}/flightplans"
    for item in world.api.list(collection):
        world.api.delete(f"{collection}/{item['metadata']['name']}")
    wait_for(lambda: not world.api.list(collection), "the plans to be deleted")


def flight(
    *,
    usage: str = "Planned",
    in_s: float = 3600,
    north_m: float = 40,
    upper: float = 40,
    reference: str = "SFC",
    **more: Any,
) -> Body:
    start = datetime.now(UTC) + timedelta(seconds=in_s)
    center = {"lat": LAT + north_m / 111_030, "lng": LON}
    volume = {
        "volume": {
            "outline_circle": {"center": center, "radius": {"value": 30, "units": "M"}},
            "altitude_lower": {"value": 10, "reference": reference, "units": "M"},
            "altitude_upper": {"value": upper, "reference": reference, "units": "M"},
        },
        "time_start": {"value": start.isoformat(), "format": "RFC3339"},
        "time_end": {"value": (start + timedelta(minutes=10)).isoformat(), "format": "RFC3339"},
    }
    state = more.pop("uas_state", "Nominal")
    return {"basic_information": {"usage_state": usage, "uas_state": state, "area": [volume]}, **more}


def put(send: Send, plan_id: str, plan: Body, style: str = "IfAllowed", request_id: str = "") -> tuple[str, str]:
    """Send a flight, check the response against InterUSS' types, and return result and status."""
    request = {"flight_plan": plan, "execution_style": style, "request_id": request_id or str(uuid.uuid4())}
    reply = send("PUT", f"/flight_plans/{plan_id}", request)
    assert reply.status == 200, reply
    response: Any = ImplicitDict.parse(reply.body, api.UpsertFlightPlanResponse)
    if response.planning_result != api.PlanningActivityResult.Completed:
        assert reply.body["notes"]
    assert reply.body["includes_advisories"] in list(api.AdvisoryInclusion)
    return response.planning_result.value, response.flight_plan_status.value


def close(send: Send, plan_id: str) -> tuple[str, str]:
    reply = send("DELETE", f"/flight_plans/{plan_id}")
    assert reply.status == 200, reply
    response: Any = ImplicitDict.parse(reply.body, api.DeleteFlightPlanResponse)
    return response.planning_result.value, response.flight_plan_status.value


def plans(world: World, namespace: str) -> list[str]:
    return [each["metadata"]["name"] for each in world.api.list(f"{FRACTUS}/namespaces/{namespace}/flightplans")]


@pytest.fixture
def plan_id() -> str:
    return str(uuid.uuid4())


def test_status_is_ready_for_a_valid_token(send: Send) -> None:
    response: Any = ImplicitDict.parse(send("GET", "/status").body, api.StatusResponse)
    assert response.status == api.StatusResponseStatus.Ready
    assert response.api_name == "Flight Planning Automated Testing Interface"
    assert response.api_version == f"v{api.API_VERSION}"
    assert send("GET", "/status", token="wrong").status == 401


def test_flight_is_planned_modified_activated_and_closed(send: Send, plan_id: str, world: World) -> None:
    assert put(send, plan_id, flight(in_s=-5)) == ("Completed", "Planned")
    assert put(send, plan_id, flight(in_s=-5, north_m=45)) == ("Completed", "Planned")
    assert put(send, plan_id, flight(in_s=-5, north_m=45, usage="InUse")) == ("Completed", "OkToFly")
    assert put(send, plan_id, flight(in_s=-5, north_m=45)) == ("Rejected", "OkToFly")
    moved = flight(in_s=-5, north_m=60, usage="InUse")
    assert put(send, plan_id, moved) == ("NotSupported", "OkToFly")
    assert close(send, plan_id) == ("Completed", "Closed")
    assert put(send, plan_id, flight()) == ("Completed", "Planned")
    assert put(send, plan_id, flight(usage="Closed")) == ("Completed", "Closed")
    missing = send("DELETE", f"/flight_plans/{plan_id}")
    assert missing.status == 404
    assert missing.body["flight_plan_status"] == "NotPlanned"


def test_conflicting_flight_is_rejected_and_removed(send: Send, plan_id: str, world: World, tests: str) -> None:
    other = str(uuid.uuid4())
    assert put(send, plan_id, flight()) == ("Completed", "Planned")
    assert put(send, other, flight()) == ("Rejected", "NotPlanned")
    assert plans(world, tests) == [f"interuss-{plan_id}"]
    assert put(send, other, flight(in_s=7200)) == ("Completed", "Planned")
    # The refused change does not happen later either.
    assert put(send, other, flight()) == ("Rejected", "Planned")
    assert close(send, plan_id) == ("Completed", "Closed")
    spec = world.api.get(f"{FRACTUS}/namespaces/{tests}/flightplans/interuss-{other}") or {}
    start = datetime.fromisoformat(spec["spec"]["window"]["start"])
    assert start - datetime.now(UTC) > timedelta(seconds=7000)


def test_flight_above_the_limit_of_its_template_is_rejected(send: Send, world: World, tests: str) -> None:
    """A FlightPlan has no altitudes, but reserves those of its template."""
    for upper_m, reference in ((90, "SFC"), (HOME_M + 90, "W84")):
        assert put(send, str(uuid.uuid4()), flight(upper=upper_m, reference=reference)) == ("Rejected", "NotPlanned")
    assert plans(world, tests) == []
    for upper_m, reference in ((59, "SFC"), (HOME_M + 59, "W84")):
        own = {"fractus": {"drone": "drone-1" if reference == "SFC" else "drone-2"}}
        plan = flight(
            upper=upper_m, reference=reference, in_s=3600 if reference == "SFC" else 7200, additional_information=own
        )
        assert put(send, str(uuid.uuid4()), plan) == ("Completed", "Planned")


def test_hypothetical_flight_reserves_nothing(send: Send, plan_id: str) -> None:
    assert put(send, plan_id, flight(), "Hypothetical") == ("Completed", "Planned")
    assert put(send, plan_id, flight()) == ("Completed", "Planned")
    assert put(send, str(uuid.uuid4()), flight(), "Hypothetical") == ("Rejected", "NotPlanned")
    assert put(send, plan_id, flight(usage="InUse"), "InReality") == ("NotSupported", "Planned")


def test_repeated_request_gets_the_first_response(send: Send, plan_id: str) -> None:
    assert put(send, plan_id, flight(), request_id="one") == ("Completed", "Planned")
    assert close(send, plan_id) == ("Completed", "Closed")
    assert put(send, plan_id, flight(), request_id="one") == ("Completed", "Planned")
    assert send("DELETE", f"/flight_plans/{plan_id}").status == 404
    assert put(send, str(uuid.uuid4()), flight(upper=90), request_id="one") == ("Rejected", "NotPlanned")


def test_clear_area_removes_the_plans_in_the_extent(send: Send, plan_id: str, world: World, tests: str) -> None:
    def clear(extent: Body) -> None:
        reply = send("POST", "/clear_area_requests", {"request_id": str(uuid.uuid4()), "extent": extent})
        response: Any = ImplicitDict.parse(reply.body, api.ClearAreaResponse)
        assert response.outcome.success

    plan = flight(in_s=-5, usage="InUse")
    assert put(send, plan_id, plan) == ("Completed", "OkToFly")
    clear(flight(in_s=-5, north_m=9000)["basic_information"]["area"][0])
    clear(flight(in_s=7200)["basic_information"]["area"][0])
    assert len(plans(world, tests)) == 1
    clear(plan["basic_information"]["area"][0])
    assert plans(world, tests) == []


def test_conflict_that_arose_is_notified(send: Send, plan_id: str, world: World, tests: str) -> None:
    begin = datetime.now(UTC)
    assert put(send, plan_id, flight()) == ("Completed", "Planned")
    urgent = fractus_object(
        "FlightPlan",
        "urgent",
        world.api.get(f"{FRACTUS}/namespaces/{tests}/flightplans/interuss-{plan_id}")["spec"]
        | {"priorityClass": "elevated"},
        tests,
    )
    world.put(urgent)

    def notified() -> list[Body]:
        after = begin.isoformat().replace("+", "%2B")
        response: Any = ImplicitDict.parse(
            send("GET", f"/user_notifications?after={after}").body, api.QueryUserNotificationsResponse
        )
        return list(response.user_notifications)

    (notification,) = wait_for(notified, "the notification")
    assert notification["conflicts"] == "Single"
    assert send("GET", "/user_notifications?after=2026-01-02T00:00:00Z&before=2026-01-01T00:00:00Z").status == 400
