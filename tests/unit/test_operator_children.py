"""How the operator makes what an application needs: what waits for what, on an API server of the test's own."""

from __future__ import annotations

import asyncio
from collections import defaultdict
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import yaml
from fractus_core.api import Application
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_operator import kinds
from fractus_operator.children import Children
from fractus_operator.deployments import Deployments
from fractus_operator.kinds import Body, Key, Kind
from fractus_operator.store import StoreError

INPUT = yaml.safe_load((Path(__file__).parents[1] / "golden" / "operator" / "input.yaml").read_text())
APPLICATION = Application.from_body(INPUT["application"])
PLAN = DeploymentPlanSpec.model_validate(INPUT["plan"])

NOW = datetime(2026, 6, 1, 12, 0, tzinfo=UTC)


class Copy(dict[Key, Body]):
    """What the watch showed of a kind: nothing."""

    def note(self, key: Key, body: Body) -> None:
        """Nothing is remembered."""


def live() -> Any:
    return SimpleNamespace(children=defaultdict(Copy), children_of=lambda *_: [])


class Webhooks:
    """An API server that never answers writes of one kind."""

    def __init__(self, hanging: Kind) -> None:
        self.hanging = hanging
        self.hangs = 0
        self.full = asyncio.Event()
        self.applied: list[Kind] = []

    async def create(self, kind: Kind, body: Body) -> Body:
        if kind is self.hanging:
            self.hangs += 1
            if self.hangs == 2:
                self.full.set()
            await asyncio.Event().wait()
        self.applied.append(kind)
        return body


async def test_secrets_that_hang_hold_up_neither_plans_nor_grants() -> None:
    store = Webhooks(kinds.SECRET)
    grantor = SimpleNamespace(signed=lambda body: body)
    children = Children(cast(Any, store), live(), cast(Any, grantor))
    secrets = [kinds.SECRET.header(f"s{i}", "city") for i in range(5)]
    stuck = asyncio.create_task(children.apply(APPLICATION, {kinds.SECRET: secrets}))
    async with asyncio.timeout(10.0):
        await store.full.wait()
    wanted = {kind: [kind.header("other", "city")] for kind in (kinds.DEPLOYMENT_PLAN, kinds.GRANT)}
    async with asyncio.timeout(10.0):
        await children.apply(APPLICATION, wanted)
    assert store.applied == [kinds.DEPLOYMENT_PLAN, kinds.GRANT]
    stuck.cancel()
    await asyncio.gather(stuck, return_exceptions=True)


class Recorder:
    """The children of an application, as the one that deploys asks for them."""

    def __init__(self) -> None:
        self.said: list[str] = []
        self.refused: Kind | None = None

    async def apply(self, _application: Application, wanted: dict[Kind, Any], *_: object) -> None:
        for _turn in range(5):
            await asyncio.sleep(0)
        self.said += [f"apply {kind.name}" for kind in wanted]
        if self.refused in wanted:
            raise StoreError(422, "Invalid", "no")

    async def prune(self, *_: object, **_more: object) -> None:
        self.said.append("prune")


def deployer() -> tuple[Deployments, Recorder]:
    inventory = live()
    inventory.drones = {}
    authority = SimpleNamespace(certificate=SimpleNamespace(not_valid_before_utc=NOW))
    one = Deployments(cast(Any, None), inventory, cast(Any, authority), lambda: NOW)
    recorder = Recorder()
    one._children = cast(Any, recorder)
    return one, recorder


async def test_the_plan_is_written_before_anything_is_removed() -> None:
    one, recorder = deployer()
    decided = PLAN.model_copy(update={"placements": (), "drone": None})
    await one._deploy(APPLICATION, decided, (), ())
    assert recorder.said[:2] == ["apply DeploymentPlan", "prune"]


async def test_what_schedules_pods_comes_before_all_that_they_wait_for() -> None:
    one, recorder = deployer()
    decided = PLAN.model_copy(update={"placements": (), "drone": None})
    await one._deploy(APPLICATION, decided, (), ())
    assert recorder.said[2:4] == ["apply Deployment", "apply Grant"]


async def test_a_deployment_that_is_refused_stops_no_grant() -> None:
    one, recorder = deployer()
    recorder.refused = kinds.DEPLOYMENT
    decided = PLAN.model_copy(update={"placements": (), "drone": None})
    with pytest.raises(StoreError, match="no"):
        await one._deploy(APPLICATION, decided, (), ())
    assert recorder.said[2:4] == ["apply Deployment", "apply Grant"]


async def test_nothing_else_is_written_without_the_plan() -> None:
    one, recorder = deployer()
    recorder.refused = kinds.DEPLOYMENT_PLAN
    decided = PLAN.model_copy(update={"placements": (), "drone": None})
    with pytest.raises(StoreError, match="no"):
        await one._deploy(APPLICATION, decided, (), ())
    assert recorder.said == ["apply DeploymentPlan"]
