"""Random flights of the mobility service on the simulated vehicle, over a link that delays and loses frames.

Service and vehicle run in one event loop with virtual time. Only the driver is fake. The service sets the parameters,
failsafes and fence of the vehicle over the link. It judges the calls of the driver, and flies and monitors motions.

A seed determines a flight: zones and limits, the requests of the driver, the delay of the link, the wind and the
faults. An oracle checks the true position of the vehicle. The service cannot observe this position. The oracle shares
no code with the policy engine.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import random
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import shapely
from fractus_core.api.grants import GrantSpec
from fractus_core.control import ControlEvent, ControlState, StreamState
from fractus_core.policy.decision_types import SetSpeedArgs, TakeoffArgs, VelocityArgs
from fractus_runtime.mavlink_codec import Parser
from fractus_services.errors import AutopilotError, Refused
from fractus_services.grant_files import ActiveGrant
from fractus_services.mobility.authority.journal import Journal
from fractus_services.mobility.mavlink.ardupilot import ARDUCOPTER
from fractus_services.mobility.mavlink.failsafes import MavlinkFailsafes
from fractus_services.mobility.mavlink.fence import MissionFence
from fractus_services.mobility.mavlink.mavlink_autopilot import MavlinkAutopilot
from fractus_services.mobility.mavlink.rtl_parameters import RtlParameters
from fractus_services.mobility.mavlink.vehicle_identification import KnownVehicleFile
from fractus_services.mobility.rpc.mobility_components import MobilityComponents
from fractus_vehicle.earth import Place
from fractus_vehicle.simulation import Simulation
from fractus_vehicle.state import CONTROL_STEP_S, VehicleConfig, VehicleState
from mobility_world import FRAME, Grants, area, goto, spec, zone
from virtual_time import Loop

PROGRAMME_S = 400.0
"""Maximum duration of a driver's flight. Flights under a low speed limit may reach it."""

HOME_S = 250.0
"""Maximum duration of a return flight, including the driver grace before it."""

HALF_M = 130.0
"""Distance from home to each side of the operation area, in metres."""

WATCH_S = 0.05
HEIGHT_SLACK_M = 2.0
SPEED_SLACK_MPS = 0.1
LEVEL_SLACK_M = 0.1
"""Tolerances from docs/policies.md (height) and docs/mobility.md (speed, and height of a drone below its limit, without gusts).

The vehicle exceeds a commanded speed by up to 0.3 m/s and a commanded height by up to 0.1 m.
"""

GUST_SHARE = 0.3
"""Momentary changes of speed and height by a gust, as shares of the speed of the gust."""

REACTION_S = 0.4
"""Time until a new rule affects the motion: at most 0.2 s in the service, and 0.2 s in the vehicle."""

BRAKING_SHARE = 0.64
MAX_BRAKING_MPS2 = 1.6
"""Mean deceleration of ArduCopter's BRAKE mode in tailwind.

It is the smaller value of BRAKING_SHARE times WPNAV_ACCEL and MAX_BRAKING_MPS2.

With WPNAV_ACCEL 250, the stopping distance is 10.6 m from 6.4 m/s and 19.6 m from 9.6 m/s.
"""


METRES_PER_DEG = 111_319.0

JERK_MPS3 = 5.0
"""ArduCopter's PSC_JERK_XY. It limits how fast the vehicle can reduce its acceleration."""


JUMP_SWERVE_M = 5.0
JUMP_SWERVE_MPS = 20.0
"""Distance by which a drone may leave its course when its estimate jumps (docs/mobility.md): without delay, and per second of delay."""

DRIFT_MPS = 0.5
"""Speed of a GPS position that drifts. GPS and estimate drift together, so that no sign shows the fault."""


@dataclass(frozen=True)
class PositionFault:
    """Fault of the position in flight.

    Attributes:
        kind: `glitch`: the GPS is wrong. `second`: one of two GPS receivers is wrong. `jump`: the estimate is reset to a wrong
            position. `altitude`: the barometer is wrong. `drift`: the GPS drifts slowly, and does not return.
        at_s: Begin, after the start of the flight.
        lasting_s: Duration.
        north_m, east_m, up_m: Error of the position.
    """

    kind: str
    at_s: float
    lasting_s: float
    north_m: float = 0.0
    east_m: float = 0.0
    up_m: float = 0.0


