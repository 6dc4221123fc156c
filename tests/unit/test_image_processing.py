"""Image processing: filters, face and motion detection, decoding, metadata and camera drivers."""

from __future__ import annotations

import io
import math
import os
import re
import struct
import sys
import types
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from depth import examples
from fractus_core.api.nodes import EdgeNodeSpec
from fractus_core.policy.decision_types import Attitude, Filter, Home, Lens
from fractus_core.policy.footprint import camera_axes
from fractus_services.camera.drivers.connection import create_driver
from fractus_services.camera.drivers.driver import CameraFailed, CaptureRequest, InvalidCameraConnection
from fractus_services.camera.face_detection import CascadeDetector, InvalidFaceModel, ModelDetector, smallest_face_px
from fractus_services.camera.filter_pipeline import (
    FaceDetectionUnreliable,
    blacken,
    blur_average,
    blur_median,
    hide_faces,
    plan_filters,
    remove_background,
)
from fractus_services.camera.image_metadata import with_metadata
from fractus_services.camera.image_store import ImageRecord
from fractus_services.camera.motion_detection import detect_motion
from fractus_services.camera.pixels import InvalidImage, Pixels, crop_and_resize, decode_image, encode_jpeg, source_size
from fractus_services.camera.pose import FixedPose, Pose, is_upright
from fractus_world.billboards import photograph
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image
from policy_world import HOME, NOW, at

FACE = (177, 66, 97, 97)


@pytest.fixture(scope="module")
def photo() -> Pixels:
    return photograph()


@pytest.fixture(scope="module")
def detector() -> CascadeDetector:
    return CascadeDetector()


def covers(boxes: list[Any], face: tuple[int, int, int, int]) -> bool:
    x = face[0] + face[2] / 2
    y = face[1] + face[3] / 2
    return any(left <= x <= left + w and top <= y <= top + h and w < 2.5 * face[2] for left, top, w, h in boxes)


# Filters


@pytest.mark.parametrize("blur", [blur_average, blur_median])
def test_blur_leaves_16_by_16_values_and_no_face(blur: Any, photo: Pixels, detector: CascadeDetector) -> None:
    blurred = blur(photo)
    assert blurred.shape == photo.shape
    assert abs(float(blurred.mean()) - float(photo.mean())) < 12
    assert not covers(detector.detect(blurred, 48, upright=True), FACE)
    # The blurred picture can be computed from 16x16 values, so it contains no finer structure.
    few = cv2.resize(blurred[16::32, 16::32], (512, 512), interpolation=cv2.INTER_LINEAR)
    assert float(np.abs(few.astype(float) - blurred).mean()) < 6


def test_blacken_sets_all_pixels_to_black(photo: Pixels) -> None:
    assert blacken(photo).max() == 0


