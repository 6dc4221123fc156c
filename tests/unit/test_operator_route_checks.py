"""Route checks of active plans run in a worker thread, and apply only to the plan and rules that they were made for."""

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
from fractus_operator.metrics import ERRORS
from fractus_operator.route_check_cache import RouteCheckCache

KEY = ("ns", "a")
NOW = datetime(2026, 1, 1, tzinfo=UTC)


class Judge:
    """Stands for what judges a way: it takes as long as the test wants."""

    def __init__(self) -> None:
        self.asked: list[DeploymentPlanSpec] = []
        self.threads: set[int] = set()
        self.go = threading.Event()

    def __call__(self, _application: Any, plan: DeploymentPlanSpec, *_: Any) -> DeploymentPlanSpec:
        self.asked.append(plan)
        self.threads.add(threading.get_ident())
        assert self.go.wait(20)
        return plan.model_copy(update={"application_generation": 99})


@pytest.fixture
def judge(monkeypatch: pytest.MonkeyPatch) -> Judge:
    found = Judge()
    monkeypatch.setattr(route_check_cache, "with_legality", found)
    return found


def plan() -> DeploymentPlanSpec:
    return DeploymentPlanSpec(application="a", application_generation=1, placements=())


class Notes:
    """Notes with a clock and a wake-up of the test's own."""

    def __init__(self) -> None:
        self.now = NOW
        self.woken = asyncio.Event()
        self.notes = RouteCheckCache(lambda _: self.woken.set(), lambda: self.now)

    def ask(self, plan: DeploymentPlanSpec, rules: int = 1, key: tuple[str, str] = KEY) -> DeploymentPlanSpec:
        application = cast(Application, None)
        return self.notes.checked(key, application, plan, rules=rules, inventory=Inventory(), settings=Settings())

    async def until(self, told: Callable[[], bool]) -> None:
        async with asyncio.timeout(20.0):
            while not told():  # noqa: ASYNC110 (nothing tells when)
                await asyncio.sleep(0.001)


async def test_route_check_runs_in_a_thread_and_is_cached(judge: Judge) -> None:
    notes, present = Notes(), plan()
    assert notes.ask(present) is present
    assert notes.ask(present) is present
    judge.go.set()
    async with asyncio.timeout(20.0):
        await notes.woken.wait()
    assert judge.asked == [present], "once, however often it is asked for"
    assert threading.get_ident() not in judge.threads
    noted = notes.ask(present)
    assert noted.application_generation == 99
    assert notes.ask(noted) is noted
    assert len(judge.asked) == 1
    notes.now += timedelta(minutes=2)
    await notes.until(lambda: bool(notes.ask(noted)) and len(judge.asked) == 2)


async def test_route_check_of_other_rules_is_not_used(judge: Judge) -> None:
    notes, present = Notes(), plan()
    judge.go.set()
    notes.ask(present, rules=1)
    async with asyncio.timeout(20.0):
        await notes.woken.wait()
    assert notes.ask(present, rules=2) is present
    await notes.until(lambda: notes.ask(present, rules=2) is not present)


async def test_route_check_does_not_replace_newer_plan(judge: Judge) -> None:
    notes, present, newer = Notes(), plan(), plan()
    notes.ask(present)
    await notes.until(lambda: bool(judge.asked))
    notes.notes.put(KEY, newer, 1)
    judge.go.set()
    await notes.until(lambda: not notes.notes._running)
    assert not notes.woken.is_set()
    assert notes.ask(newer) is newer
    assert len(judge.asked) == 1


async def test_route_checks_run_one_at_a_time(judge: Judge) -> None:
    notes = Notes()
    for number in range(5):
        notes.ask(plan(), key=("ns", str(number)))
    await notes.until(lambda: bool(judge.asked))
    await asyncio.sleep(0)
    assert len(judge.asked) == 1
    notes.notes.forget(("ns", "4"))
    judge.go.set()
    await notes.until(lambda: not notes.notes._running)
    assert len(judge.asked) == 4, "one that is gone is not judged"


async def test_failed_route_check_is_counted_and_cached(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def count() -> float:
        return ERRORS.counted("routes", "Bug")

    def broken(*_: Any) -> DeploymentPlanSpec:
        raise KeyError("a zone that is none")

    monkeypatch.setattr(route_check_cache, "with_legality", broken)
    notes, present, before = Notes(), plan(), count()
    for failures in (1, 1, 2):
        notes.now += timedelta(minutes=2) if failures == 2 else timedelta()
        assert notes.ask(present) is present
        await notes.until(lambda: not notes.notes._running)
        assert count() == before + failures
    assert "a zone that is none" in caplog.text
    assert not notes.woken.is_set()
