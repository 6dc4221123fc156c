"""Rollout of node services, and detection of nodes that no longer report."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import pytest
from fractus_core.api import Drone, EdgeNode
from fractus_core.api.conditions import ConditionUpdate
from fractus_operator.cache import ClusterCache
from fractus_operator.kinds import GRANT
from fractus_operator.mission_condition import MissionConditionController
from fractus_operator.node_conditions import NodeConditionWriter
from fractus_operator.node_liveness import NodeLivenessController, ObservationClock, StaleNodeDetector
from fractus_operator.node_services import NodeServicePods, Revision, parse_revision
from fractus_operator.pods import PodView, parse_pod
from fractus_operator.service_rollout import ServiceRollout, ServicesOfNode, next_step
from fractus_operator.store import KubeError, Store

V1 = "fractus.dev/v1alpha1"


def pod(node: str = "d1", revision: str = "new", **changes: Any) -> PodView:
    labels = {"controller-revision-hash": revision}
    owner = {"apiVersion": "apps/v1", "kind": "DaemonSet", "name": "fractus-mobility", "controller": True}
    metadata = {
        "namespace": "fractus-system",
        "name": f"m-{node}-{revision}",
        "labels": labels,
        "ownerReferences": [owner],
    }
    return parse_pod({"metadata": metadata | changes, "spec": {"nodeName": node}})


def node(
    name: str, *, outdated: bool = True, starting: bool = False, obstacle: str = "", starting_s: float = 0.0
) -> ServicesOfNode:
    pods = (pod(name, "old"),) if outdated else ()
    waited_for = {"fractus-mobility": "m"} if starting else {}
    return ServicesOfNode(name, pods, waited_for, (obstacle, f"{name} is so") if obstacle else None, starting_s)


def step_of(*nodes: ServicesOfNode, ready: int = 0) -> tuple[list[str], dict[str, ConditionUpdate]]:
    chosen, reasons = next_step(nodes, len(nodes), lambda _: ready)
    return [n.node for n in chosen], reasons


def test_services_are_replaced_on_one_node_at_a_time() -> None:
    chosen, conditions = step_of(node("d1"), node("d2"), node("d3"))
    assert chosen == ["d1"]
    assert [conditions[n].reason for n in ("d1", "d2", "d3")] == ["Replacing", "Queued", "Queued"]
    assert "when the services of d1 are ready" in conditions["d2"].message
    assert "m-d2-old" in conditions["d2"].message


def test_nodes_wait_while_services_of_another_start() -> None:
    chosen, conditions = step_of(node("d1", outdated=False, starting=True), node("d2"))
    assert not chosen
    assert conditions["d1"].reason == "Starting"
    assert "when the services of d1 are ready" in conditions["d2"].message


@pytest.mark.parametrize("obstacle", ["InTheAir", "OnMission", "NodeUnreachable"])
def test_services_of_flying_or_unreachable_drone_are_kept(obstacle: str) -> None:
    chosen, conditions = step_of(node("d1", obstacle=obstacle), node("d2"))
    assert chosen == ["d2"], "other nodes do not wait for a node whose services are kept"
    assert (conditions["d1"].status, conditions["d1"].reason) == ("False", obstacle)
    assert "d1 is so" in conditions["d1"].message


def test_unreachable_node_does_not_stop_rollout() -> None:
    chosen, _ = step_of(node("d1", outdated=False, starting=True, obstacle="NodeUnreachable"), node("d2"))
    assert chosen == ["d2"]


STUCK = {"outdated": False, "starting": True, "starting_s": 601.0}


def test_node_that_is_never_ready_is_skipped_and_reported() -> None:
    chosen, conditions = step_of(node("d1", **STUCK), node("d2"))
    assert chosen == ["d2"]
    assert (conditions["d1"].reason, conditions["d1"].warning) == ("NotReady", True)
    assert "m: not ready for 10 minutes; the rollout continues without it" in conditions["d1"].message


def test_broken_release_stops_at_second_node() -> None:
    failed = [node("d1", **STUCK), node("d2", **STUCK)]
    chosen, conditions = step_of(*failed, node("d3"))
    assert not chosen
    assert "other nodes wait" in conditions["d1"].message
    assert step_of(*failed, node("d3"), ready=2)[0] == ["d3"], (
        "the failed nodes do not stop the rollout, because other nodes run the release"
    )


def test_unready_services_are_replaced_last() -> None:
    ready = replace(node("d2"), outdated=(replace(pod("d2", "old"), ready=True),))
    assert step_of(node("d1"), ready)[0] == ["d2"]


def test_services_are_replaced_on_one_in_twenty_nodes_at_a_time_in_large_fleet() -> None:
    assert len(step_of(*(node(f"d{i:03}") for i in range(100)))[0]) == 5


def test_latest_revision_has_highest_number() -> None:
    services = NodeServicePods("fractus-system")
    old = pod(revision="old")
    new = pod(revision="new")
    for replica in (old, new):
        services.pod_changed((replica.namespace, replica.name), None, replica)
    assert services.is_current(old), "no revision is known yet"
    services.revision_changed(("", "a"), None, Revision("fractus-mobility", 1, "old"))
    services.revision_changed(("", "b"), None, Revision("fractus-mobility", 2, "new"))
    services.revision_changed(("", "c"), None, Revision("fractus-camera", 9, "else"))
    assert (services.is_current(old), services.is_current(new)) == (False, True)
    services.revision_changed(("", "a"), None, Revision("fractus-mobility", 3, "old"))
    assert (services.is_current(old), services.is_current(new)) == (True, False), (
        "the old revision is current again after a rollback"
    )
    services.pod_changed((old.namespace, old.name), old, None)
    assert (len(services), list(services.on("d1"))) == (1, [new])
    assert services.ready("fractus-mobility") == 0
    for change in (replace(old, ready=True), old, replace(old, ready=True)):
        services.pod_changed((old.namespace, old.name), services._pods["d1"].get((old.namespace, old.name)), change)
    assert services.ready("fractus-mobility") == 1


def test_only_changed_nodes_are_returned() -> None:
    services = NodeServicePods("fractus-system")
    for replica in (pod("d1"), pod("d2")):
        services.pod_changed((replica.namespace, replica.name), None, replica)
    assert services.take_changed() == {"d1", "d2"}
    assert not services.take_changed()
    services.revision_changed(("", "a"), None, Revision("fractus-mobility", 1, "old"))
    assert services.take_changed() == {"d1", "d2"}, "both nodes may be outdated after a new revision"
    services.revision_changed(("", "b"), None, Revision("fractus-mobility", 0, "older"))
    assert not services.take_changed()
    deleted_pod = pod("d2")
    services.pod_changed((deleted_pod.namespace, deleted_pod.name), deleted_pod, None)
    assert services.take_changed() == {"d2"}


def test_other_pods_and_revisions_are_ignored() -> None:
    services = NodeServicePods("fractus-system")
    for other in (pod(ownerReferences=[]), pod(namespace="default")):
        services.pod_changed((other.namespace, other.name), None, other)
    assert not len(services)
    assert parse_revision({"metadata": {"name": "x", "namespace": "fractus-system"}, "revision": 1}) is None


# -- stale nodes --


def drone(last_seen: str | None, state: str = "flying") -> Drone:
    status = {"flightState": state, "lastFlightState": state} | ({"lastSeen": last_seen} if last_seen else {})
    return Drone.from_body({"apiVersion": V1, "kind": "Drone", "metadata": {"name": "d"}, "spec": {}, "status": status})


def at(second: int) -> str:
    return datetime(2026, 1, 1, 0, 0, second, tzinfo=UTC).isoformat()


def test_drone_in_flight_is_stale_after_fifteen_seconds() -> None:
    silence = StaleNodeDetector()
    assert not silence.stale_nodes([drone(at(0))], 100.0)
    assert not silence.stale_nodes([drone(at(0))], 115.0)
    assert silence.stale_nodes([drone(at(0))], 115.1)
    assert not silence.stale_nodes([drone(at(5))], 116.0), "a node that reports again is not stale"


@pytest.mark.parametrize("jump", ["2020-01-01T00:00:00Z", "2031-01-01T00:00:00Z"])
def test_clock_of_node_does_not_affect_staleness(jump: str) -> None:
    silence = StaleNodeDetector()
    silence.stale_nodes([drone(at(0))], 100.0)
    assert not silence.stale_nodes([drone(jump)], 114.0)
    assert not silence.stale_nodes([drone(jump)], 129.0)
    assert silence.stale_nodes([drone(jump)], 129.1)


def test_report_timeout_depends_on_report_period() -> None:
    silence = StaleNodeDetector()
    standing = drone(at(0), "inactive")
    spec = {"location": {"lat": 1, "lon": 2}}
    body = {"apiVersion": V1, "kind": "EdgeNode", "metadata": {"name": "e"}, "spec": spec}
    edge = EdgeNode.from_body({**body, "status": {"lastSeen": at(0)}})
    assert not silence.stale_nodes([standing, edge], 0.0)
    assert not silence.stale_nodes([standing, edge], 90.0)
    assert silence.stale_nodes([standing, edge], 91.0) == [standing]
    assert silence.stale_nodes([standing, edge], 181.0) == [standing, edge]


def test_node_without_report_is_not_stale() -> None:
    silence = StaleNodeDetector()
    for now_s in (0.0, 1000.0):
        assert not silence.stale_nodes([drone(None)], now_s)


def test_api_server_outage_makes_no_node_stale() -> None:
    now_s = [0.0]
    connected = [True]
    clock = ObservationClock(lambda: now_s[0], lambda: connected[0])
    silence = StaleNodeDetector()

    def silent_after(seconds: int) -> bool:
        stale = False
        for _ in range(seconds):
            now_s[0] += 1.0
            stale = bool(silence.stale_nodes([drone(at(0))], clock.now_s()))
        return stale

    assert not silent_after(5)
    connected[0] = False
    assert not silent_after(600)
    connected[0] = True
    assert not silent_after(15), "agents retry at least every 15 s"
    assert not silent_after(10)
    assert silent_after(6)


def test_delayed_step_makes_no_node_stale() -> None:
    now_s = [0.0]
    clock = ObservationClock(lambda: now_s[0], lambda: True)
    now_s[0] += 60.0
    assert clock.now_s() <= 3.0


# -- rollout steps --


class Api(Store):
    """Fake API server with drones.

    It refuses writes to the drones in `refused`, and forbids the methods in `forbidden`.
    """

    def __init__(self) -> None:
        # The constructor of Store is not called, because `request` needs no connection.
        self.field_manager = "test"
        self.objects: dict[str, dict[str, Any]] = {}
        self.refused: set[str] = set()
        self.forbidden: set[str] = set()
        self.requests: list[tuple[str, str]] = []

    async def request(self, method: str, path: str, body: Any = None, **_: Any) -> Any:
        name = path.removesuffix("/status").rpartition("/")[2]
        if method != "GET":
            self.requests.append((method, name))
        if name in self.refused:
            raise KubeError(422, "Invalid", f"{name} is refused")
        if method in self.forbidden:
            raise KubeError(403, "Forbidden", f"the account cannot {method} {path}")
        if method == "PUT":
            self.objects[name] = body
        if method == "PATCH":
            # Merge the conditions by their type, like the API server.
            status = self.objects[name].setdefault("status", {})
            new = {condition["type"]: condition for condition in body["status"]["conditions"]}
            others = [each for each in status.get("conditions", ()) if each["type"] not in new]
            status["conditions"] = [*others, *new.values()]
        return json.loads(json.dumps(self.objects.get(name, {})))


@pytest.fixture
async def cache() -> ClusterCache:
    """Return a cache with three drones on the ground. One service of each drone is outdated."""
    cluster_cache = ClusterCache(Api())
    for informer in cluster_cache.informers:
        informer.synced.set()
    for name in ("d1", "d2", "d3"):
        body = drone(at(0), "inactive").to_dict()
        body["metadata"]["name"] = name
        cluster_cache.drones.record_write(("", name), body)
        ready = {"conditions": [{"type": "Ready", "status": "True"}]}
        cluster_cache.hosts.record_write(("", name), {"metadata": {"name": name}, "spec": {}, "status": ready})
        shown(cluster_cache, pod(name, "old"))
    cluster_cache.services.revision_changed(("", "b"), None, Revision("fractus-mobility", 2, "new"))
    return cluster_cache


def shown(cache: ClusterCache, new: PodView) -> None:
    cache.services.pod_changed((new.namespace, new.name), None, new)


def removed(cache: ClusterCache, old: PodView) -> None:
    cache.services.pod_changed((old.namespace, old.name), old, None)


def reported(cache: ClusterCache, api: Api) -> NodeConditionWriter:
    for body in cache.drones.values():
        api.objects.setdefault(body.name, body.to_dict())
    return NodeConditionWriter(api, cache, lambda: datetime(2026, 1, 1, tzinfo=UTC))


def condition_reason(api: Api, name: str, type_: str) -> str:
    conditions = api.objects[name]["status"].get("conditions", ())
    return next((c["reason"] for c in conditions if c["type"] == type_), "")


async def test_missing_successor_pod_stops_rollout(cache: ClusterCache) -> None:
    api = Api()
    now_s = [0.0]
    rollout = ServiceRollout(api, cache, reported(cache, api), lambda: now_s[0])

    async def step() -> list[str]:
        api.requests.clear()
        await rollout.step()
        for name, body in api.objects.items():
            if name in {"d1", "d2", "d3"}:
                cache.drones.record_write(("", name), json.loads(json.dumps(body)))
        return [name for method, name in api.requests if method == "DELETE"]

    assert await step() == ["m-d1-old"]
    removed(cache, pod("d1", "old"))
    assert not await step(), "no second pod is deleted before the first has a successor"
    now_s[0] = 600.0
    assert not await step(), "no second pod is deleted before the start period ends"
    assert condition_reason(api, "d1", "ServicesCurrent") == "Starting"
    starting = pod("d1", "new")
    shown(cache, starting)
    assert not await step()
    shown(cache, replace(starting, ready=True))
    assert await step() == ["m-d2-old"]
    removed(cache, pod("d2", "old"))
    cache.hosts._drop(("", "d2"))
    assert await step() == ["m-d3-old"], "the rollout does not wait for a deleted node"


async def test_node_that_is_never_ready_does_not_stop_rollout(cache: ClusterCache) -> None:
    api = Api()
    now_s = [0.0]
    rollout = ServiceRollout(api, cache, reported(cache, api), lambda: now_s[0])
    await rollout.step()
    removed(cache, pod("d1", "old"))
    shown(cache, pod("d1", "new"))
    for now_s[0] in (10.0, 605.0):
        await rollout.step()
        assert [name for method, name in api.requests if method == "DELETE"] == ["m-d1-old"]
    now_s[0] = 620.0
    await rollout.step()
    assert [name for method, name in api.requests if method == "DELETE"] == ["m-d1-old", "m-d2-old"]
    assert condition_reason(api, "d1", "ServicesCurrent") == "NotReady"


async def test_current_fleet_is_not_checked_again(cache: ClusterCache, monkeypatch: pytest.MonkeyPatch) -> None:
    cache.services.revision_changed(("", "c"), None, Revision("fractus-mobility", 3, "old"))
    for name in ("d1", "d2", "d3"):
        shown(cache, replace(pod(name, "old"), ready=True))
    rollout = ServiceRollout(api := Api(), cache, reported(cache, api), lambda: 0.0)
    await rollout.step()
    monkeypatch.setattr(cache.services, "on", None)
    await rollout.step()
    assert not api.requests


async def test_refused_deletion_does_not_stop_rollout(cache: ClusterCache) -> None:
    api = Api()
    for name in map(str, range(40)):
        shown(cache, pod(f"e{name}", "old"))
        cache.hosts.record_write(
            ("", f"e{name}"),
            {"metadata": {"name": f"e{name}"}, "status": {"conditions": [{"type": "Ready", "status": "True"}]}},
        )
    api.refused = {"m-d1-old", "d2"}
    await ServiceRollout(api, cache, reported(cache, api), lambda: 0.0).step()
    assert [name for method, name in api.requests if method == "DELETE"] == ["m-d1-old", "m-d2-old"]
    assert condition_reason(api, "d1", "ServicesCurrent") == "Refused"
    assert condition_reason(api, "d3", "ServicesCurrent") == "Queued", (
        "the status of d3 is written although that of d2 was refused"
    )


@pytest.mark.parametrize("last_seen", [None, "2026-01-01T00:00:00z", "yesterday"])
async def test_report_times_are_parsed(cache: ClusterCache, last_seen: str | None) -> None:
    api = Api()
    now_s = [0.0]
    watch = NodeLivenessController(cache, reported(cache, api), lambda: now_s[0])
    await watch.step()
    api.objects["d1"]["status"] = {"lastSeen": last_seen} if last_seen else {}
    api.refused = {"d2"}
    now_s[0] = 1000.0
    await watch.step()
    assert condition_reason(api, "d1", "Ready") == ("AgentSilent" if last_seen and last_seen.endswith("z") else "")
    assert condition_reason(api, "d3", "Ready") == "AgentSilent", (
        "the status of d3 is written although that of d2 was refused"
    )


# -- missions --


def granted(cache: ClusterCache, name: str, node: str | None) -> None:
    """Add a Grant for a node. If `node` is None, remove the Grant."""
    owner = {"namespace": "ns", "name": "app", "uid": "u"}
    grants = cache.children[GRANT]
    if node is None:
        grants._drop(("", name))
    else:
        spec = {"node": node, "application": owner, "component": "A", "instance": "a"}
        grants.record_write(("", name), {"apiVersion": V1, "kind": "Grant", "metadata": {"name": name}, "spec": spec})


async def test_mission_condition_ends_after_two_reports(cache: ClusterCache) -> None:
    api = Api()
    missions = MissionConditionController(api, cache, reported(cache, api), lambda: datetime(2026, 1, 1, tzinfo=UTC))
    changed: list[Any] = []
    cache.add_listener(GRANT, lambda key: changed.append(missions.grant_changed(key)))

    async def mission_reason(**status: Any) -> str:
        api.objects["d1"]["status"] |= status
        cache.drones.record_write(("", "d1"), json.loads(json.dumps(api.objects["d1"])))
        await missions.reconcile(("", "d1"))
        cache.drones.record_write(("", "d1"), json.loads(json.dumps(api.objects["d1"])))
        return condition_reason(api, "d1", "OnMission")

    assert await mission_reason() == "", "a drone without any Grant has no condition"
    granted(cache, "ns.a", "d1")
    assert await mission_reason() == "Granted"
    assert api.requests == [("PATCH", "d1")], "one patch writes the condition, without a GET before it"
    assert cache.drones.get(("", "d1")).may_take_off  # type: ignore[union-attr]
    granted(cache, "ns.a", None)
    assert await mission_reason() == "AwaitingReports"
    assert await mission_reason() == "AwaitingReports"
    assert await mission_reason(lastSeen=at(30), flightState="unknown") == "AwaitingReports"
    assert cache.drones.get(("", "d1")).may_take_off  # type: ignore[union-attr]
    for _ in range(2):
        assert await mission_reason(lastSeen=at(31), flightState="inactive") == "AwaitingReports", (
            "the reported state may be older than the removal of the Grant"
        )
    assert await mission_reason(lastSeen=at(59)) == "NoGrant"
    assert not cache.drones.get(("", "d1")).may_take_off  # type: ignore[union-attr]


async def test_condition_is_not_written_twice_before_watch_event(cache: ClusterCache) -> None:
    """The Grants of an application are created one by one, and each creation causes a reconciliation."""
    api = Api()
    missions = MissionConditionController(api, cache, reported(cache, api), lambda: datetime(2026, 1, 1, tzinfo=UTC))
    cache.add_listener(GRANT, lambda key: bool(missions.grant_changed(key)))
    for name in ("ns.a", "ns.b", "ns.c"):
        granted(cache, name, "d1")
        await missions.reconcile(("", "d1"))
    assert api.requests == [("PATCH", "d1")]


def test_grounded_annotation_is_valid_until_next_report() -> None:
    flying = drone(at(0)).to_dict()

    def in_air(annotation: str) -> bool:
        flying["metadata"]["annotations"] = {"fractus.dev/grounded": annotation}
        return Drone.from_body(json.loads(json.dumps(flying))).in_air

    assert not in_air("2026-01-01T00:00:00Z")
    for other in ("2026-01-01T00:00:01Z", "2026-01-01T00:00:00", "yes", ""):
        assert in_air(other)


async def test_condition_is_updated_if_patch_is_forbidden(
    cache: ClusterCache, caplog: pytest.LogCaptureFixture
) -> None:
    """After `helm rollback`, the ClusterRole permits only updates.

    The operator must still write OnMission, because admission treats a drone without it as idle.
    """
    api = Api()
    api.forbidden = {"PATCH"}
    missions = MissionConditionController(api, cache, reported(cache, api), lambda: datetime(2026, 1, 1, tzinfo=UTC))
    cache.add_listener(GRANT, lambda key: bool(missions.grant_changed(key)))
    for name, reason in (("ns.a", "Granted"), (None, "AwaitingReports"), (None, "AwaitingReports")):
        granted(cache, "ns.a", "d1" if name else None)
        await missions.reconcile(("", "d1"))
        assert condition_reason(api, "d1", "OnMission") == reason
    assert api.requests == [("PATCH", "d1"), ("PUT", "d1")] * 2, (
        "a forbidden patch is replaced by an update, and not repeated"
    )
    (warning,) = (record.getMessage() for record in caplog.records if record.levelname == "WARNING")
    assert "upgrade the chart fractus, because its ClusterRole belongs to another release" in warning
    api.forbidden = {"PATCH", "PUT"}
    granted(cache, "ns.c", "d2")
    with pytest.raises(KubeError, match="cannot PUT"):
        await missions.reconcile(("", "d2"))