@dataclass(frozen=True)
class Weather:
    """Environment of a flight.

    Attributes:
        uplink_s: Delay from the companion to the vehicle. Jitter adds up to half of this delay.
        downlink_s: Delay from the vehicle to the companion, with the same jitter.
        loss: Share of frames lost in each direction.
        wind_mps: Mean wind.
        gusts_mps: Strength of gusts.
        error_m: Distance of the true position north of the estimated position.
        claimed_error_m: Position error reported by the GPS. If None, the GPS reports the actual error.
        speedup: Speed of the vehicle's clock relative to the clock of the service.
        cut: Begin and duration of the link outage, if any.
        fault: Fault of the position, if any.
        stall: Process ("service" or "vehicle") that stalls every few seconds, and the duration of each stall.
    """

    uplink_s: float = 0.0
    downlink_s: float = 0.0
    loss: float = 0.0
    wind_mps: float = 0.0
    gusts_mps: float = 0.0
    error_m: float = 0.0
    claimed_error_m: float | None = None
    speedup: int = 1
    cut: tuple[float, float] | None = None
    fault: PositionFault | None = None
    stall: tuple[str, float] | None = None


STALL_EVERY_S = (2.0, 6.0)
"""Range of the interval between two stalls of a process."""

TURN_S = 1e-7
"""Virtual duration of one iteration of the event loop.

It must not be 0, because rounding could then keep a timer from expiring.
"""


class Wire(asyncio.Transport):
    """The companion's end of a link. Complete frames arrive late and in order, or are lost."""

    def __init__(self, loop: Sky, protocol: asyncio.Protocol) -> None:
        super().__init__()
        self._loop = loop
        self._protocol = protocol
        self._channel = loop.craft.open("companion")
        self._parser = Parser()
        self._arrivals = {True: 0.0, False: 0.0}
        self._open = True

    def write(self, data: Any) -> None:
        self._carry(bytes(data), self._loop.weather.uplink_s, self._to_vehicle, to_vehicle=True)

    def _to_vehicle(self, data: bytes) -> None:
        if self._open:
            self._loop.craft.receive(self._channel, data)

    def _to_companion(self, data: bytes) -> None:
        if self._open:
            self._protocol.data_received(data)

    def flush(self) -> None:
        """Send the pending messages of the vehicle to the companion."""
        for message in self._parser.feed(self._channel.take()):
            self._carry(message.frame, self._loop.weather.downlink_s, self._to_companion, to_vehicle=False)

    def _carry(self, data: bytes, delay_s: float, deliver: Callable[[bytes], None], *, to_vehicle: bool) -> None:
        loop = self._loop
        if not self._open or loop.severed or loop.chance.random() < loop.weather.loss:
            return
        arrives = max(loop.time() + delay_s * loop.chance.uniform(1.0, 1.5), self._arrivals[to_vehicle])
        self._arrivals[to_vehicle] = arrives
        loop.call_at(arrives, deliver, data)

    def close(self) -> None:
        self._open = False
        self._loop.craft.close(self._channel)

    def is_closing(self) -> bool:
        return not self._open


class Sky(Loop):
    """An event loop whose only network is a link to a simulated vehicle."""

    def __init__(self, seed: int, weather: Weather, parameters: dict[str, float]) -> None:
        super().__init__()
        self.chance = random.Random(seed)
        self.weather = weather
        self.severed_at = math.inf
        place = Place.from_degrees(39.36, 22.95, 10.0)
        wind = {"SIM_WIND_SPD": weather.wind_mps, "SIM_WIND_DIR": float(seed % 360), "SIM_WIND_TURB": weather.gusts_mps}
        claimed_m = abs(weather.error_m) if weather.claimed_error_m is None else weather.claimed_error_m
        wind["SIM_GPS_ACC"] = max(claimed_m, 0.3)
        if weather.fault is not None and weather.fault.kind == "second":
            # First receiver, mean of both, and the one with more satellites.
            wind |= {"GPS2_TYPE": 1.0, "SIM_GPS2_DISABLE": 0.0, "GPS_AUTO_SWITCH": float((0, 2, 1)[seed % 3])}
        config = VehicleConfig(start=place, seed=seed, ready_after_s=2.0, parameters=wind | parameters)
        self.simulation = Simulation([config])
        self.craft = self.simulation.crafts[0]
        self.wires: list[Wire] = []
        self.witnesses: list[Callable[[], object]] = []

    def _run_once(self) -> None:
        self._now += TURN_S
        super()._run_once()  # type: ignore[misc]

    @property
    def severed(self) -> bool:
        """True while the link is cut."""
        return self.severed_at < math.inf

    @property
    def truth(self) -> VehicleState:
        """True state of the vehicle. The reported state may differ."""
        return self.craft.vehicle.state

    async def create_connection(self, factory: Any, *_: Any, **__: Any) -> Any:  # type: ignore[override]
        protocol = factory()
        if self.severed:
            raise OSError("unreachable")
        wire = Wire(self, protocol)
        self.wires = [each for each in self.wires if not each.is_closing()] + [wire]
        protocol.connection_made(wire)
        return wire, protocol

    async def run_vehicle(self) -> None:
        """Advance the simulation until cancelled."""
        stalls_at = self.time() + self.chance.uniform(*STALL_EVERY_S)
        while True:
            self._advance_simulation()
            await asyncio.sleep(CONTROL_STEP_S)
            if self.weather.stall is not None and self.time() >= stalls_at:
                await self._stall(*self.weather.stall)
                stalls_at = self.time() + self.chance.uniform(*STALL_EVERY_S)

    def _advance_simulation(self, steps: int = 1) -> None:
        for _ in range(steps * self.weather.speedup):
            self.simulation.step()
        for wire in self.wires:
            wire.flush()
        for witness in self.witnesses:
            witness()

    async def _stall(self, process: str, duration_s: float) -> None:
        steps = round(duration_s / CONTROL_STEP_S)
        if process == "vehicle":
            await asyncio.sleep(duration_s)
            self._advance_simulation(steps)  # After the stall, the vehicle simulates the missed steps at once.
            return
        for _ in range(steps):
            self._now += CONTROL_STEP_S
            self._advance_simulation()


