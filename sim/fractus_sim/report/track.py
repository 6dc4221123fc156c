"""What any flight leaves behind: where a drone was, how it was, and what it said."""

from __future__ import annotations

from dataclasses import dataclass

from fractus_core.api.geometry import Point
from fractus_core.geo import geodesic_m


@dataclass(frozen=True, slots=True)
class Place:
    """Degrees, and metres above home."""

    lat: float
    lon: float
    alt_m: float

    @property
    def ground(self) -> Point:
        """The same without the altitude."""
        return Point(lat=self.lat, lon=self.lon)


@dataclass(frozen=True, slots=True)
class Sample:
    """The drone at one moment; `battery` is a share of the full charge."""

    time_s: float
    place: Place
    speed_mps: float
    mode: str
    in_air: bool
    battery: float
    voltage_v: float | None = None


@dataclass(frozen=True)
class Track:
    """One drone's flight."""

    name: str
    samples: tuple[Sample, ...]

    @property
    def takeoff_s(self) -> float | None:
        """When it left the ground first."""
        return next((s.time_s for s in self.samples if s.in_air), None)

    @property
    def landing_s(self) -> float | None:
        """When it stood on the ground for good; None while it is in the air, or if it never was."""
        flying = [i for i, s in enumerate(self.samples) if s.in_air]
        return self.samples[flying[-1] + 1].time_s if flying and flying[-1] + 1 < len(self.samples) else None

    @property
    def home(self) -> Place | None:
        """Where it took off; None if it never did."""
        at = next((i for i, s in enumerate(self.samples) if s.in_air), None)
        return self.samples[max(at - 1, 0)].place if at is not None else None

    @property
    def distance_m(self) -> float:
        """Metres flown over the ground; steps below a quarter of a metre, noise on the spot, do not count."""
        total, last = 0.0, None
        for sample in self.samples:
            if not sample.in_air:
                continue
            if last is None:
                last = sample.place
                continue
            step = geodesic_m(last.ground, sample.place.ground)
            if step >= 0.25:
                total, last = total + step, sample.place
        return total

    @property
    def max_altitude_m(self) -> float:
        """Highest altitude above home."""
        return max((s.place.alt_m for s in self.samples), default=0.0)

    @property
    def max_speed_mps(self) -> float:
        """Highest speed over ground while in the air."""
        return max((s.speed_mps for s in self.samples if s.in_air), default=0.0)

    @property
    def miss_m(self) -> float | None:
        """How far from its takeoff it landed; None while it has not."""
        if self.home is None or self.landing_s is None:
            return None
        return geodesic_m(self.home.ground, self.samples[-1].place.ground)
