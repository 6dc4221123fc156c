"""Positions of pixels in georeferenced pictures: world files, GeoTIFF tags and UTM."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from fractus_core.api.geometry import Point
from fractus_core.geo import LocalFrame, geodesic_m
from fractus_world.georeference import GeoreferenceError, Projected, parse_system, read_world_file
from fractus_world.optics import Intrinsics, Pose
from fractus_world.raster import OUTSIDE, read_raster
from fractus_world.survey import Sheet
from fractus_world.world import World

LENS = Intrinsics(640, 480, 60.0)


@pytest.mark.parametrize(
    ("code", "lat", "lon", "east", "northing"),
    [
        (32633, 52.0, 15.0, 500_000.0, 5_761_038.2125),
        (32617, 43.642566, -79.387139, 630_084.303, 4_833_438.475),
        (32632, 0.0, 9.0, 500_000.0, 0.0),
        (25833, 52.0, 15.0, 500_000.0, 5_761_038.2125),
        (3857, 0.0, 180.0, 20_037_508.3428, 0.0),
    ],
)
def test_projected_coordinates_match_published_values(
    code: int, lat: float, lon: float, east: float, northing: float
) -> None:
    plane = Projected(code).to_plane(np.array([lat]), np.array([lon]))
    assert plane[0] == pytest.approx((east, northing), abs=2e-3)


@pytest.mark.parametrize(
    ("lat", "lon", "code"), [(80.0, 17.0, 32633), (-45.0, 179.9, 32760), (-1e-9, -177.0, 32701), (60.0, -179.9, 32660)]
)
def test_projection_round_trip_is_exact_to_a_millimetre(lat: float, lon: float, code: int) -> None:
    system = Projected(code)
    x, y = system.to_plane(np.array([lat]), np.array([lon]))[0]
    back = system.to_degrees(float(x), float(y))
    assert geodesic_m(Point(lat=back[0], lon=back[1]), Point(lat=lat, lon=lon)) < 1e-3


def marked(size: int = 400) -> tuple[np.ndarray, list[tuple[int, int]]]:
    """Return a grey picture with white squares of 3 by 3 pixels, and their centres as (column, row)."""
    picture = np.full((size, size, 3), 60, np.uint8)
    marks = [(100, 100), (300, 120), (210, 290)]
    for column, row in marks:
        picture[row - 1 : row + 2, column - 1 : column + 2] = 255
    return picture, marks


def spot_centres(picture: np.ndarray) -> list[tuple[float, float]]:
    """Return the centres of bright spots in pixels from the picture's corner."""
    count, _, _, centres = cv2.connectedComponentsWithStats((picture[..., 1] > 150).astype(np.uint8))
    return [(float(x) + 0.5, float(y) + 0.5) for x, y in centres[1:count]]


def check_rendered_places(world: World, places: list[tuple[float, float]], height_m: float) -> None:
    """Check that the rendered picture shows each place within one pixel of its projected position."""
    frame = world.frame
    pose = Pose(frame.lat, frame.lon, height_m, yaw_deg=30.0)
    view = world.view(pose, LENS)
    picture = world.render(pose, LENS, hidden=frozenset(f"face-{n}" for n in range(6)))
    spots = spot_centres(picture)
    for lat, lon in places:
        (expected,), _ = view.project(np.array([[*frame.xy(lat, lon), 0.0]]))
        assert min(np.hypot(x - expected[0], y - expected[1]) for x, y in spots) < 1.0, (lat, lon)


@pytest.mark.parametrize(("lat", "lon"), [(50.86, 4.68), (80.0, 25.0), (-12.0, 180.0)])
def test_png_with_world_file_in_degrees_is_rendered_in_place(tmp_path: Path, lat: float, lon: float) -> None:
    """One place is at a high latitude, where a degree of longitude is short. Another is on the antimeridian."""
    picture, marks = marked()
    cv2.imwrite(str(tmp_path / "map.png"), picture)
    sheet = Sheet(lat, lon, 200.0, 400)
    (tmp_path / "map.pgw").write_text(sheet.world_file())
    east, south = sheet.step_deg
    places = [(lat - (row - 199.5) * south, (lon + (column - 199.5) * east + 180) % 360 - 180) for column, row in marks]
    check_rendered_places(World.on(read_raster(tmp_path / "map.png")), places, 200.0)


