"""What the live view tells of a cluster, and that it tells when it does not hear of it any more."""

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
from fractus_view.cluster import KINDS, Cluster
from fractus_view.server import View
from scraping import assert_documented, values

NOW_MS = 1_780_000_000_000


def ours(kind: str, name: str, spec: Body, status: Body | None = None, namespace: str = "") -> Body:
    metadata = {"name": name, "resourceVersion": "1"} | ({"namespace": namespace} if namespace else {})
    body: Body = {"apiVersion": api.API_VERSION, "kind": kind, "metadata": metadata, "spec": spec}
    return body | ({"status": status} if status is not None else {})


def ready(status: str, reason: str = "Because", message: str = "") -> Body:
    when = "2026-05-28T20:26:40Z"
    return {"type": "Ready", "status": status, "reason": reason, "message": message, "lastTransitionTime": when}


DRONE = ours(
    "Drone", "drone-1", {},
    {
        "flightState": "flying", "position": {"lat": 39.36, "lon": 22.93, "alt": 12.5}, "battery": {"remaining": 0.5},
        "controller": "spiffe://fractus.dev/ns/d/app/traffic/component/Navigator/instance/n", "lastSeen": "2026-05-28T20:26:39Z",
    },
)  # fmt: skip
EDGE = ours("EdgeNode", "edge-1", {"location": {"lat": 39.361, "lon": 22.931}}, {"conditions": [ready("True")]})
DEPOT = ours("Depot", "base", {"location": {"lat": 39.36, "lon": 22.93}, "radius": 30})
ZONE = ours(
    "Zone", "school",
    {"area": {"circle": {"center": {"lat": 39.36, "lon": 22.932}, "radius": 50}}, "altitude": {"lower": 0, "upper": 30}},
)  # fmt: skip
POLICY = ours(
    "Policy", "town-altitude",
    {"type": "LimitControl", "kind": "altitude", "upperLimit": 50, "lowerLimit": 5, "selector": {"zones": ["town"]}},
)  # fmt: skip
NAVIGATOR = {
    "name": "Navigator", "placement": "drone", "class": "driver",
    "container": {"image": "registry.test/navigator:1"},
    "services": [{"service": "mobility", "methods": ["Arm", "Takeoff", "Goto", "Land"]}],
    "controlPoints": [{"navigation": "pathBased", "path": [{"lat": 39.36, "lon": 22.93, "alt": 10}, {"lat": 39.361, "lon": 22.931, "alt": 20}]}],
}  # fmt: skip
APPLICATION = ours(
    "Application", "traffic", {"components": [NAVIGATOR]},
    {"phase": "Flying", "drone": "drone-1", "message": "drone-1 flies", "conditions": [ready("True", "Deployed")]}, "demo",
)  # fmt: skip
AREA = {
    "type": "MultiPolygon",
    "coordinates": [[[[22.93, 39.36], [22.94, 39.36], [22.94, 39.37], [22.93, 39.36]]]],
}
PLAN = ours(
    "DeploymentPlan", "traffic",
    {
        "application": "traffic", "operationArea": AREA,
        "drone": {"node": "drone-1", "transit": [{"start": {"lat": 39.36, "lon": 22.93}, "end": {"lat": 39.362, "lon": 22.93}}]},
    },
    None, "demo",
)  # fmt: skip
LINK = ours(
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
    """Stands for `fractus_runtime.kubernetes.Client`: lists what it holds, tells of changes, and is out of reach when told so."""

    def __init__(self, *bodies: Body) -> None:
        self.bodies = list(bodies)
        self.refusal: KubeError | None = None
        self._news: dict[str, asyncio.Queue[tuple[str, Body] | None]] = {}

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
        news = self._news[kind.name] = asyncio.Queue()
        while (found := await news.get()) is not None:
            yield found

    async def tell(self, type_: str, body: Body) -> None:
        body = json.loads(json.dumps(body))
        body["metadata"]["resourceVersion"] = "2"
        self._news[body["kind"]].put_nowait((type_, body))

    def cut(self) -> None:
        self.refusal = KubeError(0, "Unreachable", "connection refused")
        for news in self._news.values():
            news.put_nowait(None)


class Clock:
    """One second passes between two looks at the contact."""

    now_ms = NOW_MS

    def __call__(self) -> int:
        return self.now_ms


@contextlib.asynccontextmanager
async def watched(server: ApiServer, clock: Clock, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Cluster]:
    monkeypatch.setattr(cluster_module, "CONTACT_S", 0.01)
    monkeypatch.setattr(cluster_module, "GATHER_S", 0.01)
    cluster = Cluster(server, "", clock)  # type: ignore[arg-type]
    task = asyncio.create_task(cluster.run())
    try:
        async with asyncio.timeout(20):
            yield cluster
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def until(cluster: Cluster, wanted: Any) -> list[dict[str, Any]]:
    """The events from one that is wanted on are of no interest: those up to it."""
    found: list[dict[str, Any]] = []
    async with aclosing(cluster.stream("")) as stream:
        async for message in stream:
            found += json.loads(message.decode().split("\n")[1].removeprefix("data: "))
            if any(wanted(event) for event in found):
                return found
    raise AssertionError


def last(events: list[dict[str, Any]], type_: str) -> dict[str, Any]:
    return [event for event in events if event["type"] == type_][-1]


async def test_the_view_tells_prometheus_what_is_documented(monkeypatch: pytest.MonkeyPatch) -> None:
    async with watched(ApiServer(*ALL), Clock(), monkeypatch) as cluster:
        await until(cluster, lambda event: event["type"] == "policies")
        text = metrics_text([*View(cluster, frozenset()).metrics(), *cluster.metrics()]).decode()
    assert_documented(text, "View")
    seen = values(text)
    assert all(seen["fractus_view_watch_open", kind.PLURAL] == 1 for kind in KINDS)
    assert all(0 <= seen["fractus_view_watch_age_seconds", kind.PLURAL] < 20 for kind in KINDS)
    assert seen["fractus_view_pages",] == 0


async def test_all_that_a_cluster_knows_of_flights_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
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
    }  # fmt: skip
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


