"""Golden flights: record control authority, stream events and autopilot commands.

A flight uses only external inputs: control streams, calls, Grants, and actions of pilots and of the autopilot. Any
version of the service can therefore fly it. This command records all flights again:
`PYTHONPATH=tests python tests/component/test_control_golden.py`.
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

HEARTBEAT_S = 0.5
RECORDED_STEP_S = 0.05
SAMPLE_S = 5.0

Trace = dict[str, list[str]]


class Recording(list[Any]):
    """A list that passes each appended item to a function."""

    def __init__(self, on_append: Callable[[Any], None]) -> None:
        super().__init__()
        self._on_append = on_append

    def append(self, item: Any) -> None:
        super().append(item)
        self._on_append(item)


class Flight:
    """Flight that records its trace.

    Attributes:
        trace: Events by source in order of time.
        texts: Reasons and error texts. They are not compared, because their wording may change.
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
        world.entries = Recording(self._record_audit_entry)
        world.plane.commands = Recording(self._record_command)
        obey = type(world.plane).set_to

        def set_to(mode: FlightMode) -> None:
            self._write("commands", f"mode {mode.name}")
            obey(world.plane, mode)

        def obey_and_report(outgoing: Any) -> None:
            """Execute a command and report the new state at once.

            The service attributes arming to a driver only if a heartbeat follows soon. Regular heartbeats are too rare.
            """
            type(world.plane)._obey(world.plane, outgoing)
            self.observer.heartbeat()

        world.plane.set_to = set_to  # type: ignore[method-assign]
        world.plane._obey = obey_and_report  # type: ignore[method-assign]
        self.observer = world.observer
        return world

    # Trace

    def _write(self, source: str, event: str) -> None:
        """Add an entry to the trace of a source. Repetitions are kept only for the sources authority and streams."""
        lines = self.trace[source]
        if not lines or lines[-1].partition(" ")[2] != event or source in {"authority", "streams"}:
            lines.append(f"{self.world.plane.now - 1000:.1f} {event}")

    def _record_audit_entry(self, entry: tuple[str, dict[str, Any]]) -> None:
        kind, content = entry
        if kind in {"control", "takeover"}:
            plane = self.world.plane
            position = self._position()
            controller = str(content["controller"]).rpartition("/")[2]
            self._write(
                "authority", f"{kind} {content['action']} by {controller} {content['code'] or '-'} at {position}"
            )
            self.texts.append(f"{plane.now:.1f} {kind} {content['reason']}")
        elif kind == "monitor":
            self._write("authority", f"monitor {content['action']} {content['code']}")

    def _record_command(self, number: int) -> None:
        self._write("commands", f"command {number}")

    def _stream_event(self, name: str, event: str, text: str = "") -> None:
        self._write("streams", f"{name} {event}")
        self.texts.append(f"{self.world.plane.now:.1f} {name} {event} {text}")

    def _position(self) -> str:
        """Return the position in whole metres east, north and up of home."""
        plane = self.world.plane
        return str(tuple(round(metres) for metres in (*plane.xy, plane.height)))

    # Actions

    def put(self, grant: Any, key: str = "m1") -> ActiveGrant:
        self._grants.append((grant, key))
        return self.world.grants.put(grant, key)

    def follow(self, grant: ActiveGrant, name: str = "driver") -> asyncio.Task[None]:
        """Open a GetControl stream in the background."""
        return self._spawn(self._follow(grant, name, asyncio.Event()))

    async def drive(self, grant: ActiveGrant, name: str = "driver") -> asyncio.Task[None]:
        """Open a GetControl stream, and wait until it has control or ends."""
        granted = asyncio.Event()
        stream = self._spawn(self._follow(grant, name, granted))
        waiting = asyncio.ensure_future(granted.wait())
        await asyncio.wait([stream, waiting], return_when=asyncio.FIRST_COMPLETED)
        waiting.cancel()
        return stream

    async def _follow(self, grant: ActiveGrant, name: str, granted: asyncio.Event) -> None:
        try:
            async for event in self.world.streams.follow(grant):
                state = event.state.name
                self._stream_event(name, f"{state} {event.control_point} {event.waypoints_reached}", event.reason)
                if state == "GRANTED":
                    granted.set()
        except asyncio.CancelledError:
            self._stream_event(name, "left")
            raise
        except Exception as error:  # the trace contains every end of a stream
            self._stream_event(name, f"refused {_code(error)}", str(error))
        else:
            self._stream_event(name, "ended")

    def call(self, name: str, work: Any) -> asyncio.Task[None]:
        """Start a call in the background."""
        return self._spawn(self.do(name, work))

    async def do(self, name: str, work: Any) -> None:
        """Make a call and record its result."""
        try:
            async for _ in _steps(work):
                pass
        except asyncio.CancelledError:
            self._write("calls", f"{name} cancelled")
            raise
        except Exception as error:  # the trace contains every result of a call
            self._write("calls", f"{name} {_code(error)}")
            self.texts.append(f"{name} {error}")
        else:
            self._write("calls", f"{name} done")

    async def up(self, grant: ActiveGrant, altitude_m: float = 10.0) -> asyncio.Task[None]:
        """Take control, arm and take off."""
        stream = await self.drive(grant)
        await self.do("Arm", lambda: self.world.service.arm(grant))
        await self.do("Takeoff", lambda: self.world.service.take_off(grant, TakeoffArgs(altitude_m)))
        return stream

    async def goto(self, grant: ActiveGrant, x: float, y: float, alt: float = 10.0) -> None:
        await self.do("Goto", lambda: self.world.service.goto(grant, goto(x, y, alt), 0))

    def start_goto(self, grant: ActiveGrant, x: float, y: float) -> asyncio.Task[None]:
        return self.call("Goto", lambda: self.world.service.goto(grant, goto(x, y), 0))

    async def give_back(self, grant: ActiveGrant) -> None:
        await self.do("ReturnControl", lambda: self.world.control.return_control(grant))

    def failsafe(self, mode: FlightMode) -> None:
        """Let a failsafe of the autopilot change the mode."""
        vehicle = self.world.plane.vehicle
        plane = self.world.plane
        vehicle.failsafe_text = "Battery Failsafe"
        vehicle.failsafe_text_at = plane.now
        plane.set_to(mode)

    def break_link(self) -> None:
        self.world.plane.disconnected = True

    def restore_link(self) -> None:
        """Restore the link and let the service find the vehicle."""
        plane = self.world.plane
        plane.disconnected = False
        plane.vehicle.heartbeat_at = plane.now
        self.observer.found()

    async def restart(self) -> None:
        """Stop the service and start another one with the same journal."""
        old = self.world
        await self._stop_tasks()
        await old.__aexit__()
        self.world = self._wired(World(self._directory, **self._options, after=old, initialised=False))
        grants = self._grants
        self._grants = []
        for grant, key in grants:
            self.put(grant, key)
        self.observer.found()
        await self.world.__aenter__()
        self._send_heartbeats()

    async def sleep(self, seconds: float) -> None:
        await asyncio.sleep(seconds)

    async def until(self, condition: Callable[[], object], timeout_s: float = 120.0) -> None:
        await self.world.until(condition, timeout_s)

    async def landed(self) -> None:
        await self.until(lambda: not self.world.plane.vehicle.armed)
        await self.sleep(2)

    # Tasks

    def _spawn(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        task = asyncio.ensure_future(work)
        self._tasks.append(task)
        return task

    def _send_heartbeats(self) -> None:
        async def send_heartbeats() -> None:
            for number in itertools.count():
                await asyncio.sleep(HEARTBEAT_S)
                if not self.world.plane.disconnected:
                    self.observer.heartbeat()
                if number % (SAMPLE_S / HEARTBEAT_S) == 0:
                    self._write("path", self._position())

        self._spawn(send_heartbeats())

    async def _stop_tasks(self) -> None:
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self._tasks = []

    @asynccontextmanager
    async def flown(self) -> AsyncIterator[Flight]:
        async with self.world:
            self._send_heartbeats()
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
    """Return the missions in the control state."""
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


def fly_script(directory: Path, script: Callable[[Flight], Coroutine[Any, Any, None]], **options: Any) -> Flight:
    """Fly a script in virtual time and return the flight with its trace."""
    flights: list[Flight] = []

    async def flight() -> None:
        flights.append(Flight(directory, **options))
        async with flights[0].flown():
            await script(flights[0])

    fly(flight)
    return flights[0]
