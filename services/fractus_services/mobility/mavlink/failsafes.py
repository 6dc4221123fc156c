"""The autopilot's failsafes as the last line of defence: set and read back before arming, and verified in flight."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Mapping
from dataclasses import replace

from fractus_core.policy.decision_types import Airframe

from fractus_services.mobility.autopilot import Checked
from fractus_services.mobility.mavlink.flight_stack import Names, Setting
from fractus_services.mobility.mavlink.mavlink_autopilot import MavlinkAutopilot
from fractus_services.mobility.mavlink.parameters import ParameterLost, Parameters, Spellings, same

log = logging.getLogger(__name__)

_DEFAULT_SPEED_MPS = 5.0


class Reader:
    """Values from the vehicle's parameters, and problems with them.

    Args:
        told: Reported parameters; the vehicle does not have others.

    Attributes:
        problems: Parameters that are missing or not a number.
    """

    def __init__(self, told: Mapping[str, float]) -> None:
        self._told = told
        self.problems: list[str] = []

    def read(self, names: Names, otherwise: float, *, needed: bool = True) -> float:
        """Return a scaled value, or the default if the parameter is missing or invalid; that is a problem if it is needed."""
        for name, scale in names:
            if name in self._told:
                if math.isfinite(self._told[name]):
                    return self._told[name] * scale
                self.problems.append(f"{name} is not a number")
                return otherwise
        if needed:
            self.problems.append(f"the autopilot has no {' or '.join(name for name, _ in names)}")
        return otherwise


class _Settings:
    """One pass over the settings.

    Args:
        parameters: Access to the vehicle's parameters.
        told: Their values as they were read.

    Attributes:
        told: Current values.
        problems: Settings that do not hold.
        missing: Settings that the vehicle does not have.
        changed: Changed settings as sentences.
    """

    def __init__(self, parameters: Parameters, told: dict[str, float]) -> None:
        self._parameters = parameters
        self.told = told
        self.problems: list[str] = []
        self.missing: list[str] = []
        self.changed: list[str] = []

    async def establish(self, settings: Iterable[Setting]) -> bool:
        """Make settings hold and return False if one of them does not.

        Raises:
            ParameterLost: It is unknown if a setting holds.
        """
        problems = len(self.problems)
        for setting in settings:
            name = next((name for name in setting.names if name in self.told), None)
            if name is None:
                self._lacks(setting)
                continue
            await self._set(name, setting)
            if name in setting.also:
                self.told |= await self._parameters.read([setting.also[name].names])
                await self.establish([setting.also[name]])
        return len(self.problems) == problems

    def _lacks(self, setting: Setting) -> None:
        self.missing.append(setting.names[0])
        if setting.needed:
            self.problems.append(f"the autopilot has no {' or '.join(setting.names)} ({setting.why})")

    async def _set(self, name: str, setting: Setting) -> None:
        found = self.told[name]
        if setting.holds(found):
            return
        self.told[name] = await self._parameters.write(name, setting.value)
        if not same(self.told[name], setting.value):
            self.problems.append(
                f"{name} is {found:g} and cannot be set to {setting.value:g} (the autopilot {setting.why})"
            )
            return
        self.changed.append(f"{name} was {found:g} and is {setting.value:g}: the autopilot {setting.why}")
        log.info(
            "failsafes: set %s, the autopilot %s (before=%g, after=%g)", name, setting.why, found, setting.value
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
        settings = (*stack.failsafes, *stack.flown, *stack.straight, *stack.retracing)
        self._wanted: tuple[Spellings, ...] = tuple(
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
        also = (name for s in settings for other in s.also.values() for name in other.names)
        self._concerned = frozenset((*(name for names in self._wanted for name in names), *also))

    def concerns(self, name: str) -> bool:
        """Return True if a parameter is set or read by the failsafes."""
        return name in self._concerned

    async def configure(self, *, flying: bool = False, before: Checked | None = None) -> Checked:
        """Set the failsafes, read each one back, and return them with the vehicle's dynamics.

        In flight, the return flight stays as it was chosen at arming, and values that cannot be read keep their last value.

        Args:
            flying: True if the motors run.
            before: Result of the last verification in this flight.

        Raises:
            AutopilotError: The link broke, or no parameter of a drone in flight can be read and none is known.
        """
        before = before if flying else None
        if not flying and self._autopilot.vehicle.foreign:
            log.error("failsafes: not set, unsupported vehicle (problem=%s)", self._autopilot.vehicle.foreign)
            return Checked(self._autopilot.vehicle.foreign, (), Airframe(), _DEFAULT_SPEED_MPS)
        try:
            checked = await self._configure(flying, before)
        except ParameterLost as error:
            if flying and before is None:
                raise
            known = before or Checked("", (), Airframe(), _DEFAULT_SPEED_MPS)
            checked = replace(known, problem=str(error), changed=(), lost=True)
        if checked.problem:
            log.error("failsafes: not verified, refusing to arm (problem=%s)", checked.problem)
        elif before is None or checked.changed:
            log.info("failsafes: set and read back (not_offered=%s)", ",".join(checked.missing) or "none")
        return checked

    async def _configure(self, flying: bool, before: Checked | None) -> Checked:
        stack = self._stack
        settings = _Settings(self._parameters, await self._parameters.read(self._wanted))
        # On the ground the owner may choose the other settings. They are set and restored with the limits of a mission.
        await settings.establish((*stack.failsafes, *stack.flown) if flying else stack.failsafes)
        missing = tuple(settings.missing)
        parameter, least_points = stack.path_memory
        remembers = settings.told.get(parameter, 0.0) >= least_points
        retraces = await self._choose(settings, retrace=remembers and (not flying or self._chosen(settings, before)))
        reader = self._reader(settings.told)
        known, speed = (before.airframe, before.speed_mps) if before is not None else (Airframe(), _DEFAULT_SPEED_MPS)
        airframe, speed = stack.airframe(reader, known, speed)
        problem = "; ".join(settings.problems + reader.problems)
        airframe = replace(airframe, retraces=retraces)
        return Checked(problem, missing, airframe, speed, remembers, tuple(settings.changed))

    def learn(self, checked: Checked) -> Checked:
        """Update the vehicle's dynamics from the parameters known so far."""
        airframe, speed = self._stack.airframe(self._reader(self._parameters.told), checked.airframe, checked.speed_mps)
        return replace(checked, airframe=replace(airframe, retraces=checked.airframe.retraces), speed_mps=speed)

    def _reader(self, told: Mapping[str, float]) -> Reader:
        """Return a reader in which the speed of legs is the owner's, under the name that the vehicle knows."""
        return Reader({name: self._parameters.leg_speed.get(name, value) for name, value in told.items()})

    async def choose_return(self, checked: Checked, *, retrace: bool) -> Checked:
        """Let the failsafes return straight, or along the path if the vehicle supports that.

        Raises:
            AutopilotError: The link broke.
        """
        retrace = retrace and checked.remembers
        if retrace == checked.airframe.retraces or checked.problem:
            return checked
        wanted = [setting.names for setting in (*self._stack.straight, *self._stack.retracing)]
        try:
            settings = _Settings(self._parameters, await self._parameters.read(dict.fromkeys(wanted)))
            retraces = await self._choose(settings, retrace=retrace)
        except ParameterLost as error:
            return replace(checked, problem=str(error))
        airframe = replace(checked.airframe, retraces=retraces)
        return replace(checked, problem="; ".join(settings.problems), airframe=airframe)

    async def learn_return(self, checked: Checked) -> Checked:
        """Update the altitude of the autopilot's own return flight under its current fence.

        A value that cannot be read stays as it was and is a problem.

        Raises:
            AutopilotError: The link broke.
        """
        try:
            reader = Reader(await self._parameters.read(self._stack.movement))
        except ParameterLost as error:
            return replace(checked, problem="; ".join(filter(None, [checked.problem, str(error)])))
        height_m = self._stack.return_altitude_m(reader, checked.airframe.return_altitude_m)
        problem = "; ".join(filter(None, [checked.problem, *reader.problems]))
        return replace(checked, problem=problem, airframe=replace(checked.airframe, return_altitude_m=height_m))

    def _chosen(self, settings: _Settings, before: Checked | None) -> bool:
        """Return True if the return along the path was chosen for this flight. After a restart of the service, only the vehicle knows."""
        if before is not None:
            return before.airframe.retraces
        companion = self._stack.retracing[0]
        return settings.told.get(companion.names[0]) in companion.accepted | {companion.value}

    async def _choose(self, settings: _Settings, *, retrace: bool) -> bool:
        """Set the return of the failsafes and return True if it follows the path."""
        problems = len(settings.problems)
        if retrace:
            if await settings.establish(self._stack.retracing):
                return True
            log.warning(
                "failsafes: return along the path not available, straight return set (problems=%s)",
                "; ".join(settings.problems),
            )
            del settings.problems[problems:]
        await settings.establish(self._stack.straight)
        return False
