"""State of one vehicle: body, sensors, controllers, stored lists and flags, shared by the flight modes."""

from __future__ import annotations

import math
import random
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from fractus_runtime.mavlink_codec import Value
from fractus_services.mavlink_server.channel import Channel
from fractus_services.mavlink_server.coordinates import ABSOLUTE_FRAMES, GLOBAL_FRAMES, TERRAIN_FRAMES
from fractus_services.mavlink_server.mission_items import ItemStore
from fractus_services.mavlink_server.stored_mission import Mission
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_vehicle.body import Airframe, Body, Wind
from fractus_vehicle.breadcrumbs import Breadcrumbs
from fractus_vehicle.control import Control
from fractus_vehicle.earth import Place
from fractus_vehicle.estimator import FULL_START_S, Estimator
from fractus_vehicle.fence import Fence
from fractus_vehicle.gimbal import Gimbal
from fractus_vehicle.heading import Heading
from fractus_vehicle.params import Parameters
from fractus_vehicle.receiver import Receiver
from fractus_vehicle.sensors import Battery, Gps
from fractus_vehicle.settings import set_battery, set_fence, set_limits, set_wind
from fractus_vehicle.shaping import clamp

CONTROL_STEP_S = 0.01
ARMING_DELAY_S = 2.0
TEXT_CHUNK = 50
# Start time of repeatable runs, microseconds since the Unix epoch.
REPEATABLE_EPOCH_US = 1_700_000_000_000_000


@dataclass(frozen=True, slots=True)
class VehicleConfig:
    """Configuration of one vehicle.

    Attributes:
        depot: Place where the battery charges. Default: the start position.
        charge_percent_per_min: Charging rate at the depot, percent of the capacity per minute.
    """

    start: Place
    depot: Place | None = None
    charge_percent_per_min: float = 0.0
    heading_deg: float = 0.0
    sysid: int = 1
    seed: int = 1
    ready_after_s: float = FULL_START_S
    parameters: Mapping[str, float] = field(default_factory=dict)
    store: Path | None = None
    epoch_us: int = REPEATABLE_EPOCH_US
    position_noise_m: float = 0.12
    throttle_us: int = 1500


@dataclass(slots=True)
class ActiveFailsafes:
    """Currently active failsafes."""

    gcs: bool = False
    radio: bool = False
    battery: bool = False
    battery_critical: bool = False
    ekf: bool = False

    @property
    def any(self) -> bool:
        """True if any failsafe is active."""
        return self.gcs or self.radio or self.battery or self.ekf


