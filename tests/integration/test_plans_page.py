"""Web page of flight plans in Chromium, on the real management API, API server and operator."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import pytest
from axe_playwright_python.sync_playwright import Axe
from browser import CHROMIUM, SOFTWARE_GL, TIMEOUT_MS, launched
from control_plane import wait_for
from flight_log import call, write_log, write_pictures
from management_server import Body, ManagementServer, User, plan, restriction, submitted, user_token
from operator_world import FRACTUS, LAT, LON, World, approved_region_template, approved_template, at, fractus_object
from PIL import Image
from playwright.sync_api import Browser, Page, Playwright, Route, expect, sync_playwright
from record_node import Flight, report_start, started

IMPORTED = Path(__file__).parents[1] / "imported"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        CHROMIUM is None, reason="Chromium is not installed; `make packages` installs it on machines with apt-get"
    ),
    pytest.mark.xdist_group("browser"),
]


@pytest.fixture(scope="module")
def playwright() -> Iterator[Playwright]:
    with sync_playwright() as playwright:
        yield playwright


@pytest.fixture(scope="module")
def browser(playwright: Playwright) -> Iterator[Browser]:
    with launched(playwright, *SOFTWARE_GL) as browser:
        yield browser


@pytest.fixture
def page(browser: Browser, management: ManagementServer) -> Iterator[Page]:
    """The page before the sign-in. The test fails if the page violates its Content-Security-Policy or throws an error."""
    context = browser.new_context(viewport={"width": 1400, "height": 1000})
    context.set_default_timeout(TIMEOUT_MS)
    page = context.new_page()
    problems = list[str]()
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.on("console", lambda message: problems.append(message.text) if "Content Security" in message.text else None)
    page.on("dialog", lambda dialog: dialog.accept())
    page.goto(management.url)
    yield page
    assert problems == []
    context.close()


def sign_in(page: Page, pilot: User, *, by_keyboard: bool = False) -> None:
    page.get_by_label("Token").fill(pilot.token)
    page.get_by_label("Namespace").fill(pilot.namespace)
    if by_keyboard:
        page.get_by_label("Namespace").press("Enter")
    else:
        page.locator("#sign-in button").click()
    expect(page.get_by_role("heading", name="Plan a flight")).to_be_visible(timeout=TIMEOUT_MS)


def enter_point(page: Page, number: int, north_m: float, east_m: float, alt: float) -> None:
    """Add a point by the table."""
    position = at(north_m, east_m)
    page.get_by_role("button", name="Add a point").press("Enter")
    for label, value in (("Latitude", position["lat"]), ("Longitude", position["lon"]), ("Altitude", alt)):
        page.get_by_label(f"{label} of point {number}").fill(f"{value:.7f}")


def import_file(page: Page, content: str) -> None:
    file = {"name": "route", "mimeType": "application/json", "buffer": content.encode()}
    page.get_by_label("Import").set_input_files(file)


def is_ready(pilot: User, template: str) -> bool:
    status = pilot("GET", f"/v1/apps/{template}").body.get("status") or {}
    return any(each["type"] == "Ready" and each["status"] == "True" for each in status.get("conditions") or ())


def publish_parameters(world: World, schema: Body) -> None:
    """Publish and approve the template `survey` with a schema of its parameters."""
    approved_template(world)
    path = f"{FRACTUS}/applicationtemplates/survey"
    body = world.api.merge(path, {"spec": {"parameters": schema}})
    approval = {"generation": body["metadata"]["generation"], "by": "admin", "at": "2026-01-01T00:00:00Z"}
    world.api.merge(f"{path}/status", {"status": {"approval": approval}})


def expect_decision(page: Page, text: str) -> None:
    expect(page.locator("#decision")).to_contain_text(text, timeout=TIMEOUT_MS)


def test_plans_page_leads_from_a_token_to_an_accepted_plan(page: Page, pilot: User) -> None:
    sign_in(page, pilot)
    submit = page.get_by_role("button", name="Submit the plan")
    expect_decision(page, "Add a waypoint.")
    expect(submit).to_be_disabled()
    page.wait_for_selector("#map[data-map=ready]")
    # The map shows the surroundings of imported points.
    takeoff = {"type": "SimpleItem", "command": 22, "frame": 3, "params": [0, 0, 0, None, 0, 0, 10]}
    waypoint = {
        "type": "SimpleItem",
        "command": 16,
        "frame": 3,
        "params": [0, 0, 0, None, LAT + 0.0002, LON + 0.0002, 30],
    }
    import_file(page, json.dumps({"fileType": "Plan", "mission": {"items": [takeoff, waypoint]}}))
    expect_decision(page, "Accepted")
    expect(page.get_by_label("Altitude of point 1")).to_have_value("30")
    page.locator("#map canvas").click(position={"x": 420, "y": 320})
    expect(page.locator("#route tr")).to_have_count(2)
    expect_decision(page, "Accepted")
    expect(page.locator("#findings")).to_contain_text("Suitable drones")
    expect(page.locator("#findings")).to_contain_text("Reserved airspace")
    submit.click()
    item = page.locator("#plans > li")
    expect(item).to_contain_text("Accepted", timeout=TIMEOUT_MS)
    (stored,) = pilot("GET", "/v1/plans").body["items"]
    assert stored["status"]["state"] == "Accepted"
    assert len(stored["spec"]["waypoints"]) == 2
    expect(item).to_contain_text(stored["metadata"]["name"])
    expect(submit).to_be_disabled()
    item.get_by_role("button", name="Start").click()
    expect(item).to_contain_text("may take off from", timeout=TIMEOUT_MS)
    # The stream of the followed plan reports the change.
    item.get_by_role("button", name="End").click()
    expect(item).to_contain_text("Ended", timeout=TIMEOUT_MS)
    expect(page.locator("#announcer")).to_contain_text("Ended", timeout=TIMEOUT_MS)


def test_plans_page_shows_a_route_across_the_antimeridian_in_one_piece(page: Page, pilot: User) -> None:
    sign_in(page, pilot)
    page.wait_for_selector("#map[data-map=ready]")
    # The map shows the imported points, so its middle is on the antimeridian.
    import_file(page, json.dumps({"type": "LineString", "coordinates": [[179.999, -17], [-179.999, -17]]}))
    expect(page.locator("#route tr")).to_have_count(2)
    page.locator("#map canvas").click()
    expect(page.locator("#route tr")).to_have_count(3)
    longitude = float(page.get_by_label("Longitude of point 3").input_value())
    assert 180 - abs(longitude) < 0.0005


def test_plans_page_submits_a_plan_of_a_region(page: Page, pilot: User, world: World) -> None:
    approved_region_template(world)
    wait_for(lambda: is_ready(pilot, "patrol"), "the template to be ready")
    sign_in(page, pilot)
    page.get_by_label("Application", exact=True).select_option("patrol")
    expect_decision(page, "Add the corners of the region.")
    corners = [at(10, 10), at(40, 10), at(40, 40)]
    ring = [[corner["lon"], corner["lat"]] for corner in [*corners, corners[0]]]
    import_file(page, json.dumps({"type": "Feature", "geometry": {"type": "Polygon", "coordinates": [ring]}}))
    expect(page.locator("#route tr")).to_have_count(3)
    page.get_by_label("Minutes in the region").fill("1")
    expect_decision(page, "Accepted")
    page.get_by_role("button", name="Submit the plan").click()
    expect(page.locator("#plans > li")).to_contain_text("Accepted", timeout=TIMEOUT_MS)
    (stored,) = pilot("GET", "/v1/plans").body["items"]
    assert stored["spec"]["region"]["polygon"]["exterior"] == corners
    assert stored["spec"]["stay"] == 1


def test_plans_page_can_be_used_by_keyboard_and_passes_axe(page: Page, pilot: User) -> None:
    assert Axe().run(page).violations_count == 0
    sign_in(page, pilot, by_keyboard=True)
    expect(page.locator("#plan-title")).to_be_focused()
    enter_point(page, 1, 50, 50, 20)
    expect_decision(page, "Accepted")
    result = Axe().run(page)
    assert result.violations_count == 0, result.generate_report()
    page.get_by_role("button", name="Submit the plan").press("Enter")
    expect(page.locator("#plans-title")).to_be_focused()
    expect(page.locator("#plans > li")).to_contain_text("Accepted", timeout=TIMEOUT_MS)
    result = Axe().run(page)
    assert result.violations_count == 0, result.generate_report()


def test_plans_page_shows_reasons_and_the_conflicting_plan(page: Page, pilot: User) -> None:
    first = submitted(pilot, in_s=600).body["metadata"]["name"]
    sign_in(page, pilot)
    enter_point(page, 1, 50, 50, 20)
    expect_decision(page, "Rejected")
    expect(page.locator("#findings")).to_contain_text("Unsuitable drones")
    expect(page.locator("#findings")).to_contain_text("drone-1")
    expect(page.get_by_role("button", name="Submit the plan")).to_be_disabled()
    expect(page.locator("#plans")).to_contain_text(first)


def test_plans_page_requires_an_action_for_each_policy_with_choices(page: Page, pilot: User, world: World) -> None:
    square = [{"lat": 39.4 + north, "lon": 22.97 + east} for north, east in ((0, 0), (0, 0.001), (0.001, 0.001))]
    world.put(fractus_object("Zone", "yard", {"area": {"polygon": {"exterior": square}}}))
    spec = {"type": "GeofenceControl", "kind": "exclusion", "selector": {"zones": ["yard"]}}
    world.put(fractus_object("Policy", "school", spec | {"action": "hover", "choices": ["land"]}))
    sign_in(page, pilot)
    enter_point(page, 1, 50, 50, 20)
    expect_decision(page, "Select an action for school.")
    submit = page.get_by_role("button", name="Submit the plan")
    expect(submit).to_be_disabled()
    page.get_by_role("radio", name="land: ").check()
    expect_decision(page, "Accepted")
    submit.click()
    expect(page.locator("#plans > li")).to_contain_text("Accepted", timeout=TIMEOUT_MS)
    (stored,) = pilot("GET", "/v1/plans").body["items"]
    assert stored["spec"]["policyActions"] == [{"policy": "school", "action": "land"}]


def test_plans_page_requires_a_landing_place_for_an_abort(page: Page, pilot: User, world: World) -> None:
    square = [{"lat": 39.4 + north, "lon": 22.97 + east} for north, east in ((0, 0), (0, 0.001), (0.001, 0.001))]
    world.put(fractus_object("Zone", "yard", {"area": {"polygon": {"exterior": square}}}))
    spec = {"type": "GeofenceControl", "kind": "exclusion", "selector": {"zones": ["yard"]}}
    world.put(fractus_object("Policy", "school", spec | {"action": "hover", "choices": ["abort"]}))
    sign_in(page, pilot)
    enter_point(page, 1, 50, 50, 20)
    expect_decision(page, "Select an action for school.")
    page.get_by_role("radio", name="abort: ").check()
    expect_decision(page, "Land at")
    submit = page.get_by_role("button", name="Submit the plan")
    expect(submit).to_be_disabled()
    place = page.get_by_role("group", name="Landing place for school")
    place.get_by_label("Land at").select_option("another place")
    expect(submit).to_be_disabled()
    page.wait_for_selector("#map[data-map=ready]")
    place.get_by_role("button", name="Select on the map").press("Enter")
    page.locator("#map canvas").click()
    expect(page.locator("#route tr")).to_have_count(1)
    latitude = float(place.get_by_label("Latitude").input_value())
    longitude = float(place.get_by_label("Longitude").input_value())
    result = Axe().run(page)
    assert result.violations_count == 0, result.generate_report()
    expect_decision(page, "Accepted")
    submit.click()
    expect(page.locator("#plans > li")).to_contain_text("Accepted", timeout=TIMEOUT_MS)
    (stored,) = pilot("GET", "/v1/plans").body["items"]
    (action,) = stored["spec"]["policyActions"]
    assert action == {"policy": "school", "action": "abort", "landAt": {"lat": latitude, "lon": longitude}}


def test_plans_page_keeps_the_landing_place_after_lost_contact(page: Page, pilot: User) -> None:
    sign_in(page, pilot)
    enter_point(page, 1, 50, 50, 20)
    page.get_by_role("radio", name="abort, and land").check()
    place = page.get_by_role("group", name="Landing place after lost contact")
    place.get_by_label("Land at").select_option("another place")
    place.get_by_label("Latitude").fill(str(LAT))
    place.get_by_label("Longitude").fill(str(LON))
    expect_decision(page, "Accepted")
    page.get_by_role("button", name="Submit the plan").click()
    expect(page.locator("#plans > li")).to_contain_text("Accepted", timeout=TIMEOUT_MS)
    (stored,) = pilot("GET", "/v1/plans").body["items"]
    assert stored["spec"]["contactLost"]["landAt"] == {"lat": LAT, "lon": LON}
    name = stored["metadata"]["name"]
    page.get_by_role("button", name=f"Change {name}").click()
    expect(place.get_by_label("Latitude")).to_have_value(str(LAT))


def test_plans_page_offers_higher_priorities_only_to_users_who_may_select_them(
    page: Page, pilot: User, world: World, namespace: str
) -> None:
    sign_in(page, pilot)
    expect(page.locator("#priority-help")).to_contain_text("fractus-flightplan-prioritizer")
    expect(page.get_by_label("Priority").locator("option", has_text="emergency")).to_be_disabled()
    user_token(world, namespace, "pilot", ("fractus-flightplan-prioritizer",), ())
    wait_for(lambda: pilot("GET", "/v1/permissions").body["prioritize"], "the role of the pilot")
    page.reload()
    enter_point(page, 1, 50, 50, 20)
    page.get_by_label("Priority").select_option("emergency")
    expect_decision(page, "Accepted")
    page.get_by_role("button", name="Submit the plan").click()
    expect(page.locator("#plans > li")).to_contain_text("Accepted", timeout=TIMEOUT_MS)
    (stored,) = pilot("GET", "/v1/plans").body["items"]
    assert stored["spec"]["priorityClass"] == "emergency"


def test_plans_page_lists_the_restrictions_during_the_flight(
    page: Page, pilot: User, authority: User, world: World, namespace: str
) -> None:
    authority("POST", "/v1/restrictions", restriction("present"))
    authority("POST", "/v1/restrictions", restriction("later", validFrom="2098-01-01T00:00:00Z"))
    user_token(world, namespace, "pilot", (), ("fractus-policy-viewer", "fractus-zone-viewer"))
    wait_for(lambda: pilot("GET", "/v1/restrictions").status == 200, "the roles of the pilot")
    sign_in(page, pilot)
    listed = page.locator("#restrictions > li")
    expect(listed).to_have_count(1, timeout=TIMEOUT_MS)
    expect(listed).to_contain_text("present")
    expect(page.get_by_role("button", name="Delete present")).to_have_count(0)
    page.get_by_label("Start (UTC)").fill("2098-06-01T10:00:00")
    expect(listed).to_have_count(2)


def test_plans_page_checks_a_change_without_a_conflict_with_the_plan_itself(page: Page, pilot: User) -> None:
    name = submitted(pilot).body["metadata"]["name"]
    sign_in(page, pilot)
    page.get_by_role("button", name=f"Change {name}").click()
    with page.expect_response("**/v1/plans/*:check?*") as checked:
        page.get_by_label("Duration in minutes").fill("20")
    assert checked.value.json()["status"]["state"] == "Accepted"
    expect_decision(page, f"You change {name}. Accepted")
    page.get_by_label("Start (UTC)").fill("2098-01-01T00:00:00")
    expect_decision(page, f"You change {name}. Rejected")


def test_plans_page_shows_parameters_of_the_template(page: Page, pilot: User, world: World) -> None:
    schema = {
        "type": "object",
        "required": ["pictures"],
        "properties": {
            "pictures": {"type": "integer", "title": "Number of pictures", "minimum": 1},
            "mode": {"enum": ["fast", "careful"], "default": "careful"},
        },
    }
    publish_parameters(world, schema)
    wait_for(lambda: is_ready(pilot, "survey"), "the template to be ready")
    sign_in(page, pilot)
    enter_point(page, 1, 50, 50, 20)
    expect_decision(page, "Number of pictures")
    page.get_by_label("Number of pictures").fill("3")
    expect_decision(page, "Accepted")
    page.get_by_role("button", name="Submit the plan").click()
    expect(page.locator("#plans > li")).to_contain_text("Accepted", timeout=TIMEOUT_MS)
    (stored,) = pilot("GET", "/v1/plans").body["items"]
    assert stored["spec"]["parameters"] == {"pictures": 3, "mode": "careful"}


def test_plans_page_shows_differences_if_another_user_changed_the_plan(page: Page, pilot: User) -> None:
    name = submitted(pilot).body["metadata"]["name"]
    sign_in(page, pilot)
    page.get_by_role("button", name=f"Change {name}").click()
    page.get_by_label("Duration in minutes").fill("20")
    pilot("PATCH", f"/v1/plans/{name}", {"window": {"duration": 25}}, If_Match="*")
    change = page.get_by_role("button", name="Change the plan", exact=True)
    change.click()
    problem = page.locator("#submit-problem")
    expect(problem).to_contain_text("window.duration is now 25, and 20 in your version", timeout=TIMEOUT_MS)
    assert pilot("GET", f"/v1/plans/{name}").body["spec"]["window"]["duration"] == 25
    change.click()
    expect(page.locator("#plans > li")).to_contain_text("20 minutes", timeout=TIMEOUT_MS)
    assert pilot("GET", f"/v1/plans/{name}").body["spec"]["window"]["duration"] == 20


def test_plans_page_shows_since_when_it_is_stale(page: Page, pilot: User) -> None:
    sign_in(page, pilot)
    page.context.set_offline(True)
    enter_point(page, 1, 50, 50, 20)
    expect(page.locator("#connection")).to_contain_text("Stale since", timeout=TIMEOUT_MS)
    expect(page.get_by_role("button", name="Submit the plan")).to_be_disabled()
    page.context.set_offline(False)
    expect(page.locator("#connection")).to_be_empty(timeout=TIMEOUT_MS)
    expect_decision(page, "Accepted")


def test_plans_page_refuses_an_invalid_token_and_forgets_it(page: Page, pilot: User) -> None:
    page.get_by_label("Token").fill("not-a-token")
    page.locator("#sign-in button").click()
    expect(page.locator("#sign-in-problem")).to_contain_text("the bearer token is invalid", timeout=TIMEOUT_MS)
    sign_in(page, pilot)
    page.reload()
    expect(page.get_by_role("heading", name="Plan a flight")).to_be_visible(timeout=TIMEOUT_MS)
    page.get_by_role("button", name="Sign out").click()
    expect(page.get_by_label("Token")).to_be_focused()
    assert page.evaluate("sessionStorage.getItem('token')") is None


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "The file is not JSON"),
        ("null", "no point, line or polygon"),
        ('{"type": "LineString", "coordinates": [[0, 91]]}', "position 91, 0, without altitude"),
        ('{"type": "LineString", "coordinates": [[0, 1, 120]]}', "heights above the ellipsoid"),
        ('{"type": "LineString"}', "coordinates of the file are incomplete"),
        ((IMPORTED / "plan-jump.plan").read_text(), "of the mission is not a waypoint"),
        ((IMPORTED / "plan-terrain-frames.plan").read_text(), "is not relative to home"),
    ],
)
def test_plans_page_names_the_problem_of_an_imported_file(page: Page, pilot: User, content: str, message: str) -> None:
    sign_in(page, pilot)
    import_file(page, content)
    expect(page.locator("#import-problem")).to_contain_text(message)
    expect(page.locator("#route tr")).to_have_count(0)


def test_plans_page_keeps_changing_a_plan_that_is_edited_during_its_submission(page: Page, pilot: User) -> None:
    name = submitted(pilot).body["metadata"]["name"]
    sign_in(page, pilot)
    page.get_by_role("button", name=f"Change {name}").click()
    page.get_by_label("Duration in minutes").fill("20")
    pending: list[Route] = []

    def held(route: Route) -> None:
        pending.append(route)

    page.route(f"**/v1/plans/{name}?*", held, times=1)
    change = page.get_by_role("button", name="Change the plan", exact=True)
    with page.expect_request(f"**/v1/plans/{name}?*"):
        change.click()
    page.get_by_label("Duration in minutes").fill("25")
    pending[0].continue_()
    expect(page.locator("#plans > li")).to_contain_text("20 minutes", timeout=TIMEOUT_MS)
    expect_decision(page, f"You change {name}.")
    change.click()
    expect(page.locator("#plans > li")).to_contain_text("25 minutes", timeout=TIMEOUT_MS)
    expect(page.locator("#plans > li")).to_have_count(1)


def test_plans_page_keeps_changing_a_plan_if_another_one_cannot_be_shown(page: Page, pilot: User, world: World) -> None:
    approved_region_template(world)
    wait_for(lambda: is_ready(pilot, "patrol"), "the template to be ready")
    name = submitted(pilot).body["metadata"]["name"]
    circle = {"circle": {"center": at(10, 10), "radius": 20}}
    window = {"start": "2099-01-01T00:00:00Z", "duration": 15}
    reply = pilot("POST", "/v1/plans", {"template": "patrol", "region": circle, "stay": 1, "window": window})
    sign_in(page, pilot)
    page.get_by_role("button", name=f"Change {name}").click()
    page.get_by_role("button", name=f"Change {reply.body['metadata']['name']}").click()
    expect(page.locator("#plans-problem")).to_contain_text("cannot change a region that is a circle")
    page.get_by_label("Duration in minutes").fill("20")
    expect(page.get_by_role("button", name="Change the plan", exact=True)).to_be_enabled()
    expect_decision(page, f"You change {name}.")


@pytest.mark.parametrize("button", ["Start", "Delete"])
def test_plans_page_does_nothing_with_a_plan_that_another_user_has_changed(
    page: Page, pilot: User, button: str
) -> None:
    name = submitted(pilot, in_s=7200).body["metadata"]["name"]
    if button == "Delete":
        name = submitted(pilot, in_s=7200).body["metadata"][
            "name"
        ]  # It conflicts with the first one, so it is rejected.
    sign_in(page, pilot)
    page.route("**/v1/plans?*", lambda route: route.abort())  # The list is not read again.
    later = plan(in_s=14400)["window"]
    pilot("PATCH", f"/v1/plans/{name}", {"window": later}, If_Match="*")
    page.get_by_role("button", name=f"{button} {name}").click()
    expect(page.locator("#plans-problem")).to_contain_text("window.start is now", timeout=TIMEOUT_MS)
    stored = pilot("GET", f"/v1/plans/{name}").body
    assert stored["spec"].get("use") != "InUse"
    assert stored["status"]["state"] == "Accepted"


def test_plans_page_keeps_the_altitude_reference_of_waypoints(page: Page, pilot: User) -> None:
    waypoints = [{**at(50, 50, alt=30), "altitudeReference": "amsl"}]
    name = submitted(pilot, waypoints=waypoints).body["metadata"]["name"]
    sign_in(page, pilot)
    page.get_by_role("button", name=f"Change {name}").click()
    expect(page.locator("#route")).to_contain_text("above sea level")
    enter_point(page, 2, 60, 60, 31)
    page.get_by_role("button", name="Change the plan", exact=True).click()
    expect(page.get_by_role("button", name="Submit the plan")).to_be_visible(timeout=TIMEOUT_MS)
    stored = pilot("GET", f"/v1/plans/{name}").body["spec"]["waypoints"]
    assert [(each["alt"], each["altitudeReference"]) for each in stored] == [(30, "amsl"), (31, "amsl")]


def test_plans_page_keeps_parameters_that_the_schema_does_not_describe(page: Page, pilot: User, world: World) -> None:
    publish_parameters(world, {"type": "object"})
    wait_for(lambda: is_ready(pilot, "survey"), "the template to be ready")
    name = submitted(pilot, parameters={"note": "north"}).body["metadata"]["name"]
    sign_in(page, pilot)
    page.get_by_role("button", name=f"Change {name}").click()
    page.get_by_label("Duration in minutes").fill("20")
    page.get_by_role("button", name="Change the plan", exact=True).click()
    expect(page.locator("#plans > li")).to_contain_text("20 minutes", timeout=TIMEOUT_MS)
    assert pilot("GET", f"/v1/plans/{name}").body["spec"]["parameters"] == {"note": "north"}


def test_plans_page_forgets_the_plan_of_a_user_who_signs_out(page: Page, pilot: User) -> None:
    sign_in(page, pilot)
    enter_point(page, 1, 50, 50, 20)
    page.get_by_role("button", name="Sign out").click()
    expect(page.locator("#route tr")).to_have_count(0)
    expect(page.get_by_label("Token")).to_be_focused()


def open_restrictions(page: Page, user: User) -> None:
    sign_in(page, user)
    page.get_by_role("button", name="Restrictions", exact=True).press("Enter")


def test_plans_page_leads_an_authority_from_an_area_to_a_published_restriction(
    page: Page, pilot: User, authority: User
) -> None:
    affected = submitted(pilot, in_s=600).body["metadata"]["name"]
    open_restrictions(page, authority)
    publish = page.get_by_role("button", name="Publish the restriction")
    page.get_by_label("Name", exact=True).fill("summer-fair")
    page.get_by_label("Message to users").fill("Summer fair")
    center = at(50, 50)
    page.get_by_label("Latitude of the centre").fill(str(center["lat"]))
    page.get_by_label("Longitude of the centre").fill(str(center["lon"]))
    page.get_by_label("Radius").fill("15")
    page.get_by_label("Up to (m)").fill("120")
    page.get_by_label("End (UTC)").fill("2099-01-01T00:00:00")
    expect(publish).to_be_disabled()
    page.get_by_role("button", name="Show the impact").press("Enter")
    expect(page.locator("#impact-result")).to_contain_text("1 plan and 0 flights", timeout=TIMEOUT_MS)
    expect(page.locator("#impact-findings")).to_contain_text(affected)
    result = Axe().run(page)
    assert result.violations_count == 0, result.generate_report()
    publish.press("Enter")
    expect(page.locator("#restrictions")).to_contain_text("In force", timeout=TIMEOUT_MS)
    (stored,) = authority("GET", "/v1/restrictions").body["items"]
    zone = stored["zone"]
    assert zone["description"] == "Summer fair"
    assert zone["area"]["circle"] == {"center": {"lat": center["lat"], "lon": center["lon"]}, "radius": 15}
    assert zone["altitude"] == {"upper": 120, "reference": "home"}
    assert stored["policy"].items() >= {
        "type": "GeofenceControl", "kind": "exclusion", "action": "returnToLaunch", "validUntil": "2099-01-01T00:00:00Z",
    }.items()  # fmt: skip
    result = Axe().run(page)
    assert result.violations_count == 0, result.generate_report()
    page.get_by_role("button", name="End now summer-fair").click()
    expect(page.locator("#restrictions")).to_contain_text("Ended", timeout=TIMEOUT_MS)
    page.get_by_role("button", name="Delete summer-fair").click()
    expect(page.locator("#restrictions")).to_contain_text("No restrictions are published.", timeout=TIMEOUT_MS)
    assert authority("GET", "/v1/restrictions").body["items"] == []


def test_plans_page_imports_the_polygon_of_a_restriction(page: Page, authority: User) -> None:
    open_restrictions(page, authority)
    expect_decision(page, "fractus-applicationtemplate-viewer")
    corners = [at(10, 10), at(40, 10), at(40, 40)]
    ring = [[corner["lon"], corner["lat"]] for corner in [*corners, corners[0]]]
    content = json.dumps({"type": "Polygon", "coordinates": [ring]})
    file = {"name": "area", "mimeType": "application/json", "buffer": content.encode()}
    page.get_by_label("GeoJSON of a polygon").set_input_files(file)
    expect(page.locator("#area tr")).to_have_count(3)
    page.get_by_label("Name", exact=True).fill("slow")
    page.get_by_label("Rule").select_option("Speed limit")
    page.get_by_label("At most").fill("3")
    page.get_by_role("button", name="Show the impact").click()
    page.get_by_role("button", name="Publish the restriction").click()
    expect(page.locator("#restrictions")).to_contain_text("speed at most 3 m/s", timeout=TIMEOUT_MS)
    (stored,) = authority("GET", "/v1/restrictions").body["items"]
    assert stored["zone"]["area"]["polygon"]["exterior"] == corners
    assert stored["policy"].items() >= {"kind": "speed", "upperLimit": 3, "action": "enforce"}.items()


def test_plans_page_changes_a_restriction_only_in_the_version_that_the_user_has_seen(
    page: Page, authority: User
) -> None:
    selected = {"applications": {"names": ["other"]}}
    created = authority("POST", "/v1/restrictions", restriction(priority=7, selector=selected)).body["policy"]
    open_restrictions(page, authority)
    page.get_by_role("button", name="Change fair").click()
    expect(page.get_by_role("heading", name="Change fair")).to_be_visible()
    page.get_by_label("Message to users").fill("Winter fair")
    authority("PATCH", "/v1/restrictions/fair", {"zone": {"description": "Spring fair"}}, If_Match="*")
    page.get_by_role("button", name="Show the impact").click()
    change = page.get_by_role("button", name="Change the restriction", exact=True)
    change.click()
    difference = 'zone.description is now "Spring fair", and "Winter fair" in your version'
    expect(page.locator("#restriction-problem")).to_contain_text(difference, timeout=TIMEOUT_MS)
    assert authority("GET", "/v1/restrictions/fair").body["zone"]["description"] == "Spring fair"
    change.click()
    expect(page.locator("#restrictions")).to_contain_text("Winter fair", timeout=TIMEOUT_MS)
    stored = authority("GET", "/v1/restrictions/fair").body["policy"]
    assert (stored["priority"], stored["selector"]) == (7, created["selector"])


def test_plans_page_does_not_change_a_restriction_that_the_user_has_left(page: Page, authority: User) -> None:
    authority("POST", "/v1/restrictions", restriction())
    open_restrictions(page, authority)
    page.get_by_role("button", name="Change fair").click()
    page.get_by_label("Message to users").fill("Winter fair")
    page.get_by_role("button", name="Show the impact").click()
    authority("PATCH", "/v1/restrictions/fair", {"zone": {"description": "Spring fair"}}, If_Match="*")
    pending: list[Route] = []

    def held(route: Route) -> None:
        pending.append(route)

    page.route("**/v1/restrictions/fair?*", held, times=1)
    with page.expect_request("**/v1/restrictions/fair?*"):
        page.get_by_role("button", name="Change the restriction", exact=True).click()
    page.get_by_role("button", name="Keep the restriction as it is").click()
    pending[0].continue_()
    page.get_by_label("Name", exact=True).fill("market")
    center = at(50, 50)
    page.get_by_label("Latitude of the centre").fill(str(center["lat"]))
    page.get_by_label("Longitude of the centre").fill(str(center["lon"]))
    page.get_by_label("Radius").fill("15")
    page.get_by_role("button", name="Show the impact").click()
    page.get_by_role("button", name="Publish the restriction").click()
    expect(page.locator("#restrictions > li")).to_have_count(2, timeout=TIMEOUT_MS)
    assert authority("GET", "/v1/restrictions/fair").body["zone"]["description"] == "Spring fair"


def test_plans_page_does_not_delete_a_restriction_that_another_user_has_changed(page: Page, authority: User) -> None:
    authority("POST", "/v1/restrictions", restriction())
    open_restrictions(page, authority)
    delete = page.get_by_role("button", name="Delete fair")
    expect(delete).to_be_visible()
    page.route("**/v1/restrictions?*", lambda route: route.abort())  # The list is not read again.
    authority("PATCH", "/v1/restrictions/fair", {"zone": {"description": "Spring fair"}}, If_Match="*")
    delete.click()
    expect(page.locator("#restrictions-problem")).to_contain_text("Nothing was done.", timeout=TIMEOUT_MS)
    assert authority("GET", "/v1/restrictions/fair").status == 200


def test_plans_page_shows_why_a_user_cannot_publish_restrictions(page: Page, pilot: User) -> None:
    open_restrictions(page, pilot)
    expect(page.locator("#publish-permission")).to_contain_text("fractus-policy-editor and fractus-zone-editor")
    expect(page.locator("#restrictions")).to_contain_text("fractus-policy-viewer and fractus-zone-viewer")
    expect(page.get_by_role("button", name="Publish the restriction")).to_be_hidden()
    result = Axe().run(page)
    assert result.violations_count == 0, result.generate_report()


def test_plans_page_submits_a_plan_and_shows_restrictions_without_webgl(
    page: Page, pilot: User, authority: User, world: World, namespace: str
) -> None:
    authority("POST", "/v1/restrictions", restriction())
    user_token(world, namespace, "pilot", (), ("fractus-policy-viewer", "fractus-zone-viewer"))
    wait_for(lambda: pilot("GET", "/v1/restrictions").status == 200, "the roles of the pilot")
    page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page.reload()
    expect(page.locator("#no-map")).to_contain_text("no WebGL")
    sign_in(page, pilot)
    expect(page.locator("#restrictions")).to_contain_text("no flights", timeout=TIMEOUT_MS)
    enter_point(page, 1, -50, -50, 20)
    page.get_by_role("radio", name="abort, and land").check()
    place = page.get_by_role("group", name="Landing place after lost contact")
    place.get_by_label("Land at").select_option("another place")
    expect(place.get_by_role("button", name="Select on the map")).to_be_hidden()
    place.get_by_label("Land at").select_option("home")
    expect_decision(page, "Accepted")
    result = Axe().run(page)
    assert result.violations_count == 0, result.generate_report()
    page.get_by_role("button", name="Submit the plan").press("Enter")
    expect(page.locator("#plans > li")).to_contain_text("Accepted", timeout=TIMEOUT_MS)


def jpeg() -> bytes:
    content = io.BytesIO()
    Image.new("RGB", (64, 36), "green").save(content, "JPEG")
    return content.getvalue()


def verdict(second: int, action: str = "deny", **more: object) -> Body:
    time = f"2026-06-01T12:{second // 60:02}:{second % 60:02}Z"
    content = {"kind": "call", "component": "Navigator", "method": "Goto", "reason": f"reason {second}"}
    return {"time": time, "action": action, **content, **more}


def picture(number: int, size: int = 1000) -> Body:
    time = f"2026-06-01T12:00:{number:02}Z"
    return {"id": f"1-{number}-0", "time": time, "component": "AerialViewer", "sizeBytes": size}


class Records:
    """Records of a flight that the page receives instead of those of a drone."""

    def __init__(self, page: Page) -> None:
        self.items: dict[str, list[Body]] = {"verdicts": [], "track": [], "pictures": []}
        self.requests = list[str]()
        page.route(re.compile(r"/v1/plans/[^/]+/(verdicts|track|pictures)\?"), self._send_page)
        page.route(re.compile(r"/v1/plans/[^/]+/pictures/"), lambda route: route.fulfill(body=jpeg()))

    def _send_page(self, route: Route) -> None:
        url = urlsplit(route.request.url)
        query = {name: int(value) for name, (value,) in parse_qs(url.query).items() if name != "namespace"}
        begin = query.get("continue", 0)
        end = begin + query["limit"]
        records = self.items[url.path.rpartition("/")[2]]
        self.requests.append(f"{url.path.rpartition('/')[2]} from {begin}")
        more = {"continue": str(end)} if end < len(records) else {}
        route.fulfill(json={"items": records[begin:end], **more})


def follow(page: Page, plan: Body) -> None:
    page.get_by_role("button", name=f"Follow {plan['metadata']['name']}").press("Enter")


def pixels(page: Page, colour: tuple[int, int, int]) -> int:
    """Return how many pixels of the map have a colour."""
    screenshot = Image.open(io.BytesIO(page.locator("#map").screenshot())).convert("RGB")
    colours = screenshot.getcolors(screenshot.width * screenshot.height) or []
    return sum(count for count, each in colours if each == colour)


def test_plans_page_shows_the_records_of_the_followed_flight(page: Page, served_flight: Flight) -> None:
    user = served_flight.user
    page.goto(user.url)
    sign_in(page, user)
    page.wait_for_selector("#map[data-map=ready]")
    page.get_by_role("button", name=f"Follow {served_flight.name}").press("Enter")
    verdicts = page.locator("#verdicts > li")
    expect(verdicts).to_have_count(1, timeout=TIMEOUT_MS)
    for text in ("Navigator Goto", "refused", "too far"):
        expect(verdicts).to_contain_text(text)
    expect(page.locator("#track")).to_contain_text("altitude 10.0 m above home, speed 3.0 m/s, in the air")
    wait_for(lambda: pixels(page, (11, 87, 184)) > 150, "the track on the map")
    expect(page.locator("#pictures-status")).to_contain_text("records no pictures")
    verdicts.evaluate("item => { item.dataset.kept = 'yes' }")
    corrected = call(served_flight.since_s + 5, served_flight.driver, "correct", reason="too fast")
    write_log(served_flight.log, [corrected], 6)
    second, owner, _ = served_flight.pictures[0]
    write_pictures(served_flight.recorded, [(second, owner, jpeg()), *served_flight.pictures[1:]])
    expect(verdicts).to_have_count(2, timeout=TIMEOUT_MS)
    expect(verdicts.first).to_contain_text("too fast")
    # The other items stay in the document, so that a screen reader does not lose its place.
    expect(verdicts.last).to_have_attribute("data-kept", "yes")
    expect(page.locator("#announcer")).to_contain_text("Navigator Goto corrected, too fast")
    image = page.get_by_role("img", name="picture of Navigator at")
    expect(image).to_have_count(1, timeout=TIMEOUT_MS)
    assert image.evaluate("async image => { await image.decode(); return image.naturalWidth }") == 64
    expect(page.locator("#pictures > li")).to_have_count(1)
    result = Axe().run(page)
    assert result.violations_count == 0, result.generate_report()
    with page.expect_popup() as opened:
        page.locator("#pictures a").press("Enter")
    opened.value.wait_for_function("document.images[0]?.naturalWidth === 64")


def test_plans_page_reads_records_from_the_start_of_the_flight_on(page: Page, pilot: User, world: World) -> None:
    requests = list[str]()
    page.on("request", lambda request: requests.append(urlsplit(request.url).path.rpartition("/")[2]))
    body = submitted(pilot).body
    sign_in(page, pilot)
    follow(page, body)
    expect(page.locator("#records-status")).to_contain_text("has not started")
    page.wait_for_timeout(1000)
    assert not {"verdicts", "track", "pictures"} & set(requests)
    report_start(world, body)
    # The drone of the test has no recording endpoint.
    expect(page.locator("#records-status")).to_contain_text("drone-1 serves no records", timeout=TIMEOUT_MS)


@pytest.mark.parametrize(
    ("status", "detail", "sentence"),
    [
        (409, "the flight of this plan has not started", "the flight of this plan has not started"),
        (403, "forbidden", "You may not read the records. An administrator can give you the roles"),
        (503, "drone-1 does not respond", "drone-1 does not respond"),
    ],
)
def test_plans_page_shows_why_there_are_no_records(
    page: Page, pilot: User, world: World, status: int, detail: str, sentence: str
) -> None:
    problem = {"status": status, "detail": detail}
    page.route("**/verdicts?*", lambda route: route.fulfill(status=status, json=problem))
    _, body = started(pilot, world)
    sign_in(page, pilot)
    follow(page, body)
    expect(page.locator("#records-status")).to_contain_text(sentence, timeout=TIMEOUT_MS)
    expect(page.locator("#records")).to_be_hidden()
    expect(page.locator("#plans-problem")).to_be_empty()
    expect(page.locator("#connection")).to_be_empty()
    expect(page.get_by_role("button", name=f"Change {body['metadata']['name']}")).to_be_enabled()
    result = Axe().run(page)
    assert result.violations_count == 0, result.generate_report()


def test_plans_page_reads_records_in_pages_and_keeps_the_latest(page: Page, pilot: User, world: World) -> None:
    page.add_init_script(
        "HTMLCanvasElement.prototype.getContext = () => null; window.revoked = [];"
        "const revoke = URL.revokeObjectURL; URL.revokeObjectURL = (url) => { revoked.push(url); revoke.call(URL, url) }"
    )
    page.reload()
    records = Records(page)
    records.items["verdicts"] = [verdict(0), *(verdict(second, "allow") for second in range(1, 260))]
    records.items["track"] = [
        {"time": "2026-06-01T12:00:00Z", "lat": LAT, "lon": LON, "alt": 12, "controller": "system", "inAir": False},
        {"time": "2026-06-01T12:00:01Z", "controller": "system", "inAir": True},
    ]
    records.items["pictures"] = [picture(0)]
    _, body = started(pilot, world)
    sign_in(page, pilot)
    follow(page, body)
    thumbnail = page.locator("#pictures img")
    expect(thumbnail).to_have_count(1, timeout=TIMEOUT_MS)
    source = thumbnail.get_attribute("src")
    expect(page.locator("#track")).to_contain_text("12:00:00 UTC")
    expect(page.locator("#track")).to_contain_text("speed –, on the ground")
    expect(page.locator("#verdicts > li")).to_have_count(1)
    expect(page.locator("#calls > li")).to_have_count(100)
    expect(page.locator("#calls > li").first).to_contain_text("reason 259")
    assert records.requests.count("verdicts from 0") == 1
    records.items["verdicts"].append(verdict(300))
    records.items["pictures"] += [*(picture(number, 2_000_000) for number in range(1, 12)), picture(12)]
    expect(page.locator("#verdicts > li")).to_have_count(2, timeout=TIMEOUT_MS)
    expect(page.locator("#pictures > li")).to_have_count(12)
    # The large pictures are read only at the request of the user.
    expect(thumbnail).to_have_count(1, timeout=TIMEOUT_MS)
    assert page.evaluate("revoked").count(source) == 1
    page.get_by_role("button", name="Load picture of AerialViewer at 12:00:05 UTC, 2.0 MB").press("Enter")
    expect(thumbnail).to_have_count(2)
    expect(page.locator("#pictures a").last).to_be_focused()
    assert records.requests.count("verdicts from 0") == 1
    assert "verdicts from 200" in records.requests
    shown = page.locator("#pictures a").evaluate_all("links => links.map(link => link.href)")
    follow(page, body)
    assert set(shown) <= set(page.evaluate("revoked"))


def test_plans_page_shows_the_area_of_the_policy_of_a_refusal(
    page: Page, pilot: User, authority: User, world: World, namespace: str
) -> None:
    authority("POST", "/v1/restrictions", restriction("fair"))
    user_token(world, namespace, "pilot", (), ("fractus-policy-viewer", "fractus-zone-viewer"))
    wait_for(lambda: pilot("GET", "/v1/restrictions").status == 200, "the roles of the pilot")
    Records(page).items["verdicts"] = [verdict(1, policies=["fair", "other"])]
    _, body = started(pilot, world)
    sign_in(page, pilot)
    page.wait_for_selector("#map[data-map=ready]")
    follow(page, body)
    expect(page.locator("#verdicts")).to_contain_text("policy other", timeout=TIMEOUT_MS)
    expect(page.locator("#verdicts button")).to_have_count(1)
    before = page.locator("#map").screenshot()
    page.get_by_role("button", name="Show the area of fair").press("Enter")
    wait_for(lambda: page.locator("#map").screenshot() != before, "the area on the map")
