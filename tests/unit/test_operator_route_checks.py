"""Route checks of active plans: they run in a worker thread, and a result is valid for one plan and set of rules."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from typing import Any, cast

import pytest
from fractus_core.api import Application
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.planning.inventory import Inventory, Settings
from fractus_operator import route_check_cache
from fractus_operator.operator_metrics import ERRORS
from fractus_operator.route_check_cache import RouteCheckCache

KEY = ("ns", "a")
NOW = datetime(2026, 1, 1, tzinfo=UTC)


class FakeCheck:
    """Route check that waits until the test ends it."""

    def __init__(self) -> None:
        self.plans: list[DeploymentPlanSpec] = []
        self.threads: set[int] = set()
        self.go = threading.Event()

    def __call__(self, _application: Any, plan: DeploymentPlanSpec, *_: Any) -> DeploymentPlanSpec:
        self.plans.append(plan)
        self.threads.add(threading.get_ident())
        assert self.go.wait(20)
        return plan.model_copy(update={"application_generation": 99})


@pytest.fixture
def check(monkeypatch: pytest.MonkeyPatch) -> FakeCheck:
    fake = FakeCheck()
    monkeypatch.setattr(route_check_cache, "with_legality", fake)
    return fake


def plan() -> DeploymentPlanSpec:
    return DeploymentPlanSpec(application="a", application_generation=1, placements=())


class Scene:
    """RouteCheckCache with a fake clock and wake-up."""

    def __init__(self) -> None:
        self.now = NOW
        self.woken = asyncio.Event()
        self.checks = RouteCheckCache(lambda _: self.woken.set(), lambda: self.now)

    def lookup(self, plan: DeploymentPlanSpec, rules: int = 1, key: tuple[str, str] = KEY) -> DeploymentPlanSpec:
        application = cast(Application, None)
        return self.checks.checked(key, application, plan, rules=rules, inventory=Inventory(), settings=Settings())

    async def until(self, condition: Callable[[], bool]) -> None:
        async with asyncio.timeout(20.0):
            while not condition():  # noqa: ASYNC110 (no notification)
                await asyncio.sleep(0.001)


async def test_route_check_runs_in_a_thread_and_is_cached(check: FakeCheck) -> None:
    scene = Scene()
    present = plan()
    assert scene.lookup(present) is present
    assert scene.lookup(present) is present
    check.go.set()
    async with asyncio.timeout(20.0):
        await scene.woken.wait()
    assert check.plans == [present], "several lookups share one check"
    assert threading.get_ident() not in check.threads
    result = scene.lookup(present)
    assert result.application_generation == 99
    assert scene.lookup(result) is result
    assert len(check.plans) == 1
    scene.now += timedelta(minutes=2)
    await scene.until(lambda: bool(scene.lookup(result)) and len(check.plans) == 2)


async def test_route_check_of_other_rules_is_not_used(check: FakeCheck) -> None:
    scene = Scene()
    present = plan()
    check.go.set()
    scene.lookup(present, rules=1)
    async with asyncio.timeout(20.0):
        await scene.woken.wait()
    assert scene.lookup(present, rules=2) is present
    await scene.until(lambda: scene.lookup(present, rules=2) is not present)


async def test_route_check_does_not_replace_newer_plan(check: FakeCheck) -> None:
    scene = Scene()
    present = plan()
    newer = plan()
    scene.lookup(present)
    await scene.until(lambda: bool(check.plans))
    scene.checks.put(KEY, newer, 1)
    check.go.set()
    await scene.until(lambda: not scene.checks._running)
    assert not scene.woken.is_set()
    assert scene.lookup(newer) is newer
    assert len(check.plans) == 1


async def test_route_checks_run_one_at_a_time(check: FakeCheck) -> None:
    scene = Scene()
    for number in range(5):
        scene.lookup(plan(), key=("ns", str(number)))
    await scene.until(lambda: bool(check.plans))
    await asyncio.sleep(0)
    assert len(check.plans) == 1
    scene.checks.forget(("ns", "4"))
    check.go.set()
    await scene.until(lambda: not scene.checks._running)
    assert len(check.plans) == 4, "the route of a deleted Application is not checked"


async def test_failed_route_check_is_counted_and_cached(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def count() -> float:
        samples = [sample for metric in ERRORS.collect() for sample in metric.samples]
        labels = {"kind": "routes", "reason": "Bug"}
        return sum(sample.value for sample in samples if sample.name.endswith("_total") and sample.labels == labels)

    def broken(*_: Any) -> DeploymentPlanSpec:
        raise KeyError("an invalid zone")

    monkeypatch.setattr(route_check_cache, "with_legality", broken)
    scene = Scene()
    present = plan()
    before = count()
    for failures in (1, 1, 2):
        scene.now += timedelta(minutes=2) if failures == 2 else timedelta()
        assert scene.lookup(present) is present
        await scene.until(lambda: not scene.checks._running)
        assert count() == before + failures
    assert "an invalid zone" in caplog.text
    assert not scene.woken.is_set()