@dataclass
class Wall:
    """Zone in the representation of the oracle.

    Attributes:
        box: Forbidden area in metres around home.
        low_m: Lower limit above home.
        high_m: Upper limit above home.
        excused: True until the drone has left a zone that it could not avoid when the zone was added.
        since_s: Time at which the zone was added.
    """

    box: shapely.Geometry
    low_m: float
    high_m: float
    excused: bool = False
    since_s: float = -math.inf


@dataclass
class Rules:
    """Rules in force at a moment.

    Attributes:
        walls: Exclusion zones.
        ceiling_m: Altitude limit above home.
        top_mps: Limit of the ground speed.
        high_since_s: Time of the last change of the ceiling.
        fast_since_s: Time of the last change of the speed limit.
    """

    walls: list[Wall] = field(default_factory=list)
    ceiling_m: float = 60.0
    top_mps: float = 12.0
    high_since_s: float = -math.inf
    fast_since_s: float = -math.inf


@dataclass
class Account:
    """Result of a flight.

    Attributes:
        seed: Seed of the flight.
        wrong: Violations, as text.
        events: Log of the flight.
        flew: True if the drone left the ground.
        down: True if the drone has landed and disarmed.
        depth_m: Greatest depth inside a zone.
    """

    seed: int
    wrong: list[str] = field(default_factory=list)
    events: list[str] = field(default_factory=list)
    flew: bool = False
    down: bool = False
    depth_m: float = 0.0


