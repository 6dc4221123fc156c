"""Controller of flight plans: writes in their order, exactly one Application for each plan, and restarts of the operator."""

from __future__ import annotations

import asyncio
import contextlib
import copy
import itertools
import random
from datetime import UTC, datetime
from typing import Any

import pytest
from depth import examples
from fractus_core.airspace.lifecycle import OFF_NOMINAL
from fractus_core.api.plans import DeploymentPlanSpec, MissionRecord
from fractus_core.planning import Settings
from fractus_operator import kinds
from fractus_operator.cache import ClusterCache
from fractus_operator.flight_plan_controller import FlightPlanController
from fractus_operator.flight_plan_index import ReservedFlight
from fractus_operator.kinds import Body, Key, Kind
from fractus_operator.labels import FINALIZER, LANDING_FINALIZER
from fractus_operator.store import Conflict, KubeError, NotFound, Store
from test_airspace_flights import located
from test_flight_plan_steps import BEGIN_S, DAY_BEFORE_S, END_S, accepted
from test_grants import FENCE, policy, zone
from test_ordered_applications import flight, template
from test_planning import at, inventory

PLAN = ("team", "morning")
FLIGHT = ("team", "flight-3e0a")


class Killed(BaseException):
    """The operator process ends."""


class Api(Store):
    """Fake API server. It can end the operator at a write, before or after the write takes effect.

    Attributes:
        writes: Method and kind of each write that took effect.
        kill_at: Number of the write at which the operator is killed.
        effective: True if this write takes effect.
        lose_status: True if statuses are stored, but no response arrives.
        foreign: Status fields of another writer, which an apply does not remove. A JSON patch of the status is refused.
    """

    def __init__(self) -> None:
        self.field_manager = "test"
        self.objects: dict[str, Body] = {}
        self.writes: list[tuple[str, str]] = []
        self.kill_at: int | None = None
        self.effective = False
        self.lose_status = False
        self.foreign: Body = {}
        self.attempts = 0
        self._versions = itertools.count(1)

    def put(self, kind: Kind, body: Body) -> None:
        namespace = body["metadata"].get("namespace", "") if kind.namespaced else ""
        body["metadata"].setdefault("uid", f"uid of {body['metadata']['name']}")
        body["metadata"]["resourceVersion"] = str(next(self._versions))
        self.objects[kind.path(namespace, body["metadata"]["name"])] = body

    def find(self, kind: Kind, key: Key) -> Body | None:
        return self.objects.get(kind.path(*key))

    async def request(self, method: str, path: str, body: Any = None, **_: Any) -> Any:
        target = path.removesuffix("/status")
        if method == "GET":
            if target not in self.objects:
                raise NotFound(404, "NotFound", path)
            return copy.deepcopy(self.objects[target])
        if "/events" in path:
            return {}
        self.attempts += 1
        if self.attempts == self.kill_at and not self.effective:
            raise Killed
        response = self._write(method, path, target, copy.deepcopy(body))
        if self.attempts == self.kill_at:
            raise Killed
        if self.lose_status and path.endswith("/status"):
            raise KubeError(0, "Unreachable", "no response")
        return response

    def _write(self, method: str, path: str, target: str, body: Any) -> Any:
        if method == "POST":
            target = f"{path}/{body['metadata']['name']}"
            if target in self.objects:
                raise Conflict(409, "AlreadyExists", target)
            body["metadata"]["uid"] = f"uid of {target}"
            body["metadata"]["generation"] = 1
            self.objects[target] = body
        elif target not in self.objects:
            raise NotFound(404, "NotFound", path)
        elif method == "DELETE":
            self.writes.append((method, self.objects[target]["kind"]))
            self.objects[target]["metadata"]["deletionTimestamp"] = "2027-01-15T08:00:00Z"
            if not self.objects[target]["metadata"].get("finalizers"):
                del self.objects[target]
            return {"kind": "Status"}
        elif isinstance(body, list):
            raise Conflict(409, "Conflict", "the object was changed")
        elif path != target:
            self.objects[target]["status"] = {**self.foreign, **body["status"]}
        else:
            self.objects[target]["metadata"]["finalizers"] = body["metadata"]["finalizers"]
        self.objects[target]["metadata"]["resourceVersion"] = str(next(self._versions))
        self.writes.append((method, self.objects[target]["kind"]))
        return copy.deepcopy(self.objects[target])


