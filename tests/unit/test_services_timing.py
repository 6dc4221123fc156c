"""Estimated delay of the autopilot link: it is an upper bound, despite lost messages and differences of the clocks."""

from __future__ import annotations

import heapq
import math
import random
from collections.abc import Callable
from dataclasses import dataclass, field

import pytest
from fractus_services.mobility.mavlink.timing import (
    MAX_ARMING_DELAY_S,
    MAX_DELAY_S,
    MAX_PACE,
    PROBE_S,
    REACTION_S,
    STALE_S,
    WINDOW_S,
    Timing,
)

Delay = Callable[[], float]


@dataclass
class Bench:
    """Simulated link to a vehicle with its own clock.

    Attributes:
        up, down: Delay of a message in seconds, infinite if the message is lost.
        clock: Vehicle time since its start as a function of the time of the test.
        worst: Largest true delay minus its estimate. A positive value is an error.
    """

    up: Delay
    down: Delay
    clock: Callable[[float], float] = lambda t: t + 1000.0
    every_s: float = 0.05
    answers: bool = True
    copies: int = 1
    timing: Timing = field(default_factory=Timing)
    now: float = 50.0
    worst: float = -math.inf
    excess: list[float] = field(default_factory=list)
    _queue: list[tuple[float, int, Callable[[], None]]] = field(default_factory=list)
    _number: int = 0
    _reported_stamp: float = -math.inf

    def schedule(self, delay_s: float, action: Callable[[], None]) -> None:
        if math.isfinite(delay_s):
            self._number += 1
            heapq.heappush(self._queue, (self.now + delay_s, self._number, action))

    def fly(self, seconds: float) -> None:
        """Advance the time. Positions arrive, delays are measured, and the estimate is compared with the true delay."""
        end = self.now + seconds
        for event in (self._state, self._probe, self._judge):
            self.schedule(0.0, event)
        while self._queue and self._queue[0][0] <= end:
            self.now, _, action = heapq.heappop(self._queue)
            action()
        self._queue = [item for item in self._queue if item[2] not in (self._state, self._probe, self._judge)]
        heapq.heapify(self._queue)
        self.now = end

    def _state(self) -> None:
        stamp = self.clock(self.now)
        for _ in range(self.copies):
            self.schedule(self.down(), lambda: self._arrives(stamp))
        self.schedule(self.every_s, self._state)

    def _arrives(self, stamp: float) -> None:
        if self.timing.take_position(round(stamp * 1e3) % (1 << 32), self.now) is not None:
            self._reported_stamp = stamp

    def _probe(self) -> None:
        number = self.timing.request(self.now)
        sent = self.now
        if number is not None and self.answers:
            up = self.up()
            tc1 = round(self.clock(self.now + min(up, 1e6)) * 1e9)
            for _ in range(self.copies):
                self.schedule(up + self.down(), lambda: self.timing.take_reply(tc1, number, self.now))
        elif number is not None and self.timing.unanswering:
            self.schedule(self.up() + self.down(), lambda: self.timing.take_acknowledgement(sent, self.now))
        self.schedule(PROBE_S, self._probe)

    def _judge(self) -> None:
        estimate = self.timing.latency_s(self.now)
        if math.isfinite(estimate):
            up = self.up()
            if math.isfinite(up):
                true = self.clock(self.now + up) - self._reported_stamp
                self.worst = max(self.worst, true - estimate)
                self.excess.append(estimate - true)
        self.schedule(0.013, self._judge)


def steady(seconds: float) -> Delay:
    return lambda: seconds


def random_delay(rng: random.Random, least: float, most: float, loss: float = 0.0) -> Delay:
    return lambda: math.inf if rng.random() < loss else rng.uniform(least, most)


@pytest.mark.parametrize(("up", "down"), [(0.0, 0.0), (0.15, 0.15), (0.25, 0.25), (0.5, 0.0), (0.0, 0.5)])
def test_latency_of_each_direction_is_counted_once(up: float, down: float) -> None:
    """The estimate exceeds the delay only slightly, for any distribution of the delay over the two directions."""
    bench = Bench(steady(up), steady(down))
    bench.fly(30)
    assert bench.worst <= -REACTION_S + 0.01
    assert max(bench.excess) <= REACTION_S + 0.01
    assert bench.timing.delay_s == pytest.approx(up + down, abs=0.01)


