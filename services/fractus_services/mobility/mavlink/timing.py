"""How late the vehicle's state comes and how late it obeys: measured upper bounds, in seconds of the vehicle's own clock.

The autopilot stamps its positions and the TIMESYNC requests that it hears with one clock, whose offset to ours is not
known. Let E be the latest reading of that clock that its positions prove. A request that is sent at E and heard at H
took the vehicle at most H - E longer than the fastest position takes to come: the way there and that way back together.
A position stamped S is E - S older than the fastest one would be. Their sum, E - S + max(H - E), bounds the time from a
position to the effect of a command that is sent now: the unknown offset cancels, whichever way is the slower one.
"""

from __future__ import annotations

import math
import secrets
from collections import deque
from itertools import islice

from fractus_services.mobility.autopilot import MAX_POSITION_AGE_S

PROBE_S = 0.2
"""How often the delay is measured."""

WINDOW_S = 10.0
"""The longest delay of this time counts."""

ENVELOPE_S = 2.0
"""Positions of this time tell what the vehicle's clock shows now."""

STALE_S = 3.0
"""Without an answer for this time, in which fifteen were due, the delay is not known."""

UNANSWERED = 10
"""A vehicle that leaves this number of requests in a row without an answer is measured by its acknowledgements of commands."""

RATE_S = (1.0, 10.0)
"""The vehicle's clock is compared with ours over at least the first and at most the second time."""

REACTION_S = 0.25
"""What comes on top: the autopilot's loops, the time to tilt, and one command that was lost or overtaken and is sent again."""

MAX_ARMING_DELAY_S, MAX_DELAY_S = 1.2, 1.8
"""A link that delays by more than the first, there and back, lets nothing arm; above the second a flying drone hovers."""

MAX_PACE = 6.0
"""A simulator that runs faster than this multiple of real time cannot be followed."""

OVERTAKEN_S = 5.0
"""A position that is older than the last by less than this was overtaken on its way. One that is older by more is of long ago, or the
vehicle has restarted: then the next one goes on from it."""

_WRAP_MS = 1 << 32
_SLACK_S = 0.5
"""Positions may wait in the autopilot before they are sent; a reply that contradicts them by more is of another clock."""


