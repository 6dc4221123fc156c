"""Missions: waypoints flown in order. The service judges each leg when it begins."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Any

from fractus.control import Control, Motion, OnProgress
from fractus.errors import InvalidRequest, PolicyDenied
from fractus.forgotten import Pending
from fractus.values import Position, Progress

EARTH_M = 6_371_008.8
"""Mean radius of the Earth in metres. The error on an orbit of one kilometre is a few metres at most."""

_log = logging.getLogger("fractus")


@dataclass(frozen=True, slots=True)
class Waypoint:
    """A waypoint of a mission.

    Attributes:
        position: Target position.
        yaw_deg: Heading in degrees clockwise from true north; None if the autopilot chooses it.
        speed_mps: Horizontal speed of the leg to this waypoint; None for the current speed setting.
        acceptance_radius_m: Distance at which the waypoint counts as reached; 0 for the service's default (1 m).
        stay_s: Seconds for which the drone hovers at the waypoint.
    """

    position: Position
    yaw_deg: float | None = None
    speed_mps: float | None = None
    acceptance_radius_m: float = 0.0
    stay_s: float = 0.0


@dataclass(frozen=True, slots=True)
class MissionProgress:
    """Progress of a mission.

    Attributes:
        number: Number of the current target waypoint, from 1.
        count: Number of waypoints.
        step: Progress of the current leg.
    """

    number: int
    count: int
    step: Progress


class Mission:
    """Mission that flies its waypoints when awaited. The result contains the refused legs by waypoint number.

    Progress is stored on the drone (`Control.report`), so the mission of a restarted component continues with the current
    waypoint. Each leg is a `goto`, judged when it begins; nothing is uploaded to the autopilot.

    A control point has one mission, because it has one waypoint counter. A second mission with the same waypoints
    continues the first one.

    Args:
        fly: Function that returns the motion of one leg.
        control: Control lease of the control point.
        waypoints: Waypoints; by default the path of the control point.
        skip_refused: Continue with the next waypoint if policies forbid a leg.
        pending: Warning if the mission is not flown.
    """

    def __init__(
        self,
        fly: Callable[[Waypoint, OnProgress], Motion],
        control: Control,
        waypoints: Sequence[Waypoint | Position] | None = None,
        *,
        skip_refused: bool = False,
        pending: Pending | None = None,
    ) -> None:
        path = control.task.path if waypoints is None else waypoints
        self.waypoints = tuple(Waypoint(item) if isinstance(item, Position) else item for item in path)
        self.refused: dict[int, PolicyDenied] = {}
        """Refusals of the skipped legs, by the number of the leg's waypoint. The first waypoint has number 1."""
        self._fly = fly
        self._control = control
        self._skip_refused = skip_refused
        self._pending = pending
        self._paused = asyncio.Event()
        self._resumed = asyncio.Event()
        self._resumed.set()

    @property
    def paused(self) -> bool:
        """True while the mission is paused."""
        return self._paused.is_set()

    def pause(self) -> None:
        """Stop the current leg. The drone hovers until `resume`; the task that awaits the mission waits."""
        self._paused.set()
        self._resumed.clear()

    def resume(self) -> None:
        """Continue the stopped leg."""
        self._paused.clear()
        self._resumed.set()

    async def fly(self, progress: Callable[[MissionProgress], None] | None = None) -> dict[int, PolicyDenied]:
        """Fly the remaining waypoints.

        Args:
            progress: Callback for each progress report of each leg.

        Returns:
            Refused legs by waypoint number; empty unless `skip_refused` is set.

        Raises:
            PolicyDenied: Policies forbid a leg. The drone hovers before it.
            Interrupted: A leg was stopped. Awaiting the mission again continues it.
            ControlLost: The system or a pilot took the drone.
            InvalidRequest: The control point has another mission, or this mission is already complete.
        """
        if self._pending is not None:
            self._pending.begin()
        self._begin()
        for number in range(self._control.waypoints_reached + 1, len(self.waypoints) + 1):
            try:
                await self._leg(number, progress)
            except PolicyDenied as refusal:
                if not self._skip_refused:
                    raise
                _log.warning("mission: waypoint skipped (number=%d reason=%s)", number, refusal)
                self.refused[number] = refusal
            await self._control.report(number)
        return self.refused

    def __await__(self) -> Generator[Any, None, dict[int, PolicyDenied]]:
        if self._pending is not None:
            self._pending.begin()
        return self.fly().__await__()

    def _begin(self) -> None:
        begun = self._control.begun
        complete = self._control.waypoints_reached >= len(self.waypoints)
        if begun is not None and begun is not self.waypoints and (complete or begun != self.waypoints):
            raise InvalidRequest(
                "a control point has one mission, and another one has started: fly all waypoints in one mission, "
                "`drone.mission([*survey, *orbit])`, or use `drone.goto` for waypoints whose progress need not be stored"
            )
        self._control.begun = self.waypoints

    async def _leg(self, number: int, progress: Callable[[MissionProgress], None] | None) -> None:
        """Fly one leg, and restart it after each pause."""

        def report(step: Progress) -> None:
            if progress is not None:
                progress(MissionProgress(number, len(self.waypoints), step))

        async def fly_leg() -> None:
            await self._fly(self.waypoints[number - 1], report)
            await asyncio.sleep(self.waypoints[number - 1].stay_s)

        while True:
            await self._resumed.wait()
            leg = asyncio.ensure_future(fly_leg())
            pause = asyncio.ensure_future(self._paused.wait())
            try:
                await asyncio.wait([leg, pause], return_when=asyncio.FIRST_COMPLETED)
                if leg.done():
                    leg.result()
                    return
            finally:
                pause.cancel()
                leg.cancel()
                await asyncio.gather(leg, pause, return_exceptions=True)


def orbit(
    center: Position, radius_m: float, *, turns: float = 1.0, points: int = 16, speed_mps: float | None = None
) -> tuple[Waypoint, ...]:
    """Return waypoints on a circle with the nose to its centre: `await drone.mission(fractus.orbit(tower, 30))`.

    Args:
        center: Centre; its altitude is the altitude of the circle.
        radius_m: Radius in metres, up to about a kilometre.
        turns: Number of turns, clockwise; negative for counter-clockwise.
        points: Waypoints per turn.
        speed_mps: Speed of the legs; by default the current speed setting.

    Returns:
        Waypoints, starting at the northernmost point of the circle.

    Raises:
        InvalidRequest: The radius is not positive, or there are fewer than 3 points.
    """
    if not radius_m > 0 or points < 3:
        raise InvalidRequest(f"an orbit needs a radius above 0 m and at least 3 points, not {radius_m} m and {points}")
    waypoints = []
    for index in range(round(abs(turns) * points) + 1):
        angle = math.copysign(index * 2 * math.pi / points, turns)
        north = radius_m * math.cos(angle)
        east = radius_m * math.sin(angle)
        lat = center.lat + math.degrees(north / EARTH_M)
        lon = center.lon + math.degrees(east / EARTH_M / math.cos(math.radians(center.lat)))
        position = Position(lat, lon, center.alt, center.reference)
        waypoints.append(Waypoint(position, (math.degrees(angle) + 180.0) % 360.0, speed_mps))
    return tuple(waypoints)
