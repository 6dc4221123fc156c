"""Tells where the camera is: the protocol, and a camera that stands still."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from fractus_core.api.nodes import EdgeNodeSpec
from fractus_core.policy.footprint import lens_of
from fractus_core.policy.values import Attitude, Home, Lens, Situation

SURVEY_ERROR_M = 0.5
"""Error of a position that was measured when the camera was mounted."""


class PoseProvider(Protocol):
    """Tells where the camera is and where it was."""

    def situation(self, time_s: float) -> Situation:
        """The present state, at a Unix time."""

    def situations_since(self, begun_s: float, time_s: float) -> tuple[Situation, ...]:
        """All states since a moment of monotonic time: the one before it first, the present one last."""


@dataclass(frozen=True, slots=True)
class FixedPose:
    """The pose of a node that stands still, on its own home."""

    lat: float
    lon: float
    amsl_m: float
    height_m: float = 0.0
    lens: Lens | None = None
    relief_m: float = 0.0

    @classmethod
    def of(cls, spec: EdgeNodeSpec, relief_m: float = 0.0) -> FixedPose:
        """The pose that a description gives; without the camera's height it is unknown what the camera sees."""
        camera = spec.services.camera
        height_m = camera.mount.height if camera is not None and camera.mount is not None else None
        lens = lens_of(camera) if height_m is not None else None
        return cls(spec.location.lat, spec.location.lon, spec.location.alt or 0.0, height_m or 0.0, lens, relief_m)

    def situation(self, time_s: float) -> Situation:
        """See `PoseProvider`."""
        return Situation(
            time_s=time_s,
            lat=self.lat,
            lon=self.lon,
            altitude_m=self.height_m,
            home=Home(self.lat, self.lon, self.amsl_m),
            position_error_m=SURVEY_ERROR_M,
            altitude_error_m=SURVEY_ERROR_M,
            attitude=Attitude(0.0, 0.0, 0.0, 0.0, 0.0),
            lens=self.lens,
            relief_m=self.relief_m,
        )

    def situations_since(self, begun_s: float, time_s: float) -> tuple[Situation, ...]:
        """See `PoseProvider`."""
        del begun_s
        return (self.situation(time_s),)