class Oracle:
    """Checks the true position against the rules."""

    def __init__(self, sky: Sky, account: Account) -> None:
        self._sky = sky
        self._account = account
        self.rules = Rules()
        self.arena = shapely.box(-HALF_M, -HALF_M, HALF_M, HALF_M)
        self._reported: set[str] = set()
        self._complied_with_m = math.inf
        self._speed_mps = 0.0
        self.speeding_mps2 = 0.0

    def place(self) -> tuple[float, float, float]:
        """Return the true position: east, north and height above home in metres."""
        truth = self._sky.truth.true_place
        x, y = FRAME.xy(truth.lat_e7 / 1e7, truth.lon_e7 / 1e7)
        return float(x), float(y) + self._sky.weather.error_m, -self._sky.truth.body.down

    def undetected_m(self) -> float:
        """Return by how far the drone may be from where it must be, because of a fault that no sign shows or only its effect."""
        fault = self._sky.weather.fault
        if fault is None:
            return 0.0
        if fault.kind == "drift":
            truth = self._sky.truth
            return math.hypot(*truth.true_place.vector_to(truth.place)[:2])
        if fault.kind != "jump":
            return 0.0
        weather = self._sky.weather
        return JUMP_SWERVE_M + JUMP_SWERVE_MPS * 1.5 * (weather.uplink_s + weather.downlink_s)

    def speeds(self) -> tuple[float, float]:
        """Return the true ground speed and climb rate in m/s."""
        body = self._sky.truth.body
        return math.hypot(body.vn, body.ve), -body.vd

    def unavoidable_m(self) -> float:
        """Return the stopping distance in metres. It includes the acceleration until a stop command takes effect."""
        speed = self.speeds()[0]
        late_s = self._late_s()
        more = self.speeding_mps2
        easing_s = more / JERK_MPS3
        surge_mps = more * (late_s + easing_s / 2)
        accel_mps2 = self._sky.truth.params["WPNAV_ACCEL"] / 100.0
        run_m = (speed + surge_mps / 2) * (late_s + easing_s)
        speed = speed + surge_mps
        return run_m + speed * speed / (2 * min(BRAKING_SHARE * accel_mps2, MAX_BRAKING_MPS2)) + 1.0

    def add_wall(self, wall: Wall) -> None:
        """Add a zone that is in force from now on."""
        wall.since_s = self._sky.time()
        self._excuse(wall)
        self.rules.walls.append(wall)

    def _excuse(self, wall: Wall) -> None:
        x, y, height = self.place()
        _, climb = self.speeds()
        near = wall.box.distance(shapely.Point(x, y)) < self.unavoidable_m()
        reach = 4.0 + 2.0 * abs(climb)
        wall.excused = near and wall.low_m - reach < height < wall.high_m + reach

    def reconnected(self, severed_at: float) -> None:
        """Apply the rules that changed during a link outage, because the drone can comply only from now on."""
        for wall in self.rules.walls:
            if wall.since_s > severed_at - self._late_s():
                self._excuse(wall)
        # The outbound path may be older than the altitude limit and above it. A drone without link returns along this
        # path.
        if math.isfinite(self.rules.high_since_s):
            self.rules.high_since_s = self._sky.time()
        if self.rules.fast_since_s > severed_at - self._late_s():
            self.rules.fast_since_s = self._sky.time()

    def _late_s(self) -> float:
        """Return the maximum time until a command takes effect."""
        weather = self._sky.weather
        # The loss of two successive frames delays a command as much as the jitter of a slow link.
        return REACTION_S + 1.5 * (weather.uplink_s + weather.downlink_s) + (0.4 if weather.loss else 0.0)

    async def run(self) -> None:
        while True:
            self._look()
            await asyncio.sleep(WATCH_S)

    def _look(self) -> None:
        truth = self._sky.truth
        speed_mps = self.speeds()[0]
        self.speeding_mps2 = max((speed_mps - self._speed_mps) / WATCH_S, 0.0)
        self._speed_mps = speed_mps
        x, y, height = self.place()
        if height < 0.7 or not truth.armed:
            return
        self._account.flew = True
        point = shapely.Point(x, y)
        unknown_since_s = self._sky.severed_at - self._late_s()  # unknown to the vehicle
        for number, wall in enumerate(self.rules.walls):
            if wall.since_s > unknown_since_s:
                continue
            inside = wall.low_m < height < wall.high_m and wall.box.contains(point)
            if wall.excused:
                wall.excused = inside or wall.box.distance(point) < 0.5 * self.unavoidable_m() + 2.0
            elif inside:
                depth = float(wall.box.exterior.distance(point))
                if depth <= self.undetected_m():
                    continue
                self._account.depth_m = max(self._account.depth_m, depth)
                self._wrong(f"zone {number}", f"{depth:.1f} m deep at ({x:.0f}, {y:.0f}, {height:.0f})")
        if self.arena.distance(point) > self.undetected_m():
            self._wrong("area", f"outside by {self.arena.distance(point):.1f} m")
        speed, climb = self.speeds()
        settled, slowed = (
            self._sky.time() - since_s if since_s <= unknown_since_s else 0.0
            for since_s in (self.rules.high_since_s, self.rules.fast_since_s)
        )
        high = height > self.rules.ceiling_m + HEIGHT_SLACK_M
        if high and settled > 4.0 + abs(climb) and (climb > 0.3 or settled > 60.0):
            self._wrong("height", f"{height:.1f} m above a limit of {self.rules.ceiling_m:.1f}")
        gust_mps = GUST_SHARE * self._sky.weather.gusts_mps
        self._check_overshoot(height, settled, LEVEL_SLACK_M + gust_mps)
        excess = speed - self.rules.top_mps - SPEED_SLACK_MPS - gust_mps
        if excess > 0.0 and slowed > 5.0 + self.unavoidable_m() / 4.0:
            self._wrong("speed", f"{speed:.1f} m/s above a limit of {self.rules.top_mps:.1f}")

    def _check_overshoot(self, height: float, settled: float, slack_m: float) -> None:
        """Check that a drone which has been below a known ceiling stays below it, without the tolerance of new ceilings."""
        ceiling_m = self.rules.ceiling_m
        known = settled > 10.0
        if known and self._complied_with_m == ceiling_m and height > ceiling_m + slack_m:
            self._wrong("overshoot", f"{height:.2f} m above a limit of {ceiling_m:.1f}")
        if height <= ceiling_m:
            self._complied_with_m = ceiling_m
        elif not known:
            self._complied_with_m = math.inf

    def _wrong(self, kind: str, text: str) -> None:
        if kind in self._reported:
            return
        self._reported.add(kind)
        mode = ARDUCOPTER.mode(self._sky.truth.mode).name
        self._account.wrong.append(f"{kind}: {text} at {self._sky.time() - 1000:.1f} s in {mode}")


