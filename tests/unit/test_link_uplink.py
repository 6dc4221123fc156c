"""Whether the path to the cloud answers, and what it offers; without a network or a clock."""

from __future__ import annotations

import asyncio

import pytest
from fractus_agent.links import uplink
from fractus_agent.links.uplink import SILENT_S, STEADY_S, Answering, Uplink
from fractus_core.api.nodes import Drone


def answering(*answers_s: float, questions_s: range) -> Answering:
    """One that was asked once a second, and answered at once in these seconds."""
    found = Answering()
    for now_s in questions_s:
        found.asked(now_s)
        if now_s in answers_s:
            found.answered(now_s)
    return found


def test_a_path_that_has_not_answered_for_some_seconds_is_silent() -> None:
    assert Answering().works(0.0), "until the opposite is known"
    found = answering(0, questions_s=range(3))
    assert found.works(SILENT_S + 0.9)
    assert not found.works(SILENT_S + 1.0)


def test_who_does_not_ask_knows_nothing() -> None:
    assert answering(0, questions_s=range(1)).works(1000.0)


def test_a_path_that_was_silent_has_to_answer_for_a_while() -> None:
    found = answering(0, *range(20, 30), questions_s=range(25))
    assert not found.works(24.0)
    found.asked(25.0)
    found.answered(20.0 + STEADY_S)
    assert found.works(25.0)


def test_a_path_that_comes_and_goes_stays_silent() -> None:
    found = Answering()
    worked = []
    for now_s in range(1, 200):
        found.asked(now_s)
        if now_s % 8 < 2:
            found.answered(now_s + 0.1)
        worked.append(found.works(now_s + 0.2))
    assert not any(worked[10:])


DRONE = Drone.from_body({
    "apiVersion": "fractus.dev/v1alpha1", "kind": "Drone", "metadata": {"name": "d1"},
    "spec": {"interfaces": [{"technology": "4G", "bandwidth": 3}, {"technology": "5G", "bandwidth": 5}]},
})  # fmt: skip


def test_what_the_path_offers_is_declared_until_it_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uplink, "ASK_S", 0.0)
    answers = iter([True] * 5 + [False] * 5)
    asked = 0

    async def ask(timeout_s: float) -> bool:
        nonlocal asked
        assert timeout_s == uplink.ANSWER_TIMEOUT_S
        asked += 1
        await asyncio.sleep(0.01)
        return next(answers)

    async def run() -> None:
        path = Uplink(lambda: DRONE, ask)
        first = path.offers()
        assert first is not None
        assert (first.ingress_mbps, first.ingress_latency_ms) == (5.0, 15.0)
        running = asyncio.create_task(path.run())
        async with asyncio.timeout(30):
            while asked < 9:  # noqa: ASYNC110 (the loop under test has no event)
                await asyncio.sleep(0.001)
        measured = path.offers()
        assert measured is not None
        assert (measured.ingress_mbps, measured.egress_mbps) == (5.0, 5.0)
        assert measured.ingress_latency_ms > 4.0, "half of the 10 ms that the quickest answer took"
        monkeypatch.setattr(uplink, "SILENT_S", 0.0)
        assert path.offers() is None
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)

    asyncio.run(run())