def test_geotiff_in_utm_is_rendered_in_place(tmp_path: Path) -> None:
    picture, marks = marked()
    corner = (533_000.0, 5_640_000.0)
    size = 0.5
    keys = (1, 1, 0, 3, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, 32631)
    tags = [
        (33550, "d", 3, (size, size, 0.0), True),
        (33922, "d", 6, (0.0, 0.0, 0.0, *corner, 0.0), True),
        (34735, "H", len(keys), keys, True),
    ]
    tifffile.imwrite(tmp_path / "map.tif", picture[..., ::-1], photometric="rgb", extratags=tags)
    system = Projected(32631)
    places = [system.to_degrees(corner[0] + (c + 0.5) * size, corner[1] - (r + 0.5) * size) for c, r in marks]
    check_rendered_places(World.on(read_raster(tmp_path / "map.tif")), places, 200.0)


def test_picture_in_local_metres_requires_an_origin(tmp_path: Path) -> None:
    picture, marks = marked()
    cv2.imwrite(str(tmp_path / "map.png"), picture)
    (tmp_path / "map.pgw").write_text("0.5\n0\n0\n-0.5\n-99.75\n99.75\n")
    with pytest.raises(GeoreferenceError, match="origin"):
        read_raster(tmp_path / "map.png", "local")
    frame = LocalFrame(47.0, 11.0)
    places = [frame.latlon((c - 199.5) * 0.5, (199.5 - r) * 0.5) for c, r in marks]
    check_rendered_places(World.on(read_raster(tmp_path / "map.png", "local", (47.0, 11.0))), places, 200.0)


def test_ground_outside_the_picture_has_the_colour_of_outside(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "map.png"), np.full((100, 100, 3), 200, np.uint8))
    (tmp_path / "map.pgw").write_text(Sheet(50.0, 4.0, 50.0, 100).world_file())
    world = World.on(read_raster(tmp_path / "map.png"))
    far = world.frame.latlon(3000.0, 0.0)
    assert tuple(world.render(Pose(*far, 50.0), LENS)[240, 320]) == OUTSIDE
    assert world.render(Pose(50.0, 4.0, 20.0), LENS, hidden=frozenset({"face-0"}))[240, 320].max() >= 198


def test_exported_map_matches_the_original_map(tmp_path: Path) -> None:
    """The marks of the exported map are at the positions in the original world file."""
    picture, marks = marked()
    cv2.imwrite(str(tmp_path / "map.png"), picture)
    (tmp_path / "map.pgw").write_text(Sheet(50.0, 4.0, 200.0, 400).world_file())
    exported = World.on(read_raster(tmp_path / "map.png")).map(Sheet(50.0, 4.0, 200.0, 400))
    spots = spot_centres(exported)
    for column, row in marks:
        assert min(np.hypot(x - column - 0.5, y - row - 0.5) for x, y in spots) < 0.6


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("map.png", None, "map.pgw"),
        ("map.png", "1\n2\n3\n", "six lines"),
        ("map.png", "0\n0\n0\n0\n4\n50\n", "no size on the ground"),
        ("map.png", "0.5\n0\n0\n-0.5\n533000\n5640000\n", "EPSG:4326"),
        ("map.tif", None, "cannot be read"),
        ("none.png", None, "cannot be read"),
    ],
)
def test_invalid_picture_error_names_the_problem(tmp_path: Path, name: str, content: str | None, message: str) -> None:
    if name == "map.png":
        cv2.imwrite(str(tmp_path / name), np.zeros((10, 10, 3), np.uint8))
    elif name == "map.tif":
        (tmp_path / name).write_bytes(b"II*\0nonsense")
    if content is not None:
        (tmp_path / "map.pgw").write_text(content)
    with pytest.raises(GeoreferenceError, match=message):
        read_raster(tmp_path / name)


@pytest.mark.parametrize(
    ("crs", "message"),
    [("EPSG:999999", "not a coordinate"), ("EPSG:4978", "not projected"), ("mercator", "expected local")],
)
def test_invalid_coordinate_system_is_refused(crs: str, message: str) -> None:
    with pytest.raises(GeoreferenceError, match=message):
        parse_system(crs, None)


def test_sixteen_bit_tiff_is_refused(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "deep.tif", np.zeros((10, 10, 3), np.uint16), photometric="rgb")
    with pytest.raises(GeoreferenceError, match="8 bits"):
        read_raster(tmp_path / "deep.tif")


def test_jpeg_requires_world_file_with_jgw_suffix(tmp_path: Path) -> None:
    with pytest.raises(GeoreferenceError, match=r"map\.jgw"):
        read_world_file(tmp_path / "map.jpg", parse_system("EPSG:4326", None))
