"""Leader election by a Lease, with a fake clock and a fake API server."""

from __future__ import annotations

import asyncio
import copy
import time
from typing import Any, cast

import pytest
from fractus_runtime.kubernetes import (
    Body,
    Client,
    Conflict,
    Kind,
    KubeError,
    Lease,
    LeaseThread,
    LostLease,
    NotFound,
    key_of,
)
from fractus_runtime.kubernetes import leader_election as lease_module

DURATION_S = 10.0


class Shelf:
    """Fake API server with one Lease object and its resource version."""

    def __init__(self) -> None:
        self.body: Body | None = None
        self.reachable = True
        self.stalls = 0
        self.writes = 0

    async def get(self, kind: Kind, name: str, namespace: str = "") -> Body:
        self._reach()
        if self.stalls:
            self.stalls -= 1
            await asyncio.Event().wait()
        if self.body is None:
            raise NotFound(404, "NotFound", name)
        return copy.deepcopy(self.body)

    async def create(self, kind: Kind, body: Body) -> Body:
        self._reach()
        if self.body is not None:
            raise Conflict(409, "AlreadyExists", "")
        return self._put(body)

    async def replace(self, kind: Kind, body: Body) -> Body:
        self._reach()
        if self.body is None or body["metadata"].get("resourceVersion") != self.body["metadata"]["resourceVersion"]:
            raise Conflict(409, "Conflict", "")
        return self._put(body)

    def _reach(self) -> None:
        if not self.reachable:
            raise KubeError(0, "Unreachable", "no answer")

    def _put(self, body: Body) -> Body:
        assert key_of(body) == ("system", "fractus-operator")
        self.writes += 1
        self.body = copy.deepcopy(body)
        self.body["metadata"]["resourceVersion"] = str(self.writes)
        return self.body


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def lease(shelf: Shelf, clock: Clock, identity: str) -> Lease:
    return Lease(cast(Client, shelf), ("system", "fractus-operator"), identity, DURATION_S, clock)


async def step(*leases: Lease) -> None:
    """Let each candidate make one attempt, in order."""
    for candidate in leases:
        task = asyncio.create_task(candidate.run())
        for _ in range(6):
            await asyncio.sleep(0)
        if task.done():
            task.result()
        # End the task without a release of the Lease, like a killed process.
        one_release = candidate._release
        candidate._release = _nothing  # type: ignore[method-assign]
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        candidate._release = one_release  # type: ignore[method-assign]


async def _nothing() -> None:
    return


async def test_second_candidate_waits_for_lease_duration() -> None:
    shelf = Shelf()
    clock = Clock()
    first = lease(shelf, clock, "first")
    second = lease(shelf, clock, "second")
    await step(first, second)
    assert first.left_s > 0
    assert second.left_s == 0
    acted_until = clock.now + first.left_s
    clock.now += DURATION_S
    await step(second)
    assert second.left_s == 0
    clock.now += 0.1
    await step(second)
    assert second.left_s > 0
    # The first holder must have stopped acting long before the second one acts.
    assert acted_until < clock.now - 0.2 * DURATION_S
    assert first.left_s == 0


async def test_renewed_lease_excludes_other_candidates() -> None:
    shelf = Shelf()
    clock = Clock()
    first = lease(shelf, clock, "first")
    second = lease(shelf, clock, "second")
    for _ in range(20):
        await step(first, second)
        assert first.left_s > 0.5 * DURATION_S
        assert second.left_s == 0
        clock.now += 0.2 * DURATION_S


async def test_frozen_holder_loses_lease() -> None:
    shelf = Shelf()
    clock = Clock()
    first = lease(shelf, clock, "first")
    second = lease(shelf, clock, "second")
    await step(first, second)
    clock.now += DURATION_S + 1
    await step(second)
    assert first.left_s == 0
    with pytest.raises(LostLease, match="second has acted"):
        await step(first)


async def test_holder_gives_up_lease_that_was_restored_from_backup() -> None:
    """A Lease from an older backup has a lower version.

    The holder must give up, because its watches would wait for versions that do not exist yet.
    """
    shelf = Shelf()
    clock = Clock()
    only = lease(shelf, clock, "only")
    await step(only)
    backup = copy.deepcopy(shelf.body)
    writes = shelf.writes
    for _ in range(3):
        await step(only)
    shelf.body = backup
    shelf.writes = writes
    with pytest.raises(LostLease, match="went back from 4 to 1, as after a restore"):
        await step(only)
    again = lease(shelf, clock, "again")
    await step(again)
    clock.now += DURATION_S + 1
    await step(again)
    assert again.left_s > 0


async def test_lease_ends_while_api_server_is_unreachable() -> None:
    shelf = Shelf()
    clock = Clock()
    only = lease(shelf, clock, "only")
    await step(only)
    shelf.reachable = False
    clock.now += DURATION_S
    await step(only)
    assert only.left_s == 0
    shelf.reachable = True
    await step(only)
    assert only.left_s > 0


async def test_restarted_holder_continues_at_once() -> None:
    shelf = Shelf()
    clock = Clock()
    await step(lease(shelf, clock, "pod"))
    again = lease(shelf, clock, "pod")
    await step(again)
    assert again.left_s > 0


