"""Heartbeats to a drone in flight while the service starts.

They are sent for a limited time. After a failed start, the next start sends none.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fractus_runtime.mavlink_codec import Endpoint, Parser
from fractus_services.mobility.mavlink import startup_heartbeat
from fractus_services.mobility.mavlink.companion import COMPONENT_ID, SYSTEM_ID
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from virtual_time import Loop

URL = "udpout:192.168.1.2:14550"


class Air:
    """Fake link to a vehicle. After a first message, the vehicle sends a heartbeat every second."""

    def __init__(self, *, state: int = mavlink.MAV_STATE_ACTIVE, armed: bool = True, sysid: int = 1) -> None:
        self._vehicle = Endpoint(sysid, 1)
        self._contacted = {
            "type": mavlink.MAV_TYPE_QUADROTOR, "autopilot": mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, "custom_mode": mavlink.COPTER_MODE_GUIDED,
            "system_status": state, "base_mode": mavlink.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0,
        }  # fmt: skip
        self._receive: Callable[[bytes], None] | None = None
        self.opened: list[str] = []
        self.beats: list[float] = []

    async def open_link(self, url: str, receive: Callable[[bytes], None], closed: Callable[[Any], None]) -> Air:
        self.opened.append(url)
        if len(self.opened) == 1:
            raise ConnectionRefusedError
        self._closed = closed
        self._fly(receive)
        return self

    def _fly(self, receive: Callable[[bytes], None]) -> None:
        if self._receive is not None:
            receive(self._vehicle.encode("HEARTBEAT", self._contacted))
        self._again = asyncio.get_running_loop().call_later(1.0, self._fly, receive)

    def write(self, data: bytes) -> None:
        self._receive = self._receive or (lambda _data: None)
        for received in Parser().feed(data):
            if received.name == "HEARTBEAT":
                assert (received.sysid, received.compid) == (SYSTEM_ID, COMPONENT_ID)
                self.beats.append(asyncio.get_running_loop().time())

    def close(self) -> None:
        self._again.cancel()


def served(directory: Path) -> Path:
    (directory / "vehicle.json").write_text(json.dumps({"link": URL, "system": 1, "component": 1}))
    asyncio.run(startup_heartbeat.mark_served(directory))
    return directory


def start(
    air: Air, directory: Path, monkeypatch: pytest.MonkeyPatch, *, url: str | None = None, takes_s: float = 7.5
) -> list[float]:
    """Start the service. Return the times of its heartbeats, in seconds since the start."""
    monkeypatch.setattr(startup_heartbeat, "open_link", air.open_link)
    with asyncio.Runner(loop_factory=Loop) as runner:
        begun_s = runner.get_loop().time()
        assert (
            runner.run(startup_heartbeat.with_heartbeats(asyncio.sleep(takes_s, "server"), directory, url)) == "server"
        )
    return [round(at - begun_s, 1) for at in air.beats]


@pytest.mark.parametrize("url", [None, URL])
def test_heartbeats_are_sent_to_a_drone_in_flight_during_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, url: str | None
) -> None:
    air = Air()
    assert start(air, served(tmp_path), monkeypatch, url=url) == [2.0, 3.0, 4.0, 5.0, 6.0, 7.0]
    assert air.opened == [URL, URL]


def test_heartbeats_stop_when_the_start_takes_too_long(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    beats = start(Air(), served(tmp_path), monkeypatch, takes_s=60.0)
    assert startup_heartbeat.TIMEOUT_S - 1.5 < beats[-1] <= startup_heartbeat.TIMEOUT_S


def test_no_heartbeats_are_sent_after_a_failed_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    served(tmp_path)
    assert start(Air(), tmp_path, monkeypatch)
    air = Air()
    assert start(air, tmp_path, monkeypatch) == []
    assert air.opened == []
    served(tmp_path)
    assert start(Air(), tmp_path, monkeypatch)


@pytest.mark.parametrize(
    "air",
    [Air(armed=False), Air(state=mavlink.MAV_STATE_STANDBY), Air(state=mavlink.MAV_STATE_CRITICAL), Air(sysid=2)],
    ids=["stands", "on the ground", "failsafe acts", "another vehicle"],
)
def test_no_heartbeats_are_sent_to_other_vehicles_or_states(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, air: Air
) -> None:
    assert start(air, served(tmp_path), monkeypatch) == []


def test_nothing_is_sent_to_another_url_or_an_unknown_vehicle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    air = Air()
    assert start(air, served(tmp_path), monkeypatch, url="tcp:127.0.0.1:5760") == []
    (tmp_path / "vehicle.json").unlink()
    assert start(air, tmp_path, monkeypatch) == []
    assert air.opened == []


def test_broken_link_does_not_prevent_the_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Broken(Air):
        async def open_link(self, url: str, receive: Any, closed: Any) -> Air:
            raise ValueError(url)

    assert start(Broken(), served(tmp_path), monkeypatch) == []
