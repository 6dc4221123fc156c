"""Upper bounds of the delays of vehicle state and commands, in seconds of the vehicle's clock.

The autopilot stamps its positions, and the TIMESYNC requests that it receives, with one clock. The offset of this clock
is unknown. A position that was stamped S and arrived t seconds (of this clock) ago shows that this clock reads at least
S + t now. Let E be the largest of these lower bounds. A request that is sent when the bound is E, and that is stamped H
on reception, took at most H - E longer on the uplink than the fastest position took on the downlink. A position stamped
S is E - S older than it would be if it had arrived as fast as the fastest position. The sum E - S + max(H - E)
therefore bounds the time from a position to the effect of a command that is sent now. The sum does not depend on the
unknown offset, regardless of which direction of the link is slower.
"""

from __future__ import annotations

import math
import secrets
from collections import deque
from itertools import islice

from fractus_services.mobility.autopilot import MAX_POSITION_AGE_S

PROBE_S = 0.2
"""Interval between measurements."""

WINDOW_S = 10.0
"""Seconds for which measured delays are kept. The longest of them is the delay of the link."""

ENVELOPE_S = 2.0
"""Seconds for which received positions are used to compute a lower bound of the vehicle's clock."""

STALE_S = 3.0
"""Seconds without an answer after which the delay is unknown. In this time, 15 answers are due."""

UNANSWERED = 10
"""Number of consecutive unanswered requests after which acknowledgements of commands measure the link."""

RATE_S = (1.0, 10.0)
"""Shortest and longest period over which the vehicle's clock is compared with real time."""

REACTION_S = 0.25
"""Additional delay: the autopilot's loops, the time to tilt, and one lost or overtaken command that is sent again."""

MAX_ARMING_DELAY_S = 1.2
"""Round-trip delay above which arming is refused."""

MAX_DELAY_S = 1.8
"""Round-trip delay above which a flying drone hovers."""

MAX_PACE = 6.0
"""Fastest simulation that the service can follow, as a multiple of real time."""

OVERTAKEN_S = 5.0
"""Limit that separates overtaken positions from restarts of the vehicle, in seconds of the vehicle's clock.

If a position is older than the previous position by less than this limit, the previous position has overtaken it. If it
is older by more, the position was delivered very late, or the vehicle has restarted. After a restart, the time stamps
of the following positions continue from this position.
"""

_WRAP_MS = 1 << 32
_SLACK_S = 0.5
"""Tolerance of a measured delay, because positions may wait in the autopilot before they are sent.

A reply whose time stamp is outside the tolerance is from the clock of another system.
"""


