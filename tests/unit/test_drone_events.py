"""Events of a drone.

Each transition has one Event, even if the operator restarts or a report is repeated. A flapping drone has few Events.
"""

from __future__ import annotations

import asyncio
from datetime import UTC, datetime, timedelta
from types import SimpleNamespace
from typing import Any, cast

import pytest
from fractus_core.api import Drone
from fractus_core.api.model import API_VERSION
from fractus_operator import drone_events
from fractus_operator.drone_events import EVENT_BURST, DroneEventRecorder
from fractus_operator.store import KubeError

NOW = datetime(2026, 6, 1, 12, 0, tzinfo=UTC)
KEY = ("", "drone-1")
DRIVER = "Navigator"
APPLICATION = "city/traffic"


def drone(state: str, controller: str | None = "system", *, at_s: int, reason: str = "", uid: str = "u1") -> Drone:
    taken = {
        "type": "ControlTaken", "status": "True", "reason": "SystemInControl", "message": reason,
        "lastTransitionTime": "2026-06-01T12:00:00Z",
    }  # fmt: skip
    status = {"flightState": state, "controller": controller, "lastSeen": (NOW + timedelta(seconds=at_s)).isoformat()}
    status |= {"conditions": [taken] if reason else [], "lastFlightState": "flying" if state == "unknown" else state}
    metadata = {"name": "drone-1", "uid": uid}
    return Drone.from_body(
        {"apiVersion": API_VERSION, "kind": "Drone", "metadata": metadata, "spec": {}, "status": status}
    )


class Cluster:
    """Fake cluster that records Events. A test can restart the operator."""

    def __init__(self) -> None:
        self.drones: dict[str, Drone] = {}
        self.holders: list[str] = [APPLICATION]
        self.applications: dict[tuple[str, str], Any] = {}
        self.posted: dict[str, tuple[str, str]] = {}
        self.of_application: dict[str, tuple[str, str, str]] = {}
        self.failing = 0
        self.landed = asyncio.Event()
        self.start()

    def start(self) -> None:
        async def synced() -> None:
            return

        cache = SimpleNamespace(drone=self.drones.get, synced=synced, applications=self.applications)
        self.events = DroneEventRecorder(cast(Any, self), cast(Any, cache), lambda _drone: self.holders, lambda: NOW)

    async def create_event(
        self, regarding: Any, *, reason: str, message: str, name: str, warning: bool, **_: object
    ) -> None:
        assert not warning
        if regarding["kind"] == "Application":
            self.of_application.setdefault(name, (regarding["metadata"]["uid"], reason, message))
            return
        assert regarding["kind"] == "Drone"
        self.failing -= 1
        if self.failing == 0:
            raise KubeError(503, "ServiceUnavailable", "not now")
        self.posted.setdefault(name, (reason, message))  # Like the API server, keep only the first Event of a name.
        if reason == "Landed":
            self.landed.set()

    async def observe(self, *reports: Drone | None) -> list[str]:
        """Deliver reports of the drone. Return the reasons of the Events that follow."""
        before = len(self.posted)
        for each in reports:
            if each is None:
                self.drones.pop("drone-1")
            else:
                self.drones["drone-1"] = each
            self.events.changed(KEY)
            await self.events.reconcile(KEY)
        return [reason for reason, _ in self.posted.values()][before:]

    def sentences(self) -> list[str]:
        return [sentence for _, sentence in self.posted.values()]


@pytest.fixture
def cluster() -> Cluster:
    return Cluster()


def ended(message: str) -> Any:
    condition = {"type": "MissionComplete", "status": "True", "reason": "MissionComplete", "message": message}
    return SimpleNamespace(body={"metadata": {"uid": "a1"}, "status": {"conditions": [condition]}})


async def test_takeover_is_also_an_event_of_the_application(cluster: Cluster) -> None:
    cluster.applications["city", "traffic"] = SimpleNamespace(body={"metadata": {"uid": "a1"}})
    await cluster.observe(drone("inactive", at_s=0), drone("flying", DRIVER, at_s=2))
    await cluster.observe(drone("flying", "system", at_s=12, reason="policy campus forbids it"))
    assert list(cluster.of_application.values()) == [
        (
            "a1",
            "SystemTookControl",
            "the system has control of drone-1 instead of Navigator: policy campus forbids it",
        )
    ]


async def test_events_of_a_complete_flight(cluster: Cluster) -> None:
    assert await cluster.observe(drone("inactive", at_s=0), drone("inactive", DRIVER, at_s=1)) == []
    assert await cluster.observe(drone("takingOff", DRIVER, at_s=2)) == ["TookOff", "MissionBegun"]
    assert await cluster.observe(drone("flying", DRIVER, at_s=6), drone("flying", DRIVER, at_s=11)) == []
    taken = drone("flying", "system", at_s=12, reason="policy campus forbids it")
    assert await cluster.observe(taken) == ["SystemTookControl"]
    assert await cluster.observe(drone("flying", DRIVER, at_s=20)) == ["ControlGranted"]
    assert await cluster.observe(drone("flying", "pilot", at_s=25)) == ["PilotTookControl"]
    cluster.holders = []
    cluster.applications["city", "traffic"] = ended("all control points were returned")
    assert await cluster.observe(drone("landing", "pilot", at_s=28)) == ["MissionOver"]
    assert await cluster.observe(drone("inactive", "system", at_s=30), drone("charging", "system", at_s=60)) == [
        "Landed"
    ]
    assert cluster.sentences() == [
        "drone-1 took off, flown by Navigator",
        "city/traffic flies drone-1",
        "the system has control of drone-1 instead of Navigator: policy campus forbids it",
        "Navigator has control of drone-1",
        "a pilot has control of drone-1 instead of Navigator",
        "city/traffic no longer flies drone-1: all control points were returned",
        "drone-1 landed",
    ]


