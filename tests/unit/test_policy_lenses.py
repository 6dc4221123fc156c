"""Footprints of lens models compared with projections of OpenCV. A footprint must contain everything in the picture."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import pytest
import shapely
from depth import examples
from fractus_core.api.nodes import CameraFeatures, CameraLens
from fractus_core.policy.decision_types import Attitude, Lens
from fractus_core.policy.footprint import MAX_HALF_VIEW_DEG, footprint
from fractus_core.policy.lenses import bounding_lens
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from policy_world import FRAME, at

_cases = settings(max_examples=examples(300), deadline=None, derandomize=True)
_POINTS = 400
_WIDTH = 640

MODELS = ["pinhole", "brownConrady", "equidistant"]


def rotation(axis: int, degrees: float) -> np.ndarray:
    return cv2.Rodrigues(np.eye(3)[axis] * math.radians(degrees))[0]


def projected(model: str, rays: np.ndarray, focal: float, centre: tuple[float, float], k: tuple[float, ...]) -> Any:
    """Return the pixels of rays (right, down, ahead) in front of the camera, projected by OpenCV."""
    matrix = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1]])
    still = np.zeros(3)
    if model == "equidistant":
        pixels, _ = cv2.fisheye.projectPoints(rays.reshape(-1, 1, 3), still, still, matrix, np.zeros(4))
    else:
        pixels, _ = cv2.projectPoints(rays.reshape(-1, 1, 3), still, still, matrix, np.array(k))
    return pixels.reshape(-1, 2)


def described(model: str, half: float, height: int, k: tuple[float, ...], *, has_lens: bool) -> CameraFeatures:
    lens: dict[str, Any] = {"model": model}
    if model == "brownConrady":
        lens |= dict(zip(("k1", "k2", "p1", "p2", "k3"), k, strict=True))
    return CameraFeatures.model_validate(
        {
            "methods": ["CaptureImage"],
            "resolution": f"{_WIDTH}x{height}",
            "horizontalFieldOfView": math.degrees(2 * half),
            "mount": {"pitch": -90},
            **({"lens": lens} if has_lens else {}),
        }
    )


def folds_at(k: tuple[float, ...], reach: float) -> float:
    """Return the tangent of the angle beyond which the lens model is not monotonic. Real lenses are monotonic."""
    r = np.linspace(0, reach, 20_000)
    shown = r * (1 + k[0] * r**2 + k[1] * r**4 + k[4] * r**6)
    falling = np.flatnonzero(np.diff(shown) <= 0)
    return float(r[falling[0]]) if falling.size else math.inf


@_cases
@given(
    model=st.sampled_from(MODELS),
    has_lens=st.booleans(),
    half_deg=st.floats(5, 75),
    height=st.sampled_from([360, 480, 640, 853]),
    k=st.tuples(st.floats(-0.35, 0.2), st.floats(-0.05, 0.15), *[st.floats(-0.003, 0.003)] * 2, st.floats(-0.02, 0.02)),
    turn=st.tuples(st.floats(-80, 80), st.floats(-60, 60), st.floats(-180, 180)),
    alt=st.floats(2, 100),
    seed=st.integers(0, 2**32 - 1),
)
def test_bounding_lens_covers_every_zone_a_picture_shows(
    model: str,
    has_lens: bool,
    half_deg: float,
    height: int,
    k: tuple[float, ...],
    turn: tuple[float, float, float],
    alt: float,
    seed: int,
) -> None:
    half = math.radians(half_deg)
    fold = math.inf
    if model != "brownConrady":
        k = (0.0,) * 5
    else:
        fold = folds_at(k, 200.0)
        assume(fold > math.tan(half) * 1.3)
        # Without a lens description, the bound does not cover tangential distortion.
        k = k if has_lens else (*k[:2], 0.0, 0.0, k[4])
    # Choose the focal length so that the sides of the picture are at the angle `half`.
    side = projected(model, np.array([[math.tan(half), 0.0, 1.0]]), 1.0, (0.0, 0.0), k)[0][0]
    assume(side > 0.01)
    focal = _WIDTH / 2 / side
    centre = (_WIDTH / 2, height / 2)
    lens = bounding_lens(described(model, half, height, k, has_lens=has_lens))
    assert lens is not None
    exact = Lens(lens.horizontal_deg, lens.vertical_deg, error_deg=0.0)
    now = at(0, 0, alt=alt, lens=exact, attitude=Attitude(*turn, 0, 0), position_error_m=0.0, altitude_error_m=0.0)
    shown = footprint(now, FRAME)
    assert shown is not None
    # Sample points of the ground, with a higher density near the drone, and project them into the picture.
    rng = np.random.default_rng(seed)
    reach = alt * 10 ** rng.uniform(-2, 1.7, _POINTS)
    bearing = rng.uniform(0, 2 * math.pi, _POINTS)
    north = reach * np.cos(bearing)
    east = reach * np.sin(bearing)
    world = np.stack([north, east, np.full(_POINTS, alt)], axis=1)
    turned = rotation(2, turn[2]) @ rotation(1, turn[1]) @ rotation(0, turn[0]) @ rotation(1, -90)
    ahead, right, down = (world @ turned).T
    rays = np.stack([right, down, ahead], axis=1)
    visible = ahead > 1e-6
    if model == "brownConrady":
        visible &= np.hypot(right, down) < fold * np.abs(ahead)
    u, v = projected(model, np.where(visible[:, None], rays, [0.0, 0.0, 1.0]), focal, centre, k).T
    visible &= (u >= 0) & (u <= _WIDTH) & (v >= 0) & (v <= height)
    if not has_lens and model == "brownConrady":
        # Without a lens description, the bound covers at most an orthographic fisheye lens at the corners.
        angle = np.arctan2(np.hypot(right, down), ahead)
        across = np.hypot(u - centre[0], v - centre[1]) / (_WIDTH / 2)
        visible &= np.sin(np.minimum(angle, math.pi / 2)) <= np.maximum(across, 1.0) * math.sin(half) + 1e-9
        visible &= angle < math.pi / 2
    for x, y in zip(east[visible], north[visible], strict=True):
        zone = shapely.Point(x, y).buffer(0.01 * alt)
        assert shown.shows(zone), f"a zone at {x:.1f} {y:.1f} is in the picture"


def half_views(model: str | None, field_deg: float, **more: float) -> tuple[float, float]:
    fields = {"methods": ["CaptureImage"], "resolution": "1280x960", "horizontalFieldOfView": field_deg, "mount": {}}
    lens = bounding_lens(CameraFeatures.model_validate(fields | ({"lens": {"model": model, **more}} if model else {})))
    assert lens is not None
    return lens.horizontal_deg / 2, lens.vertical_deg / 2


def test_bounding_lens_excludes_ground_outside_the_picture() -> None:
    assert half_views("pinhole", 62.2) == pytest.approx((31.1, 24.34), abs=0.01)
    assert half_views("brownConrady", 62.2) == pytest.approx((31.1, 24.34), abs=0.1)
    assert half_views("equidistant", 62.2) == pytest.approx((32.82, 25.81), abs=0.05)
    assert half_views(None, 62.2) == pytest.approx((34.06, 31.1), abs=0.05), (
        "the picture is taller than that of any known sensor"
    )
    wide = half_views("brownConrady", 100, k1=-0.3, k2=0.1)
    assert max(wide) < 75


@pytest.mark.parametrize(
    ("model", "field_deg", "more"),
    [
        (None, 120, {}), ("equidistant", 170, {}), ("pinhole", 165, {}),
        ("brownConrady", 100, {"k1": -0.5}), ("brownConrady", 60, {"k1": -100.0}), ("brownConrady", 60, {"p1": 5.0}),
        ("brownConrady", 100, {"k1": 100.0, "k2": -100.0}), ("brownConrady", 179.9, {"k3": 100.0}),
    ],
)  # fmt: skip
def test_lens_without_bound_sees_everything(model: str | None, field_deg: float, more: dict[str, float]) -> None:
    assert max(half_views(model, field_deg, **more)) >= MAX_HALF_VIEW_DEG


def test_distortion_coefficients_are_rejected_for_other_lens_models() -> None:
    with pytest.raises(ValueError, match="k2: distortion coefficients belong to model brownConrady"):
        CameraLens.model_validate({"model": "equidistant", "k2": 0.1})
    CameraLens.model_validate({"model": "brownConrady", "k2": 0.1})