class Timing:
    """Delays of one link. Times are monotonic seconds unless they are stated to be on the vehicle's clock.

    Attributes:
        pace: Seconds of the vehicle's clock per second of real time.
        restarted: True if the vehicle's clock has restarted since the last reset.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Reset for another link, or for a vehicle that has restarted."""
        self._boot_ms = 0
        self._sampled = self._arrived_at = self._resumed_at = self._compared_from = -math.inf
        self._samples: deque[tuple[float, float]] = deque()
        self._history: deque[tuple[float, float]] = deque()
        self._open_requests: dict[int, tuple[float, float]] = {}
        self._delays: deque[tuple[float, float, float]] = deque()
        self._unanswered = 0
        self._measured_at = self._latest_tc1_ns = self._latest_answered_sent = -math.inf
        self.pace = 1.0
        self.restarted = False
        self._restart_boot_ms: int | None = None

    def take_position(self, boot_ms: int, now: float) -> float | None:
        """Process the time stamp of a position.

        Args:
            boot_ms: Reading of the vehicle's clock, which wraps after 49 days.
            now: Time of arrival.

        Returns:
            Time by which the position took longer than the fastest recent one, in seconds of real time. None for a duplicate or an
            overtaken position.
        """
        if self._samples:
            later_s = self._since(boot_ms)
            if -OVERTAKEN_S < later_s <= 0.0:
                return None
            if later_s <= 0.0:
                # A much older position may have been delivered very late and must be ignored. If the vehicle has
                # restarted, the time stamp of the next position continues from this position.
                restart_boot_ms = self._restart_boot_ms
                self._restart_boot_ms = boot_ms
                if restart_boot_ms is None or not 0 < boot_ms - restart_boot_ms < OVERTAKEN_S * 1e3:
                    return None
                self.reset()
                self.restarted = True
            elif self._present(now) + OVERTAKEN_S < self._sampled + later_s:
                self.reset()
        self._restart_boot_ms = None
        if now - self._arrived_at > MAX_POSITION_AGE_S:
            # Requests that were sent during an interruption measure the interruption, not the link. Messages that were delayed by the
            # interruption arrive together and do not show the pace of the clock.
            self._open_requests.clear()
            self._resumed_at = now
            self._history.clear()
            self._compared_from = now + ENVELOPE_S if self._samples else now
        self._sampled = self._sampled + self._since(boot_ms) if self._samples else 0.0
        self._boot_ms = boot_ms
        self._arrived_at = now
        while self._samples:
            arrived, stamp = self._samples[-1]
            if stamp + self.pace * (now - arrived) > self._sampled:
                break
            self._samples.pop()
        self._samples.append((now, self._sampled))
        while self._samples[0][0] < now - ENVELOPE_S:
            self._samples.popleft()
        self._compare(now)
        return (self._present(now) - self._sampled) / self.pace

    def age_s(self, boot_ms: int, now: float) -> float:
        """Return how much longer a time-stamped message took than the fastest recent position, in seconds of real time.

        The result is 0 without positions.
        """
        if not self._samples:
            return 0.0
        return max(self._present(now) - self._sampled - self._since(boot_ms), 0.0) / self.pace

    def _since(self, boot_ms: float) -> float:
        """Return the seconds from the last position to a reading of the vehicle's clock, which may have wrapped."""
        return ((boot_ms - self._boot_ms + _WRAP_MS / 2) % _WRAP_MS - _WRAP_MS / 2) / 1e3

    def _present(self, at: float) -> float:
        """Return the largest lower bound of the vehicle's clock at a time, computed from recently received positions.

        A position that was stamped S and arrived t seconds before that time, by the pace of the vehicle's clock, gives
        the lower bound S + t.
        """
        return max(stamp + self.pace * (at - arrived) for arrived, stamp in self._samples)

    def _compare(self, now: float) -> None:
        """Update the pace of the vehicle's clock.

        The pace is 1 unless the measured rate exceeds 1 by more than the possible error of the measurement.
        """
        if now < self._compared_from:
            return
        if not self._history or now - self._history[-1][0] >= RATE_S[0] / 4:
            self._history.append((now, self._sampled))
        while self._history[0][0] < now - RATE_S[1]:
            self._history.popleft()
        since_s = now - self._history[0][0]
        if since_s < RATE_S[0]:
            return
        # If the first position of the period arrived late, the measured rate is too high. Therefore measure from the
        # second position as well, and take the lower rate. Both positions are rarely late.
        rate = min((self._sampled - first) / (now - begun) for begun, first in islice(self._history, 2))
        error = (max(self.delay_s, 0.0) + 0.1) / since_s
        # The error is infinite while the delay is unknown, so it is limited here.
        self.pace = rate + min(error, 0.1 * rate) if rate > 1.0 + min(error, 1.0) else 1.0

    def request(self, due: float) -> int | None:
        """Start a measurement and return the `ts1` of its TIMESYNC, if any.

        The delay of a late transmission is measured from the time at which it was due. The number is random, because replies to other
        stations are received as well.
        """
        if not self._samples:
            return None
        for number in [number for number, (sent, _) in self._open_requests.items() if sent < due - STALE_S]:
            del self._open_requests[number]
        number = secrets.randbits(62) + 1
        self._open_requests[number] = due, self._present(due)
        self._unanswered += 1
        return number

    def take_reply(self, tc1_ns: int, ts1: int, now: float) -> None:
        """Process a TIMESYNC message. Only the first reply to a request of this station counts."""
        request = self._open_requests.pop(ts1, None) if tc1_ns != 0 else None
        if request is None or not self._samples:
            return
        self.restarted = self.restarted or tc1_ns < self._latest_tc1_ns - OVERTAKEN_S * 1e9
        self._latest_tc1_ns = tc1_ns
        sent, clock_at_sending = request
        clock_at_reception = self._sampled + self._since(tc1_ns / 1e6)
        delay_s = clock_at_reception - clock_at_sending
        if -_SLACK_S <= delay_s <= self.pace * (now - sent) + _SLACK_S:
            self._unanswered = 0
            self._latest_answered_sent = max(self._latest_answered_sent, sent)
            self._add_delay(max(delay_s, 0.0), sent, now)

    def take_acknowledgement(self, sent: float, now: float) -> None:
        """Process the acknowledgement of a command.

        If the vehicle does not answer TIMESYNC, the round trip of the command is the bound. A command that was repeated until the link
        recovered measures the interruption and does not count.
        """
        resumed = sent >= self._resumed_at and now - self._arrived_at <= MAX_POSITION_AGE_S
        if self.unanswering and resumed:
            self._add_delay(self.pace * (now - sent), sent, now)

    @property
    def unanswering(self) -> bool:
        """True if the vehicle does not answer TIMESYNC."""
        return self._unanswered >= UNANSWERED

    def _add_delay(self, delay_s: float, sent: float, now: float) -> None:
        self._measured_at = now
        self._delays.append((now, delay_s, now - sent))
        while self._delays[0][0] < now - WINDOW_S:
            self._delays.popleft()

    @property
    def delay_s(self) -> float:
        """Longest recent round-trip delay in seconds of the vehicle's clock; infinite without measurements."""
        return max((delay_s for _, delay_s, _ in self._delays), default=math.inf)

    def downlink_latency_s(self, now: float) -> float:
        """Return an upper bound of the delay of a message in seconds of real time: the longest recent round trip.

        It is infinite if the delay is unknown.
        """
        return math.inf if now - self._measured_at > STALE_S else self.delay_s / self.pace

    @property
    def answer_s(self) -> float:
        """Longest recent time until an answer, in seconds of real time; 0 without answers."""
        return max((took_s for _, _, took_s in self._delays), default=0.0)

    def silence_s(self, now: float) -> float:
        """Return the seconds since the last answer; infinite without answers."""
        return now - self._measured_at

    def latency_s(self, now: float) -> float:
        """Return the time from the last reported position to the effect of a command that is sent now, in seconds of the vehicle's clock.

        It is infinite if the delay is unknown or too long to fly.
        """
        if now - self._measured_at > STALE_S or self.delay_s > MAX_DELAY_S:
            return math.inf
        age_s = self._present(now) - self._sampled
        # When the link becomes slow, the new delay is unknown until the first slow answer arrives. Until then, assume
        # that the delay has grown by the time for which the oldest unanswered request is overdue.
        overdue_s = 0.0
        # A vehicle that has not answered TIMESYNC for `STALE_S` is measured by acknowledgements of commands. Its
        # TIMESYNC requests are then not overdue. Before that, the answers may only have become slow.
        if not self.unanswering or now - self._latest_answered_sent <= STALE_S:
            later_requests = (sent for sent, _ in self._open_requests.values() if sent > self._latest_answered_sent)
            overdue_s = max(now - min(later_requests, default=now) - self.answer_s, 0.0)
        # An unanswered request alone does not make the link too slow to fly, because it may be lost and the next one answered.
        delay_s = min(self.delay_s + self.pace * overdue_s, MAX_DELAY_S)
        return age_s + delay_s + REACTION_S if age_s <= MAX_POSITION_AGE_S else math.inf

    def problem(self, now: float) -> str:
        """Return why this link forbids arming; empty if it does not."""
        if self.pace > MAX_PACE:
            return (
                f"the autopilot's clock runs {self.pace:.1f} times as fast as real time, and the maximum is {MAX_PACE:g} times;"
                " run the simulator slower"
            )
        if now - self._measured_at > STALE_S:
            return "the delay of the autopilot's link is unknown, because the autopilot answers neither TIMESYNC nor commands"
        if self.delay_s > MAX_ARMING_DELAY_S:
            return (
                f"the round trip on the autopilot's link takes {self.delay_s:.1f} s, and the maximum for arming is"
                f" {MAX_ARMING_DELAY_S} s; use a faster link"
            )
        return ""
