"""The autopilot as the last line: its own failsafes, set and read back before anything may arm, and kept in flight."""

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
    """Figures from the parameters that the vehicle told, and what is wrong with them.

    Args:
        told: the parameters; one that is not there the vehicle does not have.

    Attributes:
        problems: which are not numbers, or missing.
    """

    def __init__(self, told: Mapping[str, float]) -> None:
        self._told = told
        self.problems: list[str] = []

    def read(self, names: Names, otherwise: float, *, needed: bool = True) -> float:
        """A figure; another when the vehicle tells none that can be used, which is a problem if it is needed."""
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
        parameters: the vehicle's.
        told: their values as they were read.

    Attributes:
        told: their values by now.
        problems: which do not hold.
        missing: which the vehicle does not have.
        changed: which were set, as sentences.
    """

    def __init__(self, parameters: Parameters, told: dict[str, float]) -> None:
        self._parameters = parameters
        self.told = told
        self.problems: list[str] = []
        self.missing: list[str] = []
        self.changed: list[str] = []

    async def establish(self, settings: Iterable[Setting]) -> bool:
        """Let settings hold; False when one of them does not.

        Raises:
            ParameterLost: it is not known whether one holds.
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
        autopilot: the link.
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
        """Whether a parameter is one of those that are set or read here."""
        return name in self._concerned

    async def configure(self, *, flying: bool = False, before: Checked | None = None) -> Checked:
        """Set the failsafes, read each one back, and learn how the vehicle moves.

        In flight the way home stays as it was chosen when the drone was armed, and what does not answer as it was.

        Args:
            flying: whether the motors run.
            before: what was known in this flight until now.

        Raises:
            AutopilotError: the link broke, or nothing was known of a drone in flight and nothing can be read.
        """
        before = before if flying else None
        if not flying and self._autopilot.vehicle.foreign:
            log.error("failsafes: none are set (problem=%s)", self._autopilot.vehicle.foreign)
            return Checked(self._autopilot.vehicle.foreign, (), Airframe(), _DEFAULT_SPEED_MPS)
        try:
            checked = await self._configure(flying, before)
        except ParameterLost as error:
            if flying and before is None:
                raise
            known = before or Checked("", (), Airframe(), _DEFAULT_SPEED_MPS)
            checked = replace(known, problem=str(error), changed=(), lost=True)
        if checked.problem:
            log.error("failsafes: not verified, arming is refused (problem=%s)", checked.problem)
        elif before is None or checked.changed:
            log.info("failsafes: set and read back (not_offered=%s)", ",".join(checked.missing) or "none")
        return checked

    async def _configure(self, flying: bool, before: Checked | None) -> Checked:
        stack = self._stack
        settings = _Settings(self._parameters, await self._parameters.read(self._wanted))
        # On the ground the owner has the rest as it likes: it is set, and put back, with the limits of a mission.
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
        """How the vehicle moves by what it has told until now."""
        airframe, speed = self._stack.airframe(self._reader(self._parameters.told), checked.airframe, checked.speed_mps)
        return replace(checked, airframe=replace(airframe, retraces=checked.airframe.retraces), speed_mps=speed)

    def _reader(self, told: Mapping[str, float]) -> Reader:
        """Figures with the owner's speed of legs, as far as it has a name that the vehicle knows."""
        return Reader({name: self._parameters.leg_speed.get(name, value) for name, value in told.items()})

    async def choose_return(self, checked: Checked, *, retrace: bool) -> Checked:
        """Let the failsafes bring the drone home straight, or, where the vehicle can, on the path that it came.

        Raises:
            AutopilotError: the link broke.
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
        """Learn at which altitude the autopilot flies home by itself, under the fence that it has by now.

        What cannot be read stays as it was, and is a problem.

        Raises:
            AutopilotError: the link broke.
        """
        try:
            reader = Reader(await self._parameters.read(self._stack.movement))
        except ParameterLost as error:
            return replace(checked, problem="; ".join(filter(None, [checked.problem, str(error)])))
        height_m = self._stack.return_altitude_m(reader, checked.airframe.return_altitude_m)
        problem = "; ".join(filter(None, [checked.problem, *reader.problems]))
        return replace(checked, problem=problem, airframe=replace(checked.airframe, return_altitude_m=height_m))

    def _chosen(self, settings: _Settings, before: Checked | None) -> bool:
        """Whether the path was chosen as the way home of the flight under way; only the vehicle knows after a restart of the service."""
        if before is not None:
            return before.airframe.retraces
        companion = self._stack.retracing[0]
        return settings.told.get(companion.names[0]) in companion.accepted | {companion.value}

    async def _choose(self, settings: _Settings, *, retrace: bool) -> bool:
        """Whether the failsafes retrace the path now."""
        problems = len(settings.problems)
        if retrace:
            if await settings.establish(self._stack.retracing):
                return True
            log.warning("failsafes: the drone will fly home straight (problems=%s)", "; ".join(settings.problems))
            del settings.problems[problems:]
        await settings.establish(self._stack.straight)
        return False
