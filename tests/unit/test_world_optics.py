"""Projection of ground positions into a picture, compared with an oracle in earth-centred coordinates."""

from __future__ import annotations

import math

import numpy as np
import pytest
from depth import examples
from fractus_core.geo import LocalFrame
from fractus_world.optics import Intrinsics, Mount, Pose, View
from hypothesis import given, settings
from hypothesis import strategies as st

A = 6_378_137.0
E2 = (2 - 1 / 298.257223563) / 298.257223563
LENS = Intrinsics(1920, 1080, 62.2)


def ecef(lat: float, lon: float, height_m: float) -> np.ndarray:
    phi = math.radians(lat)
    lam = math.radians(lon)
    n = A / math.sqrt(1 - E2 * math.sin(phi) ** 2)
    return np.array(
        [
            (n + height_m) * math.cos(phi) * math.cos(lam),
            (n + height_m) * math.cos(phi) * math.sin(lam),
            (n * (1 - E2) + height_m) * math.sin(phi),
        ]
    )


def oracle(pose: Pose, mount: Mount, lat: float, lon: float) -> np.ndarray:
    """Return the pixel of a position on the ellipsoid. The vector algebra shares no code with the code under test."""
    phi = math.radians(pose.lat)
    lam = math.radians(pose.lon)
    east = np.array([-math.sin(lam), math.cos(lam), 0.0])
    north = np.array([-math.sin(phi) * math.cos(lam), -math.sin(phi) * math.sin(lam), math.cos(phi)])
    up = np.cross(east, north)
    roll, pitch = (0.0, 0.0) if mount.stabilised else (math.radians(pose.roll_deg), math.radians(pose.pitch_deg))
    yaw = math.radians(pose.yaw_deg)
    ahead = math.cos(pitch) * (math.sin(yaw) * east + math.cos(yaw) * north) + math.sin(pitch) * up
    level = math.cos(yaw) * east - math.sin(yaw) * north
    right = math.cos(roll) * level - math.sin(roll) * np.cross(level, ahead)
    below = np.cross(ahead, right)
    turn = math.radians(mount.yaw_deg)
    tilt = math.radians(mount.pitch_deg)
    forward = math.cos(turn) * ahead + math.sin(turn) * right
    side = math.cos(turn) * right - math.sin(turn) * ahead
    optical = math.cos(tilt) * forward - math.sin(tilt) * below
    downward = math.cos(tilt) * below + math.sin(tilt) * forward
    ray = ecef(lat, lon, 0.0) - ecef(pose.lat, pose.lon, pose.height_m)
    focal = LENS.width / 2 / math.tan(math.radians(LENS.horizontal_fov_deg) / 2)
    depth = float(ray @ optical)
    assert depth > 0
    return np.array(
        [LENS.width / 2 + focal * float(ray @ side) / depth, LENS.height / 2 + focal * float(ray @ downward) / depth]
    )


ATTITUDES = [
    (Pose(0, 0, 120.0), Mount()),
    (Pose(0, 0, 120.0, yaw_deg=137.0), Mount(-60.0, 30.0)),
    (Pose(0, 0, 60.0, 12.0, -9.0, 250.0), Mount(-90.0, 0.0, stabilised=False)),
    (Pose(0, 0, 400.0, -20.0, 15.0, 10.0), Mount(-45.0, -70.0, stabilised=False)),
]
PLACES = [(50.8637, 4.6785), (80.0, 25.0), (-79.9, -60.0), (10.0, 179.9999), (65.0, -179.99995), (0.0, 0.0)]


@pytest.mark.parametrize(("pose", "mount"), ATTITUDES)
@pytest.mark.parametrize(("lat", "lon"), PLACES)
def test_projection_matches_oracle(pose: Pose, mount: Mount, lat: float, lon: float) -> None:
    """Some cameras are 5 km from the world origin. Their north direction differs from that at the origin."""
    for east_m, north_m in ((0.0, 0.0), (5000.0, -3000.0)):
        frame = LocalFrame(lat, lon)
        camera = Pose(*frame.latlon(east_m, north_m), pose.height_m, pose.roll_deg, pose.pitch_deg, pose.yaw_deg)
        view = View.of(camera, mount, LENS, frame)
        inverse = view.ground_matrix()
        for u, v in ((960.0, 540.0), (100.0, 900.0), (1800.0, 500.0), (500.5, 300.5)):
            x, y, w = inverse @ np.array([u, v, 1.0])
            if w >= -0.05:
                continue  # above the horizon, or kilometres away
            target = frame.latlon(x / w, y / w)
            assert np.abs(oracle(camera, mount, *target) - (u, v)).max() < 1.0
            pixels, depth = view.project(np.array([[x / w, y / w, 0.0]]))
            assert depth[0] > 0
            assert pixels[0] == pytest.approx((u, v), abs=1e-6)


@settings(max_examples=examples(200), deadline=None)
@given(
    st.floats(-84, 84),
    st.floats(-180, 180),
    st.floats(2, 500),
    st.floats(-30, 30),
    st.floats(-30, 30),
    st.floats(-180, 180),
    st.floats(-90, -35),
)
def test_projection_matches_oracle_at_any_attitude(
    lat: float, lon: float, height: float, roll: float, pitch: float, yaw: float, mount_pitch: float
) -> None:
    pose = Pose(lat, lon, height, roll, pitch, yaw)
    mount = Mount(mount_pitch, 0.0, stabilised=False)
    frame = LocalFrame(lat, lon)
    view = View.of(pose, mount, LENS, frame)
    x, y, w = view.ground_matrix() @ np.array([700.0, 800.0, 1.0])
    if w < -0.1:
        assert np.abs(oracle(pose, mount, *frame.latlon(x / w, y / w)) - (700.0, 800.0)).max() < 1.0


def test_top_of_downward_picture_points_ahead() -> None:
    frame = LocalFrame(50.0, 4.0)
    view = View.of(Pose(50.0, 4.0, 100.0, yaw_deg=90.0), Mount(), LENS, frame)
    (ahead, right), _ = view.project(np.array([[20.0, 0.0, 0.0], [0.0, -20.0, 0.0]]))
    assert ahead == pytest.approx((960.0, 540.0 - LENS.focal_px / 5), abs=1e-6)
    assert right == pytest.approx((960.0 + LENS.focal_px / 5, 540.0), abs=1e-6)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Intrinsics(width=4), "width: 4 is not"),
        (lambda: Intrinsics(height=100_000), "height"),
        (lambda: Intrinsics(horizontal_fov_deg=170.0), "field of view: 170"),
        (lambda: Mount(-91.0), "mount pitch: -91"),
        (lambda: Mount(yaw_deg=1000.0), "mount yaw"),
        (lambda: Pose(91.0, 0.0, 1.0), "not on the globe"),
        (lambda: Pose(0.0, math.nan, 1.0), "finite"),
        (lambda: Pose(0.0, 0.0, 60_000.0), "more than 50 km"),
    ],
)
def test_impossible_camera_is_refused(make: object, message: str) -> None:
    assert callable(make)
    with pytest.raises(ValueError, match=message):
        make()