class Timing:
    """Measures one link; times are our monotonic seconds unless they are said to be the vehicle's.

    Attributes:
        pace: how many of the vehicle's seconds go by in one of ours.
        restarted: whether the vehicle's clock has begun again since the last reset.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget everything: another link, or a vehicle that has restarted."""
        self._boot_ms = 0
        self._sampled = self._arrived_at = self._resumed_at = self._compared_from = -math.inf
        self._samples: deque[tuple[float, float]] = deque()
        self._history: deque[tuple[float, float]] = deque()
        self._asked: dict[int, tuple[float, float]] = {}
        self._delays: deque[tuple[float, float, float]] = deque()
        self._unanswered = 0
        self._heard_at = self._read_at_ns = self._answered = -math.inf
        self.pace = 1.0
        self.restarted = False
        self._begun_ms: int | None = None

    def sampled(self, boot_ms: int, now: float) -> float | None:
        """Take the time stamp of a position.

        Args:
            boot_ms: the vehicle's clock; it wraps after 49 days.
            now: when it arrived.

        Returns:
            How much later it came than the fastest of the last ones, in our seconds; None for a position that came
            twice, or that a later one has overtaken.
        """
        if self._samples:
            later_s = self._since(boot_ms)
            if -OVERTAKEN_S < later_s <= 0.0:
                return None
            if later_s <= 0.0:
                # One from long ago that a network delivers now is no place to fly by: a vehicle that has restarted goes on from there.
                begun_ms, self._begun_ms = self._begun_ms, boot_ms
                if begun_ms is None or not 0 < boot_ms - begun_ms < OVERTAKEN_S * 1e3:
                    return None
                self.reset()
                self.restarted = True
            elif self._present(now) + OVERTAKEN_S < self._sampled + later_s:
                self.reset()
        self._begun_ms = None
        if now - self._arrived_at > MAX_POSITION_AGE_S:
            # What was sent while nothing came measures the gap, not the link that is back. And what a connection kept
            # meanwhile comes all at once: nothing of it says how fast the vehicle's clock runs.
            self._asked.clear()
            self._resumed_at = now
            self._history.clear()
            self._compared_from = now + ENVELOPE_S if self._samples else now
        self._sampled, self._boot_ms = (self._sampled + self._since(boot_ms) if self._samples else 0.0), boot_ms
        self._arrived_at = now
        while self._samples and self._at(self._samples[-1], now) <= self._sampled:
            self._samples.pop()
        self._samples.append((now, self._sampled))
        while self._samples[0][0] < now - ENVELOPE_S:
            self._samples.popleft()
        self._compare(now)
        return (self._present(now) - self._sampled) / self.pace

    def age_s(self, boot_ms: int, now: float) -> float:
        """How much later a message with a time stamp came than the fastest of the last positions, in our seconds; 0 while there are none."""
        if not self._samples:
            return 0.0
        return max(self._present(now) - self._sampled - self._since(boot_ms), 0.0) / self.pace

    def _since(self, boot_ms: float) -> float:
        """The vehicle's seconds from the last position to a reading of its clock, which may have wrapped between."""
        return ((boot_ms - self._boot_ms + _WRAP_MS / 2) % _WRAP_MS - _WRAP_MS / 2) / 1e3

    def _present(self, at: float) -> float:
        """The latest reading of the vehicle's clock that its positions prove for a moment."""
        return max(self._at(sample, at) for sample in self._samples)

    def _at(self, sample: tuple[float, float], at: float) -> float:
        arrived, stamp = sample
        return stamp + self.pace * (at - arrived)

    def _compare(self, now: float) -> None:
        """How fast the vehicle's clock runs: as fast as ours, unless that is certainly wrong."""
        if now < self._compared_from:
            return
        if not self._history or now - self._history[-1][0] >= RATE_S[0] / 4:
            self._history.append((now, self._sampled))
        while self._history[0][0] < now - RATE_S[1]:
            self._history.popleft()
        since_s = now - self._history[0][0]
        if since_s < RATE_S[0]:
            return
        # A position that came late makes the clock seem fast as long as it is the first; its neighbour was in time.
        rate = min((self._sampled - first) / (now - begun) for begun, first in islice(self._history, 2))
        error = (max(self.delay_s, 0.0) + 0.1) / since_s
        # The error grows with what is measured by it: a delay that is not known does not count.
        self.pace = rate + min(error, 0.1 * rate) if rate > 1.0 + min(error, 1.0) else 1.0

    def request(self, due: float) -> int | None:
        """Begin a measurement that was due at a moment: that it is sent late counts. The `ts1` of its TIMESYNC, if any.

        Its number is random: replies to the requests of others are heard as well.
        """
        if not self._samples:
            return None
        for number in [number for number, (sent, _) in self._asked.items() if sent < due - STALE_S]:
            del self._asked[number]
        number = secrets.randbits(62) + 1
        self._asked[number] = due, self._present(due)
        self._unanswered += 1
        return number

    def replied(self, tc1_ns: int, ts1: int, now: float) -> None:
        """Take a TIMESYNC message: a reply to ours once, nothing else."""
        asked = self._asked.pop(ts1, None) if tc1_ns != 0 else None
        if asked is None or not self._samples:
            return
        self.restarted = self.restarted or tc1_ns < self._read_at_ns - OVERTAKEN_S * 1e9
        self._read_at_ns = tc1_ns
        sent, present = asked
        heard = self._sampled + self._since(tc1_ns / 1e6)
        delay_s = heard - present
        if -_SLACK_S <= delay_s <= self.pace * (now - sent) + _SLACK_S:
            self._unanswered = 0
            self._answered = max(self._answered, sent)
            self._take(max(delay_s, 0.0), sent, now)

    def acknowledged(self, sent: float, now: float) -> None:
        """Take the acknowledgement of a command: of a vehicle that answers no TIMESYNC its round trip is the bound.

        A command that was sent again until the link was back measures the gap.
        """
        resumed = sent >= self._resumed_at and now - self._arrived_at <= MAX_POSITION_AGE_S
        if self.unanswering and resumed:
            self._take(self.pace * (now - sent), sent, now)

    @property
    def unanswering(self) -> bool:
        """Whether the vehicle answers no TIMESYNC."""
        return self._unanswered >= UNANSWERED

    def _take(self, delay_s: float, sent: float, now: float) -> None:
        self._heard_at = now
        self._delays.append((now, delay_s, now - sent))
        while self._delays[0][0] < now - WINDOW_S:
            self._delays.popleft()

    @property
    def delay_s(self) -> float:
        """The longest delay of late, there and back, in the vehicle's seconds; infinite while there is none."""
        return max((delay_s for _, delay_s, _ in self._delays), default=math.inf)

    def downlink_latency_s(self, now: float) -> float:
        """Our seconds that any message takes at most, by the longest delay of late there and back; infinite: not known."""
        return math.inf if now - self._heard_at > STALE_S else self.delay_s / self.pace

    @property
    def answer_s(self) -> float:
        """Our seconds that the slowest answer of late took; 0 while there is none."""
        return max((took_s for _, _, took_s in self._delays), default=0.0)

    def silence_s(self, now: float) -> float:
        """Our seconds since the last answer: one that is under way may take as long already; infinite: there was none."""
        return now - self._heard_at

    def latency_s(self, now: float) -> float:
        """The vehicle's seconds from its last position to the effect of a command that is sent now; infinite: not known."""
        if now - self._heard_at > STALE_S or self.delay_s > MAX_DELAY_S:
            return math.inf
        age_s = self._present(now) - self._sampled
        # By waiting alone nothing gets slower than can be flown with: one request may be lost, and the next one answered.
        delay_s = min(self.delay_s + self.pace * self._overdue_s(now), MAX_DELAY_S)
        return age_s + delay_s + REACTION_S if age_s <= MAX_POSITION_AGE_S else math.inf

    def _overdue_s(self, now: float) -> float:
        """By how much the first request after the last answered one waits longer than the slowest answer of late took.

        A link that gets slow tells by no answer until the first slow one is there: meanwhile it is slower by this at the least.
        """
        if self.unanswering and now - self._answered > STALE_S:
            return 0.0  # It is measured by its acknowledgements; before that, its answers may only have become slow.
        waiting = min((sent for sent, _ in self._asked.values() if sent > self._answered), default=now)
        return max(now - waiting - self.answer_s, 0.0)

    def problem(self, now: float) -> str:
        """Why nothing may arm over this link; empty when nothing is wrong."""
        if self.pace > MAX_PACE:
            return (
                f"the autopilot's clock runs {self.pace:.1f} times as fast as real time, and more than {MAX_PACE:g} times"
                " cannot be followed; run the simulator slower"
            )
        if now - self._heard_at > STALE_S:
            return (
                "the delay of the autopilot's link is not known: it answers neither TIMESYNC nor commands at the moment"
            )
        if self.delay_s > MAX_ARMING_DELAY_S:
            return (
                f"the autopilot's link delays by {self.delay_s:.1f} s there and back, and only up to {MAX_ARMING_DELAY_S} s"
                " can be flown with; use a faster link"
            )
        return ""