class Drone:
    """The mobility service of one drone, without its gRPC server."""

    def __init__(
        self, directory: Path, account: Account, *, grace_s: float = 10.0, known_vehicle: KnownVehicleFile | None = None
    ) -> None:
        self.grants = Grants()
        self._account = account
        self.audit = SimpleNamespace(append=self._append, failure="")
        self.autopilot = MavlinkAutopilot(
            "tcp:vehicle:1",
            ARDUCOPTER,
            # The autopilot is created before `self.parts`, so the callbacks look up the components when they are
            # called.
            alive=lambda: self.parts.supervisor.alive(),  # noqa: PLW0108
            on_found=lambda: self.parts.observer.found(),  # noqa: PLW0108
            on_heartbeat=lambda: self.parts.observer.heartbeat(),  # noqa: PLW0108
            on_parameter=lambda name: self.parts.observer.parameter(name),  # noqa: PLW0108
            known_vehicle=known_vehicle,
        )
        self.journal = Journal(directory)
        self.journal._write = lambda _data: None  # type: ignore[method-assign]
        self.parts = MobilityComponents(
            self.autopilot, MavlinkFailsafes(self.autopilot), MissionFence(self.autopilot, directory), RtlParameters(self.autopilot, directory),
            journal=self.journal, grants=self.grants, audit=self.audit,  # type: ignore[arg-type]
            clock=lambda: 1_790_000_000.0 + self.autopilot.now, grace_s=grace_s, boarding_s=0.0, state=ControlState(),
        )  # fmt: skip
        parts = self.parts
        self.control = parts.control
        self.service = parts.service
        self.streams = parts.streams
        work = (self.autopilot.run(), parts.monitor.run(), parts.poi_missions.run())
        self.tasks = [asyncio.ensure_future(part) for part in work]
        self.state = StreamState.WAITING
        self._last = ""

    def _append(self, kind: str, content: dict[str, Any], **_: Any) -> None:
        if kind != "state":
            now = asyncio.get_running_loop().time() - 1000
            fields = {key: value for key, value in content.items() if key in _LOGGED_FIELDS and value}
            line = f"{kind} {fields}"
            if line != self._last:
                self._account.events.append(f"{now:7.2f} {line}")
            self._last = line

    async def close(self) -> None:
        self.control.close()
        while tasks := [task for task in (*self.tasks, *self.control.tasks._tasks) if not task.done()]:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def follow(self, grant: ActiveGrant) -> None:
        """Follow the control stream of a driver to its end."""
        with contextlib.suppress(Refused):
            async for event in self.streams.follow(grant):
                self.record(event)

    def record(self, event: ControlEvent) -> None:
        self.state = event.state
        self._account.events.append(f"{self.autopilot.now - 1000:7.2f} stream {event.state.name} {event.reason}")


_LOGGED_FIELDS = frozenset({"method", "action", "code", "reason", "takeover", "change", "controller", "outcome"})


