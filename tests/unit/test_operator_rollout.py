"""Rollout: the order in which the child objects of an Application are applied, and the renewal of certificates."""

from __future__ import annotations

import asyncio
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
from fractus_operator import kinds
from fractus_operator.kinds import Body, Key, Kind
from fractus_operator.labels import CERTIFICATE_ANNOTATION, INSTANCE_LABEL
from fractus_operator.resources import children
from fractus_operator.rollout import Rollout
from fractus_operator.store import KubeError
from fractus_operator.work_queue import Subscription

INPUT = yaml.safe_load((Path(__file__).parents[1] / "golden" / "operator" / "input.yaml").read_text())
APPLICATION = Application.from_body(INPUT["application"])
PLAN = DeploymentPlanSpec.model_validate(INPUT["plan"])
PLACED = PLAN.model_copy(update={"placements": PLAN.placements[:2], "drone": None})
INSTANCES = [placed.instance for placed in PLACED.placements]
NOW = datetime(2026, 6, 1, 12, 0, tzinfo=UTC)
AUTHORITY = Authority.generate(NOW)


def pod(instance: str, *, ready: bool = False) -> Any:
    return SimpleNamespace(
        instance=instance, node="n1", ready=ready, terminating=False, finished=False, takes_calls=False
    )


async def test_subscription_pause_ends_only_with_urgent_change() -> None:
    inputs = Subscription()
    inputs.wake()
    waiting = asyncio.create_task(inputs.changed(20.0, pause_s=20.0))
    await turns()
    inputs.wake()
    await turns()
    assert not waiting.done()
    inputs.wake(urgent=True)
    async with asyncio.timeout(10.0):
        assert await waiting
    inputs.wake(urgent=True)
    async with asyncio.timeout(10.0):
        assert await inputs.changed(20.0, pause_s=20.0)
    inputs.wake()
    waiting = asyncio.create_task(inputs.changed(20.0, pause_s=20.0))
    await turns()
    assert not waiting.done(), "an urgent change ends only the current pause"
    waiting.cancel()
    await asyncio.gather(waiting, return_exceptions=True)


class FakeObjects:
    """Fake child objects in memory. All requests are recorded in order."""

    def __init__(self, cache: Any) -> None:
        self.cache = cache
        self.requests: list[str] = []
        self.secrets: list[tuple[str, str]] = []
        self.refused: Kind | None = None
        self.hanging: Kind | None = None
        self.cancelled = False
        self.taken: set[Key] = set()
        """Secrets that exist already."""

    def get(self, kind: Kind, key: Key) -> Body | None:
        return self.cache.children[kind].get(key)

    async def apply(self, _application: Application, desired: dict[Kind, Any]) -> None:
        failed = False
        for kind, bodies in desired.items():
            await asyncio.sleep(0)
            if kind is self.hanging:
                try:
                    await asyncio.Event().wait()
                finally:
                    self.cancelled = True
            self.requests += [f"apply {kind.name}" for _ in bodies]
            if kind is self.refused:
                failed = True
                continue
            for body in bodies:
                self.cache.children[kind][kinds.key_of(body)] = body
        if failed:
            raise KubeError(422, "Invalid", "no")

    async def create_secret(self, body: Body) -> bool:
        if kinds.SECRET is self.refused or kinds.key_of(body) in self.taken:
            return False
        self.requests.append("create Secret")
        self.secrets.append((body["metadata"]["labels"][INSTANCE_LABEL], "new"))
        return True

    async def write_secret(self, _application: Application, instance: str, _body: Body, why: str) -> bool:
        if kinds.SECRET is self.refused:
            raise KubeError(503, "Unavailable", "no")
        self.requests.append("write Secret")
        self.secrets.append((instance, why))
        return True

    async def change(self, kind: Kind, observed: Body, fields: Body) -> None:
        self.requests.append(f"change {kind.name}")
        observed["metadata"]["annotations"] |= fields["metadata"]["annotations"]

    async def prune(self, *_: object) -> None:
        self.requests.append("prune")


