"""One simulated ArduCopter: body, senses, controllers, modes and memory, advanced by fixed steps, without a clock."""

from __future__ import annotations

import math
import random
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from fractus_mavlink import Message, Value

from fractus_vehicle.body import Airframe, Body, Wind
from fractus_vehicle.breadcrumbs import Breadcrumbs
from fractus_vehicle.channel import Channel
from fractus_vehicle.control import Control
from fractus_vehicle.earth import Place, valid_place
from fractus_vehicle.estimator import Estimator
from fractus_vehicle.failsafes import Failsafes
from fractus_vehicle.fence import Fence
from fractus_vehicle.flight import Flight
from fractus_vehicle.guided import Heading
from fractus_vehicle.mav import ABSOLUTE_FRAMES, GLOBAL_FRAMES, TERRAIN_FRAMES, Landed, Mode, Severity
from fractus_vehicle.mission import Item, Mission
from fractus_vehicle.modes import FLIGHTS, ReturnToLaunch, new_flight
from fractus_vehicle.params import Parameters
from fractus_vehicle.plans import Plans, ReturnPoint
from fractus_vehicle.readiness import arming_refusal
from fractus_vehicle.receiver import Receiver
from fractus_vehicle.sensors import Battery, Gps
from fractus_vehicle.settings import LIMIT_PREFIXES, set_battery, set_fence, set_limits, set_wind
from fractus_vehicle.shaping import clamp, wrap_pi
from fractus_vehicle.voice import Voice

CONTROL_STEP_S = 0.01
PHYSICS_PER_CONTROL = 2
ARMING_DELAY_S = 2.0
# The time of day at which runs begin that must be repeatable.
REPEATABLE_EPOCH_US = 1_700_000_000_000_000


@dataclass(frozen=True, slots=True)
class VehicleConfig:
    """What distinguishes one vehicle from another."""

    start: Place
    heading_deg: float = 0.0
    sysid: int = 1
    seed: int = 1
    ready_after_s: float = 32.0
    parameters: Mapping[str, float] = field(default_factory=dict)
    store: Path | None = None
    epoch_us: int = REPEATABLE_EPOCH_US
    position_noise_m: float = 0.12