class Flight:
    """Random flight that is determined by a seed."""

    def __init__(self, seed: int, directory: Path, weather: Weather, sky: Sky) -> None:
        self.chance = random.Random(seed)
        self.weather = weather
        self.sky = sky
        self.account = Account(seed)
        self.oracle = Oracle(sky, self.account)
        self.drone = Drone(directory, self.account)
        self.policies: list[dict[str, Any]] = []
        self.changed = False

    def _box(self) -> tuple[float, float, float, float]:
        """Return a random box away from home. Routes around the box are possible."""
        chance = self.chance
        while True:
            x = chance.uniform(-100, 100)
            y = chance.uniform(-100, 100)
            wide = chance.uniform(6, 35)
            high = chance.uniform(6, 35)
            box = x - wide, y - high, x + wide, y + high
            if shapely.box(*box).distance(shapely.Point(0, 0)) > 18.0 and max(map(abs, box)) < HALF_M - 12.0:
                return box

    def _box_ahead(self) -> tuple[float, float, float, float]:
        """Return a box ahead of a moving drone, or between a hovering drone and home.

        The drone can still stop before the box.
        """
        chance = self.chance
        body = self.sky.truth.body
        x, y, _ = self.oracle.place()
        speed, _ = self.oracle.speeds()
        east, north = (body.ve / speed, body.vn / speed) if speed > 1.0 else (-x, -y)
        length = math.hypot(east, north) or 1.0
        wide = chance.uniform(4, 20)
        high = chance.uniform(4, 20)
        away = self.oracle.unavoidable_m() + chance.uniform(0.5, 20)
        for _ in range(100):
            cx = x + east / length * away
            cy = y + north / length * away
            box = cx - wide, cy - high, cx + wide, cy + high
            if shapely.box(*box).distance(shapely.Point(x, y)) > self.oracle.unavoidable_m():
                home_m = shapely.box(*box).distance(shapely.Point(0, 0))
                return box if home_m > 12.0 and max(map(abs, box)) < HALF_M - 12.0 else self._box()
            away += 1.0
        return self._box()

    def add_zone(self, *, ahead: bool = False) -> None:
        """Add a random zone."""
        chance = self.chance
        box = self._box_ahead() if ahead else self._box()
        if any(wall.box.distance(shapely.box(*box)) < 25.0 for wall in self.oracle.rules.walls):
            return
        action = chance.choice(["ignore", "adjust", "hover", "returnToLaunch", "land"])
        name = f"z{len(self.policies)}"
        policy = zone(name, action, *box)
        low = -math.inf
        high = math.inf
        if chance.random() < 0.25:
            low, high = chance.choice([(-5.0, 14.0), (18.0, 60.0)])
            policy["zones"][0]["altitude"] = {"lower": low, "upper": high, "reference": "home"}
        self.policies.append(policy)
        self.account.events.append(
            f"{self.sky.time() - 1000:7.2f} zone {name} {action} {[round(e) for e in box]} {low}..{high}"
        )
        self.oracle.add_wall(Wall(shapely.box(*box), low, high))

    def add_zone_overhead(self) -> None:
        """Add a zone above the drone. A climbing drone can still stop below the zone."""
        chance = self.chance
        x, y, height = self.oracle.place()
        _, climb = self.oracle.speeds()
        half_m = chance.uniform(15, 60)
        low = height + 4.0 + 2.0 * abs(climb) + chance.uniform(0.5, 6)
        box = x - half_m, y - half_m, x + half_m, y + half_m
        action = chance.choice(["ignore", "adjust", "hover"])
        name = f"z{len(self.policies)}"
        policy = zone(name, action, *box)
        policy["zones"][0]["altitude"] = {"lower": low, "upper": 60.0, "reference": "home"}
        self.policies.append(policy)
        self.account.events.append(f"{self.sky.time() - 1000:7.2f} zone {name} {action} from {low:.1f} m overhead")
        self.oracle.add_wall(Wall(shapely.box(*box), low, 60.0))

    def add_limit(self) -> None:
        """Add a limit of altitude or speed."""
        chance = self.chance
        rules = self.oracle.rules
        name = f"l{len(self.policies)}"
        kind = chance.choice(["altitude", "speed"])
        value = round(chance.uniform(9, 25) if kind == "altitude" else chance.uniform(2.5, 7), 1)
        spec = {"type": "LimitControl", "kind": kind, "upperLimit": value}
        self.policies.append({"name": name, "spec": spec})
        if kind == "altitude" and value < rules.ceiling_m:
            rules.ceiling_m = value
            rules.high_since_s = self.sky.time()
        elif kind == "speed" and value < rules.top_mps:
            rules.top_mps = value
            rules.fast_since_s = self.sky.time()
        self.account.events.append(f"{self.sky.time() - 1000:7.2f} limit {kind} {value}")

    def spec(self) -> GrantSpec:
        half = HALF_M
        return spec(*self.policies, operationArea=[area(-half, -half, half, half)])

    @property
    def grant(self) -> ActiveGrant:
        """Current grant of the driver."""
        (grant,) = self.drone.grants.active.values()
        return grant

    async def fly(self) -> Account:
        chance = self.chance
        drone = self.drone
        for _ in range(chance.randrange(4)):
            self.add_zone()
        for _ in range(chance.randrange(3)):
            self.add_limit()
        turning = [asyncio.ensure_future(self.sky.run_vehicle()), asyncio.ensure_future(self.oracle.run())]
        grant = drone.grants.put(self.spec())
        following = asyncio.ensure_future(drone.follow(grant))
        trouble = asyncio.ensure_future(self._trouble())
        try:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(PROGRAMME_S):
                    await self._drive(following)
            following.cancel()  # The system now returns a flying drone home.
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(HOME_S):
                    await self._landed()
                    self.account.down = True
            if not self.account.down:
                self.account.wrong.append(
                    f"not landed and disarmed after {HOME_S:.0f} s, in {ARDUCOPTER.mode(self.sky.truth.mode).name}"
                )
        finally:
            for task in (following, trouble, *turning):
                task.cancel()
            await asyncio.gather(following, trouble, *turning, return_exceptions=True)
            await drone.close()
        return self.account

    async def _landed(self) -> None:
        await self._until(lambda: not self.sky.truth.armed)

    async def _until(self, condition: Callable[[], object]) -> None:
        while not condition():  # noqa: ASYNC110 - the simulation has no notification
            await asyncio.sleep(0.2)

    async def _drive(self, following: asyncio.Task[None]) -> None:
        """Make random requests as a driver, and end when control is lost."""
        drone = self.drone
        chance = self.chance
        try:
            async with asyncio.timeout(90):
                await self._until(lambda: drone.state is StreamState.GRANTED and drone.autopilot.vehicle.ready)
                while True:
                    try:
                        await drone.service.arm(self.grant)
                        break
                    except (Refused, AutopilotError) as error:
                        self.account.events.append(f"{drone.autopilot.now - 1000:7.2f} arm {error}")
                        await asyncio.sleep(2.0)
        except TimeoutError:
            return
        with contextlib.suppress(Refused, AutopilotError):
            await self._finish(drone.service.take_off(self.grant, TakeoffArgs(chance.uniform(8, 30))))
        for _ in range(chance.randrange(3, 9)):
            if drone.state is not StreamState.GRANTED or following.done():
                break
            try:
                await self._leg()
            except (Refused, AutopilotError) as error:
                self.account.events.append(f"{drone.autopilot.now - 1000:7.2f} refused {error}")
                await asyncio.sleep(0.3)
        if drone.state is StreamState.GRANTED and not following.done():
            with contextlib.suppress(Refused, AutopilotError):
                if chance.random() < 0.5:
                    await self._finish(drone.service.return_to_launch(self.grant))

    async def _leg(self) -> None:
        chance = self.chance
        service = self.drone.service
        kind = chance.random()
        x = chance.uniform(-1, 1) * (HALF_M + 5)
        y = chance.uniform(-1, 1) * (HALF_M + 5)
        if kind < 0.5:
            speed = chance.choice([None, chance.uniform(1, 14)])
            leg = goto(x, y, chance.uniform(4, 40), speed_mps=speed)
            self._note_request(f"goto ({x:.0f}, {y:.0f}, {leg.alt:.0f}) at {speed}")
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(chance.uniform(3, 60) if chance.random() < 0.4 else None):
                    await self._finish(service.goto(self.grant, leg, 0.0))
        elif kind < 0.85:
            angle = chance.uniform(0, 2 * math.pi)
            speed = chance.uniform(0.5, 14)
            up = chance.choice([0.0, 0.0, chance.uniform(-1.5, 2.0)])
            self._note_request(f"velocity {speed:.1f} toward {math.degrees(angle):.0f} deg, up {up:.1f}")
            end = self.drone.autopilot.now + chance.uniform(1, 20)
            while self.drone.autopilot.now < end:
                args = VelocityArgs(
                    speed * math.cos(angle), speed * math.sin(angle), -up, None, chance.choice([0.5, 1.5])
                )
                with contextlib.suppress(Refused):
                    await service.set_velocity(self.grant, args)
                angle += chance.uniform(-0.1, 0.1)
                await asyncio.sleep(chance.choice([0.1, 0.2, 0.4]))
        elif kind < 0.93:
            await service.hover(self.grant)
            await asyncio.sleep(chance.uniform(0, 4))
        else:
            await service.set_speed(self.grant, SetSpeedArgs(chance.uniform(1, 14)))

    def _note_request(self, text: str) -> None:
        self.account.events.append(f"{self.drone.autopilot.now - 1000:7.2f} requests {text}")

    async def _finish(self, motion: Any) -> None:
        async with contextlib.aclosing(motion):
            async for _ in motion:
                pass

    async def _trouble(self) -> None:
        """Add zones and limits at random times, also during the return, and cut the link."""
        chance = self.chance
        await self._until(lambda: self.account.flew)
        if self.weather.cut is not None:
            asyncio.get_running_loop().call_later(self.weather.cut[0], self._sever)
        fault = self.weather.fault
        if fault is not None:
            self.sky.call_later(fault.at_s, self._begin_fault, fault)
            if fault.kind != "drift":
                self.sky.call_later(fault.at_s + fault.lasting_s, self._set_error, fault, 0.0)
        for _ in range(chance.randrange(6)):
            await asyncio.sleep(chance.uniform(2, 30))
            if chance.random() < 0.15:
                self.add_zone_overhead()
            elif chance.random() < 0.75:
                self.add_zone(ahead=chance.random() < 0.7)
            else:
                self.add_limit()
            self.drone.grants.put(self.spec())

    def _begin_fault(self, fault: PositionFault) -> None:
        self.account.events.append(f"{self.sky.time() - 1000:7.2f} position fault {fault}")
        if fault.kind == "jump":
            self.sky.truth.estimator.reset_position(fault.north_m, fault.east_m)
        elif fault.kind == "drift":
            self._drift(fault, self.sky.time())
        else:
            self._set_error(fault, 1.0)

    def _drift(self, fault: PositionFault, began_s: float) -> None:
        lasted_s = self.sky.time() - began_s
        self._set_error(fault, min(lasted_s / fault.lasting_s, 1.0))
        if lasted_s < fault.lasting_s:
            self.sky.call_later(0.5, self._drift, fault, began_s)

    def _set_error(self, fault: PositionFault, share: float) -> None:
        """Set the sensors to a share of the error of a fault."""
        params = self.sky.truth.params
        prefix = "SIM_GPS2_GLTCH" if fault.kind == "second" else "SIM_GPS_GLITCH"
        params.assign(f"{prefix}_X", share * fault.north_m / METRES_PER_DEG)
        params.assign(f"{prefix}_Y", share * fault.east_m / METRES_PER_DEG / math.cos(math.radians(FRAME.lat)))
        params.assign("SIM_BARO_GLITCH", share * fault.up_m)

    def _sever(self) -> None:
        assert self.weather.cut is not None
        self.sky.severed_at = self.sky.time()
        self.account.events.append(f"{self.sky.time() - 1000:7.2f} link cut")
        self.sky.call_later(self.weather.cut[1], self._reconnect)

    def _reconnect(self) -> None:
        severed_at = self.sky.severed_at
        self.sky.severed_at = math.inf
        self.oracle.reconnected(severed_at)
        self.account.events.append(f"{self.sky.time() - 1000:7.2f} link restored")