async def test_released_lease_is_free_at_once() -> None:
    shelf = Shelf()
    clock = Clock()
    first = lease(shelf, clock, "first")
    second = lease(shelf, clock, "second")
    task = asyncio.create_task(first.run())
    await asyncio.wait_for(first.held(), 5.0)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    assert first.left_s == 0
    await step(second)
    assert second.left_s > 0


async def test_one_of_two_concurrent_candidates_gets_lease() -> None:
    shelf = Shelf()
    clock = Clock()
    racers = [lease(shelf, clock, f"r{i}") for i in range(5)]
    tasks: list[asyncio.Task[Any]] = [asyncio.create_task(racer.run()) for racer in racers]
    for _ in range(20):
        await asyncio.sleep(0)
    assert sum(racer.left_s > 0 for racer in racers) == 1
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


async def test_stalled_renewal_leaves_time_for_retry() -> None:
    shelf = Shelf()
    shelf.stalls = 2
    short = Lease(cast(Client, shelf), ("system", "fractus-operator"), "short", 0.1, asyncio.get_running_loop().time)
    task = asyncio.create_task(short.run())
    await asyncio.wait_for(short.held(), 10.0)
    assert shelf.stalls == 0
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


@pytest.mark.parametrize("failure", [KubeError(500, "InternalError", "not now"), TimeoutError()])
async def test_failed_renewal_leaves_time_for_retry(monkeypatch: pytest.MonkeyPatch, failure: Exception) -> None:
    shelf = Shelf()
    clock = Clock()
    pauses: list[float] = []
    done = asyncio.Event()
    failing = False

    async def sleep(pause_s: float) -> None:
        nonlocal failing
        pauses.append(pause_s)
        failing = len(pauses) == 1
        if len(pauses) == 3:
            done.set()
            await asyncio.Event().wait()

    answer = shelf.get

    async def get(kind: Kind, name: str, namespace: str = "") -> Body:
        if failing:
            raise failure
        return await answer(kind, name, namespace)

    monkeypatch.setattr(shelf, "get", get)
    monkeypatch.setattr(lease_module.asyncio, "sleep", sleep)
    only = lease(shelf, clock, "only")
    task = asyncio.create_task(only.run())
    async with asyncio.timeout(10.0):
        await done.wait()
    assert pauses == [DURATION_S / 5, DURATION_S / 20, DURATION_S / 5]
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


async def test_renewal_without_response_is_released() -> None:
    shelf = Shelf()
    clock = Clock()
    first = lease(shelf, clock, "first")
    second = lease(shelf, clock, "second")
    await step(first)
    clock.now += DURATION_S
    assert first.left_s == 0
    await first._release()
    await step(second)
    assert second.left_s > 0
    writes = shelf.writes
    await first._release()
    assert shelf.writes == writes, "the first candidate does not release the Lease of the second one"


class _Closable(Shelf):
    closed = False

    async def aclose(self) -> None:
        self.closed = True


def _lease_thread(shelf: _Closable, identity: str, duration_s: float) -> LeaseThread:
    async def connect() -> Client:
        return cast(Client, shelf)

    return LeaseThread(connect, ("system", "fractus-operator"), identity, duration_s, time.monotonic)


async def test_busy_event_loop_keeps_lease() -> None:
    shelf = _Closable()
    lease_thread = _lease_thread(shelf, "busy", 1.0)
    task = asyncio.create_task(lease_thread.run())
    async with asyncio.timeout(20.0):
        await lease_thread.held()
    end = time.monotonic() + 1.5
    while time.monotonic() < end:
        sum(range(1000))
    assert lease_thread.left_s > 0
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    assert lease_thread.left_s == 0
    assert shelf.body is not None
    assert shelf.body["spec"]["holderIdentity"] == "", "the Lease is released"
    assert shelf.closed


async def test_taken_lease_ends_lease_thread() -> None:
    shelf = _Closable()
    lease_thread = _lease_thread(shelf, "first", 0.5)
    task = asyncio.create_task(lease_thread.run())
    async with asyncio.timeout(20.0):
        await lease_thread.held()
        assert shelf.body is not None
        shelf.body["spec"] |= {"holderIdentity": "second", "leaseTransitions": 7}
        with pytest.raises(LostLease, match="second has acted"):
            await task
    assert lease_thread.left_s <= 0.5


async def test_lease_thread_cancelled_at_once_ends() -> None:
    task = asyncio.create_task(_lease_thread(_Closable(), "short", 1.0).run())
    await asyncio.sleep(0)
    task.cancel()
    async with asyncio.timeout(20.0):
        await asyncio.gather(task, return_exceptions=True)
    assert task.cancelled()


async def test_lease_thread_without_lease_has_no_time_left() -> None:
    shelf = _Closable()
    await step(lease(shelf, Clock(), "first"))
    shelf.stalls = 1
    second = _lease_thread(shelf, "second", 60.0)
    task = asyncio.create_task(second.run())
    async with asyncio.timeout(20.0):
        while shelf.stalls:  # noqa: ASYNC110 (no notification)
            await asyncio.sleep(0.01)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    await asyncio.sleep(0)
    assert not second._acquired.is_set()