class World:
    """A cluster with a drone, a template and flight plans."""

    def __init__(self, *plans: Any, drones: Any = None) -> None:
        self.api = Api()
        self.now_s = DAY_BEFORE_S
        stock = inventory(drones or [located("d")])
        for drone in stock.drones.values():
            body = drone.to_dict()
            body["status"]["flightState"] = "inactive"
            self.api.put(kinds.DRONE, body)
        for depot in stock.depots.values():
            self.api.put(kinds.DEPOT, depot.to_dict())
        for host in stock.hosts.values():
            body = kinds.NODE.header(host.name, labels=dict(host.labels))
            amounts = {name: str(amount) for name, amount in host.allocatable.items()}
            ready = [{"type": "Ready", "status": "True"}]
            self.api.put(kinds.NODE, body | {"status": {"allocatable": amounts, "conditions": ready}})
        self.api.put(kinds.APPLICATION_TEMPLATE, template().to_dict())
        for plan in plans or [flight(use="InUse")]:
            self.api.put(kinds.FLIGHT_PLAN, plan.to_dict())
        self.lead()

    def lead(self) -> None:
        """Start another operator that reads all objects."""
        self.cache = ClusterCache(self.api)
        self.controller = FlightPlanController(self.api, self.cache, self.clock, Settings())
        self.cache.add_listener(kinds.APPLICATION, self.controller.application_changed)
        self.cache.add_flight_rules_listener(self.controller.rules_changed)
        for informer in self.cache.informers:
            informer.synced.set()
        self.watch()

    def clock(self) -> datetime:
        return datetime.fromtimestamp(self.now_s, UTC)

    def watch(self) -> None:
        """Deliver the present objects to the informers."""
        watched = (
            (kinds.NODE, self.cache.hosts), (kinds.DRONE, self.cache.drones), (kinds.DEPOT, self.cache.depots),
            (kinds.APPLICATION_TEMPLATE, self.cache.templates), (kinds.FLIGHT_PLAN, self.cache.flight_plans),
            (kinds.APPLICATION, self.cache.applications), (kinds.ZONE, self.cache.zones), (kinds.POLICY, self.cache.policies),
        )  # fmt: skip
        for kind, informer in watched:
            bodies = {
                (b["metadata"].get("namespace", ""), b["metadata"]["name"]): b
                for b in self.api.objects.values()
                if b["kind"] == kind.name
            }
            for key, body in bodies.items():
                informer.record_write(key, copy.deepcopy(body))
            for key in [key for key, _ in informer.items() if key not in bodies]:
                informer._drop(key)

    async def step(self, key: Key = PLAN, times: int = 1) -> Body:
        """Take steps of a plan, and return its status."""
        for _ in range(times):
            await self.controller.reconcile(key)
            self.watch()
        return self.status(key)

    def status(self, key: Key = PLAN) -> Body:
        return (self.api.find(kinds.FLIGHT_PLAN, key) or {}).get("status") or {}

    def change(self, kind: Kind, key: Key, **fields: Any) -> None:
        body = self.api.find(kind, key)
        assert body is not None
        body["spec"] |= fields
        body["metadata"]["generation"] += 1
        self.api.put(kind, body)
        self.watch()

    def flies(self, state: str) -> None:
        body = self.api.find(kinds.DRONE, ("", "d"))
        assert body is not None
        body["status"]["flightState"] = state
        self.api.put(kinds.DRONE, body)
        self.watch()

    def mission(self, status: str) -> None:
        """Set the condition OnMission of the drone."""
        body = self.api.find(kinds.DRONE, ("", "d"))
        assert body is not None
        condition = {"type": "OnMission", "status": status, "reason": "Test", "message": ""}
        body["status"]["conditions"] = [condition | {"lastTransitionTime": "2027-01-15T08:00:00Z"}]
        self.api.put(kinds.DRONE, body)
        self.watch()

    def application(self) -> Body | None:
        return self.api.find(kinds.APPLICATION, FLIGHT)

    def created(self) -> int:
        return self.api.writes.count(("POST", "Application"))


