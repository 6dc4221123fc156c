"""Missions: waypoints flown one after the other, each leg judged by the service when its turn comes."""

from __future__ import annotations

import asyncio
import json
import logging
import math
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fractus.control import Control
from fractus.errors import InvalidRequest, PolicyDenied
from fractus.motions import Motion, OnProgress
from fractus.values import AltitudeReference, Position, Progress

EARTH_M = 6_371_008.8
"""Mean radius: over an orbit of a kilometre it is wrong by a few metres at most."""

_NAV_WAYPOINT, _NAV_RETURN, _NAV_LAND, _NAV_TAKEOFF, _NAV_LAST, _DO_CHANGE_SPEED = 16, 20, 21, 22, 95, 178
_REFERENCES = {
    **dict.fromkeys((0, 5), AltitudeReference.AMSL),
    **dict.fromkeys((3, 6), AltitudeReference.HOME),
    **dict.fromkeys((10, 11), AltitudeReference.TERRAIN),
}
"""What altitudes are measured from, by MAV_FRAME."""

_log = logging.getLogger("fractus")


@dataclass(frozen=True, slots=True)
class Waypoint:
    """A place to fly to, and how.

    Attributes:
        position: degrees, and metres above its reference.
        yaw_deg: heading in degrees clockwise from true north; None leaves it to the autopilot.
        speed_mps: horizontal speed of the leg to it; None keeps the speed in force.
        acceptance_radius_m: how near counts as reached; 0 leaves it to the service (1 m).
        stay_s: how long the drone hovers there.
    """

    position: Position
    yaw_deg: float | None = None
    speed_mps: float | None = None
    acceptance_radius_m: float = 0.0
    stay_s: float = 0.0


@dataclass(frozen=True, slots=True)
class MissionProgress:
    """How far a mission is.

    Attributes:
        number: of the waypoint that is flown to, from 1.
        count: how many there are.
        step: how far the leg is.
    """

    number: int
    count: int
    step: Progress


class Mission:
    """Waypoints that are flown when this is awaited; the result is the legs that policies refused, by number.

    Progress is kept on the drone (`Control.report`): the mission of a restarted component goes on with the waypoint that
    was under way. Each leg is a `goto` that is judged when its turn comes; nothing is uploaded to the autopilot.

    A control point has one mission, for there is one count of waypoints; one of the same waypoints goes on with it.

    Args:
        fly: begins one leg.
        control: of the control point.
        waypoints: by default the path of the control point.
        skip_refused: go on with the next waypoint where policies forbid a leg.
    """

    def __init__(
        self,
        fly: Callable[[Waypoint, OnProgress], Motion],
        control: Control,
        waypoints: Sequence[Waypoint | Position] | None = None,
        *,
        skip_refused: bool = False,
    ) -> None:
        given = control.task.path if waypoints is None else waypoints
        self.waypoints = tuple(Waypoint(one) if isinstance(one, Position) else one for one in given)
        self.refused: dict[int, PolicyDenied] = {}
        """Legs that were passed over, by the number of their waypoint, from 1."""
        self._fly = fly
        self._control = control
        self._skip_refused = skip_refused
        self._paused = asyncio.Event()
        self._resumed = asyncio.Event()
        self._resumed.set()

    @property
    def paused(self) -> bool:
        """Whether it is paused."""
        return self._paused.is_set()

    def pause(self) -> None:
        """Stop the leg under way: the drone hovers until `resume`, while the one that awaits the mission waits."""
        self._paused.set()
        self._resumed.clear()

    def resume(self) -> None:
        """Go on with the leg that was stopped."""
        self._paused.clear()
        self._resumed.set()

    async def fly(self, progress: Callable[[MissionProgress], None] | None = None) -> dict[int, PolicyDenied]:
        """Fly what is left of it.

        Args:
            progress: called with each step of each leg.

        Returns:
            The legs that policies refused, by number; empty unless refused legs are to be skipped.

        Raises:
            PolicyDenied: policies forbid a leg; the drone hovers before it.
            Interrupted: a leg was stopped; awaiting the mission again goes on with it.
            ControlLost: the system or a pilot took the drone.
            InvalidRequest: the control point's mission is another one, or one of the same waypoints is over.
        """
        self._begin()
        for number in range(self._control.waypoints_reached + 1, len(self.waypoints) + 1):
            try:
                await self._leg(number, progress)
            except PolicyDenied as refusal:
                if not self._skip_refused:
                    raise
                _log.warning("waypoint %d is passed over: %s", number, refusal)
                self.refused[number] = refusal
            await self._control.report(number)
        return self.refused

    def __await__(self) -> Generator[Any, None, dict[int, PolicyDenied]]:
        return self.fly().__await__()

    def _begin(self) -> None:
        begun, over = self._control.begun, self._control.waypoints_reached >= len(self.waypoints)
        if begun is not None and begun is not self.waypoints and (over or begun != self.waypoints):
            raise InvalidRequest(
                "a control point has one mission, and another one was begun: fly all waypoints in one, "
                "`drone.mission([*survey, *orbit])`, or those that are not to be remembered with `drone.goto`"
            )
        self._control.begun = self.waypoints

    async def _leg(self, number: int, progress: Callable[[MissionProgress], None] | None) -> None:
        """One leg, begun again after each pause."""

        def tell(step: Progress) -> None:
            if progress is not None:
                progress(MissionProgress(number, len(self.waypoints), step))

        async def flown() -> None:
            await self._fly(self.waypoints[number - 1], tell)
            await asyncio.sleep(self.waypoints[number - 1].stay_s)

        while True:
            await self._resumed.wait()
            leg, pause = asyncio.ensure_future(flown()), asyncio.ensure_future(self._paused.wait())
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
    """A circle around a place, nose to its middle, as waypoints: `await drone.mission(fractus.orbit(tower, 30))`.

    Args:
        center: its middle; its altitude is that of the circle.
        radius_m: metres, to a kilometre or so.
        turns: how many times around, clockwise; negative: the other way.
        points: waypoints a turn.
        speed_mps: of its legs; unset keeps the speed in force.

    Returns:
        Waypoints from the northernmost point of the circle on.
    """
    if not radius_m > 0 or points < 3:
        raise InvalidRequest(f"an orbit needs a radius above 0 m and 3 points or more, not {radius_m} m and {points}")
    found = []
    for index in range(round(abs(turns) * points) + 1):
        angle = math.copysign(index * 2 * math.pi / points, turns)
        north, east = radius_m * math.cos(angle), radius_m * math.sin(angle)
        lat = center.lat + math.degrees(north / EARTH_M)
        lon = center.lon + math.degrees(east / EARTH_M / math.cos(math.radians(center.lat)))
        position = Position(lat, lon, center.alt, center.reference)
        found.append(Waypoint(position, (math.degrees(angle) + 180.0) % 360.0, speed_mps))
    return tuple(found)