@pytest.mark.parametrize("seed", range(12))
def test_latency_is_an_upper_bound_despite_lost_late_and_duplicate_messages(seed: int) -> None:
    rng = random.Random(seed)
    least = rng.uniform(0, 0.2)
    most = rng.uniform(0.2, 0.4)
    bench = Bench(random_delay(rng, least, most, 0.1), random_delay(rng, least, most, 0.1), copies=2)
    bench.fly(15)
    bench.worst = -math.inf
    bench.fly(60)
    assert bench.worst <= 0.0, (
        "the estimate is sufficient, because REACTION_S covers delays that no request has measured"
    )


@pytest.mark.parametrize("rate", [0.999, 1.001, 1.5, 2.0, 3.0, 5.0])
def test_clock_with_different_rate_is_tracked(rate: float) -> None:
    bench = Bench(steady(0.01), steady(0.01), clock=lambda t: rate * t + 7)
    bench.fly(15)
    bench.worst = -math.inf
    bench.fly(30)
    assert bench.worst <= -REACTION_S + 0.05
    assert rate <= max(bench.timing.pace, 1.001) <= max(rate, 1.0) * 1.06
    assert not bench.timing.problem(bench.now)


def test_clock_that_runs_too_fast_is_rejected() -> None:
    bench = Bench(steady(0.005), steady(0.005), clock=lambda t: 9 * t, every_s=0.01)
    bench.fly(15)
    assert "9.0 times as fast as real time" in bench.timing.problem(bench.now)
    assert f"the maximum is {MAX_PACE:g}" in bench.timing.problem(bench.now)


def test_slow_link_prevents_arming_with_reason() -> None:
    bench = Bench(steady(0.65), steady(0.6))
    bench.fly(15)
    assert "takes 1.2 s" in bench.timing.problem(bench.now) or "1.3 s" in bench.timing.problem(bench.now)
    assert bench.timing.delay_s > MAX_ARMING_DELAY_S
    assert math.isfinite(bench.timing.latency_s(bench.now)), (
        "the latency is known, so that a drone in flight can land over this link"
    )
    worse = Bench(steady(1.0), steady(0.9))
    worse.fly(15)
    assert math.isinf(worse.timing.latency_s(worse.now))


def test_slow_link_is_detected_and_cleared_when_fast_again() -> None:
    slow = 0.0
    bench = Bench(lambda: 0.02 + slow, steady(0.02))
    bench.fly(15)
    slow = 0.6
    bench.fly(1.5)
    assert bench.timing.delay_s == pytest.approx(0.64, abs=0.02)
    slow = 0.0
    bench.fly(WINDOW_S - 2)
    assert bench.timing.delay_s > 0.6
    bench.fly(4)
    assert bench.timing.delay_s < 0.1


def test_slow_link_is_detected_before_first_slow_response() -> None:
    """Positions still arrive on time. Only missing responses show that the uplink has become slower."""
    up_s = 0.05
    bench = Bench(lambda: up_s, steady(0.05))
    bench.fly(15)
    before_s = bench.timing.latency_s(bench.now)
    up_s = 1.0
    bench.fly(0.9)
    assert bench.timing.delay_s < 0.2, "no slow response has arrived yet"
    assert bench.timing.latency_s(bench.now) >= before_s + 0.6
    bench.worst = -math.inf
    bench.fly(1.0)
    assert bench.worst <= 0.0


def test_many_overdue_responses_do_not_count_as_fast_link() -> None:
    """Requests without a response count as overdue.

    After ten of them, the vehicle does not respond, or the link is too slow.
    """
    up_s = 0.05
    bench = Bench(lambda: up_s, steady(0.05))
    bench.fly(15)
    up_s = 2.6
    bench.fly(1.9)
    bench.fly(0.6)
    assert bench.timing.unanswering
    assert bench.timing.latency_s(bench.now) >= MAX_DELAY_S
    bench.fly(2.0)
    assert math.isinf(bench.timing.latency_s(bench.now)), "the arrived responses show that the link is too slow"


