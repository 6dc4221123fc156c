"""In which order a plan becomes objects, and what waits for what."""

from __future__ import annotations

import asyncio
import contextlib
from collections import defaultdict
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import yaml
from fractus_core.api import Application
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.identity.authority import Authority
from fractus_operator.cluster import kinds
from fractus_operator.cluster.kinds import Body, Key, Kind
from fractus_operator.cluster.labels import CERTIFICATE_ANNOTATION
from fractus_operator.cluster.store import KubeError
from fractus_operator.inventory.subscriptions import Subscription
from fractus_operator.reconcile import builders, rollout
from fractus_operator.reconcile.rollout import Rollout

INPUT = yaml.safe_load((Path(__file__).parents[1] / "golden" / "operator" / "input.yaml").read_text())
APPLICATION = Application.from_body(INPUT["application"])
PLAN = DeploymentPlanSpec.model_validate(INPUT["plan"])
PLACED = PLAN.model_copy(update={"placements": PLAN.placements[:2], "drone": None})
NOW = datetime(2026, 6, 1, 12, 0, tzinfo=UTC)
AUTHORITY = Authority.generate(NOW)


class Pods(list[SimpleNamespace]):
    """The pods that the watch has shown."""

    def __init__(self) -> None:
        super().__init__()
        self.news = Subscription()

    def bound(self, *instances: str) -> None:
        """Show that these have a node now."""
        self += [
            SimpleNamespace(instance=instance, node="n1", ready=False, terminating=False, finished=False)
            for instance in instances
        ]
        self.news.wake()


def live() -> Any:
    pods = Pods()
    children: defaultdict[Kind, dict[Key, Body]] = defaultdict(dict)
    return SimpleNamespace(
        children=children,
        drone=lambda _name: None,
        fleet=SimpleNamespace(in_flight=lambda _plan: None),
        pods=pods,
        rules_revision=0,
        pods_of=lambda _key: pods,
        subscriptions=SimpleNamespace(subscribe=lambda _key: contextlib.nullcontext(pods.news)),
    )


async def test_only_what_is_urgent_ends_a_rest() -> None:
    news = Subscription()
    news.wake()
    assert await news.changed(20.0)
    resting = asyncio.create_task(news.rest(20.0))
    await turns()
    news.wake()
    await turns()
    assert not resting.done()
    news.wake(urgent=True)
    async with asyncio.timeout(10.0):
        await resting
    assert await news.changed(20.0)
    news.wake(urgent=True)
    assert await news.changed(20.0)
    async with asyncio.timeout(10.0):
        await news.rest(20.0)
    resting = asyncio.create_task(news.rest(20.0))
    await turns()
    assert not resting.done(), "an urgent change ends one rest"
    resting.cancel()
    await asyncio.gather(resting, return_exceptions=True)


class Recorder:
    """The children of an application, as the one that deploys asks for them."""

    def __init__(self, there: defaultdict[Kind, dict[Key, Body]]) -> None:
        self.there = there
        self.get = lambda kind, key: there[kind].get(key)
        self.said: list[str] = []
        self.secrets: list[tuple[str, str]] = []
        self.refused: Kind | None = None
        self.hanging: Kind | None = None
        self.gave_up = False
        self.granted = asyncio.Event()

    async def apply(self, _application: Application, wanted: dict[Kind, Any], *_: object) -> None:
        for _turn in range(5):
            await asyncio.sleep(0)
        if self.hanging in wanted:
            try:
                await asyncio.Event().wait()
            finally:
                self.gave_up = True
        self.said += [f"apply {kind.name}" for kind, bodies in wanted.items() if bodies]
        if kinds.GRANT in wanted:
            self.granted.set()
        if self.refused in wanted:
            raise KubeError(422, "Invalid", "no")
        for body in wanted.get(kinds.DEPLOYMENT, ()):
            self.there[kinds.DEPLOYMENT][kinds.key_of(body)] = body

    async def write_secret(self, _application: Application, instance: str, _body: Body, why: str) -> bool:
        if kinds.SECRET is self.refused:
            raise KubeError(503, "Unavailable", "no")
        self.said.append("write Secret")
        self.secrets.append((instance, why))
        return True

    async def change(self, kind: Kind, observed: Body, fields: Body) -> None:
        self.said.append(f"change {kind.name}")
        observed["metadata"]["annotations"] |= fields["metadata"]["annotations"]

    async def prune(self, *_: object, **_more: object) -> None:
        self.said.append("prune")