class Vehicle:
    """The vehicle; `step` advances it, `handle` takes a message, `broadcast` and `say` speak on every link."""

    control_step_s = CONTROL_STEP_S

    def __init__(self, config: VehicleConfig) -> None:
        self.config = config
        self.sysid = config.sysid
        self.compid = 1
        self.start = config.start
        self.rng = random.Random(f"{config.seed}:{config.sysid}")  # noqa: S311 - a simulation, not a secret
        self.noise_seed = config.seed * 251 + config.sysid
        self.channels: list[Channel] = []
        self.voice = Voice(self)
        self.params = Parameters(config.parameters, config.store)
        self.params.assign("SYSID_THISMAV", config.sysid)
        self.time_s = 0.0
        self.ticks = 0
        self.wind = Wind()
        self.body = Body(Airframe(), config.heading_deg)
        self.control = Control(self.body.airframe)
        self.battery = Battery(self.params["SIM_BATT_VOLTAGE"], self.params["BATT_CAPACITY"])
        self.estimator = Estimator(
            config.start,
            ready_after_s=config.ready_after_s,
            noise_m=config.position_noise_m,
            rng=self.rng,
            params=self.params,
            say=self.say,
        )
        self.fence = Fence()
        self.failsafes = Failsafes()
        self.plans = Plans(self)
        self.breadcrumbs = Breadcrumbs(self.params["SRTL_POINTS"])
        self.yaw = Heading()
        self.armed = False
        self.armed_at_s = 0.0
        self.armed_heading = math.radians(config.heading_deg)
        self.mode = Mode.STABILIZE
        self.flight: Flight = new_flight(Mode.STABILIZE)
        self.landed = True
        self.touch_time_s = 0.0
        self.taking_off_until_m: float | None = None
        self._lift_after_s = 0.0
        self._idle_since_s = 0.0
        self.home: Place | None = None
        self._home_locked = False
        self.reboot_wanted = False
        self.signing_key: bytes | None = None
        self.receiver = Receiver()
        self.est = self.estimator.estimate(self.body)
        self.params.changed = self._parameter_changed
        set_limits(self.params, self.control)
        set_fence(self.params, self.fence)
        set_wind(self.params, self.wind)
        self.control.reset(self.est)

    # -- what others ask ---------------------------------------------------------------------------------------

    @property
    def unix_us(self) -> int:
        """Time of day in microseconds."""
        return self.config.epoch_us + round(self.time_s * 1e6)

    @property
    def origin(self) -> Place | None:
        """Where the local frame begins; None until the estimator has a position."""
        return self.estimator.origin

    @property
    def position_ok(self) -> bool:
        """Whether the position can be trusted."""
        return self.estimator.position_ok

    @property
    def gps(self) -> Gps:
        """The GPS receiver."""
        return self.estimator.gps

    @property
    def sticks(self) -> tuple[int, ...]:
        """The channels of the radio, in microseconds."""
        return self.receiver.channels

    @property
    def mission(self) -> Mission:
        """The stored mission."""
        return self.plans.mission

    @property
    def place(self) -> Place:
        """Where the vehicle believes to be."""
        return (self.origin or self.start).offset(self.est.north, self.est.east, self.est.down)

    @property
    def true_place(self) -> Place:
        """Where the vehicle is."""
        return self.start.offset(self.body.north, self.body.east, self.body.down)

    @property
    def true_altitude_amsl_m(self) -> float:
        """True altitude above mean sea level."""
        return self.start.alt_m - self.body.down

    @property
    def home_xy(self) -> tuple[float, float]:
        """Home in local metres."""
        if self.home is None or self.origin is None:
            return (0.0, 0.0)
        return self.origin.vector_to(self.home)[:2]

    @property
    def altitude_m(self) -> float:
        """Estimated altitude above home."""
        home = self.home or self.origin or self.start
        return (self.origin or self.start).alt_m - self.est.down - home.alt_m

    @property
    def height_m(self) -> float:
        """Estimated height above the ground (flat, at the altitude of the start)."""
        return -self.est.down

    def altitude_base_m(self, frame: int) -> float | None:
        """What altitudes of a global frame count from, AMSL; None for another frame or where terrain is unknown."""
        if frame in ABSOLUTE_FRAMES:
            return 0.0
        if frame in TERRAIN_FRAMES:
            return self.start.alt_m if int(self.params["TERRAIN_ENABLE"]) else None
        return (self.home or self.origin or self.start).alt_m if frame in GLOBAL_FRAMES else None

    @property
    def heading_cdeg(self) -> int:
        """Heading in hundredths of a degree."""
        return round(math.degrees(self.est.yaw) % 360.0 * 100.0) % 36000

    @property
    def throttle_percent(self) -> int:
        """Throttle for VFR_HUD."""
        if not self.armed:
            return 0
        return round(clamp(sum(self.body.motors) / (4.0 * self.body.airframe.full_thrust_n), 0.0, 1.0) * 100.0)

    @property
    def flying_wanted(self) -> bool:
        """Whether a takeoff is under way."""
        return self.taking_off_until_m is not None

    @property
    def landed_state(self) -> Landed:
        """MAV_LANDED_STATE."""
        if self.landed:
            return Landed.ON_GROUND
        if self.taking_off_until_m is not None:
            return Landed.TAKEOFF
        return Landed.LANDING if self.mode is Mode.LAND else Landed.IN_AIR

    def mission_state(self) -> int:
        """MISSION_STATE."""
        if len(self.mission.items) <= 1:
            return 1
        if self.mission.complete:
            return 5
        return 3 if self.mode is Mode.AUTO else 2

    def arming_refusal(self) -> str | None:
        """Why the vehicle would not arm now, or None."""
        return arming_refusal(self, needs_position=FLIGHTS[self.mode].needs_position)

    # -- speaking ----------------------------------------------------------------------------------------------

    def broadcast(self, name: str, values: Mapping[str, Value]) -> None:
        """Send a message on every link."""
        self.voice.broadcast(name, values)

    def say(self, severity: Severity, text: str) -> None:
        """Send a STATUSTEXT on every link."""
        self.voice.say(severity, text)

    def send(self, channel: Channel, name: str) -> bool:
        """Send one of the telemetry messages on one link; False when there is no such message now."""
        return self.voice.send(channel, name)

    # -- arming and modes --------------------------------------------------------------------------------------

    def arm(self) -> None:
        """Start the motors; the caller has checked that it is allowed."""
        self.armed = True
        self.armed_at_s = self._idle_since_s = self.time_s
        self.armed_heading = self.est.yaw
        self.landed = True
        self.taking_off_until_m = None
        self.touch_time_s = 0.0
        self.mission.complete = False
        if not self._home_locked and self.position_ok:
            self._set_home(self.place)
        self.control.reset(self.est)
        self.breadcrumbs.restart(self)
        self.say(Severity.INFO, "Arming motors")

    def disarm(self, _reason: str, *, force: bool = False) -> None:
        """Stop the motors."""
        if not self.armed:
            return
        self.armed = False
        self.taking_off_until_m = None
        if force or self.landed:
            self.landed = self.landed or self.body.on_ground
        self.say(Severity.INFO, "Disarming motors")

    def land_complete(self) -> None:
        """The vehicle rests on the ground."""
        self.landed = True
        self.taking_off_until_m = None
        self._idle_since_s = self.time_s

    def mode_refusal(self, mode: Mode) -> str | None:
        """Why a mode cannot be entered now, or None; on the ground with the motors off every mode can."""
        if mode is Mode.SMART_RTL and not self.breadcrumbs.active:
            return f"Mode change to {mode.title} failed: init failed"
        if not self.armed:
            return None
        if FLIGHTS[mode].needs_position and not self.position_ok:
            return f"Mode change to {mode.title} failed: requires position"
        if mode is Mode.AUTO and len(self.mission.items) <= 1:
            return "Mode change to AUTO failed: init failed"
        return None

    def set_mode(self, mode: Mode) -> bool:
        """Change the mode as a ground station asks; False when it is refused."""
        if mode is self.mode:
            return True
        refusal = self.mode_refusal(mode)
        if refusal is not None:
            self.say(Severity.WARNING, refusal)
            return False
        self.force_mode(mode, "command")
        return True

    def force_mode(self, mode: Mode, _reason: str) -> None:
        """Change the mode without asking."""
        self.flight.end(self)
        self.mode = mode
        self.flight = new_flight(mode)
        set_limits(self.params, self.control)
        self.control.throttle = None
        self.control.yaw_rate = None
        if self.landed or not self.armed:
            self.control.reset(self.est)
        self.taking_off_until_m = None
        self.flight.begin(self)
        for channel in self.channels:
            self.send(channel, "HEARTBEAT")

    def new_return(self) -> Flight:
        """An RTL for a mission to run."""
        return ReturnToLaunch()

    def begin_takeoff(self, down: float) -> None:
        """Spool up and climb to `down` (local)."""
        self.taking_off_until_m = down
        ready = self.armed_at_s + ARMING_DELAY_S
        spool = self.params["MOT_SPOOL_TIME"] + 0.5 * self.params["TKOFF_SLEW_TIME"]
        self._lift_after_s = max(self.time_s, ready) + spool
        self.control.reset(self.est)
        self.control.go_to(self.est.north, self.est.east, down)

    def takeoff_done(self) -> bool:
        """Whether the climb of a takeoff is over; ends it."""
        target = self.taking_off_until_m
        if target is None:
            return True
        if self.landed or abs(self.est.down - target) > 0.3:
            return False
        self.taking_off_until_m = None
        return True

    # -- motion settings ---------------------------------------------------------------------------------------

    def change_speed(self, kind: int, speed_mps: float) -> bool:
        """DO_CHANGE_SPEED: 0 and 1 horizontal, 2 climb, 3 descent."""
        if not speed_mps > 0.0 or not math.isfinite(speed_mps):
            return False
        limits = self.control.limits
        if kind in (0, 1):
            limits.speed_mps = max(speed_mps, 0.2)
        elif kind == 2:
            limits.climb_mps = max(speed_mps, 0.1)
        elif kind == 3:
            limits.sink_mps = max(speed_mps, 0.1)
        else:
            return False
        return True

    def turn_to(self, angle_deg: float, rate_dps: float, direction: int, *, relative: bool) -> bool:
        """CONDITION_YAW."""
        if not math.isfinite(angle_deg) or not 0.0 <= abs(angle_deg) <= 360.0:
            return False
        control = self.control
        if relative:
            sign = -1.0 if direction < 0 else 1.0
            control.target_yaw = wrap_pi(control.yaw_setpoint + sign * math.radians(angle_deg))
        else:
            control.target_yaw = wrap_pi(math.radians(angle_deg))
        control.yaw_rate = None
        default = math.radians(self.params["ATC_SLEW_YAW"] / 100.0)
        control.limits.yaw_rate_rps = math.radians(rate_dps) if rate_dps > 0.0 else default
        self.yaw.hold(control.target_yaw)
        return True

    def return_point(self) -> ReturnPoint:
        """Where RTL goes: home or the nearest rally point."""
        origin = self.origin or self.start
        return self.plans.return_point(self.params, origin, self.home or origin, (self.est.north, self.est.east))

    def set_home_here(self) -> bool:
        """Make the present position home."""
        if not self.position_ok:
            return False
        self._home_locked = True
        self._set_home(self.place)
        return True

    def set_home_at(self, lat_e7: int, lon_e7: int, alt_amsl_m: float) -> bool:
        """Make a given position home."""
        if not valid_place(lat_e7, lon_e7, alt_amsl_m) or (lat_e7 == 0 and lon_e7 == 0) or self.origin is None:
            return False
        self._home_locked = True
        self._set_home(Place(lat_e7, lon_e7, alt_amsl_m))
        return True

    def _set_home(self, place: Place) -> None:
        self.home = place
        self.mission.with_home(Item(command=16, frame=0, x=place.lat_e7, y=place.lon_e7, z=place.alt_m))
        for channel in self.channels:
            self.send(channel, "HOME_POSITION")

    def set_sticks(self, values: tuple[int, ...]) -> None:
        """RC overrides, in microseconds; 0 releases a channel, 65535 leaves it."""
        self.receiver.override(values, self.time_s + max(self.params["RC_OVERRIDE_TIME"], 0.0))

    # -- parameters --------------------------------------------------------------------------------------------

    def _parameter_changed(self, name: str) -> None:
        prefix = name.split("_", 1)[0]
        if prefix in LIMIT_PREFIXES:
            set_limits(self.params, self.control)
        elif prefix == "FENCE":
            set_fence(self.params, self.fence)
        elif name.startswith("SIM_WIND"):
            set_wind(self.params, self.wind)
        elif prefix in ("SIM", "BATT"):
            set_battery(self.params, self.battery)
        elif prefix[:2] == "SR" and prefix[2:].isdigit():
            self.voice.follow_rate(name)

    # -- time --------------------------------------------------------------------------------------------------

    def step(self) -> None:
        """Advance by one control step (10 ms)."""
        self.ticks += 1
        self.time_s = self.ticks * CONTROL_STEP_S
        self.estimator.step(self.time_s, self.body)
        if self.home is None and self.estimator.ready and self.position_ok:
            self._set_home(self.place)
        self.failsafes.step(self)
        self.breadcrumbs.step(self)
        self.receiver.step(self.time_s)
        if self.armed:
            self.flight.step(self, CONTROL_STEP_S)
            self._check_idle()
        self._move()
        if self.plans.transfers.upload is not None and self.plans.transfers.step(self.time_s) is not None:
            self.say(Severity.WARNING, "Mission upload timeout")
        for channel in self.channels:
            self.voice.serve(channel)

    def _move(self) -> None:
        dt = CONTROL_STEP_S / PHYSICS_PER_CONTROL
        body = self.body
        full = body.airframe.full_thrust_n
        share = self.battery.thrust_share
        lifting = self.armed and self._may_lift()
        if body.on_ground and not lifting:
            spin = 0.05 * full if self.armed and self.time_s > self.armed_at_s + ARMING_DELAY_S else 0.0
            idle = (spin, spin, spin, spin)
            self.battery.step(CONTROL_STEP_S, 4.0 * spin / (body.airframe.mass_kg * 9.8))
            body.step(dt, idle, (0.0, 0.0, 0.0))
            self.est = self.estimator.estimate(body)
            return
        for _ in range(PHYSICS_PER_CONTROL):
            air = self.wind.step(dt, self.rng, -body.down)
            commands = self.control.step(dt, self.est, full * share) if lifting else (0.0, 0.0, 0.0, 0.0)
            failed = int(self.params["SIM_ENGINE_FAIL"])
            if failed:
                left = self.params["SIM_ENGINE_MUL"]
                m = [c * left if failed >> at & 1 else c for at, c in enumerate(commands)]
                commands = (m[0], m[1], m[2], m[3])
            body.step(dt, commands, air)
            self.est = self.estimator.estimate(self.body)
        self.battery.step(CONTROL_STEP_S, sum(body.motors) / (body.airframe.mass_kg * 9.80665))
        if self.landed and not body.on_ground:
            self.landed = False

    def _may_lift(self) -> bool:
        if not self.landed:
            return True
        if self.taking_off_until_m is not None:
            return self.time_s >= self._lift_after_s
        return self.flight.manual_throttle and self.sticks[2] > 1550

    def _check_idle(self) -> None:
        delay = self.params["DISARM_DELAY"]
        if not self.landed or self.flying_wanted:
            self._idle_since_s = self.time_s
        elif self.mode in (Mode.LAND, Mode.RTL, Mode.SMART_RTL) and self.time_s - self._idle_since_s > 1.0:
            self.disarm("landed")
        elif delay > 0.0 and self.time_s - self._idle_since_s >= delay:
            self.disarm("idle")

    def heard(self, message: Message) -> None:
        """Note a heartbeat of the ground station that failsafes watch."""
        if message.sysid == int(self.params["SYSID_MYGCS"]):
            self.failsafes.gcs_seen_s = self.time_s