async def started() -> World:
    world = World()
    await world.step()
    world.now_s = BEGIN_S
    await world.step(times=2)
    assert world.application() is not None
    return world


def plan_named(name: str, uid: str, **spec: Any) -> Any:
    plan = flight(**spec)
    return plan.model_copy(update={"metadata": plan.metadata.model_copy(update={"name": name, "uid": uid})})


async def test_accepted_plan_reserves_its_drone_for_other_applications() -> None:
    world = World()
    assert (await world.step())["state"] == "Accepted"
    ((drone, (reservation,)),) = world.cache.snapshot(("team", "other"), "u").reservations.items()
    assert (drone, reservation.holder, reservation.begin_s) == ("d", "team/morning", BEGIN_S)


@pytest.mark.parametrize("lost", [False, True])
async def test_second_plan_is_rejected_also_if_the_response_to_the_first_write_was_lost(lost: bool) -> None:
    world = World(flight(), plan_named("noon", "u2"))
    world.api.lose_status = lost
    if lost:
        with pytest.raises(KubeError):
            await world.controller.reconcile(PLAN)
        world.api.lose_status = False
    else:
        await world.step()
    await world.controller.reconcile(("team", "noon"))
    assert world.status()["state"] == "Accepted"
    assert world.status(("team", "noon"))["state"] == "Rejected"


async def test_second_plan_is_rejected_although_fields_of_another_writer_cannot_be_removed() -> None:
    world = World(flight(), plan_named("noon", "u2"))
    world.api.foreign = {"application": "other"}
    with pytest.raises(Conflict):
        await world.controller.reconcile(PLAN)
    world.api.foreign = {}
    await world.controller.reconcile(("team", "noon"))
    assert world.status(("team", "noon"))["state"] == "Rejected"


@pytest.mark.parametrize("seed", range(examples(40, 4)))
async def test_one_of_many_overlapping_plans_is_accepted_although_the_operator_is_killed(seed: int) -> None:
    source = random.Random(seed)
    names = [f"p{i}" for i in range(10)]
    world = World(*(plan_named(name, f"u-{name}") for name in names), drones=[located(f"d{i}") for i in range(10)])
    while undecided := [name for name in names if not world.status(("team", name))]:
        world.api.kill_at = world.api.attempts + source.randint(1, 4)
        world.api.effective = source.random() < 0.5
        world.api.lose_status = source.random() < 0.3
        try:
            with contextlib.suppress(KubeError):
                await world.controller.reconcile(("team", source.choice(undecided)))
            if source.random() < 0.5:
                world.watch()
        except Killed:
            world.lead()
    states = sorted(world.status(("team", name))["state"] for name in names)
    assert states == ["Accepted", *["Rejected"] * 9]


async def test_plan_starts_at_its_time_with_one_application() -> None:
    world = await started()
    body = world.application()
    assert body is not None
    assert body["metadata"]["finalizers"] == [FINALIZER]
    assert body["metadata"]["ownerReferences"][0]["uid"] == "3e0a"
    status = world.status()
    assert (status["state"], status["application"]) == ("Activated", "flight-3e0a")
    assert {c["type"]: c["status"] for c in status["conditions"]}["Started"] == "True"
    plan = world.api.find(kinds.FLIGHT_PLAN, PLAN)
    assert plan is not None
    assert plan["metadata"]["finalizers"] == [LANDING_FINALIZER]
    writes = len(world.api.writes)
    await world.step(times=3)
    assert len(world.api.writes) == writes, "an unchanged plan is not written again"


@pytest.mark.parametrize("effective", [False, True])
@pytest.mark.parametrize("write", range(1, 6))
async def test_operator_killed_at_any_write_starts_the_flight_exactly_once(write: int, effective: bool) -> None:
    world = World()
    world.api.kill_at = write
    world.api.effective = effective
    killed = False
    for now_s in (DAY_BEFORE_S, BEGIN_S, BEGIN_S + 1, BEGIN_S + 2, BEGIN_S + 3):
        world.now_s = now_s
        try:
            await world.controller.reconcile(PLAN)
            world.watch()
        except Killed:
            killed = True
            world.lead()
    assert killed
    assert (world.created(), world.status()["state"]) == (1, "Activated")


