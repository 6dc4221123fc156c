"""Pictures of the simulated world are deterministic and agree with the ground truth."""

from __future__ import annotations

import hashlib
import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest
from fractus_world.billboards import VARIATIONS, face_box, portrait
from fractus_world.bodies import parts_of
from fractus_world.optics import Intrinsics, Mount, Pose
from fractus_world.population import Thing
from fractus_world.truth import Seen, SeenFace, Truth
from fractus_world.world import World, WorldAround

LAT = 50.8637
LON = 4.6785
LENS = Intrinsics(640, 360, 62.2)
SMALL = Intrinsics(160, 90, 62.2)
TIME_S = 1_795_000_000.0
CROSSING = (70.0, 55.0)


@pytest.fixture(scope="module")
def world() -> World:
    return World.procedural(LAT, LON, 7)


def above(world: World, east_m: float, north_m: float, height_m: float, yaw_deg: float = 20.0) -> Pose:
    return Pose(*world.frame.latlon(east_m, north_m), height_m, yaw_deg=yaw_deg)


def digest(picture: np.ndarray) -> str:
    return hashlib.sha256(picture.tobytes()).hexdigest()


def test_picture_is_identical_for_same_seed_pose_and_time(world: World) -> None:
    """The picture depends neither on the order of rendering nor on the World instance."""
    poses = [above(world, 60.0, 50.0, 60.0), above(world, 200.0, 50.0, 90.0)]
    first = [digest(world.render(pose, SMALL, time_s=TIME_S)) for pose in poses]
    same_world = World.procedural(LAT, LON, 7)
    assert [digest(same_world.render(pose, SMALL, time_s=TIME_S)) for pose in reversed(poses)] == first[::-1]
    assert digest(World.procedural(LAT, LON, 8).render(poses[0], SMALL, time_s=TIME_S)) != first[0]


def test_traffic_moves_at_its_speed_and_heading(world: World) -> None:
    pose = above(world, *CROSSING, 150.0)
    before = world.truth(pose, LENS, time_s=TIME_S)
    after = world.truth(pose, LENS, time_s=TIME_S + 2.0)
    positions = {sighting.id: (sighting.lat, sighting.lon) for sighting in before.objects}
    moved = [sighting for sighting in after.objects if sighting.id in positions]
    assert any(sighting.speed_mps > 5 for sighting in moved)
    for sighting in moved:
        north = (sighting.lat - positions[sighting.id][0]) * 111_200
        east = (sighting.lon - positions[sighting.id][1]) * 111_320 * np.cos(np.radians(LAT))
        assert np.hypot(east, north) == pytest.approx(2.0 * sighting.speed_mps, rel=0.1, abs=0.05)
        if sighting.speed_mps > 5:
            assert np.cos(np.arctan2(east, north) - np.radians(sighting.heading_deg)) > 0.98


def test_vehicles_of_a_lane_keep_their_distance(world: World) -> None:
    """Vehicles on the same road and in the same direction never overlap."""
    for time_s in (0.0, 1e3, TIME_S):
        pose = above(world, 0.0, 0.0, 900.0)
        lanes: dict[str, list[tuple[float, float]]] = {}
        for sighting in world.truth(pose, LENS, time_s=time_s).objects:
            if sighting.id.startswith("vehicle"):
                lane = sighting.id.rstrip("0123456789") if sighting.id[-1].isdigit() else sighting.id
                lanes.setdefault(lane, []).append(world.frame.xy(sighting.lat, sighting.lon))
        assert sum(len(lane) for lane in lanes.values()) > 10
        for lane in lanes.values():
            assert all(np.hypot(a[0] - b[0], a[1] - b[1]) > 12.5 for a, b in itertools.combinations(lane, 2))


def changed_box(world: World, pose: Pose, mount: Mount, name: str) -> tuple[int, int, int, int]:
    """Return the box of the pixels that an object changes.

    Thermal pictures are compared, because they show no shadows.
    """
    arguments = {"mount": mount, "time_s": TIME_S}
    with_it = world.render(pose, LENS, band="ir", **arguments)
    without = world.render(pose, LENS, band="ir", hidden=frozenset({name}), **arguments)
    changed = np.abs(with_it.astype(int) - without.astype(int)).max(axis=2) > 12
    rows = np.flatnonzero(changed.any(axis=1))
    columns = np.flatnonzero(changed.any(axis=0))
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


