"""Geotagged photographs as the camera world: the nearest daylight or thermal photo is used."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest
from fractus_core.api.geometry import Point
from fractus_core.geo import geodesic_m
from fractus_world.photos import Photo, PhotoError, Photos, resized
from geotagged import save
from PIL import Image


def test_world_photo_is_nearest_in_three_dimensions(tmp_path: Path) -> None:
    save(tmp_path / "low.jpg", 50.0, 4.0, 30.0)
    save(tmp_path / "high.jpg", 50.0, 4.0, 120.0)
    save(tmp_path / "aside.jpg", 50.001, 4.0, 30.0)
    photos = Photos.of(tmp_path)
    assert photos.nearest(50.0, 4.0, 40.0, "rgb")[0].path.name == "low.jpg"
    assert photos.nearest(50.0, 4.0, 100.0, "rgb")[0].path.name == "high.jpg"
    photo, away_m = photos.nearest(50.0009, 4.0, 30.0, "rgb")
    assert photo.path.name == "aside.jpg"
    assert away_m == pytest.approx(11.1, abs=0.2)


def test_world_photo_index_agrees_with_linear_search() -> None:
    """Compare the index with geodesic distances to all photos, also near a pole and across the antimeridian."""
    roll = random.Random(5)
    for lat, lon in ((50.0, 4.0), (80.0, 179.99), (-60.0, -179.99)):
        photos = [
            Photo(
                Path(str(n)),
                lat + roll.uniform(-0.01, 0.01),
                (lon + roll.uniform(-0.02, 0.02) + 180) % 360 - 180,
                roll.uniform(0, 300),
                "rgb",
            )
            for n in range(400)
        ]
        index = Photos(photos)
        for _ in range(10):
            at = Point(lat=lat + roll.uniform(-0.01, 0.01), lon=(lon + roll.uniform(-0.02, 0.02) + 180) % 360 - 180)
            height = roll.uniform(0, 300)
            photo, away_m = index.nearest(at.lat, at.lon, height, "rgb")
            distances = [np.hypot(geodesic_m(at, Point(lat=p.lat, lon=p.lon)), p.amsl_m - height) for p in photos]
            assert away_m == pytest.approx(min(distances), rel=2e-3)
            assert distances[int(photo.path.name)] == pytest.approx(min(distances), rel=2e-3)


def test_world_photo_is_thermal_by_folder_or_file_name(tmp_path: Path) -> None:
    for name in ("rgb/a.jpg", "b.jpg", "DJI_0001_V.JPG"):
        save(tmp_path / name, 50.0, 4.0, 30.0)
    for name in ("ir/c.jpg", "thermal/flight/d.jpg", "e_ir.jpg", "f-IR.jpg", "DJI_0001_T.JPG"):
        save(tmp_path / name, 51.0, 4.0, 30.0)
    photos = Photos.of(tmp_path)
    assert photos.nearest(51.0, 4.0, 30.0, "rgb")[1] > 100_000
    assert photos.nearest(50.0, 4.0, 30.0, "ir")[1] > 100_000


def test_world_photo_without_position_is_ignored(tmp_path: Path) -> None:
    save(tmp_path / "good.jpg", -33.5, -70.6, -3.0)
    Image.new("RGB", (8, 8)).save(tmp_path / "plain.jpg")
    (tmp_path / "broken.jpg").write_bytes(b"\xff\xd8\xff nonsense")
    (tmp_path / "notes.txt").write_text("x")
    photo, away_m = Photos.of(tmp_path).nearest(-33.5, -70.6, -3.0, "rgb")
    assert photo.path.name == "good.jpg"
    assert away_m < 0.05
    assert photo.amsl_m == -3.0


def test_world_photo_errors_state_the_reason(tmp_path: Path) -> None:
    with pytest.raises(PhotoError, match="is not a directory"):
        Photos.of(tmp_path / "nowhere")
    with pytest.raises(PhotoError, match="none of its 0 pictures"):
        Photos.of(tmp_path)
    save(tmp_path / "a.jpg", 50.0, 4.0, None)
    with pytest.raises(PhotoError, match="no ir picture"):
        Photos.of(tmp_path).nearest(50.0, 4.0, 0.0, "ir")


def test_world_photo_is_resized_to_requested_size(tmp_path: Path) -> None:
    save(tmp_path / "a.png", 50.0, 4.0, 30.0, (200, 20, 20))
    photo, _ = Photos.of(tmp_path).nearest(50.0, 4.0, 30.0, "rgb")
    for width, height in ((80, 60), (320, 180), (60, 80), (31, 17)):
        picture = resized(photo, width, height)
        assert picture.shape == (height, width, 3)
        assert tuple(picture[height // 2, width // 2]) == (20, 20, 200), (
            "the channels are not in the order blue, green, red"
        )
    (tmp_path / "a.png").unlink()
    with pytest.raises(PhotoError, match="cannot be read"):
        resized(photo, 8, 8)