@dataclass
class Clock:
    """The time."""

    now: datetime = NOW


@dataclass
class Scene:
    """One application to deploy, with a Grant that is there and one that is new."""

    one: Rollout
    recorder: Recorder
    live: Any
    clock: Clock
    complete: bool | None = None

    async def deploy(self) -> None:
        async with asyncio.timeout(20.0):
            self.complete = await self.one.carry_out(APPLICATION, PLACED, cast(Any, ("there", "new")), (), 0)


@pytest.fixture
def scene(monkeypatch: pytest.MonkeyPatch) -> Scene:
    monkeypatch.setattr(builders, "grant", lambda _application, name: kinds.GRANT.header(name))
    monkeypatch.setattr(rollout, "_HEAD_START_S", 15.0)
    inventory = live()
    inventory.children[kinds.GRANT]["", "there"] = kinds.GRANT.header("there")
    recorder = Recorder(inventory.children)
    clock = Clock()
    one = Rollout(cast(Any, recorder), inventory, AUTHORITY, lambda: clock.now)
    return Scene(one, recorder, inventory, clock)


FIRST = ["apply DeploymentPlan", "prune", "apply Grant", "apply Deployment"]


async def turns() -> None:
    for _ in range(50):
        await asyncio.sleep(0)


async def test_what_no_pod_waits_for_is_made_once_every_pod_has_its_node(scene: Scene) -> None:
    under_way = asyncio.create_task(scene.deploy())
    await turns()
    scene.live.pods.bound(PLACED.placements[0].instance)
    await turns()
    assert scene.recorder.said == [*FIRST, "write Secret", "write Secret"]
    scene.live.pods.bound(*[PLACED.placements[1].instance] * PLACED.placements[1].replicas)
    await under_way
    assert scene.recorder.said[6:8] == ["apply Grant", "apply Service"]


async def test_pods_that_no_node_takes_hold_up_no_grant(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rollout, "_HEAD_START_S", 0.05)
    await scene.deploy()
    assert scene.recorder.said[4:7] == ["write Secret", "write Secret", "apply Grant"]


async def test_rules_that_change_meanwhile_are_in_the_grants_of_the_next_look(scene: Scene) -> None:
    under_way = asyncio.create_task(scene.deploy())
    await turns()
    scene.live.rules_revision += 1
    scene.live.pods.news.wake()
    await under_way
    assert scene.recorder.said.count("apply Grant") == 1
    assert "apply Service" in scene.recorder.said


async def test_rules_that_changed_since_grants_were_made_of_them_make_no_new_grant(scene: Scene) -> None:
    scene.live.rules_revision = 1
    await scene.deploy()
    assert scene.complete is False, "the next look comes at once"
    assert scene.recorder.said.count("apply Grant") == 1
    assert "apply Service" in scene.recorder.said


INSTANCES = [placed.instance for placed in PLACED.placements]


async def test_a_certificate_is_renewed_when_it_is_due_and_its_deployment_says_so(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rollout, "_HEAD_START_S", 0.05)
    await scene.deploy()
    assert sorted(scene.recorder.secrets) == sorted((instance, "new") for instance in INSTANCES)
    said = certificates(scene)
    await scene.deploy()
    assert len(scene.recorder.secrets) == len(INSTANCES), "it is good"
    scene.clock.now += timedelta(hours=17)
    await scene.one.renew_certificates(APPLICATION, PLACED, ())
    assert sorted(scene.recorder.secrets[len(INSTANCES) :]) == sorted((instance, "renewed") for instance in INSTANCES)
    assert not set(certificates(scene)) & set(said)
    scene.recorder.secrets.clear()
    await scene.one.renew_certificates(APPLICATION, PLACED, ())
    assert scene.recorder.secrets == []


