"""The informer with a scripted API server: broken watches, expiry and retries."""

from __future__ import annotations

import asyncio
import itertools
import random
from collections.abc import AsyncIterator
from typing import Any

import pytest
from fractus_runtime.kubernetes import Body, Expired, Informer, Key, Kind, KubeError, Page
from fractus_runtime.kubernetes import informer as informer_module

POLICY = Kind("fractus.dev/v1alpha1", "Policy", "policies", namespaced=False)
ZONE = Kind("fractus.dev/v1alpha1", "Zone", "zones", namespaced=False)


def zone(name: str, version: int, value: int = 0) -> Body:
    return {"metadata": {"name": name, "resourceVersion": str(version)}, "value": value}


class Script:
    """Fake client. It returns the scripted lists and watches in order, and then waits forever."""

    def __init__(self, *steps: Any) -> None:
        self.steps = list(steps)
        self.calls: list[str] = []
        self.done = asyncio.Event()

    async def list_page(self, kind: Any, *, continue_: str = "", **_: Any) -> Page:
        self.calls.append(f"list {continue_}".strip())
        step = await self._next()
        if isinstance(step, Exception):
            raise step
        return Page(step)

    async def watch(self, kind: Any, *, resource_version: str, **_: Any) -> AsyncIterator[tuple[str, Body]]:
        self.calls.append(f"watch {resource_version}")
        for event in await self._next():
            if isinstance(event, Exception):
                raise event
            yield event

    async def _next(self) -> Any:
        if not self.steps:
            self.done.set()
            await asyncio.Event().wait()
        return self.steps.pop(0)


def page(version: int, *items: Body, continue_: str = "") -> Body:
    return {"metadata": {"resourceVersion": str(version), "continue": continue_}, "items": list(items)}


async def follow(
    script: Script, monkeypatch: pytest.MonkeyPatch
) -> tuple[dict[Key, int], list[tuple[Key, int | None, int | None]]]:
    """Run an informer through the script. Return its objects and the reported changes."""
    monkeypatch.setattr(informer_module, "_BACKOFF_S", (0.0, 0.0))
    changes: list[tuple[Key, int | None, int | None]] = []
    informer: Informer[int] = Informer(
        script,  # type: ignore[arg-type]
        ZONE,
        lambda body: body["value"],
        lambda key, old, new: changes.append((key, old, new)),
        rng=random.Random(1),
    )
    task = asyncio.create_task(informer.run())
    async with asyncio.timeout(5):
        await script.done.wait()
        await informer.synced.wait()
    task.cancel()
    return dict(informer.items()), changes


async def test_informer_reads_all_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    script = Script(page(5, zone("a", 1, 1), continue_="more"), page(5, zone("b", 2, 2)))
    held, changes = await follow(script, monkeypatch)
    assert held == {("", "a"): 1, ("", "b"): 2}
    assert sorted(changes) == [(("", "a"), None, 1), (("", "b"), None, 2)]
    assert script.calls == ["list", "list more", "watch 5"]


async def test_informer_continues_watch_from_last_version(monkeypatch: pytest.MonkeyPatch) -> None:
    events = [("ADDED", zone("a", 6, 1)), ("BOOKMARK", {"metadata": {"resourceVersion": "9"}})]
    script = Script(page(5), events, [("MODIFIED", zone("a", 10, 2)), ("DELETED", zone("a", 11, 2))])
    held, changes = await follow(script, monkeypatch)
    assert held == {}
    assert changes == [(("", "a"), None, 1), (("", "a"), 1, 2), (("", "a"), 2, None)]
    assert script.calls == ["list", "watch 5", "watch 9", "watch 11"]


async def test_informer_lists_again_after_expired_watch(monkeypatch: pytest.MonkeyPatch) -> None:
    script = Script(
        page(5, zone("gone", 1, 1), zone("same", 2, 2), zone("new", 3, 3)),
        [Expired(410, "Expired", "too old")],
        page(50, zone("same", 2, 2), zone("new", 40, 4)),
    )
    held, changes = await follow(script, monkeypatch)
    assert held == {("", "same"): 2, ("", "new"): 4}
    assert sorted(changes[3:]) == [(("", "gone"), 1, None), (("", "new"), 3, 4)]
    assert script.calls == ["list", "watch 5", "list", "watch 50"]


@pytest.mark.parametrize("watch", [[], [Expired(410, "Expired", "too old")]], ids=["ends at once", "expires"])
async def test_informer_backs_off_after_empty_watches(watch: list[Any], monkeypatch: pytest.MonkeyPatch) -> None:
    pauses: list[float] = []

    async def sleep(seconds: float) -> None:
        pauses.append(seconds)

    monkeypatch.setattr(asyncio, "sleep", sleep)

    class Same(Script):
        async def _next(self) -> Any:
            return await super()._next() if len(pauses) >= 7 else page(5) if "list" in self.calls[-1] else watch

    script = Same()
    informer: Informer[int] = Informer(script, ZONE, lambda body: body["value"], lambda *_: None)  # type: ignore[arg-type]
    task = asyncio.create_task(informer.run())
    async with asyncio.timeout(5):
        await script.done.wait()
    task.cancel()
    assert 0.2 <= pauses[0] <= 0.4
    assert all(later > before * 0.9 for before, later in itertools.pairwise(pauses))
    assert pauses[-1] >= 12


async def test_informer_reconnects_after_broken_connection(monkeypatch: pytest.MonkeyPatch) -> None:
    broken = KubeError(0, "Unreachable", "reset")
    script = Script(broken, page(5), [("ADDED", zone("a", 6, 1)), broken], [("MODIFIED", zone("a", 7, 2))])
    held, _ = await follow(script, monkeypatch)
    assert held == {("", "a"): 2}
    assert script.calls == ["list", "list", "watch 5", "watch 6", "watch 7"]


