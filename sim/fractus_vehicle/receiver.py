"""Radio receiver: channels of the sticks, or overrides of a ground station."""

from __future__ import annotations

from fractus_vehicle.shaping import clamp

STICKS_CENTRED = (1500,) * 4 + (1800,) + (1000,) * 3 + (0,) * 10
RELEASED = 0
UNCHANGED = 65535


class Receiver:
    """RC channels in microseconds. Overrides expire after RC_OVERRIDE_TIME."""

    def __init__(self, throttle_us: int = 1500) -> None:
        self._rest = (*STICKS_CENTRED[:2], throttle_us, *STICKS_CENTRED[3:])
        self.channels: tuple[int, ...] = self._rest
        self.overridden = False
        self._until_s = 0.0

    def override(self, values: tuple[int, ...], until_s: float) -> None:
        """Apply channel overrides. 0 releases a channel, 65535 leaves it unchanged."""
        channels = list(self.channels)
        for at, value in enumerate(values[: len(channels)]):
            if value == RELEASED:
                channels[at] = self._rest[at]
            elif value != UNCHANGED:
                channels[at] = int(clamp(value, 800, 2200))
        self.channels = tuple(channels)
        self.overridden = True
        self._until_s = until_s

    def release(self) -> None:
        """Release all overrides."""
        self.channels = self._rest
        self.overridden = False

    def step(self, now_s: float) -> None:
        """Release expired overrides."""
        if self.overridden and now_s > self._until_s:
            self.release()
