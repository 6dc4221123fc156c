"""What is stored about a picture: enough to judge it again under the policies of a later day."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

from fractus_core.policy.decision_types import Filter, Situation

from fractus_services.camera.pose import Pose


@dataclass(frozen=True, slots=True)
class ImageRecord:
    """A picture that was taken.

    Attributes:
        name: unique within its instance.
        time_s: Unix time.
        width: pixels.
        height: pixels.
        size_bytes: of the file.
        poses: where the camera was while it was taken, from its begin to its end.
        face_px: width of the smallest face that it may show; 0 when it is unknown.
        filters: what was done to it.
        whole: whether it shows all of the camera's view; faces in a part of it are cut, and their size is taken to be unknown.
    """

    name: str
    time_s: float
    width: int
    height: int
    size_bytes: int
    poses: tuple[Pose, ...]
    face_px: float = 0.0
    filters: tuple[Filter, ...] = ()
    whole: bool = False

    def to_json(self) -> dict[str, Any]:
        """As JSON values."""
        return asdict(self)

    @classmethod
    def parse(cls, body: dict[str, Any]) -> ImageRecord:
        """The shot that JSON holds; one without poses, of an earlier release, was taken at an unknown place.

        Raises:
            ValueError: it holds none.
        """
        try:
            if "poses" not in body:
                known = {key: value for key, value in body.items() if key in cls.__slots__}
                body = {**known, "poses": [asdict(Pose.of(Situation(0.0)))], "face_px": 0.0}
            if not body.get("whole"):
                # In a part of the view faces are cut; releases that did not say so kept their size all the same.
                body = {**body, "face_px": 0.0}
            poses = tuple(Pose.parse(pose) for pose in body["poses"])
            shot = cls(**{**body, "poses": poses, "filters": tuple(Filter(**one) for one in body["filters"])})
            is_plausible = all(pose.at(Situation(0.0)).is_plausible for pose in poses) and math.isfinite(
                shot.face_px + shot.time_s
            )
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"no shot: {error}") from None
        if not poses or not is_plausible:
            raise ValueError("no shot: it does not tell where it was taken")
        return shot
