"""Model of the air between stations: one frame at a time, with airtime, acknowledgement and retries (802.11g DCF).

A pure discrete-event model: frames and times are inputs, arrivals are outputs.
"""

from __future__ import annotations

import math
import random
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from fractus_radio.propagation import SENSITIVITY_DBM, Propagation

Position = tuple[float, float, float]

RATE_BPS = 24e6
HEADER_BYTES = 76
"""LLC and MAC headers and checksum, transmitted at the data rate."""
FIXED_S = 269e-6
"""Duration of DIFS, mean first back-off, preambles, SIFS and ACK.

Airtimes of 40 to 1400 bytes match ns-3 within 2 us.
"""
SLOT_S = 20e-6
FIRST_WINDOW = 16
MAX_WINDOW = 1024
ATTEMPTS = 7
QUEUE_FRAMES = 100

MIN_FRAME_BYTES = 14
GROUP_BIT = 0x01


def airtime_s(frame_bytes: int, attempt: int = 0) -> float:
    """Return the airtime of an attempt to send an Ethernet frame. Each retry has a longer back-off."""
    window = min(FIRST_WINDOW << attempt, MAX_WINDOW)
    back_off_s = (window - FIRST_WINDOW) / 2 * SLOT_S
    return (frame_bytes - MIN_FRAME_BYTES + HEADER_BYTES) * 8 / RATE_BPS + FIXED_S + back_off_s


@dataclass(slots=True)
class Station:
    """A radio station.

    Attributes:
        position: Position in metres, in the common frame of all stations.
        address: MAC address.
        network: Network name (SSID). A station receives only frames of its own network.
        silent: True if the station receives but sends nothing.
        off: True if the station neither receives nor sends.
        loss_db: Additional loss by a fade or interference.
        reach: Range, as a share of the range of the medium. The shorter range of its two stations applies to a link.
    """

    position: Position
    address: bytes
    network: str = ""
    silent: bool = False
    off: bool = False
    loss_db: float = 0.0
    reach: float = 1.0
    queue: deque[bytes] = field(default_factory=deque)
    dropped: int = 0


@dataclass(frozen=True, slots=True)
class Attempt:
    """An attempt to transmit a frame.

    Attributes:
        station: Sender.
        frame: Ethernet frame.
        number: Number of the attempt, from 0.
        arrived: True if an earlier attempt arrived and only its ACK was lost. The receiver then drops the copy.
    """

    station: str
    frame: bytes
    number: int = 0
    arrived: bool = False


@dataclass(frozen=True, slots=True)
class Arrival:
    """A frame that a station receives."""

    station: str
    frame: bytes


class Medium:
    """The air shared by all stations.

    Args:
        propagation: Channel model.
        seed: Random seed of fading.
    """

    def __init__(self, propagation: Propagation, seed: int = 0) -> None:
        self.stations: dict[str, Station] = {}
        self._propagation = propagation
        self._chance = random.Random(seed)  # noqa: S311 - a simulation, not a secret
        self._sending: Attempt | None = None
        self._free_s = 0.0
        self._order: deque[str] = deque()

    def add(self, name: str, station: Station) -> None:
        """Add a station."""
        self.stations[name] = station
        self._order.append(name)

    def offer(self, name: str, frame: bytes, now_s: float) -> None:
        """Queue an Ethernet frame of a station. Drop it if the queue is full."""
        station = self.stations[name]
        if station.off or station.silent or len(frame) < MIN_FRAME_BYTES:
            return
        if len(station.queue) >= QUEUE_FRAMES:
            station.dropped += 1
            return
        station.queue.append(frame)
        if self._sending is None:
            self._begin(max(now_s, self._free_s))

    @property
    def next_s(self) -> float:
        """Time at which the current attempt ends. Infinite while the air is free."""
        return self._free_s if self._sending is not None else math.inf

    def advance(self, now_s: float) -> Iterator[Arrival]:
        """Return the arrivals up to `now_s`."""
        while self._sending is not None and self._free_s <= now_s:
            attempt = self._sending
            self._sending = None
            yield from self._end(attempt)
            if self._sending is None:
                self._begin(self._free_s)

    def _begin(self, at_s: float) -> None:
        """Start to send the next frame. Stations take turns, so that contention is fair."""
        for _ in range(len(self._order)):
            name = self._order[0]
            self._order.rotate(-1)
            if self.stations[name].queue:
                frame = self.stations[name].queue.popleft()
                self._sending = Attempt(name, frame)
                self._free_s = at_s + airtime_s(len(frame))
                return

    def _end(self, attempt: Attempt) -> Iterator[Arrival]:
        name = attempt.station
        frame = attempt.frame
        if frame[0] & GROUP_BIT:  # a broadcast has no acknowledgement and no retry
            yield from (
                Arrival(other, frame) for other in self.stations if other != name and self._receives(name, other)
            )
            return
        receiver = next((n for n, s in self.stations.items() if s.address == frame[:6] and n != name), None)
        arrived = receiver is not None and self._receives(name, receiver)
        if receiver is not None and arrived:
            if not attempt.arrived:
                yield Arrival(receiver, frame)
            if self._receives(receiver, name):
                return
        if attempt.number + 1 < ATTEMPTS and not self.stations[name].off:
            self._sending = Attempt(name, frame, attempt.number + 1, attempt.arrived or arrived)
            self._free_s += airtime_s(len(frame), attempt.number + 1)

    def _receives(self, sender: str, receiver: str) -> bool:
        a = self.stations[sender]
        b = self.stations[receiver]
        if a.off or b.off or a.network != b.network:
            return False
        return self._propagation.receives(_distance_m(a, b), self._chance, loss_db=a.loss_db + b.loss_db)

    def neighbours(self, name: str) -> Mapping[str, float]:
        """Return the stations of the same network in range, and their mean received power in dBm."""
        scanner = self.stations[name]
        powers = {}
        for other, station in self.stations.items():
            if other != name and not scanner.off and not station.off and station.network == scanner.network:
                power = (
                    self._propagation.received_dbm(_distance_m(scanner, station)) - scanner.loss_db - station.loss_db
                )
                if power >= SENSITIVITY_DBM:
                    powers[other] = power
        return powers


def _distance_m(a: Station, b: Station) -> float:
    """Return the distance of two stations divided by the smaller `reach`.

    The range of the medium applies to the result.
    """
    return math.dist(a.position, b.position) / min(a.reach, b.reach)