async def test_informer_lists_again_after_long_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    """An API server that was restored from a backup has lower versions than the watch.

    It sends no events until it reaches the version of the watch again.
    """
    monkeypatch.setattr(informer_module, "_SILENCE_S", 0.0)
    silent = [KubeError(0, "Unreachable", "TimeoutError")]
    script = Script(page(50, zone("a", 40, 4), zone("b", 41, 5)), silent, page(9, zone("a", 7, 3)))
    held, _ = await follow(script, monkeypatch)
    assert held == {("", "a"): 3}
    assert script.calls == ["list", "watch 50", "list", "watch 9"]


async def test_informer_reports_no_unchanged_object(monkeypatch: pytest.MonkeyPatch) -> None:
    script = Script(page(5, zone("a", 1, 1)), [("MODIFIED", zone("a", 6, 1))])
    _, changes = await follow(script, monkeypatch)
    assert changes == [(("", "a"), None, 1)]


async def test_informer_skips_invalid_object(monkeypatch: pytest.MonkeyPatch) -> None:
    odd = {"metadata": {"name": "a", "resourceVersion": "6"}}
    script = Script(page(5, zone("a", 1, 1), odd | {"metadata": {"name": "odd"}}), [("MODIFIED", odd)])
    held, _ = await follow(script, monkeypatch)
    assert held == {("", "a"): 1}


def test_informer_keeps_own_write_over_older_event() -> None:
    changes: list[tuple[int | None, int | None]] = []
    read: list[Body] = []

    def value(body: Body) -> int:
        read.append(body)
        return int(body["value"])

    informer: Informer[int] = Informer(
        Script(),  # type: ignore[arg-type]
        ZONE,
        value,
        lambda _key, old, new: changes.append((old, new)),
    )
    informer.record_write(("", "a"), zone("a", 7, 2))
    informer._take("MODIFIED", zone("a", 6, 1))
    assert informer.get(("", "a")) == 2
    informer._take("MODIFIED", zone("a", 7, 2))
    assert len(read) == 1, "an object repeated by the watch is not parsed again"
    informer._take("MODIFIED", zone("a", 8, 3))
    assert changes == [(None, 2), (2, 3)]
    informer.record_write(("", "a"), zone("a", 9, 4))
    informer._take("DELETED", zone("a", 9, 4))
    assert informer.get(("", "a")) is None


async def test_informer_ignores_late_result_of_own_write() -> None:
    events = [
        ("MODIFIED", zone("done", 10, 1)),
        ("MODIFIED", zone("done", 11, 2)),
        ("ADDED", zone("gone", 12, 1)),
        ("DELETED", zone("gone", 13, 1)),
        ("BOOKMARK", {"metadata": {"resourceVersion": "20"}}),
    ]
    script = Script(page(5, zone("done", 5, 0)), events)
    informer: Informer[int] = Informer(script, ZONE, lambda body: body["value"], lambda *_: None)  # type: ignore[arg-type]
    task = asyncio.create_task(informer.run())
    async with asyncio.timeout(5):
        await script.done.wait()
    informer.record_write(("", "done"), zone("done", 10, 1))
    informer.record_write(("", "gone"), zone("gone", 12, 1))
    informer.record_write(("", "older"), zone("older", 20, 1))
    assert dict(informer.items()) == {("", "done"): 2}
    informer.record_write(("", "done"), zone("done", 21, 3))
    informer.record_write(("", "gone"), zone("gone", 22, 4))
    assert dict(informer.items()) == {("", "done"): 3, ("", "gone"): 4}
    task.cancel()


async def test_informer_ignores_older_own_write_between_pages() -> None:
    late: list[Body] = []

    class Between(Script):
        async def _next(self) -> Any:
            for body in late:
                informer.record_write(("", body["metadata"]["name"]), body)
            late[:] = [zone("a", 10, 1)]
            return await super()._next()

    script = Between(page(12, zone("a", 11, 2), continue_="more"), page(12, zone("b", 2, 2)))
    informer: Informer[int] = Informer(script, ZONE, lambda body: body["value"], lambda *_: None)  # type: ignore[arg-type]
    task = asyncio.create_task(informer.run())
    async with asyncio.timeout(5):
        await script.done.wait()
    assert dict(informer.items()) == {("", "a"): 2, ("", "b"): 2}
    task.cancel()


def test_kind_has_paths_of_objects() -> None:
    assert ZONE.path(name="a", subresource="status") == "/apis/fractus.dev/v1alpha1/zones/a/status"
    assert POLICY.path() == "/apis/fractus.dev/v1alpha1/policies"


async def test_informer_reports_open_watch() -> None:
    ended = asyncio.Event()
    is_open = asyncio.Event()
    listed_again = asyncio.Event()

    class Watched(Script):
        async def watch(self, kind: Any, *, opened: Any, **_: Any) -> AsyncIterator[tuple[str, Body]]:
            opened()
            is_open.set()
            await ended.wait()
            raise KubeError(400, "Invalid", "gone")
            yield

        async def list_page(self, kind: Any, **_: Any) -> Page:
            if ended.is_set():
                listed_again.set()
                await asyncio.Event().wait()
            return Page(page(1))

    informer = Informer(Watched(), ZONE, lambda body: body, lambda *_: None)  # type: ignore[arg-type]
    assert not informer.watching
    task = asyncio.create_task(informer.run())
    async with asyncio.timeout(20.0):
        await is_open.wait()
        assert informer.watching
        ended.set()
        await listed_again.wait()
        assert not informer.watching
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
