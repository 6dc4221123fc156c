"""Start of the current or latest flight of each drone."""

from __future__ import annotations


class FlightTimes:
    """Detects takeoffs. A drone that is in the air in its first report has taken off at an unknown earlier time.

    The time of this report then counts as the start of the flight, because the source contains no earlier positions.
    """

    def __init__(self) -> None:
        self._in_air: dict[str, bool] = {}
        self._started_ms: dict[str, int] = {}

    def update(self, drone: str, time_ms: int, *, in_air: bool) -> int | None:
        """Handle a report, and return the start of the current or latest flight, or None if there was none.

        Args:
            drone: Name of the drone.
            time_ms: Time of the report in Unix milliseconds.
            in_air: True if the drone is in the air.
        """
        if in_air and not self._in_air.get(drone, False):
            self._started_ms[drone] = time_ms
        self._in_air[drone] = in_air
        return self._started_ms.get(drone)

    def forget(self, drone: str) -> None:
        """Forget a removed drone."""
        self._in_air.pop(drone, None)
        self._started_ms.pop(drone, None)