async def test_a_secret_that_was_not_written_is_written_again_at_the_next_look(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its Deployment says that it is there."""
    monkeypatch.setattr(rollout, "_HEAD_START_S", 0.05)
    scene.recorder.refused = kinds.SECRET
    with pytest.raises(KubeError, match="no"):
        await scene.deploy()
    scene.recorder.refused = None
    await scene.deploy()
    assert sorted(scene.recorder.secrets) == sorted((instance, "new") for instance in INSTANCES)
    await scene.deploy()
    assert len(scene.recorder.secrets) == len(INSTANCES)


async def test_a_secret_that_someone_deleted_is_made_again_for_a_pod_that_waits_for_it(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rollout, "_HEAD_START_S", 0.05)
    await scene.deploy()
    scene.recorder.secrets.clear()
    scene.live.pods.bound(INSTANCES[0])
    for seconds, looked in ((59, 0), (61, 1), (90, 1), (182, 2)):
        scene.clock.now = NOW + timedelta(seconds=seconds)
        await scene.one.renew_certificates(APPLICATION, PLACED, scene.live.pods)
        assert scene.recorder.secrets == [(INSTANCES[0], "lost")] * looked
    scene.live.pods[0].ready = True
    await scene.one.renew_certificates(APPLICATION, PLACED, scene.live.pods)
    scene.live.pods[0].ready = False
    await scene.one.renew_certificates(APPLICATION, PLACED, scene.live.pods)
    assert len(scene.recorder.secrets) == 2


async def test_an_operator_that_begins_looks_for_the_secrets_of_pods_that_wait(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The one before it may have been killed between the Deployment and its Secret."""
    monkeypatch.setattr(rollout, "_HEAD_START_S", 0.05)
    await scene.deploy()
    scene.recorder.secrets.clear()
    scene.live.pods.bound(INSTANCES[0])
    begun = Rollout(cast(Any, scene.recorder), scene.live, AUTHORITY, lambda: NOW)
    await begun.renew_certificates(APPLICATION, PLACED, scene.live.pods)
    assert scene.recorder.secrets == [(INSTANCES[0], "lost")]


async def test_another_authority_renews_all(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rollout, "_HEAD_START_S", 0.05)
    await scene.deploy()
    scene.recorder.secrets.clear()
    begun = Rollout(cast(Any, scene.recorder), scene.live, Authority.generate(NOW), lambda: NOW)
    await begun.renew_certificates(APPLICATION, PLACED, ())
    assert sorted(scene.recorder.secrets) == sorted((instance, "renewed") for instance in INSTANCES)


def certificates(scene: Scene) -> list[str]:
    """What the Deployments say of their certificates."""
    there = scene.live.children[kinds.DEPLOYMENT].values()
    return [body["metadata"]["annotations"][CERTIFICATE_ANNOTATION] for body in there]


async def test_where_nothing_is_new_nothing_waits(scene: Scene) -> None:
    for placed in PLACED.placements:
        body = builders.deployment(APPLICATION, placed, None)
        scene.live.children[kinds.DEPLOYMENT][kinds.key_of(body)] = body
    await scene.deploy()
    assert scene.recorder.said.count("apply Grant") == 2
    assert scene.complete


@pytest.mark.parametrize(("refused", "grants"), [(kinds.DEPLOYMENT, 2), (kinds.SERVICE, 2), (kinds.DEPLOYMENT_PLAN, 0)])
async def test_a_refused_deployment_stops_no_grant_but_a_refused_plan_all(
    scene: Scene, refused: Kind, grants: int
) -> None:
    scene.recorder.refused = refused
    if refused is kinds.SERVICE:
        scene.live.pods.bound(*(p.instance for p in PLACED.placements for _ in range(p.replicas)))
    with pytest.raises(KubeError, match="no"):
        await scene.deploy()
    assert scene.recorder.said.count("apply Grant") == grants


async def test_deployments_that_hang_hold_up_no_grant(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rollout, "_HEAD_START_S", 0.05)
    scene.recorder.hanging = kinds.DEPLOYMENT
    stuck = asyncio.create_task(scene.deploy())
    async with asyncio.timeout(20.0):
        await scene.recorder.granted.wait()
    assert not stuck.done()
    stuck.cancel()
    with pytest.raises(asyncio.CancelledError):
        await stuck
    assert scene.recorder.gave_up, "nothing is written any more when the next look begins"


async def test_where_calls_lead_is_said_once_they_lead_anywhere(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rollout, "_HEAD_START_S", 0.05)
    component = next(c for c in APPLICATION.spec.components if c.placement == "hybrid")
    await scene.deploy()
    assert "apply EndpointSlice" not in scene.recorder.said
    empty = builders.endpoint_slice(APPLICATION, component, ())
    scene.live.children[kinds.ENDPOINT_SLICE][kinds.key_of(empty)] = empty
    await scene.deploy()
    assert scene.recorder.said.count("apply EndpointSlice") == 1, (
        "one that is there is told that it leads nowhere any more"
    )
