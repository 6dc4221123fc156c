"""Arguments, output and exit codes of `fractus flights`."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from fake_cluster_reader import condition, show
from fractus_cli import flights, main
from fractus_runtime.kubernetes import Conflict, KubeError

V1 = "/apis/fractus.dev/v1alpha1"
PLANS = f"{V1}/namespaces/team/flightplans"
PLACE = ("--waypoint", "39.36,22.93,25")
WINDOW = ("--start", "2026-12-01T10:00:00Z", "--duration", "15")

Body = dict[str, Any]
Run = Callable[..., tuple[int, str]]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    def call(*arguments: str) -> tuple[int, str]:
        code = main.run(("flights", *arguments))
        output = capsys.readouterr()
        return code, output.out + output.err

    return call


class FakeApi:
    """API server with flight plans of one namespace, on which an operator decides at once.

    Attributes:
        decision: Status that the operator writes.
    """

    def __init__(self, decision: Mapping[str, Any]) -> None:
        self.decision = dict(decision)
        self.plans: dict[str, Body] = {}

    def call(self, method: str, path: str, body: Body) -> Body:
        assert (method, path) == ("POST", PLANS)
        metadata = body["metadata"]
        name = metadata.get("name") or metadata["generateName"] + "x7k2p"
        if name in self.plans:
            raise Conflict(409, "AlreadyExists", f'flightplans "{name}" already exists')
        return self._store(name, body["spec"], 1)

    def get(self, path: str) -> Body | None:
        return self.plans.get(path.removeprefix(f"{PLANS}/"))

    def list(self, path: str) -> list[Body]:
        return list(self.plans.values()) if path == PLANS else []

    def merge(self, path: str, body: Body) -> Body:
        plan = self.plans[path.removeprefix(f"{PLANS}/")]
        if body["metadata"]["resourceVersion"] != plan["metadata"]["resourceVersion"]:
            raise Conflict(409, "Conflict", "the object has been modified")
        metadata = plan["metadata"]
        return self._store(metadata["name"], plan["spec"] | body["spec"], metadata["generation"] + 1)

    def _store(self, name: str, spec: Body, generation: int) -> Body:
        version = {"generation": generation, "resourceVersion": str(generation), "uid": "u-1"}
        status = {"observedGeneration": generation, **self.decision}
        self.plans[name] = {"metadata": {"name": name, "namespace": "team", **version}, "spec": spec, "status": status}
        return {**self.plans[name], "status": {}}


@pytest.fixture
def api(monkeypatch: pytest.MonkeyPatch) -> FakeApi:
    server = FakeApi({"state": "Accepted", "message": "drone-1 is reserved", "drone": "drone-1"})

    @contextmanager
    def open_client(_: str | None) -> Iterator[FakeApi]:
        yield server

    monkeypatch.setattr(flights, "open_client", open_client)
    monkeypatch.setattr(flights.time, "sleep", lambda _: None)
    return server


# -- order: arguments --


def test_order_creates_plan_from_all_options(run: Run, api: FakeApi) -> None:
    code, output = run(
        "order", "survey", *PLACE, "--waypoint", "-39.4,22.95", "--altitude", "30", *WINDOW, "-n", "team", "--name", "morning",
        "--parameter", "speed=5", "--parameter", "tag=a b", "--action", "school=abort@39.3,22.9", "--action", "wood=hover",
        "--contact-lost", "abort@39.2,22.8", "--drone", "drone-1", "--priority", "elevated", "--auto-activate",
    )  # fmt: skip
    assert code == 0
    assert "team/morning: Accepted: drone-1 is reserved" in output
    assert api.plans["morning"]["spec"] == {
        "template": "survey",
        "waypoints": [{"lat": 39.36, "lon": 22.93, "alt": 25}, {"lat": -39.4, "lon": 22.95, "alt": 30}],
        "window": {"start": "2026-12-01T10:00:00Z", "duration": 15},
        "parameters": {"speed": 5, "tag": "a b"},
        "policyActions": [
            {"policy": "school", "action": "abort", "landAt": {"lat": 39.3, "lon": 22.9}},
            {"policy": "wood", "action": "hover"},
        ],
        "contactLost": {"action": "abort", "landAt": {"lat": 39.2, "lon": 22.8}},
        "drone": "drone-1",
        "priorityClass": "elevated",
        "autoActivate": True,
    }


def test_order_without_name_lets_the_server_choose_one(run: Run, api: FakeApi) -> None:
    _, output = run("order", "survey", *PLACE, *WINDOW, "-n", "team")
    assert "team/survey-x7k2p: Accepted" in output
    assert "Next: fractus flights start survey-x7k2p -n team" in output


def test_check_orders_a_dry_run_and_lists_suitable_drones(run: Run, api: FakeApi) -> None:
    api.decision["candidates"] = [{"node": "drone-1", "score": 12.5}, {"node": "drone-2", "score": 3}]
    _, output = run("order", "survey", *PLACE, *WINDOW, "-n", "team", "--check")
    assert api.plans["survey-x7k2p"]["spec"]["dryRun"] is True
    assert "a check that reserves nothing" in output
    assert "Suitable drones, best first: drone-1 (12.5), drone-2 (3)" in output
    assert "Next:" not in output


def test_relative_start_counts_from_now(run: Run, api: FakeApi) -> None:
    run("order", "survey", *PLACE, "--start", "+2h", "--duration", "15", "-n", "team")
    start = datetime.fromisoformat(api.plans["survey-x7k2p"]["spec"]["window"]["start"])
    assert abs(start - datetime.now(UTC) - timedelta(hours=2)) < timedelta(minutes=1)


def geojson(tmp_path: Path, kind: str, coordinates: Any, **properties: Any) -> Path:
    file = tmp_path / "drawn.geojson"
    feature = {"type": "Feature", "properties": properties, "geometry": {"type": kind, "coordinates": coordinates}}
    file.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    return file


SQUARE = [[[22.93, 39.36], [22.94, 39.36], [22.94, 39.37], [22.93, 39.37], [22.93, 39.36]]]


def test_path_of_geojson_gets_the_altitude_of_the_option(run: Run, api: FakeApi, tmp_path: Path) -> None:
    line = geojson(tmp_path, "LineString", [[22.93, 39.36], [22.94, 39.37, 0]])
    assert run("order", "survey", "--path", str(line), "--altitude", "20", *WINDOW, "-n", "team")[0] == 0
    waypoints = api.plans["survey-x7k2p"]["spec"]["waypoints"]
    assert waypoints == [{"lat": 39.36, "lon": 22.93, "alt": 20}, {"lat": 39.37, "lon": 22.94, "alt": 20}]


def test_path_of_qgroundcontrol_keeps_altitudes_and_reports_what_is_ignored(
    run: Run, api: FakeApi, tmp_path: Path
) -> None:
    file = tmp_path / "survey.plan"
    item = {"type": "SimpleItem", "command": 16, "frame": 0, "params": [5, 0, 0, None, 39.36, 22.93, 140]}
    file.write_text(json.dumps({"fileType": "Plan", "mission": {"items": [item]}}))
    _, output = run("order", "survey", "--path", str(file), *WINDOW, "-n", "team")
    assert "speeds, headings and stays are ignored" in output
    (waypoint,) = api.plans["survey-x7k2p"]["spec"]["waypoints"]
    assert waypoint == {"lat": 39.36, "lon": 22.93, "alt": 140, "altitudeReference": "amsl"}


def test_region_is_read_from_file_or_circle(run: Run, api: FakeApi, tmp_path: Path) -> None:
    area = geojson(tmp_path, "Polygon", SQUARE)
    assert run("order", "watch", "--region", str(area), "--stay", "5", *WINDOW, "-n", "team")[0] == 0
    region = api.plans["watch-x7k2p"]["spec"]["region"]
    assert len(region["polygon"]["exterior"]) == 4
    assert run("order", "circle", "--circle", "39.36,22.93,100", "--stay", "5", *WINDOW, "-n", "team")[0] == 0
    region = api.plans["circle-x7k2p"]["spec"]["region"]
    assert region == {"circle": {"center": {"lat": 39.36, "lon": 22.93}, "radius": 100}}


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (WINDOW, "specify the place of the flight by one of --waypoint, --path, --region and --circle"),
        ((*PLACE, "--circle", "39,22,9", *WINDOW), "by one of --waypoint, --path, --region and --circle"),
        (("--waypoint", "39.36", *WINDOW), "'--waypoint': '39.36' is not LAT,LON,ALT, such as 39.36,22.93,25"),
        (("--waypoint", "39.36,nan,5", *WINDOW), "'--waypoint': '39.36,nan,5' is not LAT,LON,ALT"),
        (("--waypoint", "39.36,22.93", *WINDOW), "--waypoint: waypoint 1 has no altitude; add --altitude METRES"),
        (("--waypoint", "99,22.93,5", *WINDOW), "waypoints[0].lat: must be less than or equal to 90"),
        (("--circle", "39,22,9", *WINDOW), "--stay: a region needs stay"),
        ((*PLACE, "--start", "tomorrow", "--duration", "15"), "--start: must be a time with its zone"),
        ((*PLACE, "--start", "now", "--duration", "0"), "--duration: must be greater than 0"),
        ((*PLACE, *WINDOW, "--action", "school"), "'school' is not POLICY=ACTION"),
        ((*PLACE, *WINDOW, "--action", "school=jump"), "--action[0].action: must be"),
        ((*PLACE, *WINDOW, "--action", "a=hover", "--action", "a=land"), "at most one entry for each policy"),
        ((*PLACE, *WINDOW, "--contact-lost", "abort@here"), "'here' is not LAT,LON of the landing place"),
        ((*PLACE, *WINDOW, "--parameter", "speed"), "'speed' is not NAME=VALUE"),
        ((*PLACE, *WINDOW, "--parameter", "a=1", "--parameter", "a=2"), "a is specified twice; remove one of them"),
        ((*PLACE, *WINDOW, "--name", "Morning"), "--name: "),
        ((*PLACE, *WINDOW, "--drone", "Drone 1"), "--drone: "),
    ],
)
def test_wrong_option_is_refused_with_its_name(
    run: Run, api: FakeApi, arguments: tuple[str, ...], sentence: str
) -> None:
    code, output = run("order", "survey", *arguments, "-n", "team")
    assert code == 1
    assert sentence in output
    assert output.count("\n") == 1
    assert not api.plans


@pytest.mark.parametrize(
    ("option", "kind", "coordinates", "sentence"),
    [
        ("--path", "Polygon", SQUARE, "the file has 0 LineStrings; draw the path as one LineString"),
        ("--path", "LineString", [[22.9, 39.3, 12], [22.9, 39.4]], "remove the heights and add --altitude"),
        ("--path", "LineString", [[22.9, 139.3]], "is not a place on Earth; the order is lon, lat"),
        ("--path", "LineString", [], "coordinates: must be a list of positions"),
        ("--region", "LineString", [[22.9, 39.3], [22.9, 39.4]], "the file has 0 areas; keep exactly one"),
        ("--region", "MultiPolygon", [SQUARE, SQUARE[:1]], "areas; keep exactly one polygon or circle"),
    ],
)
def test_unsuitable_file_is_refused_with_its_name(
    run: Run, api: FakeApi, tmp_path: Path, option: str, kind: str, coordinates: Any, sentence: str
) -> None:
    if kind == "MultiPolygon":
        coordinates = [SQUARE, [[[lon + 0.1, lat] for lon, lat in SQUARE[0]]]]
    file = geojson(tmp_path, kind, coordinates)
    code, output = run("order", "survey", option, str(file), "--altitude", "9", *WINDOW, "-n", "team")
    assert code == 1
    assert f"{option} {file}: " in output
    assert sentence in output


def test_region_with_altitude_is_refused(run: Run, api: FakeApi, tmp_path: Path) -> None:
    file = geojson(tmp_path, "Polygon", SQUARE, altitude={"upper": 50})
    code, output = run("order", "survey", "--region", str(file), "--stay", "5", *WINDOW)
    assert code == 1
    assert "the template limits the altitude" in output


# -- order: decision --


def test_taken_name_is_refused_with_a_remedy(run: Run, api: FakeApi) -> None:
    run("order", "survey", *PLACE, *WINDOW, "-n", "team", "--name", "morning")
    code, output = run("order", "survey", *PLACE, *WINDOW, "-n", "team", "--name", "morning")
    assert code == 1
    assert "specify another --name" in output


def test_rejection_exits_with_2_and_names_reasons_and_drones(run: Run, api: FakeApi) -> None:
    api.decision = {
        "state": "Rejected",
        "message": "no drone fits",
        "refusals": [{"reason": "NoDrone", "message": "no drone fits"}],
        "rejected": [
            {"component": "Navigator", "node": "drone-2", "reason": "Reserved", "message": "needed by team/other"}
        ],
    }
    code, output = run("order", "survey", *PLACE, *WINDOW, "-n", "team")
    assert code == 2
    assert "Refused:\n  NoDrone: no drone fits" in output
    assert "drone-2: Reserved: needed by team/other" in output


def test_missing_decision_is_reported(run: Run, api: FakeApi, monkeypatch: pytest.MonkeyPatch) -> None:
    api.decision = {"observedGeneration": 0}
    monkeypatch.setattr(flights, "DECISION_TIMEOUT_S", 0.0)
    code, output = run("order", "survey", *PLACE, *WINDOW, "-n", "team", "--name", "morning")
    assert code == 1
    assert "no decision on FlightPlan team/morning after 0 s; check the operator with `fractus doctor`" in output


UNDECIDED: Body = {
    "state": "Draft",
    "message": "select an action",
    "restrictions": [
        {"policy": "school", "choices": ["hover", "abort"]},
        {"policy": "town", "choices": ["land", "hover"], "chosen": "land"},
        {"policy": "speed", "choices": [], "chosen": "enforce"},
    ],
    "conditions": [condition("ActionNeeded", "True", "ChoicesMissing", "select an action")],
}


def test_choices_to_make_exit_with_2_and_are_listed(run: Run, api: FakeApi) -> None:
    api.decision = UNDECIDED
    code, output = run("order", "survey", *PLACE, *WINDOW, "-n", "team")
    assert code == 2
    assert "school: not selected; choose one of: hover, abort" in output
    assert "town: land, selected among: land, hover" in output
    assert "speed: enforce\n" in output
    assert "Next: fractus flights choose survey-x7k2p -n team POLICY=ACTION" in output


# -- commands on a plan --


def ordered(run: Run) -> None:
    run("order", "survey", *PLACE, *WINDOW, "-n", "team", "--name", "morning", "--action", "town=hover")


def test_choose_adds_actions_and_keeps_earlier_ones(run: Run, api: FakeApi) -> None:
    api.decision = UNDECIDED
    ordered(run)
    api.decision = {"state": "Accepted"}
    assert run("choose", "morning", "school=abort@39.3,22.9", "-n", "team")[0] == 0
    place = {"lat": 39.3, "lon": 22.9}
    assert api.plans["morning"]["spec"]["policyActions"] == [
        {"policy": "town", "action": "hover"},
        {"policy": "school", "action": "abort", "landAt": place},
    ]


@pytest.mark.parametrize(
    ("choice", "sentence"),
    [
        ("wood=hover", "policy wood has no choices for this flight; choose for: school, town"),
        ("speed=refuse", "policy speed has no choices for this flight"),
        ("school=land", "policy school has no action land; choose one of: hover, abort"),
    ],
)
def test_choice_that_does_not_exist_is_refused(run: Run, api: FakeApi, choice: str, sentence: str) -> None:
    api.decision = UNDECIDED
    ordered(run)
    code, output = run("choose", "morning", choice, "-n", "team")
    assert code == 1
    assert sentence in output


def test_start_and_end_change_the_use_of_the_plan(run: Run, api: FakeApi) -> None:
    ordered(run)
    assert run("start", "morning", "-n", "team")[0] == 0
    assert api.plans["morning"]["spec"]["use"] == "InUse"
    assert run("end", "morning", "-n", "team")[0] == 0
    assert api.plans["morning"]["spec"]["use"] == "Closed"
    code, output = run("start", "morning", "-n", "team")
    assert code == 1
    assert "cannot start; order another flight" in output


def test_start_of_a_plan_that_needs_actions_is_refused(run: Run, api: FakeApi) -> None:
    api.decision = UNDECIDED
    ordered(run)
    code, output = run("start", "morning", "-n", "team")
    assert code == 1
    assert "select them with `fractus flights choose`" in output


def test_start_that_is_not_possible_exits_with_2(run: Run, api: FakeApi) -> None:
    ordered(run)
    failed = condition("Startable", "False", "NoDrone", "drone-1 is not ready") | {"observedGeneration": 2}
    # The operator does not report the generation while the flight cannot start.
    api.decision = {"state": "Accepted", "observedGeneration": 1, "conditions": [failed]}
    code, output = run("start", "morning", "-n", "team")
    assert code == 2
    assert "Startable=False NoDrone: drone-1 is not ready" in output


def test_unknown_plan_is_reported_with_the_closest_name(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    show(monkeypatch, flights, {PLANS: [{"metadata": {"name": "morning"}}]})
    code, output = run("show", "mornign", "-n", "team")
    assert code == 1
    assert "FlightPlan team/mornign not found; did you mean morning?" in output


FLYING: Body = {
    "metadata": {"name": "morning", "namespace": "team", "uid": "u-1"},
    "spec": {"template": "survey", "window": {"start": "2026-12-01T10:00:00Z", "duration": 15}},
    "status": {
        "state": "Nonconforming",
        "message": "drone-1 is outside the volumes of the plan",
        "drone": "drone-1",
        "application": "flight-u-1",
        "restrictions": [{"policy": "town", "chosen": "enforce"}],
        "volumes": [
            {
                "areas": [
                    {"polygon": {"exterior": [{"lat": 1, "lon": 2}, {"lat": 3, "lon": 4}, {"lat": 2, "lon": 5}]}}
                ],
                "upper": 120.4,
                "begin": "2026-12-01T10:00:00Z",
                "end": "2026-12-01T10:15:00Z",
            }
        ],
        "offNominalVolumes": [
            {
                "areas": [{"circle": {"center": {"lat": 1, "lon": 2}, "radius": 1000}}],
                "lower": 10,
                "begin": "2026-12-01T10:10:00Z",
                "end": "2026-12-01T10:25:00Z",
            }
        ],
        "advisories": [{"reason": "OverlapsEqualPriority", "message": "overlaps team/other", "plan": "team/other"}],
        "conditions": [condition("ConflictArose", "True", "OverlapsEqualPriority", "overlaps team/other")],
    },
}


def test_show_prints_drone_volumes_advisories_and_conditions(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    show(monkeypatch, flights, {f"{PLANS}/morning": FLYING})
    code, output = run("show", "morning", "-n", "team")
    assert code == 0
    for sentence in (
        "team/morning: Nonconforming: drone-1 is outside the volumes of the plan",
        "Window: 2026-12-01T10:00:00Z, 15 minutes",
        "Application: flight-u-1",
        "  2026-12-01T10:00:00Z to 2026-12-01T10:15:00Z, from the ground to 120 m above mean sea level: polygon with 3"
        " corners, the northernmost at 3.000000, 4.000000",
        "from 10 m to no upper bound: circle of 1000 m around 1.000000, 2.000000",
        "Advisories:\n  OverlapsEqualPriority: overlaps team/other",
        "ConflictArose=True OverlapsEqualPriority: overlaps team/other",
    ):
        assert sentence in output
    parsed = json.loads(run("show", "morning", "-n", "team", "-o", "json")[1])
    assert parsed == {"namespace": "team", "name": "morning", "spec": FLYING["spec"], "status": FLYING["status"]}


def test_list_is_sorted_by_start_and_selects_by_drone_and_policy(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    window = {"start": "2026-11-30T10:00:00Z", "duration": 5}
    earlier = {"metadata": {"name": "early", "namespace": "team"}, "spec": {"template": "watch", "window": window}}
    show(monkeypatch, flights, {f"{V1}/flightplans": [FLYING, earlier]})
    _, output = run("list")
    assert [line.split()[0] for line in output.splitlines()] == ["PLAN", "team/early", "team/morning"]
    for option in (("--drone", "drone-1"), ("--policy", "town")):
        assert "team/early" not in run("list", *option)[1]
        assert "team/morning" in run("list", *option)[1]
    assert "team/morning" not in run("list", "--drone", "drone-2")[1]


# -- watch --


def history(monkeypatch: pytest.MonkeyPatch, *versions: Any, outcome: str = "Complete") -> None:
    """Let `watch` read these versions of a plan one after another. An exception is a failed request."""
    left = list(versions)
    spec = {"application": "flight-u-1", "flown": {"outcome": outcome}}

    class Cluster:
        def get(self, path: str) -> Body | None:
            version = left.pop(0) if path.startswith(PLANS) else None
            if isinstance(version, Exception):
                raise version
            return version

        def list(self, path: str) -> list[Body]:
            if path == PLANS:
                return []
            return [{"spec": spec}]

    @contextmanager
    def open_client(_: str | None) -> Iterator[Cluster]:
        yield Cluster()

    monkeypatch.setattr(flights, "open_client", open_client)
    monkeypatch.setattr(flights.time, "sleep", lambda _: None)


def version(state: str, message: str) -> Body:
    return {**FLYING, "status": {"state": state, "message": message}}


@pytest.mark.parametrize(
    ("state", "outcome", "code"), [("Ended", "Complete", 0), ("Ended", "Failed", 2), ("Rejected", "Complete", 2)]
)
def test_watch_prints_each_change_and_returns_the_outcome(
    run: Run, monkeypatch: pytest.MonkeyPatch, state: str, outcome: str, code: int
) -> None:
    flying = version("Activated", "drone-1 is in the air")
    lost = KubeError(0, "Unreachable", "connection refused")
    history(monkeypatch, flying, flying, lost, lost, flying, version(state, "over"), outcome=outcome)
    result, output = run("watch", "morning", "-n", "team")
    assert result == code
    assert output.count("team/morning: Activated: drone-1 is in the air") == 1
    assert output.count("connection refused; the connection is tried again") == 1
    assert f"team/morning: {state}: over" in output


def test_watch_of_a_deleted_plan_fails(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    history(monkeypatch, version("Accepted", "drone-1 is reserved"), None)
    code, output = run("watch", "morning", "-n", "team")
    assert code == 1
    assert "FlightPlan team/morning was deleted" in output
