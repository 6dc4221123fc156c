"""The autopilot's failsafes as the last line of defence: set and read back before arming, and verified in flight."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Mapping
from dataclasses import replace

from fractus_core.policy.decision_types import Airframe

from fractus_services.mobility.autopilot import FailsafeStatus
from fractus_services.mobility.mavlink.flight_stack import Names, Setting
from fractus_services.mobility.mavlink.mavlink_autopilot import MavlinkAutopilot
from fractus_services.mobility.mavlink.parameters import ParameterLost, Parameters, Spellings, same

log = logging.getLogger(__name__)

_DEFAULT_SPEED_MPS = 5.0


class Reader:
    """Values of the vehicle's parameters, and problems with them.

    Args:
        values: Values by name. The vehicle has no other parameters.

    Attributes:
        problems: Parameters that are missing or not a number.
    """

    def __init__(self, values: Mapping[str, float]) -> None:
        self._values = values
        self.problems: list[str] = []

    def read(self, names: Names, default: float, *, needed: bool = True) -> float:
        """Return a scaled value, or the default; see `ParameterReader`."""
        for name, scale in names:
            if name in self._values:
                if math.isfinite(self._values[name]):
                    return self._values[name] * scale
                self.problems.append(f"{name} is not a number")
                return default
        if needed:
            self.problems.append(f"the autopilot has no {' or '.join(name for name, _ in names)}")
        return default


class _Settings:
    """One pass over the settings, in which each one is checked, and set if its parameter has another value.

    Args:
        parameters: Access to the vehicle's parameters.
        values: Values of the parameters as they were read.

    Attributes:
        values: Current values of the parameters.
        problems: Settings that do not hold.
        missing: Settings that the vehicle does not have.
        changed: Changed settings as sentences.
    """

    def __init__(self, parameters: Parameters, values: dict[str, float]) -> None:
        self._parameters = parameters
        self.values = values
        self.problems: list[str] = []
        self.missing: list[str] = []
        self.changed: list[str] = []

    async def establish(self, settings: Iterable[Setting]) -> bool:
        """Set parameters until the settings hold. Return False if one of them does not hold.

        Raises:
            ParameterLost: It is unknown if a setting holds.
        """
        problems = len(self.problems)
        for setting in settings:
            name = next((name for name in setting.names if name in self.values), None)
            if name is None:
                self._lacks(setting)
                continue
            await self._set(name, setting)
            if name in setting.additional:
                self.values |= await self._parameters.read([setting.additional[name].names])
                await self.establish([setting.additional[name]])
        return len(self.problems) == problems

    def _lacks(self, setting: Setting) -> None:
        self.missing.append(setting.names[0])
        if setting.needed:
            self.problems.append(f"the autopilot has no {' or '.join(setting.names)} ({setting.purpose})")

    async def _set(self, name: str, setting: Setting) -> None:
        current = self.values[name]
        if setting.holds(current):
            return
        self.values[name] = await self._parameters.write(name, setting.value)
        if not same(self.values[name], setting.value):
            self.problems.append(
                f"{name} is {current:g} and cannot be set to {setting.value:g} (the autopilot {setting.purpose})"
            )
            return
        self.changed.append(f"{name} was {current:g} and is {setting.value:g}: the autopilot {setting.purpose}")
        log.info(
            "failsafes: set %s, the autopilot %s (before=%g, after=%g)", name, setting.purpose, current, setting.value
        )  # fmt: skip


class MavlinkFailsafes:
    """Sets and reads the failsafes by their parameters, see `Failsafes`.

    Args:
        autopilot: Link to the vehicle.
    """

    def __init__(self, autopilot: MavlinkAutopilot) -> None:
        self._autopilot = autopilot
        self._stack = autopilot.stack
        self._parameters = autopilot.vehicle_parameters
        stack = self._stack
        settings = (*stack.failsafes, *stack.mission_settings, *stack.straight_return, *stack.path_return)
        self._names: tuple[Spellings, ...] = tuple(
            dict.fromkeys(
                (
                    *(s.names for s in settings),
                    (stack.path_memory[0],),
                    *stack.movement,
                    *stack.returning,
                    *((name,) for name in stack.fence_parameters),
                )
            )
        )
        additional = (name for s in settings for other in s.additional.values() for name in other.names)
        self._concerned = frozenset((*(name for names in self._names for name in names), *additional))

    def concerns(self, name: str) -> bool:
        """Return True if the failsafes set or read the parameter with this name."""
        return name in self._concerned

    async def configure(self, *, flying: bool = False, before: FailsafeStatus | None = None) -> FailsafeStatus:
        """Set the failsafes, read each one back, and return them with the vehicle's dynamics.

        In flight, the return stays as it was chosen at arming, and parameters that cannot be read keep their last value.

        Args:
            flying: True if the motors run.
            before: Result of the last verification in this flight.

        Raises:
            AutopilotError: The link broke, or no parameter of a drone in flight can be read and none is known.
        """
        before = before if flying else None
        if not flying and self._autopilot.vehicle.unsupported:
            log.error("failsafes: not set, unsupported vehicle (problem=%s)", self._autopilot.vehicle.unsupported)
            return FailsafeStatus(self._autopilot.vehicle.unsupported, (), Airframe(), _DEFAULT_SPEED_MPS)
        try:
            status = await self._configure(flying, before)
        except ParameterLost as error:
            if flying and before is None:
                raise
            known = before or FailsafeStatus("", (), Airframe(), _DEFAULT_SPEED_MPS)
            status = replace(known, problem=str(error), changed=(), lost=True)
        if status.problem:
            log.error("failsafes: not verified, refusing to arm (problem=%s)", status.problem)
        elif before is None or status.changed:
            log.info("failsafes: set and read back (not_offered=%s)", ",".join(status.missing) or "none")
        return status

    async def _configure(self, flying: bool, before: FailsafeStatus | None) -> FailsafeStatus:
        stack = self._stack
        settings = _Settings(self._parameters, await self._parameters.read(self._names))
        # The settings of a mission are set with its limits at arming, and the owner's values are restored afterwards.
        await settings.establish((*stack.failsafes, *stack.mission_settings) if flying else stack.failsafes)
        missing = tuple(settings.missing)
        parameter, min_points = stack.path_memory
        records_path = settings.values.get(parameter, 0.0) >= min_points
        retraces = await self._choose(settings, retrace=records_path and (not flying or self._chosen(settings, before)))
        reader = self._reader(settings.values)
        known, speed = (before.airframe, before.speed_mps) if before is not None else (Airframe(), _DEFAULT_SPEED_MPS)
        airframe, speed = stack.airframe(reader, known, speed)
        problem = "; ".join(settings.problems + reader.problems)
        airframe = replace(airframe, retraces=retraces)
        return FailsafeStatus(problem, missing, airframe, speed, records_path, tuple(settings.changed))

    def learn(self, status: FailsafeStatus) -> FailsafeStatus:
        """Update the vehicle's dynamics from the parameters known so far."""
        airframe, speed = self._stack.airframe(self._reader(self._parameters.values), status.airframe, status.speed_mps)
        return replace(status, airframe=replace(airframe, retraces=status.airframe.retraces), speed_mps=speed)

    def _reader(self, values: Mapping[str, float]) -> Reader:
        """Return a reader of the parameters, in which the speed of legs is the value of the vehicle's owner."""
        return Reader({name: self._parameters.leg_speed.get(name, value) for name, value in values.items()})

    async def choose_return(self, status: FailsafeStatus, *, retrace: bool) -> FailsafeStatus:
        """Configure the failsafes to return straight, or along the path if the vehicle records it.

        Raises:
            AutopilotError: The link broke.
        """
        retrace = retrace and status.records_path
        if retrace == status.airframe.retraces or status.problem:
            return status
        names = [setting.names for setting in (*self._stack.straight_return, *self._stack.path_return)]
        try:
            settings = _Settings(self._parameters, await self._parameters.read(dict.fromkeys(names)))
            retraces = await self._choose(settings, retrace=retrace)
        except ParameterLost as error:
            return replace(status, problem=str(error))
        airframe = replace(status.airframe, retraces=retraces)
        return replace(status, problem="; ".join(settings.problems), airframe=airframe)

    async def learn_return(self, status: FailsafeStatus) -> FailsafeStatus:
        """Update the altitude of the autopilot's own return flight under its current fence.

        A value that cannot be read stays as it was and is a problem.

        Raises:
            AutopilotError: The link broke.
        """
        try:
            reader = Reader(await self._parameters.read(self._stack.movement))
        except ParameterLost as error:
            return replace(status, problem="; ".join(filter(None, [status.problem, str(error)])))
        height_m = self._stack.return_altitude_m(reader, status.airframe.return_altitude_m)
        problem = "; ".join(filter(None, [status.problem, *reader.problems]))
        return replace(status, problem=problem, airframe=replace(status.airframe, return_altitude_m=height_m))

    def _chosen(self, settings: _Settings, before: FailsafeStatus | None) -> bool:
        """Return True if failsafes of this flight return along the flown path (SmartRTL), and not in a straight line (RTL).

        After a restart of the service, the vehicle's parameter decides.
        """
        if before is not None:
            return before.airframe.retraces
        companion = self._stack.path_return[0]
        return settings.values.get(companion.names[0]) in companion.accepted | {companion.value}

    async def _choose(self, settings: _Settings, *, retrace: bool) -> bool:
        """Set the return flight of the failsafes. Return True if it follows the path."""
        problems = len(settings.problems)
        if retrace:
            if await settings.establish(self._stack.path_return):
                return True
            log.warning(
                "failsafes: return along the path not available, straight return set (problems=%s)",
                "; ".join(settings.problems),
            )
            del settings.problems[problems:]
        await settings.establish(self._stack.straight_return)
        return False
