"""Tells where the camera is: the protocol, and a camera that stands still."""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

from fractus_core.api.nodes import EdgeNodeSpec
from fractus_core.policy.decision_types import Attitude, Home, Situation
from fractus_core.policy.lenses import bounding_lens

SURVEY_ERROR_M = 0.5
"""Error of a position that was measured when the camera was mounted."""


class PoseProvider(Protocol):
    """Tells where the camera is and where it was."""

    def situation(self, time_s: float) -> Situation:
        """The present state, at a Unix time."""

    def situations_since(self, begun_s: float, time_s: float, /) -> tuple[Situation, ...]:
        """All states since a moment of monotonic time: the one before it first, the present one last."""


class FixedPose:
    """The pose of a node that stands still, on its own home.

    Args:
        spec: the node's description; without the height of its camera it is unknown what the camera sees.
        relief_m: how far the ground around may lie below home.
    """

    def __init__(self, spec: EdgeNodeSpec, relief_m: float = 0.0) -> None:
        camera, place = spec.services.camera, spec.location
        height_m = camera.mount.height if camera is not None and camera.mount is not None else None
        self._situation = Situation(
            time_s=0.0,
            lat=place.lat,
            lon=place.lon,
            altitude_m=height_m or 0.0,
            home=Home(place.lat, place.lon, place.alt or 0.0),
            position_error_m=SURVEY_ERROR_M,
            altitude_error_m=SURVEY_ERROR_M,
            attitude=Attitude(0.0, 0.0, 0.0, 0.0, 0.0),
            lens=bounding_lens(camera) if camera is not None and height_m is not None else None,
            relief_m=relief_m,
        )

    def situation(self, time_s: float) -> Situation:
        """See `PoseProvider`."""
        return replace(self._situation, time_s=time_s)

    def situations_since(self, _begun_s: float, time_s: float) -> tuple[Situation, ...]:
        """See `PoseProvider`."""
        return (self.situation(time_s),)
