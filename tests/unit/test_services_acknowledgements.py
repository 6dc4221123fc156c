"""Assignment of acknowledgements to commands.

An acknowledgement belongs to the oldest transmission that it can answer. It must not be assigned to a later command.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from fractus_runtime.mavlink_codec import Endpoint, Message, Parser, message
from fractus_services.mobility.mavlink.mavlink_autopilot import (
    ACK_TIMEOUT_S,
    MAX_ACK_TIMEOUT_S,
    MAX_UNACKNOWLEDGED,
    Acknowledgements,
    Answer,
)
from fractus_services.mobility.mavlink.timing import Timing
from pymavlink.dialects.v20 import ardupilotmega as mavlink

SPEED = mavlink.MAV_CMD_DO_CHANGE_SPEED
MODE = mavlink.MAV_CMD_DO_SET_MODE
ACCEPTED = mavlink.MAV_RESULT_ACCEPTED
DENIED = mavlink.MAV_RESULT_DENIED
IN_PROGRESS = mavlink.MAV_RESULT_IN_PROGRESS


def ack(result: int = ACCEPTED, command: int = SPEED, target: int = 245) -> Message:
    return message("COMMAND_ACK", command=command, result=result, target_system=target)


def link(delay_s: float = 1.0) -> Acknowledgements:
    """Return Acknowledgements for a link with a measured delay and regular responses."""
    return Acknowledgements(245, measured(delay_s))


class SilentTiming(Timing):
    """Fake timing. A function of the test returns the time since the last response."""

    def __init__(self, silence: Callable[[float], float]) -> None:
        super().__init__()
        self._silence = silence

    def silence_s(self, now: float) -> float:
        return self._silence(now)


def measured(delay_s: float, silence: Callable[[float], float] = lambda _now: 0.2) -> Timing:
    timing = SilentTiming(silence) if math.isfinite(delay_s) else Timing()
    if math.isfinite(delay_s):
        timing.take_position(1000, 0.0)
        number = timing.request(0.0)
        assert number is not None
        timing.take_reply(1_000_000_000, number, delay_s)
    return timing


@pytest.mark.parametrize(
    ("delay_s", "timeout_s"),
    [(0.02, ACK_TIMEOUT_S), (0.5, 0.7), (1.0, 1.2), (2.0, 2.2), (2.9, MAX_ACK_TIMEOUT_S), (math.inf, ACK_TIMEOUT_S)],
)
def test_transmission_is_lost_after_the_longest_measured_delay(delay_s: float, timeout_s: float) -> None:
    assert link(delay_s).timeout_s == pytest.approx(timeout_s)


async def test_second_acknowledgement_of_a_repeated_command_does_not_deny_the_next_command() -> None:
    acks = link()
    first = Answer()
    later = Answer()
    acks.add_transmission(SPEED, first, 0.0)
    acks.add_transmission(SPEED, first, 0.7)
    acks.take(ack(), 1.0)
    assert first.result() == ACCEPTED
    acks.add_transmission(SPEED, later, 1.1)
    acks.take(ack(DENIED), 1.7)
    assert not later.done()
    acks.take(ack(), 2.1)
    assert later.result() == ACCEPTED


async def test_earlier_acceptance_does_not_accept_a_denied_command() -> None:
    acks = link()
    first = Answer()
    later = Answer()
    for at in (0.0, 0.7):
        acks.add_transmission(SPEED, first, at)
    acks.take(ack(), 1.0)
    acks.add_transmission(SPEED, later, 1.1)
    acks.take(ack(), 1.7)
    acks.take(ack(DENIED), 2.1)
    assert later.result() == DENIED


@pytest.mark.parametrize("delay_s", [0.05, 0.5, 1.0, 2.0])
async def test_lost_transmission_does_not_consume_the_next_acknowledgement(delay_s: float) -> None:
    acks = link(delay_s)
    first = Answer()
    later = Answer()
    second_s = acks.timeout_s
    acks.add_transmission(SPEED, first, 0.0)
    acks.add_transmission(SPEED, first, second_s)
    acks.take(ack(), second_s + delay_s)
    assert first.result() == ACCEPTED
    acks.add_transmission(SPEED, later, second_s + delay_s)
    acks.take(ack(DENIED), second_s + 2 * delay_s)
    assert later.result() == DENIED


async def test_acknowledgement_of_an_abandoned_command_is_not_assigned_to_the_next() -> None:
    acks = link()
    first = Answer()
    later = Answer()
    acks.add_transmission(SPEED, first, 0.0)
    first.cancel()
    acks.add_transmission(SPEED, later, 0.1)
    acks.take(ack(DENIED), 1.0)
    assert not later.done()
    acks.take(ack(), 1.1)
    assert later.result() == ACCEPTED


async def test_acknowledgements_are_assigned_while_the_link_becomes_slow() -> None:
    acks = link(0.02)
    answer = Answer()
    for at in (0.0, 0.7):
        acks.add_transmission(SPEED, answer, at)
    acks.take(ack(), 2.0)
    assert answer.result() == ACCEPTED


async def test_missing_acknowledgements_may_still_arrive() -> None:
    timing = measured(0.02, lambda now: now)
    first = Answer()
    later = Answer()
    acks = Acknowledgements(245, timing)
    acks.add_transmission(SPEED, first, 0.1)
    first.cancel()
    acks.add_transmission(SPEED, later, 1.9)
    acks.take(ack(DENIED), 2.1)
    assert not later.done()


async def test_late_acknowledgements_are_expected_while_the_delay_is_unknown() -> None:
    acks = link(math.inf)
    first = Answer()
    later = Answer()
    for at in (0.0, 0.7, 1.4):
        acks.add_transmission(SPEED, first, at)
    acks.take(ack(), 2.0)
    acks.add_transmission(SPEED, later, 2.1)
    acks.take(ack(DENIED), 2.7)
    acks.take(ack(DENIED), 3.4)
    assert not later.done()
    acks.take(ack(), 4.1)
    assert later.result() == ACCEPTED


async def test_in_progress_keeps_the_transmission_open() -> None:
    acks = link()
    first = Answer()
    later = Answer()
    acks.add_transmission(SPEED, first, 0.0)
    acks.take(ack(IN_PROGRESS), 1.0)
    assert not first.done()
    acks.add_transmission(SPEED, later, 1.5)
    acks.take(ack(DENIED), 2.0)
    assert first.result() == DENIED
    assert not later.done()


async def test_acknowledgements_for_other_systems_and_commands_are_ignored() -> None:
    acks = link()
    answer = Answer()
    acks.add_transmission(SPEED, answer, 0.0)
    acks.take(ack(DENIED, target=255), 0.5)
    acks.take(ack(DENIED, MODE), 0.6)
    assert not answer.done()
    acks.take(ack(target=0), 0.7)
    assert answer.result() == ACCEPTED


async def test_duplicate_frame_is_ignored() -> None:
    autopilot = Endpoint(1, 1)
    parser = Parser()
    acks = link(0.05)
    first = Answer()
    later = Answer()

    def frame(result: int) -> Message:
        (incoming,) = parser.feed(autopilot.encode("COMMAND_ACK", ack(result).values))
        return incoming

    acks.add_transmission(SPEED, first, 0.0)
    denied = frame(DENIED)
    acks.take(denied, 0.05)
    acks.add_transmission(SPEED, later, 0.06)
    acks.take(denied, 0.07)
    assert not later.done()
    acks.take(frame(DENIED), 0.11)
    assert later.result() == DENIED


async def test_transmissions_are_dropped_when_the_connection_breaks(caplog: pytest.LogCaptureFixture) -> None:
    acks = link()
    before = Answer()
    after = Answer()
    acks.add_transmission(SPEED, before, 0.0)
    acks.forget()
    assert not acks.is_overtaken(SPEED, before)
    with caplog.at_level("DEBUG"):
        acks.take(ack(DENIED), 0.2)
    assert "unexpected acknowledgement" in caplog.text
    assert not before.done()
    acks.add_transmission(SPEED, after, 0.3)
    acks.take(ack(), 0.9)
    assert after.result() == ACCEPTED


async def test_number_of_open_transmissions_is_limited() -> None:
    acks = link()
    for at in range(10 * MAX_UNACKNOWLEDGED):
        acks.add_transmission(SPEED, Answer(), float(at))
    assert len(acks._sent[SPEED]) == MAX_UNACKNOWLEDGED


async def test_later_command_overtakes_an_unanswered_command() -> None:
    acks = link()
    first = Answer()
    later = Answer()
    acks.add_transmission(MODE, first, 0.0)
    assert not acks.is_overtaken(MODE, first)
    acks.add_transmission(MODE, later, 0.1)
    assert acks.is_overtaken(MODE, first)
    assert not acks.is_overtaken(MODE, later)