@dataclass
class Clock:
    """Return the current time of the test."""

    now: datetime = NOW


@dataclass
class Scene:
    """Rollout of one Application with an existing Grant and a new Grant."""

    rollout: Rollout
    objects: FakeObjects
    cache: Any
    clock: Clock
    complete: bool | None = None

    async def apply(self) -> None:
        async with asyncio.timeout(20.0):
            self.complete = await self.rollout.apply(APPLICATION, PLACED, cast(Any, ("present", "new")), (), 0)

    def certificates(self) -> list[str]:
        """Return the certificate annotations of the Deployments."""
        deployments = self.cache.children[kinds.DEPLOYMENT].values()
        return [body["metadata"]["annotations"][CERTIFICATE_ANNOTATION] for body in deployments]


@pytest.fixture
def scene(monkeypatch: pytest.MonkeyPatch) -> Scene:
    monkeypatch.setattr(children, "grant", lambda _application, name: kinds.GRANT.header(name))
    stored: defaultdict[Kind, dict[Key, Body]] = defaultdict(dict)
    stored[kinds.GRANT]["", "present"] = kinds.GRANT.header("present")
    cache = SimpleNamespace(
        children=stored,
        drone=lambda _name: None,
        fleet=SimpleNamespace(drone_in_flight=lambda _plan: None),
        rules_revision=0,
    )
    objects = FakeObjects(cache)
    clock = Clock()
    rollout = Rollout(cast(Any, objects), cast(Any, cache), AUTHORITY, lambda: clock.now, "gateway:1")
    return Scene(rollout, objects, cache, clock)


async def turns() -> None:
    for _ in range(50):
        await asyncio.sleep(0)


async def test_rollout_applies_plan_grants_secrets_deployments_and_the_rest_in_order(scene: Scene) -> None:
    """A pod whose Secret does not exist yet would report FailedMount."""
    await scene.apply()
    assert scene.objects.requests[:8] == [
        "apply DeploymentPlan",
        "prune",
        "apply Grant",
        "apply Grant",
        "create Secret",
        "create Secret",
        "apply Deployment",
        "apply Deployment",
    ]
    assert scene.objects.requests[8] == "apply Service"
    assert scene.complete


async def test_existing_secret_is_replaced_only_after_its_deployment_exists(scene: Scene) -> None:
    """The Secret may belong to a user, like a Deployment of the same name."""
    scene.objects.taken.add((APPLICATION.key[0], f"{INSTANCES[0]}-tls"))
    await scene.apply()
    assert scene.objects.requests[4:8] == ["create Secret", "apply Deployment", "apply Deployment", "write Secret"]
    assert sorted(scene.objects.secrets) == sorted((instance, "new") for instance in INSTANCES)


async def test_rollout_creates_no_grant_when_rules_changed(scene: Scene) -> None:
    scene.cache.rules_revision = 1
    await scene.apply()
    assert scene.complete is False, "the rollout is incomplete, so that the Grants are compiled again at once"
    assert scene.objects.requests.count("apply Grant") == 1
    assert ("", "new") not in scene.cache.children[kinds.GRANT]
    assert "apply Service" in scene.objects.requests


async def test_certificate_is_renewed_when_due_and_annotated(scene: Scene) -> None:
    await scene.apply()
    assert sorted(scene.objects.secrets) == sorted((instance, "new") for instance in INSTANCES)
    before = scene.certificates()
    await scene.apply()
    assert len(scene.objects.secrets) == len(INSTANCES), "valid certificates are not renewed"
    scene.clock.now += timedelta(hours=17)
    await scene.rollout.renew_certificates(APPLICATION, PLACED, ())
    renewed = sorted((instance, "renewed") for instance in INSTANCES)
    assert sorted(scene.objects.secrets[len(INSTANCES) :]) == renewed
    assert not set(scene.certificates()) & set(before)
    scene.objects.secrets.clear()
    await scene.rollout.renew_certificates(APPLICATION, PLACED, ())
    assert scene.objects.secrets == []