@pytest.mark.parametrize("method", ["pixelate", "gaussian"])
@pytest.mark.parametrize("width_px", [50, 97])
def test_hidden_face_is_not_detected(method: Any, width_px: int, photo: Pixels, detector: CascadeDetector) -> None:
    scale = width_px / 97
    picture = cv2.resize(photo, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    face = tuple(int(v * scale) for v in FACE)
    boxes = detector.detect(picture, 48, upright=True)
    assert covers(boxes, face)  # type: ignore[arg-type]
    hidden = hide_faces(picture, boxes, method)
    x, y, w, h = face
    colours = np.unique(hidden[y : y + h, x : x + w].reshape(-1, 3), axis=0)
    assert method == "gaussian" or len(colours) < 120
    before, after = (cv2.cvtColor(p[y : y + h, x : x + w], cv2.COLOR_BGR2GRAY) for p in (picture, hidden))
    eyes = cv2.CascadeClassifier(str(Path(cv2.data.haarcascades) / "haarcascade_frontalface_alt2.xml"))
    assert len(eyes.detectMultiScale(cv2.copyMakeBorder(after, 20, 20, 20, 20, cv2.BORDER_REPLICATE), 1.1, 2)) == 0
    fine = [cv2.Laplacian(cv2.GaussianBlur(p, (0, 0), 1), cv2.CV_64F) for p in (before, after)]
    assert abs(np.corrcoef(fine[0].ravel(), fine[1].ravel())[0, 1]) < 0.3


@pytest.mark.parametrize("method", ["pixelate", "gaussian"])
def test_hide_faces_reveals_nothing_when_boxes_overlap(method: Any, photo: Pixels) -> None:
    face = (100, 100, 98, 98)
    region = np.s_[65:233, 65:233]
    cells = cv2.resize(photo[region], (7, 7), interpolation=cv2.INTER_AREA)
    coarse = photo.copy()
    coarse[region] = cv2.resize(cells, (168, 168), interpolation=cv2.INTER_NEAREST)
    for boxes in ([face, (140, 130, 30, 30), (110, 150, 24, 24)], [(140, 130, 30, 30), face], [face, (60, 60, 40, 40)]):
        visible, nothing = (hide_faces(source, boxes, method)[region] for source in (photo, coarse))
        # One box crosses the edge of the region, so pixels next to the region affect the result.
        assert float(np.abs(visible.astype(int) - nothing).mean()) < 1, boxes


def test_hide_faces_leaves_few_colours_at_picture_edge(photo: Pixels) -> None:
    hidden = hide_faces(photo, [(-60, 200, 100, 100), (472, 430, 100, 100)], "pixelate")
    assert len(np.unique(hidden[240, :75], axis=0)) <= 3
    assert len(np.unique(hidden[480, 440:], axis=0)) <= 3
    assert len(np.unique(hidden[400:, 500], axis=0)) <= 5


def test_hide_faces_accepts_boxes_outside_picture(photo: Pixels) -> None:
    hidden = hide_faces(photo, [(-50, -50, 80, 80), (500, 500, 90, 90), (600, 600, 10, 10), (5, 5, 1, 1)], "pixelate")
    assert hidden.shape == photo.shape


@pytest.mark.parametrize(("turn", "light"), [(0, 1.0), (40, 1.0), (120, 0.4), (180, 1.3), (265, 1.0)])
def test_face_detector_detects_rotated_faces(turn: int, light: float, photo: Pixels, detector: CascadeDetector) -> None:
    middle = (FACE[0] + 48.5, FACE[1] + 48.5)
    matrix = cv2.getRotationMatrix2D(middle, turn, 60 / 97)
    matrix[:, 2] += (90 - middle[0], 90 - middle[1])
    scene = cv2.convertScaleAbs(cv2.warpAffine(photo, matrix, (180, 180), borderMode=cv2.BORDER_REFLECT), alpha=light)
    assert covers(detector.detect(scene, 56, upright=False), (60, 60, 60, 60))


def test_remove_background_keeps_moving_objects_only(photo: Pixels) -> None:
    def frame(shift: int, car: int) -> Pixels:
        picture = np.roll(photo, shift, axis=1).copy()
        picture[350:380, car : car + 40] = (0, 0, 255)
        return picture

    before, now, after = (frame(s, c) for s, c in ((0, 100), (3, 200), (6, 300)))
    mask = detect_motion(before, now, after, fixed=False)
    assert mask is not None
    foreground = remove_background(now, mask)
    assert (foreground[352:378, 202:238] == (0, 0, 255)).all()
    assert (foreground.max(axis=2) > 0).mean() < 0.08, (
        "the landscape and the previous position of the car must be black"
    )
    assert foreground[66:163, 177:274].max() == 0
    standing = detect_motion(frame(0, 100), frame(0, 200), frame(0, 300), fixed=True)
    assert standing is not None
    assert standing[360, 220]
    assert not standing[360, 120]


@pytest.mark.parametrize("sway_px", [0, 2, 8, 16])
def test_motion_detection_ignores_background_of_swaying_camera(sway_px: int, photo: Pixels) -> None:
    frames = []
    for i, car in enumerate((100, 200, 300)):
        picture = photo.copy()
        picture[350:380, car : car + 40] = (40, 200, 40)
        matrix = cv2.getRotationMatrix2D((256, 256), (i - 1) * sway_px / 20, 1.0)
        matrix[:, 2] += ((i - 1) * sway_px, sway_px * (i == 1) / 2)
        frames.append(np.asarray(cv2.warpAffine(picture, matrix, (512, 512), borderMode=cv2.BORDER_REFLECT), np.uint8))
    mask = detect_motion(*frames, fixed=True)
    assert mask is not None
    assert mask[360:370, 205:235].all(), "the car"
    assert mask.mean() < 0.08


def test_motion_detection_detects_motion_before_plain_background(photo: Pixels) -> None:
    frames = [np.full_like(photo, 90) for _ in range(3)]
    for i, frame in enumerate(frames):
        frame[350:380, 100 * i + 100 : 100 * i + 140] = (40, 200, 40)
    mask = detect_motion(*frames, fixed=True)
    assert mask is not None
    assert mask[352:378, 202:238].all()
    assert mask.mean() < 0.02


@pytest.mark.parametrize("fixed", [True, False])
@pytest.mark.parametrize("light", [(1.0, 1.2, 1.4), (0.7, 0.85, 1.0), (1.3, 1.0, 1.3), (0.5, 1.0, 0.5)])
def test_motion_detection_ignores_changed_exposure(light: tuple[float, ...], fixed: bool, photo: Pixels) -> None:
    frames = []
    for i, (factor, car) in enumerate(zip(light, (100, 200, 300), strict=True)):
        picture = np.roll(photo, 0 if fixed else 3 * i, axis=1).copy()
        picture[350:380, car : car + 40] = (40, 200, 40)
        frames.append(cv2.convertScaleAbs(picture, alpha=factor))
    mask = detect_motion(*frames, fixed=fixed)
    assert mask is not None
    assert mask[352:378, 202:238].all(), "the car"
    assert mask.mean() < 0.08


def test_motion_is_unknown_when_light_changes_too_much(photo: Pixels) -> None:
    dark = cv2.convertScaleAbs(photo, alpha=0.3)
    assert detect_motion(photo, dark, photo, fixed=True) is None


def test_remove_background_is_black_when_motion_is_unknown(photo: Pixels) -> None:
    other = np.asarray(cv2.rotate(photo[:, ::-1], cv2.ROTATE_90_CLOCKWISE))
    noise = np.random.default_rng(3).integers(0, 256, photo.shape).astype(np.uint8)
    plain = np.full_like(photo, 90)
    for before, after in ((noise, other), (plain, plain)):
        mask = detect_motion(before, photo, after, fixed=False)
        assert mask is None
        assert remove_background(photo, mask).max() == 0


# Reliability of face detection


def test_smallest_face_depends_on_lens_distance_and_pixels() -> None:
    lens = Lens(90.0, 60.0)
    assert smallest_face_px(lens, 10.0, 2000) == pytest.approx(13.0)
    assert smallest_face_px(lens, float("inf"), 2000) == 0
    assert smallest_face_px(None, 10.0, 2000) == 0


@pytest.mark.parametrize(
    ("lens", "attitudes", "upright"),
    [
        (Lens(60, 45, -30, stabilised=True), [Attitude(20, -30, 0)], True),
        (Lens(60, 45, -30), [Attitude(0, 5, 90), Attitude(10, -10, 0)], True),
        (Lens(60, 45, -30), [Attitude(0, 0, 0), Attitude(20, 0, 0), Attitude(0, 0, 0)], False),
        (Lens(60, 45, -30), [Attitude(0, -30, 0)], False),
        (Lens(60, 45, -30, yaw_deg=90), [Attitude(0, -30, 0)], False),
        (Lens(60, 45, -90, stabilised=True), [Attitude(0, 0, 0)], False),
        (Lens(60, 45, -30), [None], False),
        (None, [Attitude(0, 0, 0)], False),
    ],
)
def test_camera_is_upright_only_if_every_pose_is(lens: Any, attitudes: list[Any], upright: bool) -> None:
    assert is_upright([Pose.from_situation(at(lens=lens, attitude=attitude)) for attitude in attitudes]) is upright


def test_filter_fallback_applies_when_face_detection_is_unreliable(detector: CascadeDetector) -> None:
    def faces(fallback: Any) -> Filter:
        return Filter("blurFaces", fallback=fallback)

    assert plan_filters((faces("refuse"),), 48, detector).filters == (faces("refuse"),)
    assert plan_filters((faces("blurAverage"),), 47, detector).filters == (Filter("blurAverage"),)
    assert plan_filters((faces("black"), Filter("removeBackground")), 0, detector).filters == (Filter("black"),)
    assert plan_filters((Filter("blurMedian"),), 0, detector).note == ""
    with pytest.raises(FaceDetectionUnreliable, match="6 pixels"):
        plan_filters((faces("refuse"),), 6, detector)


def test_invalid_face_model_is_refused_with_reason(tmp_path: Path) -> None:
    with pytest.raises(InvalidFaceModel, match="file not found"):
        ModelDetector(tmp_path / "none.onnx")
    corrupt = tmp_path / "corrupt.onnx"
    corrupt.write_bytes(b"\x08\x01 this is no network" * 50)
    with pytest.raises(InvalidFaceModel, match="cannot use it as a face detector"):
        ModelDetector(corrupt)


# Encoding and decoding


@given(st.integers(16, 400), st.integers(16, 400), st.sampled_from([(640, 480), (1280, 720), (100, 100), (480, 640)]))
@settings(max_examples=examples(100, 10), deadline=None, derandomize=True)
def test_source_size_keeps_proportions_of_camera(width: int, height: int, native: tuple[int, int]) -> None:
    source = source_size(width, height, native)
    assert source[0] >= width
    assert source[1] >= height
    assert abs(source[0] / source[1] - native[0] / native[1]) < 0.1 * native[0] / native[1]
    assert crop_and_resize(np.zeros((source[1], source[0], 3), np.uint8), width, height).shape == (height, width, 3)


def test_crop_keeps_centre_of_picture() -> None:
    picture = np.zeros((100, 300, 3), np.uint8)
    picture[:, 100:200] = 255
    assert crop_and_resize(picture, 50, 50).min() > 250


@pytest.mark.parametrize("data", [b"", b"no picture", b"\xff\xd8\xff\xe0broken"])
def test_invalid_image_data_is_refused(data: bytes) -> None:
    with pytest.raises(InvalidImage):
        decode_image(data)


@pytest.mark.parametrize("shape", [(40, 60), (40, 60, 3), (40, 60, 4)])
@pytest.mark.parametrize(
    ("suffix", "kind"), [("png", np.uint8), ("png", np.uint16), ("tiff", np.uint8), ("bmp", np.uint8)]
)
def test_image_is_decoded_as_by_opencv(shape: tuple[int, ...], suffix: str, kind: Any) -> None:
    original = np.random.default_rng(3).integers(0, np.iinfo(kind).max, shape, kind)
    data = cv2.imencode(f".{suffix}", original)[1].tobytes()
    expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert np.abs(decode_image(data).astype(int) - expected).max() <= 1


@pytest.mark.parametrize("orientation", range(1, 9))
def test_image_is_rotated_by_exif_orientation(photo: Pixels, orientation: int) -> None:
    exif = Image.Exif()
    out = io.BytesIO()
    exif[0x0112] = orientation
    Image.fromarray(photo[:100, :60, ::-1]).save(out, "JPEG", quality=95, exif=exif)
    expected = cv2.imdecode(np.frombuffer(out.getvalue(), np.uint8), cv2.IMREAD_COLOR)
    assert decode_image(out.getvalue()).shape == expected.shape
    assert np.abs(decode_image(out.getvalue()).astype(int) - expected).mean() < 2


def test_truncated_image_is_refused(photo: Pixels) -> None:
    data = encode_jpeg(photo)
    with pytest.raises(InvalidImage):
        decode_image(data[: len(data) // 2])


def test_image_with_too_many_pixels_is_refused() -> None:
    out = io.BytesIO()
    Image.new("1", (10_000, 5_001)).save(out, "PNG")
    with pytest.raises(InvalidImage, match="the limit is 50000000 pixels"):
        decode_image(out.getvalue())


def test_image_metadata_contains_position_and_camera(photo: Pixels) -> None:
    lens = Lens(60.0, 45.0, pitch_deg=-30.0, yaw_deg=10.0, stabilised=True)
    pose = Pose.from_situation(at(30, 40, alt=12.5, lens=lens, attitude=Attitude(5, 5, 80.0)))
    data = with_metadata(encode_jpeg(photo), pose, time_s=NOW + 0.25, camera="Pi Camera ü", view_width_px=512)
    with Image.open(io.BytesIO(data)) as picture:
        assert np.asarray(picture).shape == photo.shape
        exif = picture.getexif()
        gps = exif.get_ifd(0x8825)
        more = exif.get_ifd(0x8769)
        lat = sum(float(v) / 60**i for i, v in enumerate(gps[2]))
        lon = sum(float(v) / 60**i for i, v in enumerate(gps[4]))
        assert (lat, lon) == pytest.approx((pose.lat, pose.lon), abs=1e-9)
        assert (gps[1], gps[3]) == ("N", "E")
        assert float(gps[6]) == pytest.approx(HOME.amsl_m + 12.5)
        assert float(gps[17]) == pytest.approx(90.0)
        assert more[0x9000] == b"0232", "OffsetTime needs version 2.31"
        assert (more[0x9010], more[0x9011]) == ("+00:00", "+00:00")
        assert more[0xA405] == round(18 / math.tan(math.radians(30)) * 512 / photo.shape[1])
        assert exif[0x0110] == "Pi Camera ?"
        assert more[0x9003] == "2026:06:01 12:00:00"
        assert more[0x9291] == "250"
        xmp = str(picture.getxmp())
    for name, value in (
        ("Pitch", "60.0000"),
        ("Yaw", "90.0000"),
        ("Roll", "0.0000"),
    ):
        assert f"'{name}': '{value}'" in xmp
    assert "AboveGroundAltitude" not in xmp, "the ground below the drone is unknown"
    assert "FocalLength" not in xmp, "the focal length in millimetres is unknown"
    with pytest.raises(ValueError, match="JPEG"):
        with_metadata(b"PNG", pose, time_s=NOW, camera="", view_width_px=512)


def xmp_angles(data: bytes) -> dict[str, float]:
    return {
        name: float(value) for name, value in re.findall(r'Camera:(Yaw|Pitch|Roll)="(.*?)"', data.decode("latin-1"))
    }


@pytest.mark.parametrize(
    ("mount", "attitude", "angles"),
    [
        pytest.param(-90.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), id="down-north"),
        pytest.param(-90.0, (0.0, 0.0, 250.0), (250.0, 0.0, 0.0), id="down"),
        pytest.param(-90.0, (0.0, 10.0, 40.0), (40.0, 10.0, 0.0), id="down-nose-up"),
        pytest.param(-90.0, (8.0, 0.0, 40.0), (40.0, 0.0, 8.0), id="down-right-side-down"),
        pytest.param(-45.0, (0.0, 0.0, 120.0), (120.0, 45.0, 0.0), id="oblique"),
        pytest.param(0.0, (0.0, 0.0, 120.0), (120.0, 90.0, 0.0), id="horizon"),
        pytest.param(20.0, (0.0, 0.0, 120.0), (120.0, 110.0, 0.0), id="above-horizon"),
    ],
)
def test_image_metadata_contains_attitude_by_the_convention_of_its_schema(
    photo: Pixels, mount: float, attitude: tuple[float, float, float], angles: tuple[float, float, float]
) -> None:
    now = at(lens=Lens(60.0, 45.0, pitch_deg=mount), attitude=Attitude(*attitude))
    data = with_metadata(encode_jpeg(photo), Pose.from_situation(now), time_s=NOW, camera="", view_width_px=None)
    found = xmp_angles(data)
    assert (found["Yaw"], found["Pitch"], found["Roll"]) == pytest.approx(angles, abs=1e-3)


def rotation_deg(yaw: float, pitch: float, roll: float) -> NDArray[np.float64]:
    """Return the rotation from the axes top, right and forward of the image to north, east and down."""
    cy, cp, cr = (math.cos(math.radians(angle)) for angle in (yaw, pitch, roll))
    sy, sp, sr = (math.sin(math.radians(angle)) for angle in (yaw, pitch, roll))
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    rotation: NDArray[np.float64] = about_z @ about_y @ about_x
    return rotation


def test_attitude_in_image_metadata_describes_the_axes_of_the_camera(photo: Pixels) -> None:
    jpeg = encode_jpeg(photo)
    draw = np.random.default_rng(5)
    for _ in range(200):
        lens = Lens(60.0, 45.0, pitch_deg=draw.uniform(-90, 60), yaw_deg=draw.uniform(-180, 180))
        attitude = Attitude(draw.uniform(-40, 40), draw.uniform(-40, 40), draw.uniform(0, 360))
        pose = Pose.from_situation(at(lens=lens, attitude=attitude))
        found = xmp_angles(with_metadata(jpeg, pose, time_s=NOW, camera="", view_width_px=None))
        axis, right, up = camera_axes(lens, attitude)
        expected = np.array([up, right, axis]).T
        assert rotation_deg(found["Yaw"], found["Pitch"], found["Roll"]) == pytest.approx(expected, abs=1e-4)
        assert 0.0 <= found["Yaw"] < 360.0
        assert abs(found["Roll"]) <= 90.0


@pytest.mark.parametrize("yaw_deg", [359.99999, 0.0, 359.995, 180.0])
@pytest.mark.parametrize("mount", [-90.0, -85.0, -30.0, 0.0])
def test_directions_in_image_metadata_are_below_360_degrees(photo: Pixels, yaw_deg: float, mount: float) -> None:
    """A camera that looks almost straight down has the direction of the top of the image."""
    lens = Lens(60.0, 45.0, pitch_deg=mount)
    now = at(lens=lens, attitude=Attitude(3.0 if mount <= -85 else 0.0, 0.0, yaw_deg))
    data = with_metadata(encode_jpeg(photo), Pose.from_situation(now), time_s=NOW, camera="", view_width_px=None)
    with Image.open(io.BytesIO(data)) as picture:
        direction = float(picture.getexif().get_ifd(0x8825)[17])
    assert 0.0 <= direction < 360.0
    assert abs(math.remainder(direction - yaw_deg, 360.0)) < 1.0
    assert 0.0 <= xmp_angles(data)["Yaw"] < 360.0


@pytest.mark.parametrize("degrees", [30.0 - 1e-12, 29.999999999, 12.0 + 1 / 60 - 1e-13, 0.0, 89.99999999999])
def test_seconds_of_position_in_image_metadata_are_below_60(photo: Pixels, degrees: float) -> None:
    pose = replace(Pose.from_situation(at()), lat=degrees, lon=-degrees)
    data = with_metadata(encode_jpeg(photo), pose, time_s=NOW, camera="", view_width_px=None)
    with Image.open(io.BytesIO(data)) as picture:
        gps = picture.getexif().get_ifd(0x8825)
    for tag in (2, 4):
        whole, minutes, seconds = (float(value) for value in gps[tag])
        assert (minutes < 60, seconds < 60) == (True, True)
        assert whole + minutes / 60 + seconds / 3600 == pytest.approx(degrees, abs=1e-9)


def test_metadata_of_edge_node_omits_altitude_above_unknown_datum(photo: Pixels) -> None:
    camera = {"methods": ["CaptureImage"], "horizontalFieldOfView": 60, "mount": {"pitch": -20, "height": 4}}

    def has_altitude(**location: Any) -> bool:
        spec = EdgeNodeSpec.model_validate(
            {"location": {"lat": 1, "lon": 2, **location}, "services": {"camera": camera}}
        )
        pose = Pose.from_situation(FixedPose(spec).situation(NOW))
        data = with_metadata(encode_jpeg(photo), pose, time_s=NOW, camera="", view_width_px=None)
        with Image.open(io.BytesIO(data)) as picture:
            return 6 in picture.getexif().get_ifd(0x8825)

    assert has_altitude(alt=25, altitudeReference="amsl")
    assert not has_altitude()
    assert not has_altitude(alt=25)


def test_image_metadata_accepts_unknown_position_and_negative_altitude(photo: Pixels) -> None:
    for now in (at(lens=None, home=None), at(home=Home(-33.9, -70.0, -50.0), alt=1.0)):
        data = with_metadata(encode_jpeg(photo), Pose.from_situation(now), time_s=NOW, camera="", view_width_px=512)
        with Image.open(io.BytesIO(data)) as picture:
            gps = picture.getexif().get_ifd(0x8825)
        assert (6 in gps) == (now.home is not None)
        if now.home is not None:
            assert gps[5] == b"\x01"
            assert float(gps[6]) == 49.0


def test_image_record_survives_json_round_trip() -> None:
    import json

    pose = Pose.from_situation(at(attitude=Attitude(1, 2, 3)))
    record = ImageRecord(
        "n", NOW, 10, 20, 30, (pose, Pose.from_situation(at(home=None))), 12.0, (Filter("blurFaces", "gaussian"),), True
    )
    assert ImageRecord.from_json(json.loads(json.dumps(record.to_json()))) == record
    for broken in ({}, {"before": 1}, {**record.to_json(), "colour": "red"}):
        with pytest.raises(ValueError, match="invalid image record"):
            ImageRecord.from_json(broken)


# Camera drivers


def capture_request(**more: Any) -> CaptureRequest:
    return CaptureRequest(64, 48, (64, 48), "RGB", at(**more))


@pytest.mark.parametrize(
    "connection", ["", "ftp://x/", "v4l2:", "picamera2:x", "directory:", "test:x", "http://", "http://h:x/"]
)
def test_invalid_camera_connection_is_refused(connection: str) -> None:
    with pytest.raises(InvalidCameraConnection):
        create_driver(connection)


@pytest.mark.parametrize(
    ("connection", "latency_s"),
    [("http://h/", 2.0), ("picamera2:0", 0.3), ("v4l2:/dev/video0", 0.0), ("directory:/", 0.0), ("test:", 0.0)],
)
def test_camera_driver_has_latency(connection: str, latency_s: float) -> None:
    assert create_driver(connection).latency_s == latency_s


def test_missing_camera_error_names_remedy(tmp_path: Path) -> None:
    no_camera = tmp_path / "video0"
    no_camera.write_bytes(b"no device")
    for connection, sentence in (
        ("v4l2:/dev/no-such-video", "connect the camera"),
        (f"v4l2:{no_camera}", "as a camera; check"),
        ("picamera2:0", "picamera2 is not installed"),
        (f"directory:{tmp_path}/none", "cannot read"),
        (f"directory:{tmp_path}", "GPS position"),
    ):
        driver = create_driver(connection)
        with pytest.raises(CameraFailed, match=sentence):
            driver.capture(capture_request())
        driver.close()


def test_raspberry_camera_is_configured_and_restarted(monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[Any] = []

    class Picamera2:
        def __init__(self, number: int) -> None:
            if number != 1:
                raise IndexError("list index out of range")
            self.broken = False

        def create_still_configuration(self, main: dict[str, Any]) -> dict[str, Any]:
            return main

        def configure(self, main: dict[str, Any]) -> None:
            assert main == {"size": (64, 48), "format": "RGB888"}

        def start(self) -> None:
            begun.append(self)

        def capture_array(self, name: str) -> Pixels:
            assert name == "main"
            if self.broken:
                raise RuntimeError("camera timed out")
            return np.full((48, 64, 4), 7, np.uint8)

        def close(self) -> None:
            self.broken = True

    monkeypatch.setitem(sys.modules, "picamera2", types.SimpleNamespace(Picamera2=Picamera2))
    driver = create_driver("picamera2:1")
    assert driver.capture(capture_request()).shape == (48, 64, 3)
    begun[0].broken = True
    with pytest.raises(CameraFailed, match="the next request restarts it"):
        driver.capture(capture_request())
    assert driver.capture(capture_request()).max() == 7
    assert len(begun) == 2
    with pytest.raises(CameraFailed, match="camera 0 not found"):
        create_driver("picamera2:0").capture(capture_request())


def test_video_device_with_unexpected_size_is_refused_when_view_is_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A picture of 640x480 pixels from a sensor that was set to 64x48 may show more than the described view."""
    device = SimpleNamespace(
        isOpened=lambda: True, set=lambda *_: False, grab=lambda: True, release=lambda: None,
        read=lambda: (True, np.zeros((480, 640, 3), np.uint8)),
    )  # fmt: skip
    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: device)
    (tmp_path / "video0").touch()
    driver = create_driver(f"v4l2:{tmp_path}/video0")
    with pytest.raises(
        CameraFailed, match=r"640x480 pixels although it was set to 64x48.*services\.camera\.resolution"
    ):
        driver.capture(capture_request(lens=Lens(60.0, 45.0)))
    assert driver.capture(capture_request(lens=None)).shape == (480, 640, 3), (
        "a camera without a description may see everything"
    )
    device.read = lambda: (True, np.zeros((48, 64, 3), np.uint8))
    assert driver.capture(capture_request(lens=Lens(60.0, 45.0))).shape == (48, 64, 3)


def test_directory_driver_returns_picture_taken_nearest(tmp_path: Path) -> None:
    for name, level, place in (
        ("a", 10, at(0, 0, alt=10)),
        ("b", 100, at(50, 0, alt=10)),
        ("c", 200, at(50, 0, alt=80)),
    ):
        picture = np.full((48, 64, 3), level, np.uint8)
        (tmp_path / f"{name}.jpg").write_bytes(
            with_metadata(encode_jpeg(picture), Pose.from_situation(place), time_s=NOW, camera="", view_width_px=64)
        )
    (tmp_path / "untagged.png").write_bytes(bytes(cv2.imencode(".png", np.zeros((4, 4, 3), np.uint8))[1]))
    (tmp_path / "broken.jpg").write_bytes(b"no picture")
    # The header of a bitmap with 3.6 gigapixels.
    header = struct.pack("<IIIIiiHHIIiiII", 54, 0, 54, 40, 60_000, 60_000, 1, 24, *[0] * 6)
    (tmp_path / "mosaic.tif").write_bytes(b"BM" + header)
    os.mkfifo(tmp_path / "pipe.jpg")
    driver = create_driver(f"directory:{tmp_path}")

    def level(**place: float) -> int:
        return round(float(driver.capture(capture_request(**place)).mean()))

    assert (level(x=5, y=3, alt=20), level(x=40, y=0, alt=20), level(x=40, y=0, alt=70)) == (10, 100, 200)
    late = np.full((48, 64, 3), 250, np.uint8)
    (tmp_path / "d.jpg").write_bytes(
        with_metadata(encode_jpeg(late), Pose.from_situation(at(5, 3, alt=20)), time_s=NOW, camera="", view_width_px=64)
    )
    assert level(x=5, y=3, alt=20) == 250
    with pytest.raises(CameraFailed, match="position is unknown"):
        driver.capture(CaptureRequest(64, 48, (64, 48), "RGB", at().__class__(time_s=NOW)))
