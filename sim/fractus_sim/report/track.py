"""Track of a flight: positions, state and battery over time."""

from __future__ import annotations

from dataclasses import dataclass

from fractus_core.api.geometry import Point
from fractus_core.geo import geodesic_m


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
    """State of the drone at one time. `battery` is the share of the full charge."""

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
        flying = [i for i, s in enumerate(self.samples) if s.in_air]
        return self.samples[flying[-1] + 1].time_s if flying and flying[-1] + 1 < len(self.samples) else None

    @property
    def home(self) -> Place | None:
        """Takeoff position. None if the drone never took off."""
        at = next((i for i, s in enumerate(self.samples) if s.in_air), None)
        return self.samples[max(at - 1, 0)].place if at is not None else None

    @property
    def distance_m(self) -> float:
        """Horizontal distance flown, metres. Steps below 0.25 m are ignored as position noise."""
        total = 0.0
        last = None
        for sample in self.samples:
            if not sample.in_air:
                continue
            if last is None:
                last = sample.place
                continue
            step = geodesic_m(last.ground, sample.place.ground)
            if step >= 0.25:
                total = total + step
                last = sample.place
        return total

    @property
    def max_altitude_m(self) -> float:
        """Maximum altitude above home."""
        return max((s.place.alt_m for s in self.samples), default=0.0)

    @property
    def max_speed_mps(self) -> float:
        """Maximum ground speed in the air."""
        return max((s.speed_mps for s in self.samples if s.in_air), default=0.0)

    @property
    def miss_m(self) -> float | None:
        """Distance between takeoff and landing position. None before the landing."""
        if self.home is None or self.landing_s is None:
            return None
        return geodesic_m(self.home.ground, self.samples[-1].place.ground)
