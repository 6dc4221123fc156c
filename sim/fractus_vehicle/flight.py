"""Base class of flight modes."""

from __future__ import annotations

from fractus_vehicle.state import VehicleState


class Flight:
    """A flight in one mode.

    Each mode change creates a new object. The object sets the targets of the controller in each control step.
    """

    @property
    def landing(self) -> bool:
        """True during the final descent."""
        return False

    def begin(self, v: VehicleState) -> None:
        """Called once when the mode begins."""

    def step(self, v: VehicleState) -> None:
        """Called at every control step while armed."""

    def wait(self, v: VehicleState) -> None:
        """Called at every control step while the motors are off."""

    def end(self, v: VehicleState) -> None:
        """Called once when another mode begins."""