async def test_secret_is_written_again_after_failed_write(scene: Scene) -> None:
    """The annotation of the Deployment already names the new certificate, but the write of the Secret failed."""
    scene.objects.refused = kinds.SECRET
    with pytest.raises(KubeError, match="no"):
        await scene.apply()
    scene.objects.refused = None
    await scene.apply()
    assert sorted(scene.objects.secrets) == sorted((instance, "new") for instance in INSTANCES)
    await scene.apply()
    assert len(scene.objects.secrets) == len(INSTANCES)


async def test_deleted_secret_is_written_again_for_pod_that_is_not_ready(scene: Scene) -> None:
    await scene.apply()
    scene.objects.secrets.clear()
    pods = [pod(INSTANCES[0])]
    for seconds, writes in ((59, 0), (61, 1), (90, 1), (182, 2)):
        scene.clock.now = NOW + timedelta(seconds=seconds)
        await scene.rollout.renew_certificates(APPLICATION, PLACED, pods)
        assert scene.objects.secrets == [(INSTANCES[0], "lost")] * writes
    pods[0].ready = True
    await scene.rollout.renew_certificates(APPLICATION, PLACED, pods)
    pods[0].ready = False
    await scene.rollout.renew_certificates(APPLICATION, PLACED, pods)
    assert len(scene.objects.secrets) == 2


async def test_restarted_operator_writes_secrets_of_pods_that_are_not_ready(scene: Scene) -> None:
    """The previous operator may have been killed between the Deployment and its Secret."""
    await scene.apply()
    scene.objects.secrets.clear()
    restarted = Rollout(cast(Any, scene.objects), scene.cache, AUTHORITY, lambda: NOW, "gateway:1")
    await restarted.renew_certificates(APPLICATION, PLACED, [pod(INSTANCES[0])])
    assert scene.objects.secrets == [(INSTANCES[0], "lost")]


async def test_new_authority_renews_all_certificates(scene: Scene) -> None:
    await scene.apply()
    scene.objects.secrets.clear()
    restarted = Rollout(cast(Any, scene.objects), scene.cache, Authority.generate(NOW), lambda: NOW, "gateway:1")
    await restarted.renew_certificates(APPLICATION, PLACED, ())
    assert sorted(scene.objects.secrets) == sorted((instance, "renewed") for instance in INSTANCES)


@pytest.mark.parametrize(("refused", "grants"), [(kinds.DEPLOYMENT, 2), (kinds.SERVICE, 2), (kinds.DEPLOYMENT_PLAN, 0)])
async def test_grants_are_applied_despite_refused_object_unless_it_is_the_plan(
    scene: Scene, refused: Kind, grants: int
) -> None:
    scene.objects.refused = refused
    with pytest.raises(KubeError, match="no"):
        await scene.apply()
    assert scene.objects.requests.count("apply Grant") == grants


async def test_secret_of_refused_deployment_replaces_no_existing_secret(scene: Scene) -> None:
    """The Deployment is refused, for example because its name is taken. The name of the Secret may be taken, too."""
    scene.objects.refused = kinds.DEPLOYMENT
    scene.objects.taken.add((APPLICATION.key[0], f"{INSTANCES[0]}-tls"))
    for _ in range(2):
        with pytest.raises(KubeError, match="no"):
            await scene.apply()
    assert "write Secret" not in scene.objects.requests
    assert (INSTANCES[0], "new") not in scene.objects.secrets
    assert "apply Service" in scene.objects.requests, "the refusal does not stop later steps"


async def test_hanging_deployments_delay_no_grant(scene: Scene) -> None:
    scene.objects.hanging = kinds.DEPLOYMENT
    stuck = asyncio.create_task(scene.apply())
    await turns()
    assert scene.objects.requests.count("apply Grant") == 2
    assert not stuck.done()
    stuck.cancel()
    with pytest.raises(asyncio.CancelledError):
        await stuck
    assert scene.objects.cancelled, "hanging writes are cancelled before the next reconciliation begins"