async def test_application_deleted_by_a_user_is_not_created_again_by_the_next_operator() -> None:
    world = await started()
    del world.api.objects[kinds.APPLICATION.path(*FLIGHT)]
    world.lead()
    status = await world.step()
    assert (status["state"], status["message"]) == ("Ended", "the Application was deleted")
    await world.step(times=2)
    assert world.created() == 1


async def test_application_deleted_before_it_was_recorded_is_not_created_again() -> None:
    world = World()
    await world.step()
    world.now_s = BEGIN_S
    await world.step()
    body = world.application()
    assert body is not None
    body["metadata"]["deletionTimestamp"] = "2027-01-15T08:00:01Z"
    world.lead()
    del world.api.objects[kinds.APPLICATION.path(*FLIGHT)]
    world.watch()
    assert (await world.step())["state"] == "Ended"
    assert world.created() == 1


async def test_closed_plan_keeps_its_airspace_until_the_landing() -> None:
    world = await started()
    world.flies("flying")
    world.change(kinds.FLIGHT_PLAN, PLAN, use="Closed")
    assert (await world.step())["state"] == "Contingent"
    assert ("DELETE", "Application") in world.api.writes
    del world.api.objects[kinds.APPLICATION.path(*FLIGHT)]
    world.watch()
    world.now_s = END_S + 60
    assert (await world.step())["state"] == "Contingent"
    assert world.cache.flights.get(PLAN) is not None
    world.flies("inactive")
    assert (await world.step())["state"] == "Ended"
    assert world.cache.flights.get(PLAN) is None
    plan = world.api.find(kinds.FLIGHT_PLAN, PLAN)
    assert plan is not None
    assert plan["metadata"]["finalizers"] == []


@pytest.mark.parametrize("status", ["True", "Unknown"])
async def test_ended_flight_keeps_its_airspace_until_the_drone_has_reported(status: str) -> None:
    world = await started()
    world.mission(status)
    del world.api.objects[kinds.APPLICATION.path(*FLIGHT)]
    world.watch()
    world.now_s = END_S + 60
    assert (await world.step())["state"] == "Contingent"
    reserved = world.cache.flights.get(PLAN)
    assert reserved is not None
    assert reserved.end_s > world.now_s
    world.mission("False")
    assert (await world.step())["state"] == "Ended"


@pytest.mark.parametrize("aborted", [False, True])
async def test_airspace_of_deleted_drone_stays_reserved_after_operator_restart_until_it_reports_a_landing(
    aborted: bool,
) -> None:
    world = await started()
    world.flies("flying")
    await world.step()
    drone = world.api.objects.pop(kinds.DRONE.path("", "d"))
    if aborted:
        del world.api.objects[kinds.APPLICATION.path(*FLIGHT)]
    world.lead()
    world.now_s = END_S + 60
    for _ in range(3):
        assert (await world.step())["state"] in OFF_NOMINAL
        reserved = world.cache.flights.get(PLAN)
        assert reserved is not None
        assert reserved.end_s > world.now_s
        world.now_s += 600
    del drone["status"]
    world.api.put(kinds.DRONE, drone)
    world.watch()
    assert (await world.step())["state"] != "Ended", "the new object has no report"
    drone["status"] = {"flightState": "inactive"}
    world.api.put(kinds.DRONE, drone)
    world.api.objects.pop(kinds.APPLICATION.path(*FLIGHT), None)
    world.watch()
    assert (await world.step())["state"] == "Ended"


async def test_airspace_of_drone_that_is_gone_is_released_by_the_annotation_of_its_new_object() -> None:
    world = await started()
    drone = world.api.objects.pop(kinds.DRONE.path("", "d"))
    del world.api.objects[kinds.APPLICATION.path(*FLIGHT)]
    world.watch()
    status = await world.step()
    assert status["state"] == "Contingent"
    assert "its Drone was deleted" in status["message"]
    del drone["status"]
    drone["metadata"]["annotations"] = {"fractus.dev/grounded": "never"}
    world.api.put(kinds.DRONE, drone)
    world.watch()
    assert (await world.step())["state"] == "Ended"