def test_one_lost_response_does_not_make_link_too_slow_to_fly() -> None:
    bench = Bench(steady(0.05), steady(0.05))
    bench.fly(15)
    before_s = bench.timing.latency_s(bench.now)
    bench.answers = False
    bench.fly(1.7)
    assert math.isfinite(bench.timing.latency_s(bench.now))
    bench.answers = True
    bench.fly(0.4)
    assert bench.timing.latency_s(bench.now) == pytest.approx(before_s, abs=0.05)


def test_latency_is_unknown_without_responses() -> None:
    bench = Bench(steady(0.02), steady(0.02))
    assert math.isinf(bench.timing.latency_s(bench.now))
    assert "is unknown" in bench.timing.problem(bench.now)
    bench.fly(5)
    bench.up = steady(math.inf)
    bench.fly(STALE_S + 0.5)
    assert math.isinf(bench.timing.latency_s(bench.now))


def test_latency_is_measured_by_acknowledgements_without_timesync() -> None:
    bench = Bench(steady(0.2), steady(0.1), answers=False)
    bench.fly(1.5)
    assert math.isinf(bench.timing.latency_s(bench.now))
    bench.fly(20)
    assert bench.worst <= -REACTION_S + 0.01
    assert max(bench.excess) <= REACTION_S + 0.02


def test_timesync_replies_to_other_systems_and_duplicates_are_ignored() -> None:
    timing = Timing()
    for i in range(40):
        timing.take_position(5000 + 50 * i, 1.0 + 0.05 * i)
    for foreign in (0, 1, 2**62, -1, 10**18):
        timing.take_reply(10**9, foreign, 3.0)
    assert math.isinf(timing.latency_s(3.0))
    number = timing.request(3.0)
    assert number is not None
    timing.take_reply(0, number, 3.02)
    assert math.isinf(timing.latency_s(3.02)), "a request by the vehicle does not count as a response"
    number = timing.request(3.04)
    assert number is not None
    timing.take_reply(round(7.01e9), number, 3.06)
    measured = timing.delay_s
    timing.take_reply(round(9.9e9), number, 3.5)
    assert timing.delay_s == measured


def test_repeated_command_after_gap_is_not_a_latency_sample() -> None:
    bench = Bench(steady(0.02), steady(0.02))
    bench.fly(10)
    sent = bench.now + 0.1
    bench.up = bench.down = steady(math.inf)
    bench.fly(2.5)
    assert bench.timing.unanswering
    bench.timing.take_acknowledgement(sent, bench.now)
    assert bench.timing.delay_s < 0.1, "an acknowledgement before the first position after the gap is not a sample"
    bench.up = bench.down = steady(0.02)
    bench.timing.take_position(round(bench.clock(bench.now) * 1e3), bench.now + 0.02)
    bench.timing.take_acknowledgement(sent, bench.now + 0.03)
    assert bench.timing.delay_s < 0.1
    bench.now += 0.03
    bench.fly(1)
    assert math.isfinite(bench.timing.latency_s(bench.now))


def test_timesync_reply_with_another_clock_is_ignored() -> None:
    bench = Bench(steady(0.02), steady(0.02), answers=False)
    bench.fly(3)
    number = bench.timing.request(bench.now)
    assert number is not None
    bench.timing.take_reply(1_790_000_000 * 10**9, number, bench.now + 0.04)
    assert bench.timing.unanswering


def test_vehicle_clock_wraps_after_49_days() -> None:
    bench = Bench(steady(0.1), steady(0.1), clock=lambda t: t - 60 + 2**32 / 1e3)
    bench.fly(40)
    assert bench.worst <= -REACTION_S + 0.01
    assert max(bench.excess) <= REACTION_S + 0.01


