"""Whether a frame is received over a distance: log-distance path loss, with or without Nakagami fading.

The figures follow ns-3's 802.11g ad hoc model, which the thesis used (8.9.3): a reference loss of 46.68 dB at 1 m, and
reception down to -82 dBm.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass

REFERENCE_LOSS_DB = 46.68
SENSITIVITY_DBM = -82.0
OPEN_EXPONENT = 2.2
"""Path-loss exponent over open ground, which places the edge of a declared range."""


@dataclass(frozen=True, slots=True)
class Propagation:
    """A channel between stations.

    Attributes:
        power_dbm: transmit power.
        exponent: of the path loss.
        fading: shape of Nakagami fading; None for none, and then the range has a hard edge.
    """

    power_dbm: float
    exponent: float = OPEN_EXPONENT
    fading: float | None = None

    @classmethod
    def reaching(cls, range_m: float, *, fading: float | None = None) -> Propagation:
        """The channel whose edge, without fading, is at a declared range."""
        power = SENSITIVITY_DBM + REFERENCE_LOSS_DB + 10 * OPEN_EXPONENT * math.log10(range_m)
        return cls(power, OPEN_EXPONENT, fading)

    def received_dbm(self, distance_m: float) -> float:
        """Mean power at a distance; nearer than 1 m is as at 1 m."""
        return self.power_dbm - REFERENCE_LOSS_DB - 10 * self.exponent * math.log10(max(distance_m, 1.0))

    def receives(self, distance_m: float, chance: random.Random, *, loss_db: float = 0.0) -> bool:
        """Whether one frame is received.

        Args:
            distance_m: between the stations.
            chance: source of fading.
            loss_db: beyond the path's, by interference or an obstacle.
        """
        power = self.received_dbm(distance_m) - loss_db
        if self.fading is None:
            return power >= SENSITIVITY_DBM
        gain = chance.gammavariate(self.fading, 1.0 / self.fading)
        return gain > 0 and power + 10 * math.log10(gain) >= SENSITIVITY_DBM
