"""Model of a simple network: the same range, loss, delay and rate between all its members.

It describes a network by its measured properties. `medium` models the radio channel of 802.11g instead.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from dataclasses import dataclass

from fractus_radio.medium import GROUP_BIT, MIN_FRAME_BYTES, Arrival, Position
from fractus_radio.uplink import Uplink


@dataclass(slots=True)
class Member:
    """A member of a network.

    Attributes:
        address: MAC address.
        sender: Rate and delay of the frames that the member sends.
        position: Position in metres, in the common frame of all members. None: the range does not apply to this member.
    """

    address: bytes
    sender: Uplink
    position: Position | None = None


class SharedNetwork:
    """Carries frames between members. It is a pure model: all times are arguments.

    Args:
        range_m: Maximum distance between sender and receiver, metres. None: unlimited.
        loss: Share of frames that are lost, from 0 to 1.
        delay_s: Delay from the end of transmission to arrival, seconds.
        rate_bps: Rate at which each member sends, bits per second.
        seed: Random seed of losses.
    """

    def __init__(
        self,
        *,
        range_m: float | None = None,
        loss: float = 0.0,
        delay_s: float = 0.0,
        rate_bps: float = 1e9,
        seed: int = 0,
    ) -> None:
        self.members: dict[str, Member] = {}
        self._range_m = math.inf if range_m is None else range_m
        self._loss = loss
        self._delay_s = delay_s
        self._rate_bps = rate_bps
        self._chance = random.Random(seed)  # noqa: S311 - a simulation, not a secret

    def add(self, name: str, address: bytes, position: Position | None = None) -> Member:
        """Add a member, and return it."""
        member = Member(address, Uplink(self._rate_bps, self._delay_s), position)
        self.members[name] = member
        return member

    def offer(self, name: str, frame: bytes, now_s: float) -> None:
        """Queue an Ethernet frame of a member. Drop it if the queue is full."""
        if len(frame) >= MIN_FRAME_BYTES:
            self.members[name].sender.offer(frame, now_s)

    @property
    def next_s(self) -> float:
        """Time of the next arrival. Infinite if no frame is in transit."""
        return min((member.sender.next_s for member in self.members.values()), default=math.inf)

    def advance(self, now_s: float) -> Iterator[Arrival]:
        """Return the arrivals up to `now_s`."""
        for name, member in self.members.items():
            for frame in member.sender.advance(now_s):
                for other, receiver in self.members.items():
                    addressed = frame[0] & GROUP_BIT or frame[:6] == receiver.address
                    if other != name and addressed and self._receives(member, receiver):
                        yield Arrival(other, frame)

    def _receives(self, sender: Member, receiver: Member) -> bool:
        distance_m = 0.0
        if sender.position is not None and receiver.position is not None:
            distance_m = math.dist(sender.position, receiver.position)
        return distance_m <= self._range_m and self._chance.random() >= self._loss
