"""Track of a flight: positions, state and battery over time."""

from __future__ import annotations

from dataclasses import dataclass

from fractus_core.api.geometry import Point
from fractus_core.geo import geodesic_m

MIN_STEP_M = 0.25


@dataclass(frozen=True, slots=True)
class Place:
    """Latitude and longitude in degrees, altitude in metres above home."""

    lat: float
    lon: float
    alt_m: float

    @property
    def ground(self) -> Point:
        """Latitude and longitude without altitude."""
        return Point(lat=self.lat, lon=self.lon)


@dataclass(frozen=True, slots=True)
class Sample:
    """State of the drone at one time.

    Attributes:
        time_s: Time, seconds. The clock depends on the report.
        mode: Flight mode of the autopilot.
        battery: Share of the full charge.
    """

    time_s: float
    place: Place
    speed_mps: float
    mode: str
    in_air: bool
    battery: float
    voltage_v: float | None = None


@dataclass(frozen=True)
class Track:
    """Flight of one drone."""

    name: str
    samples: tuple[Sample, ...]

    @property
    def takeoff_s(self) -> float | None:
        """First takeoff time. None if the drone never took off."""
        return next((s.time_s for s in self.samples if s.in_air), None)

    @property
    def landing_s(self) -> float | None:
        """Final landing time. None while in the air or if the drone never took off."""
        in_air = [i for i, s in enumerate(self.samples) if s.in_air]
        if not in_air or in_air[-1] + 1 == len(self.samples):
            return None
        return self.samples[in_air[-1] + 1].time_s

    @property
    def home(self) -> Place | None:
        """Takeoff position. None if the drone never took off."""
        first = next((i for i, s in enumerate(self.samples) if s.in_air), None)
        return self.samples[max(first - 1, 0)].place if first is not None else None

    def sample_at(self, time_s: float) -> Sample | None:
        """Return the sample closest to a time. None if there are no samples."""
        return min(self.samples, key=lambda sample: abs(sample.time_s - time_s), default=None)

    @property
    def distance_m(self) -> float:
        """Horizontal distance flown, metres. Steps below MIN_STEP_M are ignored as position noise."""
        total = 0.0
        last: Place | None = None
        for place in (sample.place for sample in self.samples if sample.in_air):
            if last is None:
                last = place
                continue
            step_m = geodesic_m(last.ground, place.ground)
            if step_m >= MIN_STEP_M:
                total += step_m
                last = place
        return total

    @property
    def max_altitude_m(self) -> float:
        """Maximum altitude above home, metres."""
        return max((s.place.alt_m for s in self.samples), default=0.0)

    @property
    def max_speed_mps(self) -> float:
        """Maximum ground speed in the air, m/s."""
        return max((s.speed_mps for s in self.samples if s.in_air), default=0.0)

    @property
    def landing_error_m(self) -> float | None:
        """Distance between takeoff and landing position, metres. None before the landing."""
        if self.home is None or self.landing_s is None:
            return None
        return geodesic_m(self.home.ground, self.samples[-1].place.ground)
