"""Simulated networks between virtual drones, edge nodes, the cloud and the controller."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Network:
    """Properties of a network. Delay and bandwidth refer to real time, also with a speed-up.

    Attributes:
        range: Maximum distance between two participants, metres. None: unlimited.
        loss: Share of lost packets.
        delay: Seconds in each direction.
        bandwidth: Mbit/s that each participant can send.
    """

    range: float | None = None
    loss: float = 0.0
    delay: float = 0.0
    bandwidth: float = 1000.0

    def to_dict(self) -> dict[str, float]:
        """Return the properties as fields of an experiment file."""
        fields = {"loss": self.loss, "delay": self.delay, "bandwidth": self.bandwidth}
        return fields if self.range is None else {"range": self.range, **fields}


WIFI = Network(range=100.0, delay=0.002, bandwidth=24.0)
"""802.11g without its airtime: 24 Mbit/s up to 100 m."""

LTE = Network(delay=0.06, bandwidth=8.0)
"""Mobile network: 8 Mbit/s and 60 ms at any distance."""
