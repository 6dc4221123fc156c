"""Golden flights: record control authority, stream events and autopilot commands.

Each flight acts from outside only, through streams, calls, grants and what pilots and the autopilot do, so that the same flight
can be flown by any version of the service. `PYTHONPATH=tests python
tests/component/test_control_golden.py` records them again.
"""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from fractus_core.control.state import FlightMode
from fractus_core.policy.decision_types import TakeoffArgs
from fractus_services.grant_files import ActiveGrant
from mobility_world import World, goto
from virtual_time import fly

BEAT_S = 0.5
RECORDED_STEP_S = 0.05
SAMPLE_S = 5.0

Trace = dict[str, list[str]]


class Recording(list[Any]):
    """List that calls a function for each appended item."""

    def __init__(self, heard: Callable[[Any], None]) -> None:
        super().__init__()
        self._heard = heard

    def append(self, item: Any) -> None:
        super().append(item)
        self._heard(item)


class Flight:
    """A world that is flown in, and the trace that it leaves.

    Attributes:
        trace: by source, what happened in the order of time; texts of reasons, which may be reworded, stand apart.
    """

    def __init__(self, directory: Path, **options: Any) -> None:
        self.trace: Trace = {"authority": [], "streams": [], "commands": [], "calls": [], "path": [], "missions": []}
        self.texts: list[str] = []
        self._directory = directory
        self._options = {"step_s": RECORDED_STEP_S} | options
        self._tasks: list[asyncio.Task[None]] = []
        self._grants: list[tuple[Any, str]] = []
        self.world = self._wired(World(directory, **self._options))

    def _wired(self, world: World) -> World:
        world.plane.parameters |= {"SYSID_MYGCS": 244.0}
        world.entries = Recording(self._audited)
        world.plane.commands = Recording(self._commanded)
        obey = type(world.plane).set_to

        def set_to(mode: FlightMode) -> None:
            self._write("commands", f"mode {mode.name}")
            obey(world.plane, mode)

        def heard(outgoing: Any) -> None:
            """Obey, and deliver a heartbeat at once, because regular heartbeats are too rare to attribute arming."""
            type(world.plane)._obey(world.plane, outgoing)
            self.observer.heartbeat()

        world.plane.set_to = set_to  # type: ignore[method-assign]
        world.plane._obey = heard  # type: ignore[method-assign]
        self.observer = world.observer
        return world

    # The trace

    def _write(self, source: str, what: str) -> None:
        """Add an entry; what repeats itself without a break is written once."""
        lines = self.trace[source]
        if not lines or lines[-1].partition(" ")[2] != what or source in {"authority", "streams"}:
            lines.append(f"{self.world.plane.now - 1000:.1f} {what}")

    def _audited(self, entry: tuple[str, dict[str, Any]]) -> None:
        kind, content = entry
        if kind in {"control", "takeover"}:
            plane = self.world.plane
            where = self._place()
            who = str(content["controller"]).rpartition("/")[2]
            self._write("authority", f"{kind} {content['action']} by {who} {content['code'] or '-'} at {where}")
            self.texts.append(f"{plane.now:.1f} {kind} {content['reason']}")
        elif kind == "monitor":
            self._write("authority", f"monitor {content['action']} {content['code']}")

    def _commanded(self, number: int) -> None:
        self._write("commands", f"command {number}")

    def _stream_event(self, name: str, what: str, text: str = "") -> None:
        self._write("streams", f"{name} {what}")
        self.texts.append(f"{self.world.plane.now:.1f} {name} {what} {text}")

    def _place(self) -> str:
        """Return the position in whole metres east, north and up of home."""
        plane = self.world.plane
        return str(tuple(round(metres) for metres in (*plane.xy, plane.height)))

    # What happens

    def put(self, grant: Any, key: str = "m1") -> ActiveGrant:
        self._grants.append((grant, key))
        return self.world.grants.put(grant, key)

    def follow(self, held: ActiveGrant, name: str = "driver") -> asyncio.Task[None]:
        """A stream of GetControl."""
        return self._spawn(self._follow(held, name, asyncio.Event()))

    async def drive(self, held: ActiveGrant, name: str = "driver") -> asyncio.Task[None]:
        """A stream of GetControl that has the drone, or has ended."""
        granted = asyncio.Event()
        stream = self._spawn(self._follow(held, name, granted))
        waiting = asyncio.ensure_future(granted.wait())
        await asyncio.wait([stream, waiting], return_when=asyncio.FIRST_COMPLETED)
        waiting.cancel()
        return stream

    async def _follow(self, held: ActiveGrant, name: str, granted: asyncio.Event) -> None:
        try:
            async for event in self.world.streams.follow(held):
                state = event.state.name
                self._stream_event(name, f"{state} {event.control_point} {event.waypoints_reached}", event.reason)
                if state == "GRANTED":
                    granted.set()
        except asyncio.CancelledError:
            self._stream_event(name, "left")
            raise
        except Exception as error:  # any end is part of the trace
            self._stream_event(name, f"refused {_code(error)}", str(error))
        else:
            self._stream_event(name, "ended")

    def call(self, name: str, work: Any) -> asyncio.Task[None]:
        """A call in the background."""
        return self._spawn(self.do(name, work))

    async def do(self, name: str, work: Any) -> None:
        """A call, to its end."""
        try:
            async for _ in _steps(work):
                pass
        except asyncio.CancelledError:
            self._write("calls", f"{name} cancelled")
            raise
        except Exception as error:  # any end is part of the trace
            self._write("calls", f"{name} {_code(error)}")
            self.texts.append(f"{name} {error}")
        else:
            self._write("calls", f"{name} done")

    async def up(self, held: ActiveGrant, altitude_m: float = 10.0) -> asyncio.Task[None]:
        """A driver in the air."""
        stream = await self.drive(held)
        await self.do("Arm", lambda: self.world.service.arm(held))
        await self.do("Takeoff", lambda: self.world.service.take_off(held, TakeoffArgs(altitude_m)))
        return stream

    async def goto(self, held: ActiveGrant, x: float, y: float, alt: float = 10.0) -> None:
        await self.do("Goto", lambda: self.world.service.goto(held, goto(x, y, alt), 0))

    def going(self, held: ActiveGrant, x: float, y: float) -> asyncio.Task[None]:
        return self.call("Goto", lambda: self.world.service.goto(held, goto(x, y), 0))

    async def give_back(self, held: ActiveGrant) -> None:
        await self.do("ReturnControl", lambda: self.world.control.return_control(held))

    def failsafe(self, mode: FlightMode) -> None:
        """The autopilot's own failsafe acts."""
        vehicle = self.world.plane.vehicle
        plane = self.world.plane
        vehicle.failsafe_text = "Battery Failsafe"
        vehicle.failsafe_text_at = plane.now
        plane.set_to(mode)

    def lose_link(self) -> None:
        self.world.plane.deaf = True

    def find_link(self) -> None:
        """Restore the link and let the service find the vehicle."""
        plane = self.world.plane
        plane.deaf = False
        plane.vehicle.heartbeat_at = plane.now
        self.observer.found()

    async def restart(self) -> None:
        """Stop the service and start another one with the same journal."""
        old = self.world
        await self._stop_tasks()
        await old.__aexit__()
        self.world = self._wired(World(self._directory, **self._options, after=old, known=False))
        grants = self._grants
        self._grants = []
        for grant, key in grants:
            self.put(grant, key)
        self.observer.found()
        await self.world.__aenter__()
        self._beat()

    async def sleep(self, seconds: float) -> None:
        await asyncio.sleep(seconds)

    async def until(self, condition: Callable[[], object], timeout_s: float = 120.0) -> None:
        await self.world.until(condition, timeout_s)

    async def landed(self) -> None:
        await self.until(lambda: not self.world.plane.vehicle.armed)
        await self.sleep(2)

    # Plumbing

    def _spawn(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        task = asyncio.ensure_future(work)
        self._tasks.append(task)
        return task

    def _beat(self) -> None:
        async def beat() -> None:
            for number in itertools.count():
                await asyncio.sleep(BEAT_S)
                if not self.world.plane.deaf:
                    self.observer.heartbeat()
                if number % (SAMPLE_S / BEAT_S) == 0:
                    self._write("path", self._place())

        self._spawn(beat())

    async def _stop_tasks(self) -> None:
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self._tasks = []

    @asynccontextmanager
    async def flown(self) -> AsyncIterator[Flight]:
        async with self.world:
            self._beat()
            try:
                yield self
            finally:
                self._report_missions()
                await self._stop_tasks()
        await self.world.__aexit__()

    def _report_missions(self) -> None:
        for mission in missions_of(self.world):
            kind = str(mission.outcome).partition(":")[0] if mission.outcome else "-"
            self._write("missions", f"{mission.key} {kind} {mission.points_done} {mission.waypoints} {mission.flown}")
            self.texts.append(f"mission {mission.key} {mission.outcome or ''}")


def missions_of(world: World) -> list[Any]:
    """The missions that the service remembers."""
    return list(world.control.state.missions.values())


def _code(error: Exception) -> str:
    verdict = getattr(error, "verdict", None)
    return verdict.code if verdict is not None else type(error).__name__


async def _steps(work: Any) -> AsyncIterator[Any]:
    started = work()
    if hasattr(started, "__aiter__"):
        async for step in started:
            yield step
    else:
        yield await started


def trace_of(directory: Path, course: Callable[[Flight], Coroutine[Any, Any, None]], **options: Any) -> Flight:
    """Fly once."""
    flights: list[Flight] = []

    async def flight() -> None:
        flights.append(Flight(directory, **options))
        async with flights[0].flown():
            await course(flights[0])

    fly(flight)
    return flights[0]