@pytest.mark.parametrize(
    ("height_m", "mount"), [(60.0, Mount()), (45.0, Mount(-50.0)), (40.0, Mount(-35.0, 90.0, stabilised=False))]
)
def test_boxes_match_changed_pixels(world: World, height_m: float, mount: Mount) -> None:
    pose = Pose(*world.frame.latlon(40.0, 20.0), height_m, 4.0, -3.0, 40.0)
    truth = world.truth(pose, LENS, mount=mount, time_s=TIME_S)
    whole = [sighting for sighting in truth.objects if sighting.in_frame == 1.0 and sighting.visible > 0.995]
    whole = [sighting for sighting in whole if sighting.box[2] - sighting.box[0] > 6]
    assert len(whole) >= 2, "the scene has too little traffic; choose another time"
    for sighting in whole:
        box = changed_box(world, pose, mount, sighting.id)
        assert np.abs(np.array(box) - np.array(sighting.box)).max() < 2.0, sighting


def test_position_of_an_object_is_inside_its_box(world: World) -> None:
    pose = above(world, *CROSSING, 80.0)
    view = world.view(pose, LENS)
    for sighting in world.truth(pose, LENS, time_s=TIME_S).objects:
        if sighting.in_frame == 1.0:
            (pixel,), _ = view.project(np.array([[*world.frame.xy(sighting.lat, sighting.lon), 0.5]]))
            assert sighting.box[0] - 1 <= pixel[0] <= sighting.box[2] + 1
            assert sighting.box[1] - 1 <= pixel[1] <= sighting.box[3] + 1


def test_boxes_and_shares_of_cut_objects_stay_in_range(world: World) -> None:
    """Boxes stay inside the picture, and shares between 0 and 1.

    Only an object at the edge of the picture may have a share `in_frame` below 1.
    """
    for east in range(0, 200, 25):
        truth = world.truth(above(world, float(east), 40.0, 50.0), LENS, mount=Mount(-60.0), time_s=TIME_S)
        sightings: list[Seen | SeenFace] = [*truth.objects, *truth.faces]
        for sighting in sightings:
            left, top, right, bottom = sighting.box
            assert 0 <= left < right <= LENS.width
            assert 0 <= top < bottom <= LENS.height
            assert 0 <= sighting.visible <= sighting.in_frame <= 1
            touching = left == 0 or top == 0 or right == LENS.width or bottom == LENS.height
            assert touching or sighting.in_frame == 1.0


def face(truth: Truth, name: str) -> SeenFace:
    return next(sighting for sighting in truth.faces if sighting.id == name)


def lying_faces(world: World, pose: Pose) -> list[SeenFace]:
    return [sighting for sighting in world.truth(pose, LENS, time_s=TIME_S).faces if not sighting.standing]


def test_lying_face_has_the_colours_of_the_photograph(world: World) -> None:
    """In a picture from straight above, the pixels in the box of the face have skin colour."""
    distant = lying_faces(world, above(world, 0.0, 0.0, 120.0))[0]
    east, north = world.frame.xy(distant.lat, distant.lon)
    pose = above(world, east, north, 14.0, yaw_deg=0.0)
    sighting = face(world.truth(pose, LENS, time_s=TIME_S), distant.id)
    assert sighting.visible > 0.95
    assert sighting.height_px > 40
    left, top, right, bottom = (round(edge) for edge in sighting.box)
    pixels = world.render(pose, LENS, time_s=TIME_S)[top:bottom, left:right]
    # Skin colour contains more red than blue.
    assert (pixels[..., 2] > pixels[..., 0].astype(int) + 8).mean() > 0.6


def test_standing_face_is_hidden_from_behind(world: World) -> None:
    overview = world.truth(above(world, 0.0, 0.0, 120.0), Intrinsics(1280, 720, 90.0), time_s=TIME_S)
    board = next(sighting for sighting in overview.faces if sighting.standing)
    east, north = world.frame.xy(board.lat, board.lon)
    shares = {}
    for bearing in range(0, 360, 30):
        angle = np.radians(bearing)
        pose = above(world, east - 25 * np.sin(angle), north - 25 * np.cos(angle), 9.0, float(bearing))
        truth = world.truth(pose, LENS, mount=Mount(-15.0), time_s=TIME_S)
        shares[bearing] = next((sighting.visible for sighting in truth.faces if sighting.id == board.id), 0.0)
    assert max(shares.values()) > 0.9
    assert min(shares.values()) == 0.0
    assert 3 <= sum(share > 0.0 for share in shares.values()) <= 7


