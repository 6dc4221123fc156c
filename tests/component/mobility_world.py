"""The mobility service and a simple fake vehicle in one event loop with virtual time.

Tests with this pair are fast and deterministic.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import shapely
from fractus_core.api.grants import GrantSpec
from fractus_core.control import ControlEvent, ControlState, StreamState
from fractus_core.control.state import FlightMode
from fractus_core.geo import LocalFrame
from fractus_core.policy.compiled_grant import compile_grant
from fractus_core.policy.decision_types import Airframe, GotoArgs, Home, TakeoffArgs
from fractus_runtime.mavlink_codec import Message, message
from fractus_services.errors import Refused
from fractus_services.grant_files import ActiveGrant
from fractus_services.mobility.authority.contact import LastContactFile
from fractus_services.mobility.authority.flown_grant import FlownGrantFile
from fractus_services.mobility.authority.journal import Journal
from fractus_services.mobility.autopilot import VELOCITY_HISTORY_S, FailsafeStatus
from fractus_services.mobility.flight.service import Progress
from fractus_services.mobility.mavlink.ardupilot import ARDUCOPTER
from fractus_services.mobility.mavlink.failsafes import MavlinkFailsafes
from fractus_services.mobility.mavlink.mavlink_autopilot import MavlinkAutopilot
from fractus_services.mobility.mavlink.rtl_parameters import RtlParameters
from fractus_services.mobility.mavlink.timing import PROBE_S
from fractus_services.mobility.rpc.mobility_components import MobilityComponents
from parameter_vehicle import FAILSAFES, MOVEMENT, parameter_responses
from pymavlink.dialects.v20 import ardupilotmega as mavlink

FRAME = LocalFrame(39.36, 22.95)
BRAKE, GUIDED, LAND, LOITER, RTL, SMART_RTL = (
    ARDUCOPTER.mode(getattr(mavlink, f"COPTER_MODE_{name}"))
    for name in ("BRAKE", "GUIDED", "LAND", "LOITER", "RTL", "SMART_RTL")
)
STEP_S = 0.1
"""Interval between two positions of the vehicle."""
GROUND_M = 10.0
"""Altitude of the ground above mean sea level."""
ACCEL = 2.5
CLIMB = 2.0
DEFAULT_MPS = 8.0
ALL = (
    "Arm", "Disarm", "Takeoff", "Land", "SetSpeed", "GetSpeed", "SetVelocity", "Goto", "Hover", "GetPosition",
    "ReturnToLaunch",
)  # fmt: skip


class Plane(MavlinkAutopilot):
    """Simple fake autopilot. It acknowledges commands, and moves approximately like ArduCopter."""

    def __init__(self, step_s: float = STEP_S) -> None:
        self.step_s = step_s
        self.on_parameter: Callable[[str], None] = lambda _name: None
        super().__init__("tcp:nowhere:1", ARDUCOPTER, on_parameter=lambda name: self.on_parameter(name))  # noqa: PLW0108
        self.target = (1, 1)
        self.xy = [0.0, 0.0]
        self.velocity = [0.0, 0.0]
        self.height = 0.0
        self.climb = 0.0
        self.speed_mps = DEFAULT_MPS
        self.positions = False
        self.goal: tuple[float, float] | None = None
        self.velocity_setpoint: tuple[float, float, float] | None = None
        self.setpoint_end = 0.0
        self.goal_height = 0.0
        self.heading = 0.0
        self.commands: list[int] = []
        self.trace: list[tuple[float, float, float]] = []
        self.refuses: set[int] = set()
        self.disconnected = False
        self.uplink_s = self.downlink_s = 0.0
        self.fixed: tuple[str, ...] = ()
        self.errors = False
        self.measured = False
        """True if the vehicle reports its velocity so often that the service can derive the acceleration."""
        self.parameters = MOVEMENT | FAILSAFES | {"WPNAV_SPEED": 100 * DEFAULT_MPS}
        vehicle = self.vehicle
        vehicle.mode = GUIDED
        vehicle.located = True
        vehicle.position_error_m = 0.5
        vehicle.ready = True
        vehicle.estimated = True
        vehicle.gps_at = math.inf
        vehicle.home = Home(39.36, 22.95, GROUND_M)
        self.home_amsl_m = GROUND_M

    async def run(self) -> None:
        turn = 0
        while True:
            self._step()
            if turn % round(PROBE_S / self.step_s) == 0:
                self._probe(self.now)
            turn += 1
            await asyncio.sleep(self.step_s)

    def send(self, outgoing: Message) -> None:
        if not self.disconnected:
            self._after(self.uplink_s, self._receive, outgoing)

    def _after(self, delay_s: float, function: Callable[..., None], *args: Any) -> None:
        if delay_s > 0:
            asyncio.get_running_loop().call_later(delay_s, function, *args)
        else:
            function(*args)

    def _reply(self, outgoing: Message) -> None:
        self._after(self.downlink_s, self.take, outgoing)

    def _receive(self, outgoing: Message) -> None:
        for response in parameter_responses(self.parameters, outgoing, self.fixed, errors=self.errors):
            self._reply(response)
        kind = outgoing.name
        command = outgoing.values.get("command", 0)
        if kind in {"COMMAND_LONG", "COMMAND_INT"}:
            self.commands.append(command)
            refused = command in self.refuses
            if not refused:
                self._obey(outgoing)
            self._reply(
                message(
                    "COMMAND_ACK",
                    command=command,
                    result=mavlink.MAV_RESULT_FAILED if refused else mavlink.MAV_RESULT_ACCEPTED,
                )
            )
        elif kind == "TIMESYNC":
            self._reply(message("TIMESYNC", tc1=round(self.now * 1e9), ts1=outgoing.integer("ts1")))
        elif kind == "SET_POSITION_TARGET_LOCAL_NED" and self.vehicle.mode == GUIDED and self.height > 0.2:
            self.commands.append(84)
            self.positions = False
            self.velocity_setpoint = (outgoing.real("vy"), outgoing.real("vx"), -outgoing.real("vz"))
            self.setpoint_end = self.now + 3.0
            self.goal = None

    def _obey(self, outgoing: Message) -> None:
        number = outgoing.integer("command")
        if number == mavlink.MAV_CMD_DO_SET_MODE:
            self.set_to(self.stack.mode(int(outgoing.real("param2"))))
        elif number == mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
            self.vehicle.armed = outgoing.real("param1") == 1
        elif number == mavlink.MAV_CMD_NAV_TAKEOFF:
            self.goal = (self.xy[0], self.xy[1])
            self.goal_height = outgoing.real("param7") + self.raised_m
            self.velocity_setpoint = None
        elif number == mavlink.MAV_CMD_DO_CHANGE_SPEED:
            self.speed_mps = outgoing.real("param2")
        elif number == mavlink.MAV_CMD_DO_REPOSITION:
            if not self.positions:
                self.positions = True
                self.speed_mps = DEFAULT_MPS  # a newly started position controller uses its default speed
            self.goal = FRAME.xy(outgoing.integer("x") / 1e7, outgoing.integer("y") / 1e7)
            self.goal_height = outgoing.real("z") + self.raised_m
            self.velocity_setpoint = None
        elif number == mavlink.MAV_CMD_CONDITION_YAW:
            self.heading = outgoing.real("param1")
        elif number == mavlink.MAV_CMD_DO_SET_HOME:
            self.move_home(outgoing.integer("x"), outgoing.integer("y"), outgoing.real("z"))

    @property
    def raised_m(self) -> float:
        """Height of home above the takeoff ground, in metres."""
        return self.home_amsl_m - GROUND_M

    def move_home(self, lat_e7: int, lon_e7: int, amsl_m: float) -> None:
        """Set home and announce it, as on DO_SET_HOME from any station."""
        self.home_amsl_m = amsl_m
        self._reply(
            message(
                "HOME_POSITION",
                latitude=lat_e7,
                longitude=lon_e7,
                altitude=round(amsl_m * 1000),
                q=(1.0, 0.0, 0.0, 0.0),
            )
        )

    def set_to(self, mode: FlightMode) -> None:
        """Change the mode, as a pilot or a failsafe does."""
        self.positions = False
        self.vehicle.mode = mode
        self.goal, self.velocity_setpoint = (
            ((self.xy[0], self.xy[1]), None) if mode in {GUIDED, BRAKE} else (None, None)
        )
        self.goal_height = self.height

    def _step(self) -> None:
        if self.vehicle.armed:
            self._move()
        if not self.disconnected:
            self._report_state()

    def _move(self) -> None:
        east, north, up = self._command()
        change = math.hypot(east - self.velocity[0], north - self.velocity[1])
        share = min(ACCEL * self.step_s / change, 1.0) if change > 0 else 0.0
        self.velocity[0] += (east - self.velocity[0]) * share
        self.velocity[1] += (north - self.velocity[1]) * share
        self.climb = up
        self.xy[0] += self.velocity[0] * self.step_s
        self.xy[1] += self.velocity[1] * self.step_s
        self.height = max(self.height + self.climb * self.step_s, 0.0)
        if self.height > 0.3:
            self.trace.append((self.xy[0], self.xy[1], self.height))
        if self.vehicle.mode in {LAND, RTL, SMART_RTL} and self.height <= 0.0:
            self.vehicle.armed = False
            self.velocity = [0.0, 0.0]
            self.climb = 0.0

    def _command(self) -> tuple[float, float, float]:  # noqa: PLR0911 - one return for each mode
        mode = self.vehicle.mode
        if mode == LAND:
            return 0.0, 0.0, -CLIMB
        if mode in {RTL, SMART_RTL}:
            distance = math.hypot(*self.xy)
            if distance > 0.7:
                high = 15.0 if mode == RTL else self.height
                if self.height < high - 0.3:
                    return 0.0, 0.0, CLIMB
                return (*self._toward((0.0, 0.0)), 0.0)
            return 0.0, 0.0, -CLIMB
        if self.velocity_setpoint is not None:
            if self.now < self.setpoint_end:
                return self.velocity_setpoint
            self.set_to(mode)
        if self.goal is None:
            return 0.0, 0.0, 0.0
        rise = self.goal_height - self.height
        return (*self._toward(self.goal), max(-CLIMB, min(CLIMB, rise)))

    def _toward(self, goal: tuple[float, float]) -> tuple[float, float]:
        x = goal[0] - self.xy[0]
        y = goal[1] - self.xy[1]
        distance = math.hypot(x, y)
        if distance < 0.05:
            return 0.0, 0.0
        speed = min(self.speed_mps, distance, math.sqrt(ACCEL * distance))
        return x / distance * speed, y / distance * speed

    def _report_state(self) -> None:
        place = FRAME.latlon(self.xy[0], self.xy[1])
        height = self.height
        state = (*place, height - self.raised_m, height + GROUND_M, self.heading, *self.velocity, -self.climb)
        self._after(self.downlink_s, self._show, round(self.now * 1e3), *state)

    def _show(self, boot_ms: int, *state: float) -> None:
        vehicle = self.vehicle
        late_s = self.timing.take_position(boot_ms, self.now)
        if late_s is None:
            return
        (
            vehicle.lat, vehicle.lon, vehicle.altitude_m, vehicle.amsl_m, vehicle.yaw_deg, vehicle.east_mps, vehicle.north_mps,
            vehicle.down_mps,
        ) = state  # fmt: skip
        if self.measured:
            vehicle.velocity_history.append((boot_ms / 1e3, vehicle.north_mps, vehicle.east_mps))
            while vehicle.velocity_history[0][0] < boot_ms / 1e3 - VELOCITY_HISTORY_S:
                vehicle.velocity_history.popleft()
        vehicle.position_at = self.now - late_s
        vehicle.heartbeat_at = vehicle.landed_at = vehicle.checks_at = vehicle.estimated_at = self.now
        vehicle.landed_state = 2 if vehicle.amsl_m > GROUND_M + 0.2 else 1
        self.notify()


class Grants:
    """Active Grants of the service, without Grant files."""

    def __init__(self) -> None:
        self.active: dict[str, ActiveGrant] = {}
        self._listeners: list[Any] = []

    def of(self, identity: str) -> ActiveGrant | None:
        return self.active.get(identity)

    def listen(self, listener: Any) -> None:
        self._listeners.append(listener)

    def put(self, spec: GrantSpec, key: str = "m1") -> ActiveGrant:
        fresh = ActiveGrant(key, spec.instance, spec, compile_grant(spec))
        before = self.active.get(fresh.identity)
        self.active[fresh.identity] = fresh
        for listener in self._listeners:
            listener(before, fresh)
        return fresh

    def remove(self, grant: ActiveGrant) -> None:
        del self.active[grant.identity]
        for listener in self._listeners:
            listener(grant, None)


class Fence:
    """Fake of the vehicle fence."""

    raised = False
    missing = ""
    problem: Exception | None = None

    async def raise_around(self, spec: GrantSpec, *, retraces: bool) -> None:
        del spec, retraces
        if self.problem is not None:
            raise self.problem
        self.raised = True

    async def lower(self, idle: Callable[[], bool]) -> None:
        self.raised = self.raised and not idle()

    async def hold(self) -> tuple[str, ...]:
        return ()


class World:
    """Mobility service and fake autopilot of one drone. Use it inside `virtual_time.fly`."""

    def __init__(
        self,
        directory: Path,
        *,
        retraces: bool = False,
        grace_s: float = 5.0,
        boarding_s: float = 0.0,
        after: World | None = None,
        initialised: bool = True,
        step_s: float = STEP_S,
        contact_file: LastContactFile | None = None,
        flown_grant: FlownGrantFile | None = None,
    ) -> None:
        self.plane = after.plane if after is not None else Plane(step_s)
        if retraces:
            self.plane.parameters |= {"FS_GCS_ENABLE": 3.0, "BATT_FS_LOW_ACT": 3.0, "SRTL_POINTS": 300.0}
        self.grants = Grants()
        self.entries: list[tuple[str, dict[str, Any]]] = []
        self.audit = SimpleNamespace(append=lambda kind, content, **_: self.entries.append((kind, content)), failure="")
        self.journal = after.journal if after is not None else Journal(directory)
        self.journal._write = lambda _data: None  # type: ignore[method-assign]
        self.fence = Fence()
        facts = self.plane.vehicle
        parts = MobilityComponents(
            self.plane, MavlinkFailsafes(self.plane), self.fence, RtlParameters(self.plane, directory), journal=self.journal, grants=self.grants,  # type: ignore[arg-type]
            audit=self.audit, clock=lambda: 1_790_000_000.0 + self.plane.now, grace_s=grace_s, boarding_s=boarding_s, contact_file=contact_file, flown_grant=flown_grant,  # type: ignore[arg-type]
            state=ControlState(decided=initialised, armed_seen=facts.armed if initialised else None, expected_mode=GUIDED),
        )  # fmt: skip
        self.control = parts.control
        self.gate = parts.gate
        self.service = parts.service
        self.streams = parts.streams
        self.poi_missions = parts.poi_missions
        self.monitor = parts.monitor
        self.contact = parts.control.contact
        self.supervisor = parts.supervisor
        self.observer = parts.observer  # fmt: skip
        self.control.failsafe_status = FailsafeStatus("", (), Airframe(retraces=retraces), 8.0, retraces)
        self.plane.on_parameter = self.observer.parameter
        self._tasks = [
            asyncio.ensure_future(part) for part in (self.plane.run(), self.monitor.run(), self.poi_missions.run())
        ]
        self.events: list[ControlEvent] = []

    async def __aenter__(self) -> World:
        await asyncio.sleep(0.2)
        return self

    async def __aexit__(self, *_: object) -> None:
        self.control.close()
        while tasks := [task for task in (*self._tasks, *self.control.tasks._tasks) if not task.done()]:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def drive(self, grant: ActiveGrant) -> asyncio.Task[None]:
        """Open a driver's stream in the background and wait until it has control or ends."""
        granted = asyncio.Event()

        async def follow() -> None:
            async for event in self.streams.follow(grant):
                self.events.append(event)
                if event.state is StreamState.GRANTED:
                    granted.set()

        stream = asyncio.ensure_future(follow())
        self._tasks.append(stream)
        waiting = asyncio.ensure_future(granted.wait())
        await asyncio.wait([stream, waiting], return_when=asyncio.FIRST_COMPLETED)
        waiting.cancel()
        if stream.done():
            await stream
        return stream

    async def up(self, grant: ActiveGrant, altitude_m: float = 10.0) -> asyncio.Task[None]:
        """Take control, arm and take off."""
        stream = await self.drive(grant)
        await self.service.arm(grant)
        await end(self.service.take_off(grant, TakeoffArgs(altitude_m)))
        return stream

    def outcome(self, key: str = "m1") -> str:
        """Return the outcome of a mission as text. The text is empty while the mission is not ended."""
        mission = self.control.state.missions.get(key)
        return str(mission.outcome) if mission is not None and mission.outcome is not None else ""

    async def until(self, condition: Callable[[], object], timeout_s: float = 120.0) -> None:
        async with asyncio.timeout(timeout_s):
            while not condition():
                await self.plane.update(0.1)

    def kinds(self, kind: str) -> list[dict[str, Any]]:
        return [content for entry_kind, content in self.entries if entry_kind == kind]