async def test_completed_flight_ends_without_another_report() -> None:
    world = await started()
    world.mission("Unknown")
    body = world.application()
    assert body is not None
    record = MissionRecord(outcome="Complete", message="all waypoints reached", landed=True)
    planned = DeploymentPlanSpec(application="flight-3e0a", flown=record)
    world.cache.plans.decide(FLIGHT, body["metadata"]["uid"], planned)
    assert (await world.step())["state"] == "Ended"


def conditions(status: Body) -> dict[str, tuple[str, str]]:
    return {each["type"]: (each["status"], each["reason"]) for each in status["conditions"]}


@pytest.mark.parametrize("place", [(60, 70), (5000, 0)], ids=["on the route", "elsewhere"])
async def test_restriction_published_after_the_acceptance_is_a_condition_of_the_plan(place: tuple[int, int]) -> None:
    world = World()
    await world.step()
    queued: list[Key] = []
    world.cache.add_flight_rules_listener(queued.append)
    world.api.put(kinds.ZONE, zone("z", place, 20).to_dict())
    world.api.put(kinds.POLICY, policy("keep-out", zones=["z"], **FENCE).to_dict())
    world.watch()
    near = place == (60, 70)
    assert (PLAN in queued) == near
    status = await world.step()
    assert status["state"] == "Accepted"
    assert conditions(status).get("Restricted") == (("True", "PolicyConflict") if near else None)
    writes = len(world.api.writes)
    await world.step()
    assert len(world.api.writes) == writes, "the condition stays without another judgement"
    del world.api.objects[kinds.POLICY.path("", "keep-out")]
    world.watch()
    assert "Restricted" not in {n for n, (value, _) in conditions(await world.step()).items() if value == "True"}


FAR = (5000, 0)
CHOICE = {"type": "GeofenceControl", "kind": "exclusion", "action": "land", "choices": ["land", "hover"]}


@pytest.mark.parametrize(
    ("spec", "reason"),
    [(FENCE | {"kind": "inclusion"}, "PolicyConflict"), (CHOICE, "ChoicesMissing")],
    ids=["inclusion", "choices"],
)
async def test_policy_with_a_zone_elsewhere_restricts_a_plan_if_it_permits_or_has_choices(
    spec: Body, reason: str
) -> None:
    world = World()
    await world.step()
    world.api.put(kinds.ZONE, zone("z", FAR, 20).to_dict())
    world.api.put(kinds.POLICY, policy("p", zones=["z"], **spec).to_dict())
    world.watch()
    assert conditions(await world.step()).get("Restricted") == ("True", reason)


async def test_restriction_ends_when_its_policy_was_invalid_before_its_deletion() -> None:
    world = World()
    await world.step()
    world.api.put(kinds.ZONE, zone("z", (60, 70), 20).to_dict())
    body = policy("keep-out", zones=["z"], **FENCE).to_dict()
    world.api.put(kinds.POLICY, copy.deepcopy(body))
    world.watch()
    assert conditions(await world.step())["Restricted"] == ("True", "PolicyConflict")
    body["spec"]["kind"] = "unknown"
    world.api.put(kinds.POLICY, body)
    world.watch()
    await world.step()
    del world.api.objects[kinds.POLICY.path("", "keep-out")]
    world.watch()
    assert "Restricted" not in conditions(await world.step())


async def test_plan_is_judged_again_when_its_drone_gets_an_attribute_that_a_policy_selects() -> None:
    world = World()
    world.api.put(kinds.ZONE, zone("z", (60, 70), 20).to_dict())
    heavy = [{"key": "labels.heavy", "operator": "In", "values": ["yes"]}]
    world.api.put(kinds.POLICY, policy("keep-out", zones=["z"], nodes=heavy, **FENCE).to_dict())
    drone = world.api.find(kinds.DRONE, ("", "d"))
    assert drone is not None
    drone["metadata"]["labels"] = {"heavy": "no"}
    world.watch()
    assert "Restricted" not in conditions(await world.step())
    drone["metadata"]["labels"] = {"heavy": "yes"}
    world.watch()
    assert conditions(await world.step()).get("Restricted") == ("True", "PolicyConflict")


