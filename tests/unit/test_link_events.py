"""Events of direct links: one Event for each change, in the order of the changes, and few Events of a flapping link."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any, cast

import pytest
from fractus_operator import link_events
from fractus_operator.link_events import LinkEventRecorder, LinkReport, link_changes, parse_link_report

SPEC = {"drone": "drone-1", "node": "edge-1", "application": {"namespace": "city", "name": "traffic", "uid": "u1"}}
KEY = ("", "city.traffic-drone-1-edge-1")
NOW = datetime(2026, 6, 1, 12, 0, tzinfo=UTC)


def report(phase: str = "Idle", traffic: str = "cloud", switches: int = 0, message: str = "") -> LinkReport:
    status = {"phase": phase, "traffic": traffic, "switches": switches, "message": message}
    return parse_link_report({"spec": SPEC, "status": status})


def reasons(before: LinkReport, now: LinkReport) -> list[str]:
    return [reason for reason, _ in link_changes(before, now)]


UP = report("Up")
DIRECT = report("Up", "direct", 1, "it is faster")


def test_link_events_are_in_order() -> None:
    assert reasons(parse_link_report({"spec": SPEC}), report("Connecting")) == []
    assert reasons(report(), UP) == ["LinkUp"]
    assert reasons(UP, DIRECT) == ["TrafficDirect"]
    assert reasons(report(), DIRECT) == ["LinkUp", "TrafficDirect"]
    assert reasons(DIRECT, replace(DIRECT, direct=False)) == ["TrafficCloud"]
    assert reasons(DIRECT, report(switches=2)) == ["TrafficCloud", "LinkDown"]


def test_link_event_has_reason_and_number_of_changes() -> None:
    ((_, sentence),) = link_changes(UP, DIRECT)
    assert sentence == "calls of drone-1 take the direct link to edge-1: it is faster"
    ((_, sentence),) = link_changes(UP, replace(DIRECT, switches=7))
    assert sentence.endswith("it is faster (changed 7 times since the last Event)")


class Recorder:
    """Fake API server that records the posted Events."""

    def __init__(self) -> None:
        self.events: list[tuple[str, str]] = []
        self.names: set[str] = set()
        self.down = asyncio.Event()

    async def create_event(self, regarding: Any, *, reason: str, name: str, **_: object) -> None:
        self.events.append((regarding["metadata"]["uid"], reason))
        self.names.add(name)
        if reason == "LinkDown":
            self.down.set()


@pytest.fixture
def posted() -> Recorder:
    return Recorder()


@pytest.fixture
def events(posted: Recorder) -> LinkEventRecorder:
    return LinkEventRecorder(cast(Any, posted), lambda: NOW)


async def see(events: LinkEventRecorder, *reports: LinkReport | None) -> None:
    """Deliver the reports one by one, like the watch."""
    for now in reports:
        events.changed(KEY, events._current.get(KEY), now)
        await events.reconcile(KEY)


async def test_link_state_at_start_has_no_event(events: LinkEventRecorder, posted: Recorder) -> None:
    await see(events, DIRECT, replace(DIRECT, message="still faster"))
    assert posted.events == []
    await see(events, report(switches=2))
    assert posted.events == [("u1", "TrafficCloud"), ("u1", "LinkDown")]
    assert len(posted.names) == 2


async def test_flapping_link_has_few_events(
    events: LinkEventRecorder, posted: Recorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(link_events, "LINK_EVENT_PERIOD_S", 1e6)
    await see(events, report())
    for flap in range(50):
        await see(events, replace(DIRECT, switches=2 * flap + 1), report(switches=2 * flap + 2))
    assert posted.events == [("u1", "LinkUp"), ("u1", "TrafficDirect")]
    monkeypatch.setattr(link_events, "LINK_EVENT_PERIOD_S", 0.0)
    await events.reconcile(KEY)
    assert posted.events[2:] == [("u1", "TrafficCloud"), ("u1", "LinkDown")]


async def test_delayed_link_event_is_posted_later(
    events: LinkEventRecorder, posted: Recorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(link_events, "LINK_EVENT_PERIOD_S", 0.2)
    await see(events, report(), DIRECT, report(switches=2))
    running = asyncio.create_task(events.work_queue.run())
    async with asyncio.timeout(20.0):
        await posted.down.wait()
    running.cancel()


async def test_recreated_link_starts_new_events(events: LinkEventRecorder, posted: Recorder) -> None:
    await see(events, report(), None, DIRECT, replace(DIRECT, switches=3))
    assert posted.events == []