async def test_what_changes_is_told_and_what_is_deleted_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    server = ApiServer(*ALL)
    async with watched(server, Clock(), monkeypatch) as cluster:
        await until(cluster, lambda event: event["type"] == "policies")
        await server.tell("MODIFIED", APPLICATION | {"status": {"phase": "Completed"}})
        await server.tell("DELETED", DRONE)
        events = await until(cluster, lambda event: event["type"] == "gone")
        assert last(events, "gone")["drone"] == "drone-1"
        over = await until(
            cluster, lambda e: e["type"] == "applications" and e["applications"][0]["phase"] == "Completed"
        )
        plans = [event for event in over if event["type"] == "areas" and event["origin"] == "plans"]
        assert plans[-1]["features"] == [], "what is over means to fly nowhere"
        new = await until(cluster, lambda event: event["type"] == "live")
    assert not [event for event in new if event["type"] in {"state", "fix"}], "a new page hears of no drone"


async def test_a_lost_api_server_is_told_with_since_when_and_why(monkeypatch: pytest.MonkeyPatch) -> None:
    server = ApiServer(*ALL)
    clock = Clock()
    async with watched(server, clock, monkeypatch) as cluster:
        await until(cluster, lambda event: event["type"] == "contact" and event["stale_since_ms"] is None)
        server.cut()
        clock.now_ms += 1_500
        await asyncio.sleep(0.1)
        quiet = last(await until(cluster, lambda event: event["type"] == "live"), "contact")
        assert quiet["time_ms"] == NOW_MS, "watches end and begin again all the time"
        clock.now_ms += 1_500
        stale = await until(cluster, lambda event: event["type"] == "contact" and event["stale_since_ms"] is not None)
        assert last(stale, "contact")["stale_since_ms"] == NOW_MS
        assert last(stale, "contact")["text"] == "connection refused"
        server.refusal = None
        back = await until(
            cluster, lambda e: e["type"] == "contact" and e["time_ms"] > NOW_MS and e["stale_since_ms"] is None
        )
        assert last(back, "contact")["text"] == ""


async def test_it_is_not_current_while_one_kind_is_not_watched(monkeypatch: pytest.MonkeyPatch) -> None:
    class Blind(ApiServer):
        async def watch(self, kind: Kind, **how: Any) -> AsyncIterator[tuple[str, Body]]:
            if kind.name == "Zone":
                raise KubeError(500, "InternalError", "no watch")
            async for found in super().watch(kind, **how):
                yield found

    clock = Clock()
    async with watched(Blind(*ALL), clock, monkeypatch) as cluster:
        clock.now_ms += 5_000
        events = await until(cluster, lambda event: event["type"] == "contact")
    assert (last(events, "contact")["stale_since_ms"], last(events, "contact")["text"]) == (
        NOW_MS,
        "zones are not watched yet",
    )


async def test_an_object_that_cannot_be_read_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    odd = ours("Zone", "odd", {"area": {"square": 1}})
    async with watched(ApiServer(*ALL, odd), Clock(), monkeypatch) as cluster:
        events = await until(cluster, lambda event: event["type"] == "problem")
    assert "a Zone cannot be read" in last(events, "problem")["text"]


def test_a_drone_that_is_not_heard_of_does_not_fly_for_all_that_is_shown() -> None:
    silent = {"flightState": "unknown", "lastFlightState": "flying", "position": {"lat": 1, "lon": 2, "alt": 3}}
    shown = objects.state(api.Drone.from_body(ours("Drone", "a", {}, silent)), NOW_MS)
    assert shown.phase == "not heard of, last in the air"
    new = api.Drone.from_body(ours("Drone", "a", {}))
    assert (objects.state(new, NOW_MS).phase, objects.fix(new, NOW_MS)) == ("not heard of", None)


def test_every_flight_state_has_words() -> None:
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
def test_policies_are_said_in_a_phrase(spec: Body, text: str) -> None:
    assert objects.policy(api.Policy.from_body(ours("Policy", "p", spec))).text == text
    broken = ours("Policy", "p", spec, {"conditions": [ready("False", "NoZone", "zone a is missing")]})
    assert objects.policy(api.Policy.from_body(broken)).text == f"not in force: zone a is missing ({text})"


def test_it_reads_nothing_that_has_secrets() -> None:
    assert {kind.KIND for kind in KINDS} == {
        "Drone", "EdgeNode", "Depot", "Zone", "Policy", "Application", "DeploymentPlan", "DirectLink",
    }  # fmt: skip


# The command


@pytest.mark.parametrize(
    ("refusal", "said"),
    [
        (KubeError(0, "Unreachable", "no route"), "no route; check the cluster and --context"),
        (KubeError(404, "NotFound", "not found"), "install the chart fractus-crds"),
        (KubeError(403, "Forbidden", "forbidden"), "the role view is enough"),
    ],
)
def test_a_cluster_that_cannot_be_read_is_told_at_the_start(
    refusal: KubeError, said: str, monkeypatch: pytest.MonkeyPatch
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
    done = CliRunner().invoke(command.view, [])
    assert done.exit_code == 1
    assert said in done.output
