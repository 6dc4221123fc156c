"""Which vehicle on a link is the drone's own."""

from __future__ import annotations

from fractus_mavlink import Endpoint, Message, Parser
from fractus_mavlink.enums import MAV_AUTOPILOT, MAV_TYPE
from fractus_services.mobility.mavlink.neighbours import GONE_S, MAX_FLIGHT_S, Neighbours


def heartbeat(sysid: int) -> Message:
    values = {"type": MAV_TYPE.QUADROTOR, "autopilot": MAV_AUTOPILOT.ARDUPILOTMEGA}
    (heard,) = Parser().feed(Endpoint(sysid, 1).encode("HEARTBEAT", values))
    return heard


def test_another_vehicle_takes_the_place_of_one_on_the_ground_or_of_one_that_must_be_down() -> None:
    link = Neighbours()
    assert link.finds(heartbeat(1), 0.0, flying=False)
    assert not link.problem(heartbeat(1), 100.0)
    assert not link.finds(heartbeat(2), 101.0, flying=True)
    assert not link.finds(heartbeat(2), 99.0 + MAX_FLIGHT_S, flying=True)
    assert link.finds(heartbeat(2), 101.0 + MAX_FLIGHT_S, flying=True)
    assert link.finds(heartbeat(3), 102.0 + MAX_FLIGHT_S, flying=False)


def test_others_are_told_until_they_are_gone() -> None:
    link = Neighbours()
    assert link.finds(heartbeat(1), 0.0, flying=False)
    assert "systems 2, 3" in (link.problem(heartbeat(3), 1.0) and link.problem(heartbeat(2), 2.0))
    assert "systems 2)" in link.problem(heartbeat(1), 1.5 + GONE_S)
    assert not link.problem(heartbeat(1), 2.5 + GONE_S)
