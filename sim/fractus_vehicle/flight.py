"""What every flight mode is: an object that begins once and then sets the controller's targets at each step."""

from __future__ import annotations

from fractus_vehicle.state import VehicleState


class Flight:
    """One mode in use; a new object each time the mode begins."""

    @property
    def landing(self) -> bool:
        """Whether it is in its last descent."""
        return False

    def begin(self, v: VehicleState) -> None:
        """Called once when the mode begins."""

    def step(self, v: VehicleState) -> None:
        """Called at every control step while armed."""

    def wait(self, v: VehicleState) -> None:
        """Called at every control step while the motors are off."""

    def end(self, v: VehicleState) -> None:
        """Called once when another mode begins."""