def test_vehicle_restart_resets_timing() -> None:
    boot = 0.0
    bench = Bench(steady(0.05), steady(0.05), clock=lambda t: t - boot + 100.0)
    bench.fly(5)
    assert not bench.timing.restarted
    boot = bench.now + 100.0
    bench.fly(0.2)
    assert bench.timing.restarted
    bench.worst = -math.inf
    bench.fly(10)
    assert bench.worst <= -REACTION_S + 0.01
    assert math.isfinite(bench.timing.latency_s(bench.now))


@pytest.mark.parametrize(
    ("stamps", "expected"),
    [
        ((102_000, 110_050, 110_100), [False, False, False]),
        ((1_000, 1_050, 1_100), [False, True, True]),
    ],
)
def test_late_old_position_is_not_a_restart(stamps: tuple[int, ...], expected: list[bool]) -> None:
    timing = Timing()
    for i in range(200):
        timing.take_position(100_000 + 50 * i, 50.0 + 0.05 * i)
    restarted = []
    for i, stamp in enumerate(stamps):
        timing.take_position(stamp, 60.0 + 0.05 * i)
        restarted.append(timing.restarted)
    assert restarted == expected


def test_restart_is_detected_from_replies_alone() -> None:
    bench = Bench(steady(0.02), steady(0.02), answers=False)
    bench.fly(3)
    for seconds, restarted in (1000, False), (1001, False), (998, False), (10, True), (11, True):
        number = bench.timing.request(bench.now)
        assert number is not None
        bench.timing.take_reply(seconds * 10**9, number, bench.now)
        assert bench.timing.restarted is restarted
    bench.timing.reset()
    assert not bench.timing.restarted


def test_timing_of_frozen_vehicle_is_unknown_until_it_recovers() -> None:
    frozen = 0.0
    bench = Bench(steady(0.02), steady(0.02), clock=lambda t: t - frozen)
    bench.fly(10)
    bench.now += 5.0
    frozen = 5.0
    assert math.isinf(bench.timing.latency_s(bench.now))
    bench._queue.clear()
    bench.fly(0.3)
    bench.worst = -math.inf
    bench.fly(10)
    assert bench.worst <= -REACTION_S + 0.01
    assert max(bench.excess[-100:]) <= REACTION_S + 0.02


@pytest.mark.parametrize("rate", [1.0, 3.0])
@pytest.mark.parametrize("stall_s", [0.3, 0.8, 2.0, 3.0])
def test_burst_after_stalled_connection_does_not_speed_up_clock(stall_s: float, rate: float) -> None:
    """After a stall, TCP delivers all late data at one moment. The clock of the vehicle then seems to run faster."""
    until = -math.inf
    in_order = 1 - 1e-6
    bench = Bench(steady(0.01), lambda: max(0.01, (until - bench.now) * in_order), clock=lambda t: rate * t + 7)
    bench.fly(15)
    until = bench.now + stall_s
    paces = []
    for _ in range(round(15 / 0.05)):
        bench.fly(0.05)
        paces.append(bench.timing.pace)
    assert min(paces) >= max(rate - 0.001, 1.0)
    assert max(paces) <= (1.0 if rate == 1.0 else rate * 1.1)
    assert bench.worst <= 0.0, "the late data increases the estimate, so it stays an upper bound"


def test_delay_of_the_own_event_loop_is_included() -> None:
    timing = Timing()
    for i in range(60):
        timing.take_position(5000 + 50 * i, 1.0 + 0.05 * i)
    number = timing.request(3.5)
    assert number is not None
    # The request was due at 3.5 s, but a busy loop sent it at 3.9 s. The response arrived at once.
    timing.take_reply(round((5.0 + 3.9 - 1.0) * 1e9), number, 3.95)
    assert timing.delay_s == pytest.approx(0.4, abs=0.01)


def test_restarted_vehicle_is_detected_after_two_consistent_old_timestamps() -> None:
    timing = Timing()
    for number in range(100):
        assert timing.take_position(60_000 + 50 * number, 1.0 + 0.05 * number) is not None
    assert timing.take_position(30_000, 6.0) is None
    assert timing.take_position(65_000, 6.0) is not None
    assert not timing.restarted
    assert timing.take_position(2_000, 6.05) is None
    assert timing.take_position(2_050, 6.1) is not None
    assert timing.restarted