def test_detector_finds_every_face_variation_in_its_box() -> None:
    """OpenCV's face detector finds the face at the reported position."""
    detector = cv2.CascadeClassifier(str(Path(cv2.data.haarcascades) / "haarcascade_frontalface_default.xml"))
    for variation in range(VARIATIONS):
        picture = portrait(variation, 0)
        gray = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
        faces = detector.detectMultiScale(gray, 1.1, 5, minSize=(60, 60), maxSize=(200, 200))
        assert len(faces), f"no face in variation {variation}"
        left, top, right, bottom = face_box(variation)
        height, width = picture.shape[:2]
        x = faces[0][0] + faces[0][2] / 2
        y = faces[0][1] + faces[0][3] / 2
        assert left * width < x < right * width
        assert top * height < y < bottom * height


def test_people_and_engines_are_warm_in_thermal_pictures(world: World) -> None:
    pose = above(world, *CROSSING, 60.0)
    picture = world.render(pose, LENS, time_s=TIME_S, band="ir")
    assert np.array_equal(picture[..., 0], picture[..., 2]), "a thermal picture has no colours"
    ground = float(np.median(picture))
    warm = [
        sighting
        for sighting in world.truth(pose, LENS, time_s=TIME_S).objects
        if sighting.visible == 1.0 and sighting.speed_mps
    ]
    assert warm
    for sighting in warm:
        left, top, right, bottom = (round(edge) for edge in sighting.box)
        assert picture[top:bottom, left:right].max() > ground + 60, sighting


def test_picture_shows_sky_above_and_ground_below_the_horizon(world: World) -> None:
    picture = world.render(above(world, 0.0, 0.0, 100.0), SMALL, mount=Mount(0.0), time_s=TIME_S)
    assert picture[2, 80, 0] > picture[2, 80, 2] + 20, "the sky is blue"
    assert picture[87, 80, 1] >= picture[87, 80, 0], "the ground is not blue"
    up = world.render(above(world, 0.0, 0.0, 100.0), SMALL, mount=Mount(60.0), time_s=TIME_S)
    assert world.truth(above(world, 0.0, 0.0, 100.0), SMALL, mount=Mount(60.0), time_s=TIME_S).objects == ()
    assert (up[..., 0] > up[..., 2]).all()


@pytest.mark.parametrize("height_m", [-3.0, 0.0, 0.3, 3000.0, 40_000.0])
def test_picture_is_rendered_from_extreme_heights(world: World, height_m: float) -> None:
    for mount in (Mount(), Mount(-20.0)):
        picture = world.render(above(world, 5.0, 5.0, height_m), Intrinsics(160, 90), mount=mount)
        assert picture.shape == (90, 160, 3)


def test_shape_of_every_object_kind_fits_its_size() -> None:
    for kind in ("car", "van", "truck", "bus", "person"):
        thing = Thing("x", kind, 0.0, 0.0, 0.0, 1.0, 12345)
        points = np.vstack([part.points for part in parts_of(thing)])
        length, width, height = thing.size_m
        extent = points.max(axis=0) - points.min(axis=0)
        assert extent[0] <= length + 0.45, kind
        assert extent[1] <= width + 0.2, kind
        assert points[:, 2].max() == pytest.approx(height, abs=0.1)
        assert points[:, 2].min() >= 0


def test_nearby_cameras_share_a_world_origin() -> None:
    first_around = WorldAround(7)
    second_around = WorldAround(7)
    assert first_around.at(None) is None
    first = first_around.at(Pose(50.86, 4.67, 10.0))
    second = second_around.at(Pose(50.87, 4.66, 3.0))
    assert first is not None
    assert second is not None
    assert (first.frame.lat, first.frame.lon) == (second.frame.lat, second.frame.lon)


def test_neighbouring_tiles_have_no_seam(world: World) -> None:
    """Adjacent columns of two tiles differ no more than adjacent columns within a tile."""
    ground = world.ground
    left = ground.tile(2, 0, -1).astype(int)
    right = ground.tile(2, 1, -1).astype(int)
    across = np.abs(left[:, -1] - right[:, 0]).mean()
    within = np.abs(left[:, -2] - left[:, -1]).mean()
    assert across < 2.0 * within + 1.0


def visible_ids(truth: Truth) -> set[str]:
    return {sighting.id for sighting in truth.objects if isinstance(sighting, Seen)}


def test_truth_is_unchanged_after_rendering_elsewhere(world: World) -> None:
    pose = above(world, *CROSSING, 70.0)
    before = world.truth(pose, LENS, time_s=TIME_S)
    world.render(above(world, 5000.0, -4000.0, 100.0), Intrinsics(160, 90), time_s=TIME_S)
    assert visible_ids(world.truth(pose, LENS, time_s=TIME_S)) == visible_ids(before)
    assert cv2.getNumThreads() == 1
