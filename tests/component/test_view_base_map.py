"""Offline base map of the live view: tiles of directories and archives."""

from __future__ import annotations

import asyncio
import io
from collections.abc import Mapping
from pathlib import Path

import pytest
from aiohttp import ClientSession, hdrs, web
from click.testing import CliRunner
from fractus_view import base_map
from fractus_view.base_map import BaseMap, open_map
from fractus_view.command import view
from fractus_view.server import TRANSPARENT_PNG, ViewServer
from fractus_view.sources import Replay
from PIL import Image
from pmtiles.tile import Compression, TileType, zxy_to_tileid
from pmtiles.writer import write

Tiles = Mapping[tuple[int, int, int], bytes]


def png(colour: str) -> bytes:
    buffer = io.BytesIO()
    Image.new("RGB", (256, 256), colour).save(buffer, "PNG")
    return buffer.getvalue()


TILES: Tiles = {(0, 0, 0): png("red"), (1, 0, 1): png("blue")}


def write_archive(path: Path, tiles: Tiles = TILES, type_: TileType = TileType.PNG) -> Path:
    header = {
        "tile_type": type_, "tile_compression": Compression.NONE, "center_zoom": 0, "center_lon_e7": 0, "center_lat_e7": 0,
        "min_lon_e7": -1_800_000_000, "max_lon_e7": 1_800_000_000, "min_lat_e7": -850_000_000, "max_lat_e7": 850_000_000,
    }  # fmt: skip
    with write(path) as archive:
        for place, data in sorted(tiles.items()):
            archive.write_tile(zxy_to_tileid(*place), data)
        archive.finalize(header, {"attribution": '<a href="https://osm.org">OpenStreetMap</a>  contributors'})
    return path


def write_directory(path: Path, tiles: Tiles = TILES) -> Path:
    for (zoom, x, y), data in tiles.items():
        file = path / str(zoom) / str(x) / f"{y}.png"
        file.parent.mkdir(parents=True)
        file.write_bytes(data)
    (path / "attribution.txt").write_text("<b>OpenStreetMap</b> contributors\n")
    return path


@pytest.fixture(params=["archive", "directory"])
def base(request: pytest.FixtureRequest, tmp_path: Path) -> BaseMap:
    path = tmp_path / "map"
    return open_map(write_archive(path) if request.param == "archive" else write_directory(path))


def test_base_map_returns_its_tiles_and_attribution_as_plain_text(base: BaseMap) -> None:
    assert (base.info.min_zoom, base.info.max_zoom) == (0, 1)
    assert base.info.attribution == "OpenStreetMap contributors"
    assert base.tile(0, 0, 0) == TILES[0, 0, 0]
    assert base.tile(1, 0, 1) == TILES[1, 0, 1]
    assert base.tile(1, 1, 1) is None


def test_too_large_tile_is_not_returned(base: BaseMap, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(base_map, "MAX_TILE_BYTES", len(TILES[0, 0, 0]) - 1)
    assert base.tile(0, 0, 0) is None


def test_link_out_of_the_directory_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "secret.png").write_bytes(png("green"))
    root = write_directory(tmp_path / "map")
    (root / "1" / "0" / "0.png").symlink_to(tmp_path / "secret.png")
    (root / "1" / "1").symlink_to(tmp_path)
    (tmp_path / "0.png").write_bytes(png("green"))
    opened = open_map(root)
    assert opened.tile(1, 0, 0) is None
    assert opened.tile(1, 1, 0) is None


def test_damaged_archive_returns_no_tile(tmp_path: Path) -> None:
    path = write_archive(tmp_path / "map")
    opened = open_map(path)
    data = bytearray(path.read_bytes())
    data[127:150] = b"\xff" * 23
    path.write_bytes(data)
    assert opened.tile(0, 0, 0) is None


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"no archive", "is not a PMTiles archive of version 3"),
        (b"PMTiles\x02" + bytes(200), "is not a PMTiles archive of version 3"),
        (b"", "is not a PMTiles archive of version 3"),
    ],
)
def test_other_file_is_refused_with_remedy(content: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "map"
    path.write_bytes(content)
    result = CliRunner().invoke(view, ["--map", str(path), "--recordings", str(tmp_path)])
    assert result.exit_code == 1
    assert message in result.output


def test_vector_tiles_and_empty_directory_are_refused_with_remedy(tmp_path: Path) -> None:
    vector = write_archive(tmp_path / "vector", type_=TileType.MVT)
    (tmp_path / "empty").mkdir()
    for path, message in ((vector, "convert it to an archive with raster tiles"), (tmp_path / "empty", "Z/X/Y.png")):
        result = CliRunner().invoke(view, ["--map", str(path), "--recordings", str(tmp_path)])
        assert result.exit_code == 1
        assert message in result.output


async def responses(base: BaseMap | None, *paths: str, token: bool = True) -> list[tuple[int, bytes]]:
    """Return status and body of each path."""
    server = ViewServer(Replay([]), frozenset(), base_map=base)
    runner = web.AppRunner(server.application(), shutdown_timeout=0.1)
    await runner.setup()
    await web.TCPSite(runner, "127.0.0.1", 0).start()
    headers = {hdrs.AUTHORIZATION: f"Bearer {server.token}"} if token else {}
    results = []
    try:
        async with asyncio.timeout(20), ClientSession(headers=headers) as session:
            for path in paths:
                async with session.get(f"http://127.0.0.1:{runner.addresses[0][1]}{path}") as response:
                    results.append((response.status, await response.read()))
    finally:
        await runner.cleanup()
    return results


async def test_server_serves_tiles_only_by_number(base: BaseMap) -> None:
    info, tile, missing = await responses(base, "/map.json", "/tiles/0/0/0", "/tiles/1/1/1")
    assert info == (200, b'{"min_zoom": 0, "max_zoom": 1, "attribution": "OpenStreetMap contributors"}')
    assert tile == (200, TILES[0, 0, 0])
    assert missing == (200, TRANSPARENT_PNG)
    wrong = (
        "/tiles/0/1/0",
        "/tiles/25/0/0",
        "/tiles/0/0/-1",
        "/tiles/0/0/0.png",
        "/tiles/0/..%2f0/0",
        "/tiles/..%2f..%2fetc/0/0",
    )
    assert {status for status, _ in await responses(base, *wrong)} == {404}
    assert {status for status, _ in await responses(base, "/tiles/0/0/0", "/map.json", token=False)} == {401}


async def test_server_does_not_serve_files_that_are_no_images(tmp_path: Path) -> None:
    root = write_directory(tmp_path / "map", {(0, 0, 0): b"<html>"})
    assert await responses(open_map(root), "/tiles/0/0/0") == [(200, TRANSPARENT_PNG)]


async def test_server_without_base_map_says_so() -> None:
    info, tile = await responses(None, "/map.json", "/tiles/0/0/0")
    assert info == (200, b"null")
    assert tile[0] == 404
