"""Camera footprint compared with rays of a camera whose true pose differs within the error bounds."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import shapely
from depth import examples
from fractus_core.api.nodes import CameraFeatures
from fractus_core.policy.decision_types import Attitude, Call, Filter, Lens, Situation
from fractus_core.policy.footprint import MAX_SIGHT_M, Footprint, footprint
from fractus_core.policy.lenses import bounding_lens
from fractus_core.policy.picture_rules import combine_filters, judge_privacy, remaining_filters
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from policy_world import FRAME, NOW, ask, at, box, compiled, policy, zone

_cases = settings(max_examples=examples(400), deadline=None, derandomize=True)


def rotation(axis: int, degrees: float) -> np.ndarray:
    c = math.cos(math.radians(degrees))
    s = math.sin(math.radians(degrees))
    matrix = np.eye(3)
    i, j = ((1, 2), (2, 0), (0, 1))[axis]
    matrix[i, i] = matrix[j, j] = c
    matrix[i, j] = -s
    matrix[j, i] = s
    return matrix


def ray(lens: Lens, attitude: Attitude, u: float, v: float) -> np.ndarray:
    """Return the direction (north, east, down) of the ray through the point (u, v) of the picture.

    u points right and v down. Both range from -1 to 1.
    """
    half = [math.tan(math.radians(d / 2)) for d in (lens.horizontal_deg, lens.vertical_deg)]
    camera = np.array([1.0, u * half[0], v * half[1]])
    tilt = np.eye(3)
    if not lens.stabilised:
        tilt = rotation(1, attitude.pitch_deg) @ rotation(0, attitude.roll_deg)
    mount = rotation(2, lens.yaw_deg) @ rotation(1, lens.pitch_deg)
    return rotation(2, attitude.yaw_deg) @ tilt @ mount @ camera


def view(now: Situation) -> Footprint:
    shown = footprint(now, FRAME)
    assert shown is not None
    return shown


part = st.floats(-1.0, 1.0)
lenses = st.builds(
    Lens, st.floats(5, 140), st.floats(5, 120), st.floats(-90, 90), st.floats(-180, 180), st.booleans(), st.floats(0, 4)
)
attitudes = st.builds(
    Attitude, st.floats(-50, 50), st.floats(-50, 50), st.floats(-180, 180), st.floats(0, 12), st.floats(0, 80)
)


@_cases
@given(lens=lenses, attitude=attitudes, alt=st.floats(0, 120), errors=st.tuples(*[st.floats(0, 5)] * 3),
       u=part, v=part, turn=st.tuples(*[part] * 6))  # fmt: skip
def test_footprint_contains_everything_a_picture_may_show(
    lens: Lens, attitude: Attitude, alt: float, errors: tuple[float, ...], u: float, v: float, turn: tuple[float, ...]
) -> None:
    now = at(0, 0, alt=alt, lens=lens, attitude=attitude, position_error_m=errors[0], altitude_error_m=errors[1],
             relief_m=errors[2])  # fmt: skip
    # Roll and pitch errors share one bound. The mount error is a rotation about any axis. This test uses the camera
    # axis.
    share = (1 + turn[5]) / 2
    actual = replace(
        attitude,
        roll_deg=attitude.roll_deg + share * attitude.tilt_error_deg * turn[0],
        pitch_deg=attitude.pitch_deg + (1 - share) * attitude.tilt_error_deg * turn[1],
        yaw_deg=attitude.yaw_deg + attitude.yaw_error_deg * turn[2],
    )
    direction = ray(replace(lens, pitch_deg=lens.pitch_deg + lens.error_deg * turn[3]), actual, u, v)
    above_m = alt + errors[1] * turn[4]
    assume(direction[2] > 1e-6 and above_m >= 0)
    for ground_m in (0.0, -errors[2]):
        reach = (above_m - ground_m) / direction[2]
        north = direction[0] * reach
        east = direction[1] * reach
        if math.hypot(north, east) > MAX_SIGHT_M:
            continue
        x = errors[0] * turn[0] * 0.7
        y = errors[0] * turn[1] * 0.7
        shown = view(now)
        point = shapely.Point(x + east, y + north)
        assert shown.sight.dwithin(point, shown.margin_m + 1e-6)
        assert shown.shows(point.buffer(1e-3), -math.inf, ground_m + 1e-3)
        assert math.dist((0, 0, 0), direction * reach) <= shown.farthest_m + errors[0] + 1e-6
        # The footprint also contains the points in the air through which the ray passes.
        for share in (0.3, 0.8):
            height = above_m - share * (above_m - ground_m)
            passed = shapely.Point(x + east * share, y + north * share).buffer(1e-3)
            assert shown.shows(passed, height - 1e-3, height + 1e-3)


@pytest.mark.parametrize(
    "unknown",
    [
        {"lens": None},
        {"lens": Lens(60, 45, -90)},
        {"lens": Lens(60, 45, -90), "attitude": None},
        {"alt": -20.0, "attitude": Attitude(0, 0, 0)},
        {"lens": Lens(170, 45, -90, stabilised=True), "attitude": Attitude(0, 0, 0)},
        {"lens": Lens(60, 45, -10, stabilised=True)},
    ],
)
def test_footprint_covers_everything_when_attitude_or_lens_is_unknown(unknown: dict[str, object]) -> None:
    shown = view(at(0, 0, **unknown))  # type: ignore[arg-type]
    for bearing in range(0, 360, 7):
        far = shapely.Point(9990 * math.sin(bearing), 9990 * math.cos(bearing))
        assert shown.sight.covers(far)
    assert shown.farthest_m == math.inf


def test_footprint_of_downward_lens_is_rectangle_rotated_by_yaw() -> None:
    lens = Lens(2 * math.degrees(math.atan(1.0)), 2 * math.degrees(math.atan(0.5)), error_deg=0.0)
    sharp = {"position_error_m": 0.0, "altitude_error_m": 0.0, "lens": lens}
    north = view(at(0, 0, alt=20, attitude=Attitude(0, 0, 0, 0, 0), **sharp))
    assert north.sight.bounds == pytest.approx((-20, -10, 20, 10))
    east = view(at(0, 0, alt=20, attitude=Attitude(0, 0, 90, 0, 0), **sharp))
    assert east.sight.bounds == pytest.approx((-10, -20, 10, 20))
    # If the nose is 30 degrees up, a camera that is mounted downward looks ahead.
    ahead = view(at(0, 0, alt=20, attitude=Attitude(0, 30, 0, 0, 0), **sharp))
    assert ahead.sight.bounds[3] == pytest.approx(20 * math.tan(math.radians(30) + math.atan(0.5)))


def test_footprint_of_camera_showing_horizon_is_sector_ahead() -> None:
    lens = Lens(60, 40, pitch_deg=0, stabilised=True, error_deg=0)
    shown = view(at(0, 0, lens=lens, attitude=Attitude(0, 0, 90, 0, 0)))
    assert shown.sight.covers(shapely.Point(9000, 0))
    assert not shown.sight.dwithin(shapely.Point(-20, 0), 10)
    assert shown.upper_m == math.inf


def test_footprint_shows_zones_with_altitude_bands() -> None:
    # The narrow view points east, 45 degrees down. It shows the ground about 20 m ahead.
    lens = Lens(10, 10, pitch_deg=-45, stabilised=True, error_deg=0)
    now = at(0, 0, alt=20, lens=lens, attitude=Attitude(0, 0, 90, 0, 0), position_error_m=0.1, altitude_error_m=0.1)

    def verdict(x0: float, x1: float, **band: float) -> str:
        private = policy("p", "PrivacyControl", "camera", [zone("z", box(x0, -5, x1, 5), **band)], action="refuse")
        return ask(compiled(private), _CAPTURE, now).code

    assert verdict(15, 25) == "PrivacyZone"
    assert verdict(5, 10) == "PrivacyZone", "the picture may show a building in the zone"
    assert verdict(5, 10, upper=3) == "", "the view passes above a low zone"
    assert verdict(5, 10, lower=8, upper=14) == "PrivacyZone"
    assert verdict(-30, -5) == "", "the zone is behind the camera"
    assert verdict(40, 60) == "", "the zone is beyond the view"
    assert verdict(15, 25, lower=25) == "", "the zone is above the camera"
    assert verdict(-5, 5) == "PrivacyZone", "the drone is in the zone"


def test_footprint_of_exposure_covers_the_motion_between_its_ends() -> None:
    private = policy("p", "PrivacyControl", "camera", [zone("z", box(40, -5, 45, 5))], action="refuse")
    grant = compiled(private)
    now = at(0, 0, alt=10)
    later = at(100, 0, alt=10)
    assert judge_privacy(now, grant).action == judge_privacy(later, grant).action == "allow"
    assert judge_privacy(replace(later, exposure=(now, later)), grant).code == "PrivacyZone"
    assert judge_privacy(replace(later, exposure=(now, Situation(time_s=NOW))), grant).code == "PrivacyZone", (
        "the motion between the two poses is unknown"
    )


_CAPTURE = Call("CaptureImage")
_FILTERS = st.builds(
    Filter,
    st.sampled_from(["black", "removeBackground", "blurMedian", "blurAverage", "blurFaces"]),
    st.sampled_from(["pixelate", "gaussian"]),
    st.sampled_from(["blurAverage", "black", "refuse"]),
)


@_cases
@given(st.lists(_FILTERS, max_size=6), st.lists(_FILTERS, max_size=4))
def test_combined_filters_satisfy_each_filter(required: list[Filter], more: list[Filter]) -> None:
    composed = combine_filters(required)
    assert composed == combine_filters(reversed(required)) == combine_filters(composed)
    done = {filter_.action for filter_ in composed}
    hidden = {"blurAverage", "blurMedian", "black"}
    for filter_ in required:
        assert filter_.action in done or "black" in done or (filter_.action == "blurFaces" and done & hidden)
    assert remaining_filters(required, composed) == ()
    # The remaining filters complete earlier filters that are missing or less strict.
    both = (*composed, *remaining_filters(more, composed))
    assert remaining_filters(combine_filters([*required, *more]), both) == ()


def test_combined_filters_use_stricter_face_method() -> None:
    soft = Filter("blurFaces", "gaussian", "refuse")
    hard = Filter("blurFaces", "pixelate", "black")
    assert combine_filters([soft, hard]) == (Filter("blurFaces", "pixelate", "refuse"),)
    assert combine_filters([soft]) == (soft,)
    assert remaining_filters([hard], [soft]) == (hard,), "a soft blur does not satisfy pixelation"
    assert (
        remaining_filters([soft], [hard])
        == remaining_filters([soft], [soft])
        == remaining_filters([hard], [Filter("blurMedian")])
        == ()
    )


def test_privacy_rule_returns_its_filter() -> None:
    def private(name: str, **fields: str) -> dict[str, object]:
        return policy(name, "PrivacyControl", "camera", [zone(name, box(-5, -5, 5, 5))], **fields)

    grant = compiled(
        private("faces", action="blurFaces", faces="gaussian", fallback="refuse"), private("all", action="blurMedian")
    )
    verdict = ask(grant, _CAPTURE)
    assert verdict.filters == (Filter("blurMedian"),)
    assert set(verdict.policies) == {"faces", "all"}
    assert ask(compiled(private("faces", action="blurFaces", fallback="refuse")), _CAPTURE).filters == (
        Filter("blurFaces", "pixelate", "refuse"),
    )


def test_lens_is_read_from_camera_description() -> None:
    fields = {
        "methods": ["CaptureImage"],
        "resolution": "1600x900",
        "horizontalFieldOfView": 90,
        "lens": {"model": "pinhole"},
    }
    assert bounding_lens(None) is None
    assert bounding_lens(CameraFeatures.model_validate(fields)) is None, "the direction of the camera is unknown"
    lens = bounding_lens(CameraFeatures.model_validate({**fields, "mount": {"pitch": -60, "stabilised": True}}))
    assert lens is not None
    assert (lens.pitch_deg, lens.stabilised) == (-60, True)
    assert lens.vertical_deg == pytest.approx(2 * math.degrees(math.atan(9 / 16)))