class VehicleState:
    """State of one vehicle, with derived values and simple state changes."""

    def __init__(self, config: VehicleConfig) -> None:
        self.config = config
        self.sysid = config.sysid
        self.compid = 1
        self.start = config.start
        self.rng = random.Random(f"{config.seed}:{config.sysid}")  # noqa: S311 - a simulation, not a secret
        self.noise_seed = config.seed * 251 + config.sysid
        self.channels: list[Channel] = []
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
            send_text=self.send_text,
        )
        self.fence = Fence()
        self.failsafes = ActiveFailsafes()
        self.mission = Mission()
        self.fence_items = ItemStore(mavlink.MAV_MISSION_TYPE_FENCE)
        self.rally = ItemStore(mavlink.MAV_MISSION_TYPE_RALLY)
        self.breadcrumbs = Breadcrumbs(self.params, self.send_text)
        self.heading = Heading(self.control, self.params)
        self.gimbal = Gimbal(int(self.params["MNT1_TYPE"]))
        self.item_reached: int | None = None  # mission item reached in this step, reported at its end
        self.last_item_reached: int | None = None
        self.impacts_reported = 0
        self.impact_reported_s = -math.inf
        self.receiver = Receiver(config.throttle_us)
        self.servos: dict[int, int] = {}
        self.relays_on: set[int] = set()
        self.motor_test_until_s: float | None = None
        self.accels_agree_from_s = -math.inf  # accelerometers count as inconsistent until then
        self.armed = False
        self.armed_at_s = 0.0
        self.armed_heading = math.radians(config.heading_deg)
        self.mode = mavlink.COPTER_MODE_STABILIZE
        self.landed = True
        self.touch_time_s = 0.0
        self.taking_off_until_m: float | None = None
        self.lift_after_s = 0.0
        self.idle_since_s = 0.0
        self.home: Place | None = None
        self.home_locked = False
        self.est = self.estimator.estimate(self.body)
        set_limits(self.params, self.control)
        set_fence(self.params, self.fence)
        set_wind(self.params, self.wind)
        set_battery(self.params, self.battery)
        self.control.reset(self.est)

    # -- time and position -------------------------------------------------------------------------------------

    def advance_time(self) -> None:
        """Advance time by one control step."""
        self.ticks += 1
        self.time_s = self.ticks * CONTROL_STEP_S

    @property
    def unix_us(self) -> int:
        """Time of day in microseconds."""
        return self.config.epoch_us + round(self.time_s * 1e6)

    @property
    def origin(self) -> Place | None:
        """Origin of the local frame; None until the estimator has a position."""
        return self.estimator.origin

    @property
    def position_ok(self) -> bool:
        """True if the estimated position is valid."""
        return self.estimator.position_ok

    @property
    def gps(self) -> Gps:
        """The first GPS receiver."""
        return self.estimator.gps_receivers.receivers[0]

    @property
    def sticks(self) -> tuple[int, ...]:
        """RC channels in microseconds."""
        return self.receiver.channels

    @property
    def throttle_below_failsafe(self) -> bool:
        """True if the throttle channel is below FS_THR_VALUE, the value that a receiver without signal outputs."""
        return self.sticks[2] < self.params["FS_THR_VALUE"]

    @property
    def place(self) -> Place:
        """Estimated position."""
        return (self.origin or self.start).offset(self.est.north, self.est.east, self.est.down)

    @property
    def known_position(self) -> tuple[float, float, float] | None:
        """Estimated local position (north, east, down); None if it is not valid."""
        return (self.est.north, self.est.east, self.est.down) if self.position_ok else None

    @property
    def true_place(self) -> Place:
        """True position."""
        return self.start.offset(self.body.north, self.body.east, self.body.down)

    @property
    def true_altitude_amsl_m(self) -> float:
        """True altitude above mean sea level."""
        return self.start.alt_m - self.body.down

    @property
    def home_xy(self) -> tuple[float, float]:
        """Home position in local metres (north, east)."""
        if self.home is None or self.origin is None:
            return (0.0, 0.0)
        return self.origin.vector_to(self.home)[:2]

    @property
    def altitude_m(self) -> float:
        """Estimated altitude above home in metres."""
        return self.altitude_at_m(self.est.down)

    def altitude_at_m(self, down: float) -> float:
        """Convert a local height (down) to altitude above home."""
        origin = self.origin or self.start
        return origin.alt_m - down - (self.home or origin).alt_m

    @property
    def height_m(self) -> float:
        """Estimated height above the ground in metres. The ground is flat at the altitude of the start."""
        return -self.est.down

    def altitude_base_m(self, frame: int) -> float | None:
        """Return the altitude above mean sea level to which altitudes in a global frame are relative.

        Returns None for all other frames, and for terrain frames if TERRAIN_ENABLE is not set.
        """
        if frame in ABSOLUTE_FRAMES:
            return 0.0
        if frame in TERRAIN_FRAMES:
            return self.start.alt_m if int(self.params["TERRAIN_ENABLE"]) else None
        return (self.home or self.origin or self.start).alt_m if frame in GLOBAL_FRAMES else None

    def outside_fence(self, north: float, east: float, down: float) -> bool:
        """Return True if a local target lies outside the geofence of the autopilot."""
        return bool(self.fence.outside(north, east, self.altitude_at_m(down), self.home_xy))

    # -- derived values for telemetry and checks ---------------------------------------------------------------

    @property
    def heading_cdeg(self) -> int:
        """Heading in hundredths of a degree."""
        return round(math.degrees(self.est.yaw) % 360.0 * 100.0) % 36000

    @property
    def throttle_percent(self) -> int:
        """Throttle in percent for VFR_HUD."""
        if not self.armed:
            return 0
        return round(clamp(sum(self.body.motors) / (4.0 * self.body.airframe.full_thrust_n), 0.0, 1.0) * 100.0)

    @property
    def taking_off(self) -> bool:
        """True during a takeoff."""
        return self.taking_off_until_m is not None

    @property
    def landed_state(self) -> int:
        """Current MAV_LANDED_STATE."""
        if self.landed:
            return mavlink.MAV_LANDED_STATE_ON_GROUND
        if self.taking_off:
            return mavlink.MAV_LANDED_STATE_TAKEOFF
        return (
            mavlink.MAV_LANDED_STATE_LANDING
            if self.mode == mavlink.COPTER_MODE_LAND
            else mavlink.MAV_LANDED_STATE_IN_AIR
        )

    # -- messages ----------------------------------------------------------------------------------------------

    def broadcast(self, name: str, values: Mapping[str, Value]) -> None:
        """Send a message on every link."""
        for channel in self.channels:
            channel.send(name, values)

    def send_text(self, severity: int, text: str) -> None:
        """Send a STATUSTEXT on every link, split into chunks if it is long."""
        data = text.encode("ascii", "replace")
        # All chunks of one text share a non-zero id.
        number = 1 + self.ticks % 65000 if len(data) > TEXT_CHUNK else 0
        for at in range(0, max(len(data), 1), TEXT_CHUNK):
            chunk: dict[str, Value] = {"text": data[at : at + TEXT_CHUNK], "id": number, "chunk_seq": at // TEXT_CHUNK}
            self.broadcast("STATUSTEXT", chunk | {"severity": int(severity)})

    # -- motors and ground -------------------------------------------------------------------------------------

    def disarm(self, *, force: bool = False) -> None:
        """Stop the motors. The mission then begins at its first item again."""
        if not self.armed:
            return
        self.armed = False
        self.mission.reset()
        self.taking_off_until_m = None
        if force or self.landed:
            self.landed = self.landed or self.body.on_ground
        self.send_text(mavlink.MAV_SEVERITY_INFO, "Disarming motors")

    def land_complete(self) -> None:
        """Set the state to landed."""
        self.landed = True
        self.taking_off_until_m = None
        self.idle_since_s = self.time_s

    def begin_takeoff(self, down: float) -> None:
        """Spool up and climb to `down` (local)."""
        if not self.taking_off:  # in a repeated takeoff command, the motors have already spooled up
            ready = self.armed_at_s + ARMING_DELAY_S
            spool = self.params["MOT_SPOOL_TIME"] + 0.5 * self.params["TKOFF_SLEW_TIME"]
            self.lift_after_s = max(self.time_s, ready) + spool
        self.taking_off_until_m = down
        self.control.reset(self.est)
        self.control.go_to(self.est.north, self.est.east, down)

    def takeoff_done(self) -> bool:
        """End the takeoff if its climb is complete. Return True if no takeoff is in progress."""
        target = self.taking_off_until_m
        if target is None:
            return True
        if self.landed or abs(self.est.down - target) > 0.3:
            return False
        self.taking_off_until_m = None
        return True
