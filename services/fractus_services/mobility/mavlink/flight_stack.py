"""Interface to the autopilot's firmware.

MAVLink defines how modes, parameters and fences are requested, but not which modes and parameters exist. Everything that is specific
to a firmware is behind `FlightStack`. `ardupilot` implements it for ArduCopter.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Protocol

from fractus_core.control.state import FlightMode
from fractus_core.policy.decision_types import Airframe
from fractus_core.policy.return_route import ReturnBounds


@dataclass(frozen=True, slots=True)
class Setting:
    """One parameter value that must hold.

    Attributes:
        names: Name of the parameter, and its names in older or newer releases.
        value: Value that is set.
        accepted: Values that may stay, in addition to `value`.
        span: Range of further values that may stay. The lower end of the range is excluded, the upper end is included.
        needed: True if arming is refused when the vehicle does not have the parameter.
        purpose: What the autopilot does because of the setting: a verb phrase for messages.
        additional: Further settings by name of the parameter. Each one must hold if the vehicle uses the parameter
            under that name.
    """

    names: tuple[str, ...]
    value: float
    accepted: frozenset[float]
    needed: bool
    purpose: str
    additional: Mapping[str, Setting] = field(default_factory=dict)
    span: tuple[float, float] | None = None

    def holds(self, value: float) -> bool:
        """Return True if a value may stay."""
        within = self.span is not None and self.span[0] < value <= self.span[1]
        return value == self.value or value in self.accepted or within


Names = tuple[tuple[str, float], ...]
"""Name of a parameter, and its names in older or newer releases, each with the factor of its values."""


class ParameterReader(Protocol):
    """Values of the vehicle's parameters, and problems with them.

    Attributes:
        problems: Parameters that are missing or not a number.
    """

    problems: list[str]

    def read(self, names: Names, default: float, *, needed: bool = True) -> float:
        """Return a scaled value, or the default if the parameter is missing or invalid.

        An invalid parameter is a problem. A missing parameter is a problem only if it is needed.
        """


class FlightStack(Protocol):
    """Firmware of an autopilot.

    Attributes:
        guided: Mode in which the autopilot follows the companion's commands.
        land: Mode that lands at the current position.
        return_straight: Mode that flies home on a straight line.
        return_retracing: Mode that flies home along the path; equal to `return_straight` if the firmware has none.
        probe_parameter: Parameter that every autopilot with this firmware has, so that a request for it is always answered.
        failsafes: Settings that must hold before arming and afterwards.
        mission_settings: Settings that must hold during a mission. The owner's values may differ.
        straight_return: Failsafe settings for a straight return.
        path_return: Failsafe settings for a return along the path. The first one shows in flight which return was chosen.
        path_memory: Parameter with the capacity of the path memory in points, and the capacity that is sufficient.
        movement: Parameters that determine the dynamics, each with its names.
        leg_speed: Names of the parameter with the speed of legs.
        returning: Parameters that determine altitude and speed of the autopilot's return flight, each with its names.
        fence_switch: Parameter that enables the fence.
        fence_total: Parameter that counts the fence items.
        fence_parameters: Fence parameters in the order in which they are set, the switch last.
        variance_limit: Parameter with the variance of the estimator at which its failsafe acts.
        gimbal_type: Parameter with the type of the first gimbal.
        measured_gimbals: Gimbal types with a measured attitude. Other types may report their target.
    """

    guided: FlightMode
    land: FlightMode
    return_straight: FlightMode
    return_retracing: FlightMode
    probe_parameter: str
    failsafes: tuple[Setting, ...]
    mission_settings: tuple[Setting, ...]
    straight_return: tuple[Setting, ...]
    path_return: tuple[Setting, ...]
    path_memory: tuple[str, float]
    movement: tuple[tuple[str, ...], ...]
    leg_speed: tuple[str, ...]
    returning: tuple[tuple[str, ...], ...]
    fence_switch: str
    fence_total: str
    fence_parameters: tuple[str, ...]
    variance_limit: str
    gimbal_type: str
    measured_gimbals: frozenset[float]

    def unsupported(self, vehicle_type: int, autopilot: int) -> str:
        """Return why a vehicle is not supported, from its MAV_TYPE and MAV_AUTOPILOT; empty if it has this firmware."""

    def mode(self, custom_mode: int) -> FlightMode:
        """Return the flight mode of a heartbeat's `custom_mode`."""

    def mode_parameters(self, mode: FlightMode) -> tuple[float, ...]:
        """Return the parameters of MAV_CMD_DO_SET_MODE from param2 on.

        The caller sets param1, which requests a custom mode.
        """

    def explains_refusal(self, command: int, text: str) -> bool:
        """Return True if a status text states why a command (MAV_CMD) was refused."""

    def probable_refusal(self, command: int) -> str:
        """Return the probable reason for a command that failed without a status text; empty if there is no typical one."""

    def reports_failsafe(self, text: str) -> bool:
        """Return True if a status text reports an active failsafe."""

    def reports_path_lost(self, text: str) -> bool:
        """Return True if a status text reports that the recorded path was discarded."""

    def reports_estimator_switch(self, text: str) -> bool:
        """Return True if a status text reports that the autopilot uses another of its estimators."""

    def return_values(self, owned: Mapping[str, float], bounds: ReturnBounds) -> dict[str, float]:
        """Return parameters that limit altitude and speed of the autopilot's return flight.

        Args:
            owned: Values of the owner, for the parameters that the vehicle has.
            bounds: Limits of altitude and speed.
        """

    def under_names_of(self, present: Collection[str], values: Mapping[str, float]) -> dict[str, float]:
        """Return parameters under the names, and in the units, that the vehicle's release of the firmware has.

        Args:
            present: Names of the vehicle's parameters.
            values: Values under names of this or another release. Unknown names are dropped.
        """

    def airframe(self, reader: ParameterReader, known: Airframe, speed_mps: float) -> tuple[Airframe, float]:
        """Return the vehicle's dynamics and the speed of its legs. Invalid parameters keep their known values."""

    def return_altitude_m(self, reader: ParameterReader, known_m: float) -> float:
        """Return the altitude of the autopilot's return flight under its current fence."""

    def fence_values(
        self, owned: Mapping[str, float], *, ceiling_m: float | None, polygon: bool, retraces: bool
    ) -> dict[str, float]:
        """Return the parameters of a fence around a mission, in addition to an active fence of the owner.

        Args:
            owned: Values of the owner, for the parameters that the vehicle has.
            ceiling_m: Maximum altitude above home; None without a limit.
            polygon: True if the mission is limited to an area.
            retraces: True if a vehicle that breaches the fence should return along its path.
        """