async def test_policy_that_changes_during_the_write_of_a_judgement_is_judged_next(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    world = World()
    await world.step()
    world.api.put(kinds.ZONE, zone("z", (60, 70), 20).to_dict())
    world.api.put(kinds.POLICY, policy("keep-out", zones=["z"], **FENCE).to_dict())
    world.watch()
    write = world.api._write

    def write_while_the_policy_is_deleted(*arguments: Any) -> Any:
        monkeypatch.setattr(world.api, "_write", write)
        world.api.objects.pop(kinds.POLICY.path("", "keep-out"))
        world.watch()
        return write(*arguments)

    monkeypatch.setattr(world.api, "_write", write_while_the_policy_is_deleted)
    status = await world.step()
    assert conditions(status)["Restricted"] == ("True", "PolicyConflict")
    assert "Restricted" not in {n for n, (value, _) in conditions(await world.step()).items() if value == "True"}


async def test_new_plan_is_decided_before_accepted_plans_are_judged_again() -> None:
    names = [f"p{number}" for number in range(3)]
    world = World(*(plan_named(name, f"u-{name}") for name in names), drones=[located(f"d{i}") for i in range(3)])
    for name in names:
        await world.step(("team", name))
        world.controller.rules_changed(("team", name))
    world.api.put(kinds.FLIGHT_PLAN, plan_named("new", "u-new").to_dict())
    world.watch()
    world.controller.changed(("team", "new"))
    decided: list[str] = []
    done = asyncio.Event()

    async def reconcile(key: Key) -> None:
        decided.append(key[1])
        if len(decided) == len(names):
            done.set()

    world.controller.work_queue._reconcile = reconcile
    task = asyncio.create_task(world.controller.work_queue.run())
    async with asyncio.timeout(5):
        await done.wait()
    task.cancel()
    assert decided[0] == "new"


async def test_dry_run_is_deleted_after_a_minute_without_another_change() -> None:
    world = World(flight(dryRun=True))
    await world.step()
    loop = asyncio.get_running_loop()
    assert world.controller._timers[PLAN].when() - loop.time() <= 60


async def test_deleted_plan_ends_its_flight() -> None:
    world = await started()
    world.flies("flying")
    await world.api.delete(kinds.FLIGHT_PLAN, PLAN)
    world.watch()
    assert (await world.step())["state"] == "Contingent"
    assert ("DELETE", "Application") in world.api.writes


async def test_plan_follows_the_record_of_its_mission() -> None:
    world = await started()
    body = world.application()
    assert body is not None
    world.flies("flying")
    record = MissionRecord(outcome="Failed", message="the battery is low")
    planned = DeploymentPlanSpec(application="flight-3e0a", flown=record)
    world.cache.plans.decide(FLIGHT, body["metadata"]["uid"], planned)
    status = await world.step()
    assert (status["state"], status["message"]) == (
        "Contingent",
        "the system ends the flight of d: the battery is low",
    )


def reservation(world: World, key: Key) -> ReservedFlight | None:
    submitted = world.cache.applications.get(key)
    assert submitted is not None
    return world.cache.flights.of_application(submitted)


async def test_application_of_plan_gets_the_reserved_drone() -> None:
    world = await started()
    reserved = reservation(world, FLIGHT)
    assert reserved is not None
    assert reserved.drone == "d"
    assert world.cache.snapshot(FLIGHT, "u").reservations["d"] == []


async def test_application_that_names_a_plan_as_its_owner_gets_no_reserved_drone() -> None:
    world = await started()
    body = copy.deepcopy(world.application())
    assert body is not None
    body["metadata"]["name"] = "thief"
    world.api.put(kinds.APPLICATION, body)
    world.watch()
    assert reservation(world, ("team", "thief")) is None
    assert world.cache.snapshot(("team", "thief"), "u").reservations["d"]


async def test_other_application_with_the_name_of_the_flight_is_not_adopted() -> None:
    world = World()
    await world.step()
    foreign = kinds.APPLICATION.header("flight-3e0a", "team", generation=1) | {"spec": {"components": []}}
    world.api.put(kinds.APPLICATION, foreign)
    world.now_s = BEGIN_S
    with pytest.raises(KubeError, match="is not the flight of FlightPlan morning; delete it"):
        await world.controller.reconcile(PLAN)


async def test_dry_run_is_decided_without_a_reservation_and_deleted() -> None:
    plan = flight(dryRun=True, autoActivate=True)
    created = datetime.fromtimestamp(DAY_BEFORE_S, UTC)
    plan = plan.model_copy(update={"metadata": plan.metadata.model_copy(update={"creation_timestamp": created})})
    world = World(plan)
    assert (await world.step())["state"] == "Accepted"
    assert world.cache.flights.get(PLAN) is None
    world.now_s += 61
    await world.step()
    assert world.api.find(kinds.FLIGHT_PLAN, PLAN) is None


def check_named(change_of: str | None, **spec: Any) -> Any:
    return plan_named("check", "u2", dryRun=True, changeOf=change_of, **spec)


@pytest.mark.parametrize(
    ("change_of", "state"), [("morning", "Accepted"), (None, "Rejected"), ("noon", "Rejected"), ("other", "Rejected")]
)
async def test_dry_run_of_a_change_conflicts_with_all_plans_but_the_changed_one(
    change_of: str | None, state: str
) -> None:
    """The changed plan has reserved the only drone."""
    world = World(flight(), plan_named("noon", "u3"), check_named(change_of))
    await world.step()
    status = await world.step(("team", "check"))
    assert status["state"] == state
    if state == "Accepted":
        await world.step(("team", "check"))
        assert world.status(("team", "check")).get("advisories", []) == []
        assert world.cache.flights.get(("team", "check")) is None


@pytest.mark.parametrize(
    ("change", "reason"),
    [({}, None), ({"window": {"start": "2027-01-15T08:00:00Z", "duration": 20}}, None),
     ({"waypoints": [at(40, 40, 20)]}, "ChangeNotPermitted")],
)  # fmt: skip
async def test_dry_run_of_a_change_in_flight_gets_the_decision_on_the_change(change: Body, reason: str | None) -> None:
    world = await started()
    world.api.put(kinds.FLIGHT_PLAN, check_named("morning", **change).to_dict())
    world.watch()
    status = await world.step(("team", "check"))
    assert status["state"] == ("Rejected" if reason else "Accepted"), status["message"]
    assert [each["reason"] for each in status.get("refusals", [])] == ([reason] if reason else [])


async def test_dry_run_is_never_flown() -> None:
    world = World(flight(dryRun=True, autoActivate=True))
    await world.step()
    world.now_s = BEGIN_S
    await world.step(times=2)
    assert world.created() == 0


async def test_flying_plan_that_becomes_a_dry_run_keeps_its_airspace() -> None:
    world = await started()
    body = world.api.find(kinds.FLIGHT_PLAN, PLAN)
    assert body is not None
    body["metadata"]["creationTimestamp"] = "2027-01-14T08:00:00Z"
    world.flies("flying")
    world.change(kinds.FLIGHT_PLAN, PLAN, dryRun=True)
    assert world.cache.flights.get(PLAN) is not None
    assert (await world.step())["state"] == "Activated"
    assert world.cache.flights.get(PLAN) is not None
    plan = world.api.find(kinds.FLIGHT_PLAN, PLAN)
    assert plan is not None
    assert plan["metadata"]["finalizers"] == [LANDING_FINALIZER]


async def test_deleted_drone_is_replaced_long_before_the_flight() -> None:
    world = World(drones=[located("d"), located("e", battery=0.5)])
    assert (await world.step())["drone"] == "d"
    del world.api.objects[kinds.DRONE.path("", "d")]
    world.watch()
    assert (await world.step())["drone"] == "e"


async def test_next_operator_knows_all_reservations() -> None:
    world = World(accepted(), plan_named("noon", "u2"))
    assert (await world.step(("team", "noon")))["state"] == "Rejected"
