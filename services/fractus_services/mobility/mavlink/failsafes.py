"""The autopilot as the last line: its own failsafes, set and read back before anything may arm."""

from __future__ import annotations

import logging
import math
from dataclasses import replace

from fractus_core.policy.values import Airframe

from fractus_services.mobility.autopilot import Checked
from fractus_services.mobility.mavlink.autopilot import ATTEMPTS, MavlinkAutopilot
from fractus_services.mobility.mavlink.flight_stack import Names, Setting

log = logging.getLogger(__name__)

_DEFAULT_SPEED_MPS = 5.0


class Reader:
    """Reads parameters of how the vehicle moves, and keeps what is wrong with them.

    Args:
        autopilot: the link.
        known: parameters that the vehicle has told before: they can only be lost, not missing.

    Attributes:
        known: those, and what it tells now.
        problems: which are not numbers, or lost.
    """

    def __init__(self, autopilot: MavlinkAutopilot, known: frozenset[str] = frozenset()) -> None:
        self._autopilot = autopilot
        self.known = known
        self.problems: list[str] = []

    async def read(self, names: Names, default: float) -> float:
        """A parameter's value; the default when it has none that can be used."""
        told = [name for name, _ in names if name in self.known]
        for name, scale in names:
            value = await self._autopilot.read_parameter(name, attempts=ATTEMPTS if name in told else 2)
            if value is None:
                continue
            self.known |= {name}
            if math.isfinite(value):
                return value * scale
            self.problems.append(f"{name} is not a number")
            return default
        self.problems.extend(f"{name} cannot be read any more" for name in told)
        return default


class MavlinkFailsafes:
    """Sets and reads the failsafes by their parameters, see `Failsafes`.

    Args:
        autopilot: the link.
    """

    def __init__(self, autopilot: MavlinkAutopilot) -> None:
        self._autopilot = autopilot
        self._stack = autopilot.stack

    async def configure(self, *, flying: bool = False, before: Checked | None = None) -> Checked:
        """Set the failsafes, read each one back, and learn how the vehicle moves.

        In flight the way home stays as it was chosen when the drone was armed, and what cannot be read as it was.

        Args:
            flying: whether the motors run.
            before: what was known in this flight until now.

        Raises:
            AutopilotError: the link broke.
        """
        problems: list[str] = []
        missing: list[str] = []
        stack = self._stack
        for setting in stack.failsafes:
            name, problem = await self._establish(setting)
            if not name:
                missing.append(setting.names[0])
            problems.extend(filter(None, [problem]))
            if name in setting.also:
                problems.extend(filter(None, [(await self._establish(setting.also[name]))[1]]))
        before = before if flying else None
        parameter, least_points = stack.path_memory
        points = await self._autopilot.read_parameter(parameter, attempts=2)
        remembers = before.remembers if before is not None and points is None else (points or 0.0) >= least_points
        retrace = remembers and (not flying or await self._chosen(before))
        retraces, wrong = await self._choose(retrace=retrace)
        reader = Reader(self._autopilot, before.known if before is not None else frozenset())
        known, speed = (before.airframe, before.speed_mps) if before is not None else (Airframe(), _DEFAULT_SPEED_MPS)
        airframe, speed = await stack.airframe(reader, known, speed)
        problems += wrong + reader.problems
        airframe = replace(airframe, retraces=retraces)
        checked = Checked("; ".join(problems), tuple(missing), airframe, speed, remembers, reader.known)
        if checked.problem:
            log.error("failsafes: not verified, arming is refused (problem=%s)", checked.problem)
        else:
            log.info("failsafes: set and read back (not_offered=%s)", ",".join(missing) or "none")
        return checked

    async def choose_return(self, checked: Checked, *, retrace: bool) -> Checked:
        """Let the failsafes bring the drone home straight, or, where the vehicle can, on the path that it came.

        Raises:
            AutopilotError: the link broke.
        """
        retrace = retrace and checked.remembers
        if retrace == checked.airframe.retraces or checked.problem:
            return checked
        retraces, problems = await self._choose(retrace=retrace)
        return replace(checked, problem="; ".join(problems), airframe=replace(checked.airframe, retraces=retraces))

    async def learn_return(self, checked: Checked) -> Checked:
        """Learn at which altitude the autopilot flies home by itself, under the fence that it has by now.

        What was known and cannot be read now stays as it was, and is a problem.

        Raises:
            AutopilotError: the link broke.
        """
        reader = Reader(self._autopilot, checked.known)
        height_m = await self._stack.return_altitude_m(reader, checked.airframe.return_altitude_m)
        problem = "; ".join(filter(None, [checked.problem, *reader.problems]))
        airframe = replace(checked.airframe, return_altitude_m=height_m)
        return replace(checked, problem=problem, airframe=airframe, known=reader.known)

    async def _chosen(self, before: Checked | None) -> bool:
        """Whether the path was chosen as the way home of the flight under way; only the vehicle knows after a restart of the service."""
        if before is not None:
            return before.airframe.retraces
        companion = self._stack.retracing[0]
        value = await self._autopilot.read_parameter(companion.names[0])
        return value is not None and value in companion.accepted | {companion.value}

    async def _choose(self, *, retrace: bool) -> tuple[bool, list[str]]:
        """Whether the failsafes retrace the path now, and what does not hold."""
        stack = self._stack
        if retrace:
            problems = [problem for setting in stack.retracing if (problem := (await self._establish(setting))[1])]
            if not problems:
                return True, []
            log.warning("failsafes: the drone will fly home straight (problems=%s)", "; ".join(problems))
        return False, [problem for setting in stack.straight if (problem := (await self._establish(setting))[1])]

    async def _establish(self, setting: Setting) -> tuple[str, str]:
        """The name under which the vehicle has the setting, empty when it has none, and a problem when it does not hold."""
        for name in setting.names:
            found = await self._autopilot.read_parameter(name, attempts=3)
            if found is None:
                continue
            if found == setting.value or found in setting.accepted:
                return name, ""
            after = await self._autopilot.write_parameter(name, setting.value)
            if after is not None and abs(after - setting.value) < 1e-6:
                log.info(
                    "failsafes: set %s, the autopilot %s (before=%g, after=%g)", name, setting.why, found, setting.value
                )
                return name, ""
            return name, f"{name} is {found:g} and cannot be set to {setting.value:g} (the autopilot {setting.why})"
        return "", f"the autopilot has no {' or '.join(setting.names)} ({setting.why})" if setting.needed else ""
