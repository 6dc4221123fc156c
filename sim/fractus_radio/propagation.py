"""Reception of a frame over a distance: log-distance path loss with optional Nakagami fading.

The constants follow the 802.11g ad hoc model of ns-3 used in the thesis (8.9.3): reference loss of 46.68 dB at 1 m and
reception down to -82 dBm.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass

REFERENCE_LOSS_DB = 46.68
SENSITIVITY_DBM = -82.0
OPEN_EXPONENT = 2.2
"""Path-loss exponent over open ground, used to convert a declared range to transmit power."""


@dataclass(frozen=True, slots=True)
class Propagation:
    """Channel between stations.

    Attributes:
        power_dbm: Transmit power.
        exponent: Path-loss exponent.
        fading: Shape of Nakagami fading. None: no fading, so that no frame arrives beyond the range.
    """

    power_dbm: float
    exponent: float = OPEN_EXPONENT
    fading: float | None = None

    @classmethod
    def reaching(cls, range_m: float, *, fading: float | None = None) -> Propagation:
        """Return a channel with a range.

        With fading, some frames are lost within the range and some arrive beyond it.
        """
        power = SENSITIVITY_DBM + REFERENCE_LOSS_DB + 10 * OPEN_EXPONENT * math.log10(range_m)
        return cls(power, OPEN_EXPONENT, fading)

    def received_dbm(self, distance_m: float) -> float:
        """Return the mean received power at a distance. Distances below 1 m count as 1 m."""
        return self.power_dbm - REFERENCE_LOSS_DB - 10 * self.exponent * math.log10(max(distance_m, 1.0))

    def receives(self, distance_m: float, chance: random.Random, *, loss_db: float = 0.0) -> bool:
        """Return True if a frame is received.

        Args:
            distance_m: Distance between the stations.
            chance: Random source of fading.
            loss_db: Additional loss by interference or an obstacle.
        """
        power = self.received_dbm(distance_m) - loss_db
        if self.fading is None:
            return power >= SENSITIVITY_DBM
        gain = chance.gammavariate(self.fading, 1.0 / self.fading)
        return gain > 0 and power + 10 * math.log10(gain) >= SENSITIVITY_DBM