def read_plan(path: str | Path) -> tuple[Waypoint, ...]:
    """The waypoints of a QGroundControl plan (.plan), with their speeds, headings and stays; those of surveys, too.

    Takeoff, landing and return are left out: the program takes off, and the system flies home. So are commands for cameras
    and gimbals, with a warning: pictures are taken through the camera service.

    Raises:
        InvalidRequest: it is no plan, or has a command that cannot be flown.
    """
    try:
        plan = json.loads(Path(path).read_bytes())
        return tuple(_waypoints(_simple(plan["mission"]["items"]), str(path)))
    except OSError as error:
        raise InvalidRequest(f"{path}: {error.strerror}") from None
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise InvalidRequest(
            f"{path}: this is not a plan of QGroundControl ({type(error).__name__}: {error})"
        ) from None


def _simple(items: Sequence[Any]) -> Iterator[Any]:
    """The items of a plan, with those inside of surveys and corridor scans."""
    for item in items:
        if item["type"] == "ComplexItem":
            yield from _simple(item.get("TransectStyleComplexItem", item)["Items"])
        else:
            yield item


def _waypoints(items: Iterator[Any], path: str) -> Iterator[Waypoint]:
    speed_mps: float | None = None
    for number, item in enumerate(items, start=1):
        command, params = item["command"], item["params"]
        if command == _NAV_WAYPOINT:
            if item["frame"] not in _REFERENCES:
                raise InvalidRequest(
                    f"{path}: item {number} has frame {item['frame']}; use altitudes above home or AMSL"
                )
            stay_s, radius_m, _, yaw_deg, lat, lon, alt = params
            position = Position(float(lat), float(lon), float(alt), _REFERENCES[item["frame"]])
            yield Waypoint(position, yaw_deg, speed_mps, float(radius_m or 0.0), float(stay_s or 0.0))
        elif command == _DO_CHANGE_SPEED:
            speed_mps = float(params[1]) if params[1] and params[1] > 0 else speed_mps
        elif command > _NAV_LAST:
            _log.warning("%s: item %d (MAV_CMD %d) is left out", path, number, command)
        elif command not in {_NAV_TAKEOFF, _NAV_RETURN, _NAV_LAND}:
            raise InvalidRequest(
                f"{path}: item {number} is MAV_CMD {command}, which is not flown; remove it from the plan"
            )
