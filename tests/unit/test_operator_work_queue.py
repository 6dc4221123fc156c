"""The work queue reconciles each key once, and retries failures."""

from __future__ import annotations

import asyncio

import pytest
from fractus_operator import work_queue as work_queue_module
from fractus_operator.kinds import Key
from fractus_operator.work_queue import WorkQueue, run_periodically
from fractus_runtime.kubernetes import KubeError


async def test_unexpected_failure_does_not_stop_queue(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(work_queue_module, "_FIRST_RETRY_S", 0.001)
    attempts: list[Key] = []
    done = asyncio.Event()

    async def reconcile(key: Key) -> None:
        attempts.append(key)
        if key == ("", "bad") and attempts.count(key) == 1:
            raise KeyError("spec")
        if ("", "good") in attempts and attempts.count(("", "bad")) == 2:
            done.set()

    work_queue = WorkQueue("test", reconcile)
    work_queue.add(("", "bad"))
    work_queue.add(("", "good"))
    task = asyncio.create_task(work_queue.run())
    async with asyncio.timeout(5):
        await done.wait()
    task.cancel()


async def test_key_is_reconciled_once_for_many_changes() -> None:
    reconciled: list[Key] = []
    done = asyncio.Event()

    async def reconcile(key: Key) -> None:
        reconciled.append(key)
        if key == ("", "last"):
            done.set()

    work_queue = WorkQueue("test", reconcile)
    for _ in range(5):
        work_queue.add(("", "a"))
    work_queue.add(("", "last"))
    task = asyncio.create_task(work_queue.run())
    async with asyncio.timeout(5):
        await done.wait()
    task.cancel()
    assert reconciled == [("", "a"), ("", "last")]


async def test_keys_that_can_wait_neither_delay_other_keys_nor_block_the_event_loop() -> None:
    reconciled: list[Key] = []
    begun = asyncio.Event()
    new = asyncio.Event()

    async def reconcile(key: Key) -> None:
        reconciled.append(key)
        if len(reconciled) == 10:
            begun.set()
        if key == ("", "new"):
            new.set()

    work_queue = WorkQueue("test", reconcile)
    for number in range(100):
        work_queue.add(("", f"later-{number}"), can_wait=True)
    task = asyncio.create_task(work_queue.run())
    async with asyncio.timeout(5):
        await begun.wait()
    work_queue.add(("", "later-99"))
    work_queue.add(("", "new"))
    before = len(reconciled)
    assert before < 50
    async with asyncio.timeout(5):
        await new.wait()
    assert reconciled[before:] == [("", "later-99"), ("", "new")]
    task.cancel()


async def test_new_key_does_not_wait_as_long_as_a_slow_attempt_took() -> None:
    times_s: dict[Key, float] = {}
    new = asyncio.Event()

    async def reconcile(key: Key) -> None:
        await asyncio.sleep(1.0 if key == ("", "slow") else 0)
        times_s[key] = asyncio.get_running_loop().time()
        if key == ("", "new"):
            new.set()

    work_queue = WorkQueue("test", reconcile)
    work_queue.add(("", "slow"), can_wait=True)
    task = asyncio.create_task(work_queue.run())
    await asyncio.sleep(0.1)
    work_queue.add(("", "new"))
    async with asyncio.timeout(10):
        await new.wait()
    task.cancel()
    assert times_s["", "new"] - times_s["", "slow"] < 0.8


async def test_event_loop_runs_between_attempts_that_do_not_wait() -> None:
    reconciled: list[Key] = []

    async def reconcile(key: Key) -> None:
        reconciled.append(key)

    work_queue = WorkQueue("test", reconcile)
    for number in range(100):
        work_queue.add(("", str(number)))
    task = asyncio.create_task(work_queue.run())
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    assert len(reconciled) < 100
    task.cancel()


async def test_change_during_reconcile_is_not_lost() -> None:
    reconciled: list[int] = []
    done = asyncio.Event()
    value = 1

    async def reconcile(key: Key) -> None:
        nonlocal value
        reconciled.append(value)
        if value == 1:
            value = 2
            work_queue.add(key)
            await asyncio.sleep(0)
        else:
            done.set()

    work_queue = WorkQueue("test", reconcile)
    work_queue.add(("", "a"))
    task = asyncio.create_task(work_queue.run())
    async with asyncio.timeout(5):
        await done.wait()
    task.cancel()
    assert reconciled == [1, 2]


async def test_failed_key_is_retried_and_delays_no_other_key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(work_queue_module, "_FIRST_RETRY_S", 0.001)
    attempts: dict[Key, int] = {}
    done = asyncio.Event()

    async def reconcile(key: Key) -> None:
        attempts[key] = attempts.get(key, 0) + 1
        if key == ("", "bad") and attempts[key] < 4:
            raise KubeError(500, "InternalError", "not now")
        if key == ("", "bad"):
            done.set()

    work_queue = WorkQueue("test", reconcile)
    work_queue.add(("", "bad"))
    work_queue.add(("", "good"))
    task = asyncio.create_task(work_queue.run())
    async with asyncio.timeout(5):
        await done.wait()
        await asyncio.sleep(0)
    task.cancel()
    assert attempts == {("", "bad"): 4, ("", "good"): 1}
    assert work_queue.failures == {}


@pytest.mark.parametrize("failure", [ValueError("no time"), KubeError(500, "InternalError", "not now")])
async def test_failed_step_is_repeated(failure: Exception, caplog: pytest.LogCaptureFixture) -> None:
    steps: list[int] = []
    done = asyncio.Event()

    async def step() -> None:
        steps.append(1)
        if len(steps) == 1:
            raise failure
        done.set()

    task = asyncio.create_task(run_periodically("test", step, 0.001))
    async with asyncio.timeout(5):
        await asyncio.wait((task, asyncio.ensure_future(done.wait())), return_when=asyncio.FIRST_COMPLETED)
    assert not task.done()
    task.cancel()
    assert ("Traceback" in caplog.text) == isinstance(failure, ValueError)