async def end(motion: Any) -> Progress:
    """Complete a motion and return its last step."""
    steps: list[Progress] = [step async for step in motion]
    assert steps[-1].step.complete
    return steps[-1]


async def refusal(call: Any) -> Refused:
    """Return the error of a call or motion that must be refused."""
    try:
        if hasattr(call, "__aiter__"):
            await end(call)
        else:
            await call
    except Refused as refused:
        return refused
    raise AssertionError("the call was not refused")


def at(x: float, y: float) -> tuple[float, float]:
    return FRAME.latlon(x, y)


def area(x0: float, y0: float, x1: float, y1: float) -> dict[str, Any]:
    corners = ((x0, y0), (x1, y0), (x1, y1), (x0, y1))
    return {"polygon": {"exterior": [dict(zip(("lat", "lon"), at(x, y), strict=True)) for x, y in corners]}}


def zone(name: str, action: str, *box: float) -> dict[str, Any]:
    spec = {"type": "GeofenceControl", "kind": "exclusion", "action": action, "selector": {"zones": [f"{name}-zone"]}}
    return {"name": name, "spec": spec, "zones": [{"name": f"{name}-zone", "area": area(*box)}]}


def spec(*policies: dict[str, Any], **changes: Any) -> GrantSpec:
    """Return a driver's grant with an operation area of 200 m around home."""
    body = {
        "node": "drone-1",
        "application": {"namespace": "default", "name": "app", "uid": "u1"},
        "component": "Navigator",
        "instance": "app-navigator",
        "class": "driver",
        "control": "full",
        "controlPoints": [{"navigation": "pathBased", "path": [_place(0, 70)]}],
        "services": [{"service": "mobility", "methods": list(ALL)}],
        "operationArea": [area(-200, -200, 200, 200)],
        "home": {"lat": 39.36, "lon": 22.95, "alt": 10.0, "altitudeReference": "amsl"},
        "limits": {"maxAltitude": 60, "maxSpeed": 12},
        "policies": list(policies),
    }
    return GrantSpec.model_validate(body | changes)


def partial(*policies: dict[str, Any], **changes: Any) -> GrantSpec:
    return spec(*policies, control="partial", **changes)


def touring(*policies: dict[str, Any], tour: tuple[tuple[float, float], ...], **changes: Any) -> GrantSpec:
    changes = {"class": "passenger", "control": None, "controlPoints": [], "instance": "app-viewer"} | changes
    return spec(*policies, tour=[_place(x, y) for x, y in tour], **changes)


def _place(x: float, y: float, alt: float = 12.0) -> dict[str, float]:
    return dict(zip(("lat", "lon", "alt"), (*at(x, y), alt), strict=True))


def goto(x: float, y: float, alt: float = 10.0, **more: Any) -> GotoArgs:
    return GotoArgs(*at(x, y), alt, **more)


def clearance_m(world: World, *box: float) -> float:
    return float(min(shapely.box(*box).distance(shapely.Point(x, y)) for x, y, _ in world.plane.trace))
