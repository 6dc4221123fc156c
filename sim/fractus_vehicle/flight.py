"""What every flight mode is: an object that begins once and then sets the controller's targets at each step."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fractus_vehicle.vehicle import Vehicle


class Flight:
    """One mode in use; a new object each time the mode begins."""

    needs_position = True
    manual_throttle = False

    @property
    def landing(self) -> bool:
        """Whether it is in its last descent."""
        return False

    def begin(self, v: Vehicle) -> None:
        """Called once when the mode begins."""

    def step(self, v: Vehicle, dt: float) -> None:
        """Called at every control step while armed."""

    def end(self, v: Vehicle) -> None:
        """Called once when another mode begins."""