async def test_drone_on_the_ground_has_no_events(cluster: Cluster) -> None:
    """Changes before the takeoff, such as the choice of the drone, cause no Event."""
    cluster.holders = []
    await cluster.observe(drone("inactive", at_s=0))
    cluster.holders = [APPLICATION]
    await cluster.observe(drone("inactive", DRIVER, at_s=5))
    cluster.holders = []
    assert await cluster.observe(drone("inactive", "system", at_s=9)) == []
    assert not cluster.posted


async def test_restarted_operator_posts_only_new_events(cluster: Cluster) -> None:
    await cluster.observe(drone("inactive", at_s=0), drone("flying", DRIVER, at_s=5))
    before = dict(cluster.posted)
    cluster.start()
    assert await cluster.observe(drone("flying", DRIVER, at_s=5), drone("flying", DRIVER, at_s=10)) == []
    assert cluster.posted == before
    cluster.holders = []
    assert await cluster.observe(drone("landing", DRIVER, at_s=15)) == ["MissionOver"], (
        "the restarted operator has seen the drone in flight"
    )
    assert cluster.sentences()[-1].endswith("no longer flies drone-1: it was deleted")
    cluster.start()
    assert await cluster.observe(drone("inactive", at_s=16)) == []


@pytest.mark.parametrize("late_s", [1, 30, 60])
async def test_repeated_and_late_reports_have_no_events(cluster: Cluster, late_s: int) -> None:
    landed = drone("inactive", at_s=100)
    await cluster.observe(drone("inactive", at_s=0), drone("flying", at_s=50), landed)
    before = dict(cluster.posted)
    assert (
        await cluster.observe(landed, drone("flying", DRIVER, at_s=100 - late_s), landed, drone("inactive", at_s=105))
        == []
    )
    assert cluster.posted == before


async def test_events_continue_after_clock_is_set_back(cluster: Cluster) -> None:
    await cluster.observe(drone("inactive", at_s=86_400))
    assert await cluster.observe(drone("flying", at_s=0)) == ["TookOff", "MissionBegun"]


async def test_stale_drone_has_no_events(cluster: Cluster) -> None:
    await cluster.observe(drone("inactive", at_s=0), drone("flying", DRIVER, at_s=5))
    silent = drone("unknown", None, at_s=5)
    assert await cluster.observe(silent, drone("flying", DRIVER, at_s=500)) == []
    assert await cluster.observe(silent, drone("inactive", at_s=900)) == ["Landed"]
    assert cluster.sentences()[-1] == "drone-1 landed, between 12:08:20 and 12:15:00 UTC"


async def test_recreated_drone_starts_new_events(cluster: Cluster) -> None:
    await cluster.observe(drone("inactive", at_s=0))
    assert await cluster.observe(drone("flying", at_s=5, uid="u2")) == []
    assert await cluster.observe(None, drone("inactive", at_s=9, uid="u2")) == []


async def test_failed_event_is_retried_and_posted_events_are_not_repeated(cluster: Cluster) -> None:
    await cluster.observe(drone("inactive", at_s=0))
    cluster.failing = 2
    with pytest.raises(KubeError):
        await cluster.observe(drone("flying", at_s=5))
    assert [reason for reason, _ in cluster.posted.values()] == ["TookOff"]
    assert await cluster.observe(drone("flying", at_s=10)) == ["MissionBegun"]


async def test_flapping_drone_has_few_events(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drone_events, "EVENT_PERIOD_S", 1e6)
    cluster.holders = []
    for flap in range(2000):
        await cluster.observe(drone("inactive" if flap % 2 else "flying", at_s=flap))
    assert len(cluster.posted) == EVENT_BURST
    assert cluster.sentences()[-1] == "drone-1 took off, flown by system"
    monkeypatch.setattr(drone_events, "EVENT_PERIOD_S", 1e-9)
    assert await cluster.observe(drone("inactive", at_s=2001)) == ["Landed"], (
        "the current state is posted as soon as the rate limit permits it"
    )


async def test_delayed_events_are_posted_later(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drone_events, "EVENT_PERIOD_S", 0.2)
    monkeypatch.setattr(drone_events, "EVENT_BURST", 1)
    cluster.holders = []
    await cluster.observe(drone("inactive", at_s=0), drone("flying", at_s=1), drone("inactive", at_s=2))
    running = asyncio.create_task(cluster.events.work_queue.run())
    async with asyncio.timeout(20.0):
        await cluster.landed.wait()
    running.cancel()
    assert cluster.sentences() == ["drone-1 took off, flown by system", "drone-1 landed"]
