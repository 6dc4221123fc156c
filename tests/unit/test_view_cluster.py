"""Live view of a cluster: events derived from its objects, and loss of the connection to its API server."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator
from contextlib import aclosing
from typing import Any

import pytest
from click.testing import CliRunner
from fractus_core import api
from fractus_runtime.kubernetes import Body, Kind, KubeError, Page
from fractus_runtime.metrics import metrics_text
from fractus_view import cluster as cluster_module
from fractus_view import command, objects
from fractus_view.cluster import KINDS, ClusterSource
from fractus_view.server import ViewServer
from scraping import assert_documented, values

NOW_MS = 1_780_000_000_000


def resource(kind: str, name: str, spec: Body, status: Body | None = None, namespace: str = "") -> Body:
    metadata = {"name": name, "resourceVersion": "1"} | ({"namespace": namespace} if namespace else {})
    body: Body = {"apiVersion": api.API_VERSION, "kind": kind, "metadata": metadata, "spec": spec}
    return body | ({"status": status} if status is not None else {})


def ready(status: str, reason: str = "Because", message: str = "") -> Body:
    when = "2026-05-28T20:26:40Z"
    return {"type": "Ready", "status": status, "reason": reason, "message": message, "lastTransitionTime": when}


DRONE = resource(
    "Drone", "drone-1", {},
    {
        "flightState": "flying", "position": {"lat": 39.36, "lon": 22.93, "alt": 12.5}, "battery": {"remaining": 0.5},
        "controller": "spiffe://fractus.dev/ns/d/app/traffic/component/Navigator/instance/n", "lastSeen": "2026-05-28T20:26:39Z",
    },
)  # fmt: skip
EDGE = resource("EdgeNode", "edge-1", {"location": {"lat": 39.361, "lon": 22.931}}, {"conditions": [ready("True")]})
DEPOT = resource("Depot", "base", {"location": {"lat": 39.36, "lon": 22.93}, "radius": 30})
ZONE = resource(
    "Zone", "school",
    {"area": {"circle": {"center": {"lat": 39.36, "lon": 22.932}, "radius": 50}}, "altitude": {"lower": 0, "upper": 30}},
)  # fmt: skip
POLICY = resource(
    "Policy", "town-altitude",
    {"type": "LimitControl", "kind": "altitude", "upperLimit": 50, "lowerLimit": 5, "selector": {"zones": ["town"]}},
)  # fmt: skip
NAVIGATOR = {
    "name": "Navigator", "placement": "drone", "class": "driver",
    "container": {"image": "registry.test/navigator:1"},
    "services": [{"service": "mobility", "methods": ["Arm", "Takeoff", "Goto", "Land"]}],
    "controlPoints": [{"navigation": "pathBased", "path": [{"lat": 39.36, "lon": 22.93, "alt": 10}, {"lat": 39.361, "lon": 22.931, "alt": 20}]}],
}  # fmt: skip
APPLICATION = resource(
    "Application", "traffic", {"components": [NAVIGATOR]},
    {"phase": "Flying", "drone": "drone-1", "message": "drone-1 flies", "conditions": [ready("True", "Deployed")]}, "demo",
)  # fmt: skip
AREA = {
    "type": "MultiPolygon",
    "coordinates": [[[[22.93, 39.36], [22.94, 39.36], [22.94, 39.37], [22.93, 39.36]]]],
}
PLAN = resource(
    "DeploymentPlan", "traffic",
    {
        "application": "traffic", "operationArea": AREA,
        "drone": {"node": "drone-1", "transit": [{"start": {"lat": 39.36, "lon": 22.93}, "end": {"lat": 39.362, "lon": 22.93}}]},
    },
    None, "demo",
)  # fmt: skip
LINK = resource(
    "DirectLink", "traffic-edge-1",
    {
        "drone": "drone-1", "node": "edge-1", "application": {"namespace": "demo", "name": "traffic", "uid": "u"},
        "technology": "WiFi", "pairing": {"networkId": "edge-1"}, "range": 80, "bandwidth": 12,
        "position": {"lat": 39.361, "lon": 22.931}, "heuristic": {"kind": "preferDirect"},
    },
    {"phase": "Up", "traffic": "direct", "reason": "Preferred", "message": "the link is up"},
)  # fmt: skip
ALL = (DRONE, EDGE, DEPOT, ZONE, POLICY, APPLICATION, PLAN, LINK)


class ApiServer:
    """Fake `fractus_runtime.kubernetes.Client` that lists bodies, reports changes and can become unreachable."""

    def __init__(self, *bodies: Body) -> None:
        self.bodies = list(bodies)
        self.refusal: KubeError | None = None
        self._events: dict[str, asyncio.Queue[tuple[str, Body] | None]] = {}

    async def request(self, method: str, path: str, **_: Any) -> Body:
        assert method == "GET"
        if self.refusal is not None:
            raise self.refusal
        return {}

    async def list_page(self, kind: Kind, **_: Any) -> Page:
        await self.request("GET", kind.path())
        items = [json.loads(json.dumps(body)) for body in self.bodies if body["kind"] == kind.name]
        return Page({"metadata": {"resourceVersion": "1"}, "items": items})

    async def watch(self, kind: Kind, *, opened: Any, **_: Any) -> AsyncIterator[tuple[str, Body]]:
        await self.request("GET", kind.path())
        opened()
        events = self._events[kind.name] = asyncio.Queue()
        while (event := await events.get()) is not None:
            yield event

    async def list_whole(self, kind: Kind, **_: Any) -> Page:
        return Page({"metadata": {}, "items": []})

    async def send_event(self, type_: str, body: Body) -> None:
        body = json.loads(json.dumps(body))
        body["metadata"]["resourceVersion"] = "2"
        self._events[body["kind"]].put_nowait((type_, body))

    def disconnect(self) -> None:
        self.refusal = KubeError(0, "Unreachable", "connection refused")
        for events in self._events.values():
            events.put_nowait(None)


class Clock:
    """Clock that a test sets."""

    now_ms = NOW_MS

    def __call__(self) -> int:
        return self.now_ms


@contextlib.asynccontextmanager
async def watched(server: ApiServer, clock: Clock, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[ClusterSource]:
    monkeypatch.setattr(cluster_module, "PROBE_INTERVAL_S", 0.01)
    monkeypatch.setattr(cluster_module, "PUBLISH_INTERVAL_S", 0.01)
    cluster = ClusterSource(server, "", clock)  # type: ignore[arg-type]
    task = asyncio.create_task(cluster.run())
    try:
        async with asyncio.timeout(20):
            yield cluster
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def until(cluster: ClusterSource, condition: Any) -> list[dict[str, Any]]:
    """Return all events up to the first batch that contains an event for which the condition is true."""
    events: list[dict[str, Any]] = []
    async with aclosing(cluster.stream("")) as stream:
        async for message in stream:
            events += json.loads(message.decode().split("\n")[1].removeprefix("data: "))
            if any(condition(event) for event in events):
                return events
    raise AssertionError


def last(events: list[dict[str, Any]], type_: str) -> dict[str, Any]:
    return [event for event in events if event["type"] == type_][-1]


async def test_view_metrics_equal_their_documentation(monkeypatch: pytest.MonkeyPatch) -> None:
    async with watched(ApiServer(*ALL), Clock(), monkeypatch) as cluster:
        await until(cluster, lambda event: event["type"] == "policies")
        text = metrics_text([*ViewServer(cluster, frozenset()).metrics(), *cluster.metrics()]).decode()
    assert_documented(text, "View")
    samples = values(text)
    assert all(samples["fractus_view_watch_open", kind.PLURAL] == 1 for kind in KINDS)
    assert all(0 <= samples["fractus_view_watch_age_seconds", kind.PLURAL] < 20 for kind in KINDS)
    assert samples["fractus_view_pages",] == 0


async def test_view_reports_drones_areas_applications_links_and_policies(monkeypatch: pytest.MonkeyPatch) -> None:
    async with watched(ApiServer(*ALL), Clock(), monkeypatch) as cluster:
        events = await until(cluster, lambda event: event["type"] == "policies")
    state = last(events, "state")
    fix = last(events, "fix")
    assert (state["drone"], state["phase"], state["controller"]) == ("drone-1", "in the air", "Navigator")
    assert (state["altitude_m"], state["battery"], state["seen_ms"]) == (12.5, 0.5, NOW_MS - 1_000)
    assert (fix["lat"], fix["lon"], fix["amsl_m"]) == (39.36, 22.93, None)
    features = [feature for event in events if event["type"] == "areas" for feature in event["features"]]
    assert {(f["properties"]["kind"], f["properties"]["name"]) for f in features} == {
        ("zone", "school"), ("depot", "base"), ("edgeNode", "edge-1"), ("operationArea", "demo/traffic"), ("path", "demo/traffic"),
        ("controlPoint", "demo/traffic"),
    }  # fmt: skip
    (point,) = [feature for feature in features if feature["properties"]["kind"] == "controlPoint"]
    assert (point["properties"]["number"], point["geometry"]["coordinates"]) == (0, [22.93, 39.36])
    (zone,) = [feature for feature in features if feature["properties"]["kind"] == "zone"]
    assert zone["properties"]["altitude"] == {"lower": 0, "upper": 30, "reference": "home"}
    assert {f["properties"]["component"] for f in features if f["properties"]["kind"] == "path"} == {
        "Navigator",
        "system",
    }
    assert last(events, "applications")["applications"] == [
        {"name": "demo/traffic", "drone": "drone-1", "phase": "Flying", "reason": "Deployed", "text": "drone-1 flies"}
    ]
    (link,) = last(events, "links")["links"]
    assert (link["drone"], link["node"], link["phase"], link["traffic"]) == ("drone-1", "edge-1", "Up", "direct")
    assert last(events, "policies")["policies"] == [
        {"name": "town-altitude", "text": "altitude at least 5 and at most 50 m above home, enforce", "zones": ["town"]}
    ]


async def test_view_reports_changed_and_deleted_objects(monkeypatch: pytest.MonkeyPatch) -> None:
    server = ApiServer(*ALL)
    async with watched(server, Clock(), monkeypatch) as cluster:
        await until(cluster, lambda event: event["type"] == "policies")
        await server.send_event("MODIFIED", APPLICATION | {"status": {"phase": "Completed"}})
        await server.send_event("DELETED", DRONE)
        events = await until(cluster, lambda event: event["type"] == "gone")
        assert last(events, "gone")["drone"] == "drone-1"
        completed = await until(
            cluster, lambda e: e["type"] == "applications" and e["applications"][0]["phase"] == "Completed"
        )
        plans = [event for event in completed if event["type"] == "areas" and event["origin"] == "plans"]
        assert plans[-1]["features"] == [], "a completed application has no planned route"
        new_page = await until(cluster, lambda event: event["type"] == "live")
    assert not [event for event in new_page if event["type"] in {"state", "fix"}], (
        "a new page receives no event of the deleted drone"
    )


async def test_drone_of_a_finished_mission_is_shown_as_returning(monkeypatch: pytest.MonkeyPatch) -> None:
    server = ApiServer(*ALL)
    clock = Clock()
    async with watched(server, clock, monkeypatch) as cluster:
        await until(cluster, lambda event: event["type"] == "policies")
        clock.now_ms += 5_000
        await server.send_event("MODIFIED", APPLICATION | {"status": {"phase": "Returning", "drone": "drone-1"}})
        events = await until(cluster, lambda event: event["type"] == "state" and event["phase"] == "returning")
        assert last(events, "state")["flight_ms"] == NOW_MS, "the flight starts at the first report from the air"
        await server.send_event("MODIFIED", DRONE | {"status": DRONE["status"] | {"flightState": "inactive"}})
        events = await until(cluster, lambda event: event["type"] == "state" and event["phase"] == "on the ground")
        clock.now_ms += 5_000
        await server.send_event("MODIFIED", DRONE)
        events = await until(cluster, lambda e: e["type"] == "state" and e["flight_ms"] != NOW_MS)
        assert last(events, "state")["flight_ms"] == NOW_MS + 10_000


async def test_lost_api_server_is_reported_with_time_and_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    server = ApiServer(*ALL)
    clock = Clock()
    async with watched(server, clock, monkeypatch) as cluster:
        await until(cluster, lambda event: event["type"] == "contact" and event["stale_since_ms"] is None)
        server.disconnect()
        clock.now_ms += 1_500
        await asyncio.sleep(0.1)
        contact = last(await until(cluster, lambda event: event["type"] == "live"), "contact")
        assert contact["time_ms"] == NOW_MS, "a short interruption of a watch is normal"
        clock.now_ms += 1_500
        stale = await until(cluster, lambda event: event["type"] == "contact" and event["stale_since_ms"] is not None)
        assert last(stale, "contact")["stale_since_ms"] == NOW_MS
        assert last(stale, "contact")["text"] == "connection refused"
        server.refusal = None
        recovered = await until(
            cluster, lambda e: e["type"] == "contact" and e["time_ms"] > NOW_MS and e["stale_since_ms"] is None
        )
        assert last(recovered, "contact")["text"] == ""


async def test_view_is_stale_while_one_kind_is_not_watched(monkeypatch: pytest.MonkeyPatch) -> None:
    class WithoutZoneWatch(ApiServer):
        async def watch(self, kind: Kind, **options: Any) -> AsyncIterator[tuple[str, Body]]:
            if kind.name == "Zone":
                raise KubeError(500, "InternalError", "no watch")
            async for event in super().watch(kind, **options):
                yield event

    clock = Clock()
    async with watched(WithoutZoneWatch(*ALL), clock, monkeypatch) as cluster:
        clock.now_ms += 5_000
        events = await until(cluster, lambda event: event["type"] == "contact")
    assert (last(events, "contact")["stale_since_ms"], last(events, "contact")["text"]) == (
        NOW_MS,
        "zones are not watched yet",
    )


async def test_invalid_object_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    invalid = resource("Zone", "odd", {"area": {"square": 1}})
    async with watched(ApiServer(*ALL, invalid), Clock(), monkeypatch) as cluster:
        events = await until(cluster, lambda event: event["type"] == "problem")
    assert "invalid Zone, not shown" in last(events, "problem")["text"]


def test_silent_drone_is_not_shown_as_flying() -> None:
    silent = {"flightState": "unknown", "lastFlightState": "flying", "position": {"lat": 1, "lon": 2, "alt": 3}}
    shown = objects.state(api.Drone.from_body(resource("Drone", "a", {}, silent)), NOW_MS)
    assert shown.phase == "not reporting, last in the air"
    new = api.Drone.from_body(resource("Drone", "a", {}))
    assert (objects.state(new, NOW_MS).phase, objects.fix(new, NOW_MS)) == ("not reporting", None)


def test_every_flight_state_has_a_phase_text() -> None:
    from typing import get_args

    from fractus_core.api.nodes import FlightState

    assert {*objects._PHASES, "unknown"} == set(get_args(FlightState))


@pytest.mark.parametrize(
    ("spec", "text"),
    [
        ({"type": "AccessControl", "kind": "denial", "methods": ["CaptureImage"]}, "denial of CaptureImage"),
        ({"type": "LimitControl", "kind": "speed", "upperLimit": 7.5, "action": "refuse"}, "speed at most 7.5 m/s, refuse"),
        ({"type": "GeofenceControl", "kind": "exclusion", "selector": {"zones": ["a"]}}, "exclusion, ignore"),
        ({"type": "PrivacyControl", "kind": "camera", "action": "blurFaces"}, "pictures: blurFaces"),
    ],
)  # fmt: skip
def test_policy_is_described_in_a_phrase(spec: Body, text: str) -> None:
    assert objects.policy(api.Policy.from_body(resource("Policy", "p", spec))).text == text
    broken = resource("Policy", "p", spec, {"conditions": [ready("False", "NoZone", "zone a is missing")]})
    assert objects.policy(api.Policy.from_body(broken)).text == f"not in force: zone a is missing ({text})"


def policy_on_school(name: str, spec: Body) -> api.Policy:
    return api.Policy.from_body(resource("Policy", name, spec | {"selector": {"zones": ["school"]}}))


def test_zone_has_the_effects_of_all_policies_that_select_it() -> None:
    speed = policy_on_school("slow", {"type": "LimitControl", "kind": "speed", "upperLimit": 3})
    fence = policy_on_school("closed", {"type": "GeofenceControl", "kind": "exclusion"})
    zone = api.Zone.from_body(ZONE)
    (unused,) = objects.zones([zone], [api.Policy.from_body(POLICY)])
    (used,) = objects.zones([zone], [speed, fence])
    assert unused["properties"]["uses"] == []
    assert used["properties"]["uses"] == ["exclusion", "speedLimit"]


def test_control_point_at_a_missing_depot_is_omitted() -> None:
    spec = json.loads(json.dumps(APPLICATION["spec"]))
    spec["components"][0]["controlPoints"][0]["point"] = {"depot": "base"}
    application = api.Application.from_body(APPLICATION | {"spec": spec})
    plans = {application.key: api.DeploymentPlan.from_body(PLAN)}

    def points(depots: dict[str, api.Depot]) -> list[object]:
        features = objects.planned_flights([application], plans, depots)
        return [f["geometry"]["coordinates"] for f in features if f["properties"]["kind"] == "controlPoint"]

    assert points({}) == []
    assert points({"base": api.Depot.from_body(DEPOT)}) == [[22.93, 39.36]]


def test_view_reads_no_kinds_with_secrets() -> None:
    assert {kind.KIND for kind in KINDS} == {
        "Drone", "EdgeNode", "Depot", "Zone", "Policy", "Application", "DeploymentPlan", "DirectLink",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("refusal", "message"),
    [
        (KubeError(0, "Unreachable", "no route"), "no route; check the cluster and --context"),
        (KubeError(404, "NotFound", "not found"), "install the chart fractus-crds"),
        (KubeError(403, "Forbidden", "forbidden"), "the role view is sufficient"),
    ],
)
def test_unreadable_cluster_is_reported_at_start(
    refusal: KubeError, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Refusing(ApiServer):
        async def aclose(self) -> None:
            pass

    server = Refusing()
    server.refusal = refusal

    async def access(_: str | None) -> None:
        return None

    monkeypatch.setattr(command, "Client", lambda *_: server)
    monkeypatch.setattr(command, "from_environment", access)
    result = CliRunner().invoke(command.view, [])
    assert result.exit_code == 1
    assert message in result.output
