"""Autopilot link: superseded commands are not repeated, and heartbeats stop if the companion fails."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
from fractus_services.mobility.mavlink import mavlink_autopilot
from fractus_services.mobility.mavlink.ardupilot import ARDUCOPTER
from fractus_services.mobility.mavlink.mavlink_autopilot import MavlinkAutopilot


class Superseded(Exception):
    """Raised by the permit of a command after a later command was sent."""


@pytest.fixture
def link(monkeypatch: pytest.MonkeyPatch) -> tuple[MavlinkAutopilot, list[Any]]:
    monkeypatch.setattr(mavlink_autopilot, "ACK_TIMEOUT_S", 0.01)
    autopilot = MavlinkAutopilot("tcp:127.0.0.1:1", ARDUCOPTER)
    sent: list[Any] = []
    monkeypatch.setattr(autopilot, "send", sent.append)
    return autopilot, sent


async def test_command_is_not_repeated_after_a_later_command(link: tuple[MavlinkAutopilot, list[Any]]) -> None:
    autopilot, sent = link
    autopilot.target = (1, 1)
    autopilot.vehicle.heartbeat_at = asyncio.get_running_loop().time()

    def permit() -> None:
        if sent:
            raise Superseded

    with pytest.raises(Superseded):
        await autopilot.go_to(39.0, 22.0, 10.0, None, permit)
    assert len(sent) == 1


async def test_no_heartbeat_is_sent_while_the_companion_does_not_work(monkeypatch: pytest.MonkeyPatch) -> None:
    duty = False
    sent = list[Any]()
    autopilot = MavlinkAutopilot("tcp:127.0.0.1:1", ARDUCOPTER, alive=lambda: duty)
    monkeypatch.setattr(autopilot, "send", sent.append)
    autopilot.send_heartbeat()
    assert [m.name for m in sent] == ["PARAM_REQUEST_READ"], (
        "a companion without target sends a probe instead of a heartbeat"
    )
    autopilot.target = (1, 1)
    autopilot.send_heartbeat()
    assert len(sent) == 1
    duty = True
    autopilot.send_heartbeat()
    assert sent[-1].name == "HEARTBEAT"
