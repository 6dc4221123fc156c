"""What one kind of autopilot does in its own way: the seam between the mobility service and its firmware.

MAVLink says how to ask for a mode, a parameter or a fence, not which modes and parameters there are. All that is a
firmware's own is behind `FlightStack`; `ardupilot` has the one of ArduCopter.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

from fractus_core.control.state import FlightMode
from fractus_core.policy.decision_types import Airframe
from fractus_core.policy.return_route import ReturnBounds


@dataclass(frozen=True, slots=True)
class Setting:
    """One parameter that must hold.

    Attributes:
        names: its name, and older or newer spellings of it.
        value: what it is set to.
        accepted: values that may stay as they are.
        span: values above the first and up to the second may stay, too.
        needed: whether arming is refused when the vehicle does not have it.
        why: what it does, for people.
        also: what else must hold where the vehicle has it under one of its names.
    """

    names: tuple[str, ...]
    value: float
    accepted: frozenset[float]
    needed: bool
    why: str
    also: Mapping[str, Setting] = field(default_factory=dict)
    span: tuple[float, float] | None = None

    def holds(self, value: float) -> bool:
        """Whether a value may stay as it is."""
        within = self.span is not None and self.span[0] < value <= self.span[1]
        return value == self.value or value in self.accepted or within


Names = tuple[tuple[str, float], ...]
"""A parameter's name, and older or newer spellings of it, each with what its values are multiplied by."""


class ParameterReader(Protocol):
    """Figures from the parameters that the vehicle told, and what is wrong with them.

    Attributes:
        problems: which are not numbers, or missing.
    """

    problems: list[str]

    def read(self, names: Names, otherwise: float, *, needed: bool = True) -> float:
        """A figure; another when the vehicle tells none that can be used, which is a problem if it is needed."""


class FlightStack(Protocol):
    """The firmware of an autopilot.

    Attributes:
        guided: the mode in which it obeys the companion.
        land: the mode in which it lands where it is.
        return_straight: the mode in which it flies home straight.
        return_retracing: the mode in which it flies home on the path that it came; `return_straight` where there is none.
        witness: a parameter that each such autopilot has: one that does not tell it does not answer at all.
        failsafes: what must hold before anything may arm, and stays.
        flown: what must hold while it flies for a mission; its owner may have it otherwise.
        straight: failsafes that bring the drone home straight.
        retracing: failsafes that bring it home on its own path; the first one tells in flight which of both was chosen.
        path_memory: the parameter with the number of points of its path that it remembers, and how many are enough to rely
            on that.
        movement: parameters that tell how it moves, by their spellings.
        leg_speed: the parameter with the speed of its legs, by its spellings.
        returning: parameters that tell how high and how fast it flies home by itself, by their spellings.
        fence_switch: the parameter that switches the fence on.
        fence_total: the parameter that counts the fence's items.
        fence_parameters: those of the fence in the order in which they are set, the switch last.
        gimbal_type: the parameter with the type of its first gimbal.
        measured_gimbals: types of which it reports what they measure; of others it may repeat what they were told.
    """

    guided: FlightMode
    land: FlightMode
    return_straight: FlightMode
    return_retracing: FlightMode
    witness: str
    failsafes: tuple[Setting, ...]
    flown: tuple[Setting, ...]
    straight: tuple[Setting, ...]
    retracing: tuple[Setting, ...]
    path_memory: tuple[str, float]
    movement: tuple[tuple[str, ...], ...]
    leg_speed: tuple[str, ...]
    returning: tuple[tuple[str, ...], ...]
    fence_switch: str
    fence_total: str
    fence_parameters: tuple[str, ...]
    gimbal_type: str
    measured_gimbals: frozenset[float]

    def foreign(self, vehicle_type: int, autopilot: int) -> str:
        """What flies instead, by MAV_TYPE and MAV_AUTOPILOT of its heartbeat; empty when it is this firmware's."""

    def mode(self, custom_mode: int) -> FlightMode:
        """The flight mode of a heartbeat's `custom_mode`."""

    def mode_parameters(self, mode: FlightMode) -> tuple[float, ...]:
        """The parameters of MAV_CMD_DO_SET_MODE behind the first, which asks for a mode of the firmware's own."""

    def explains_refusal(self, text: str) -> bool:
        """Whether a status text says why a command was refused."""

    def tells_failsafe(self, text: str) -> bool:
        """Whether a status text says that a failsafe acts."""

    def tells_path_lost(self, text: str) -> bool:
        """Whether a status text says that the vehicle forgot the path that it came."""

    def return_values(self, owned: Mapping[str, float], bounds: ReturnBounds) -> dict[str, float]:
        """Parameters with which it flies home by itself no higher and no faster than it may.

        Args:
            owned: the owner's, as far as the vehicle has them.
            bounds: how high and how fast it may fly.
        """

    def airframe(self, reader: ParameterReader, known: Airframe, speed_mps: float) -> tuple[Airframe, float]:
        """How the vehicle moves, and the speed of its legs; what cannot be used is as it is known."""

    def return_altitude_m(self, reader: ParameterReader, known_m: float) -> float:
        """How high it climbs to fly home by itself, under the fence that it has by now."""

    def fence_values(
        self, owned: Mapping[str, float], *, ceiling_m: float | None, polygon: bool, retraces: bool
    ) -> dict[str, float]:
        """The parameters of a fence around a mission, beside the owner's own where that is in force.

        Args:
            owned: the owner's, as far as the vehicle has them.
            ceiling_m: above home; None without a limit.
            polygon: whether there is an area that must not be left.
            retraces: whether the vehicle that breaches it is to fly back the way it came.
        """