def position_fault_of(seed: int, share: float = 0.2) -> PositionFault | None:
    """Return the position fault of a share of the seeds."""
    chance = random.Random(seed * 13 + 3)
    if chance.random() >= share:
        return None
    kind = chance.choice(["glitch", "glitch", "second", "jump", "altitude", "drift"])
    at_s = chance.uniform(3, 60)
    angle = chance.uniform(0, 2 * math.pi)
    # A longer fault may never be undone. The drone then lands, which may lead it into a zone below.
    lasting_s = chance.uniform(1, 15)
    wrong_m = chance.uniform(8, 80)
    if kind == "altitude":
        return PositionFault(kind, at_s, lasting_s, up_m=math.copysign(chance.uniform(12, 30), chance.uniform(-1, 1)))
    if kind == "drift":
        lasting_s = chance.uniform(10, 60)
        wrong_m = DRIFT_MPS * lasting_s
    return PositionFault(kind, at_s, lasting_s, wrong_m * math.cos(angle), wrong_m * math.sin(angle))


def weather_of(seed: int) -> Weather:
    """Return the environment for a seed."""
    chance = random.Random(seed * 7 + 1)
    bad = chance.random() < 0.7
    cut = (chance.uniform(3, 60), chance.uniform(0.5, 8)) if chance.random() < 0.15 else None
    # The autopilot alone does not stop for a wrong position: its failsafe returns on it.
    fault = position_fault_of(seed) if cut is None else None
    return Weather(
        uplink_s=chance.uniform(0, 0.25) if bad else 0.0,
        downlink_s=chance.uniform(0, 0.25) if bad else 0.0,
        loss=chance.choice([0.0, 0.03, 0.1]) if bad else 0.0,
        wind_mps=chance.choice([0.0, 0.0, 3.0, 6.0]),
        gusts_mps=chance.choice([0.0, 1.0]),
        cut=cut,
        fault=fault,
    )


def parameters_of(seed: int) -> dict[str, float]:
    """Return parameters of acceleration and return flight that an owner may have set."""
    chance = random.Random(seed * 11 + 5)
    if chance.random() < 0.5:
        return {}
    return {
        "WPNAV_ACCEL": float(chance.choice([100, 150, 250, 400])),
        "WPNAV_SPEED": float(chance.choice([300, 800, 1200])),
        "RTL_ALT": float(chance.choice([0, 1500, 4000])),
        "RTL_SPEED": float(chance.choice([0, 0, 800])),
    }


def flight(seed: int, directory: Path, weather: Weather | None = None) -> Account:
    """Fly the random flight of a seed, and return its result."""
    weather = weather or weather_of(seed)
    sky = Sky(seed, weather, parameters_of(seed))

    async def flying() -> Account:
        return await Flight(seed, directory, weather, sky).fly()

    with asyncio.Runner(loop_factory=lambda: sky) as runner:
        return runner.run(flying())
