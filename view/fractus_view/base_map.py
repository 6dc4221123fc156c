"""Offline base map: raster tiles of a PMTiles archive, or of a directory Z/X/Y.png."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from fractus_runtime.files import open_file, path_text, read_file
from pmtiles.reader import Reader
from pmtiles.tile import Compression, TileType

MAX_TILE_BYTES = 1_000_000
"""Maximum size of a tile. Larger tiles are not shown."""

MAX_READ_BYTES = 16_000_000
"""Maximum size of a directory in an archive."""

MAX_ZOOM = 24
MAX_ATTRIBUTION = 300
"""Maximum length of the shown attribution, in characters."""

TILE_TYPES = ("png", "jpg", "jpeg", "webp")
"""Suffixes of tiles in a directory."""

_SIGNATURES = ((b"\x89PNG\r\n\x1a\n", "image/png"), (b"\xff\xd8\xff", "image/jpeg"), (b"RIFF", "image/webp"))
_RASTER = frozenset({TileType.PNG, TileType.JPEG, TileType.WEBP})


class UnsuitableMap(ValueError):
    """The path is not a base map that the page can show. The message contains the remedy."""


@dataclass(frozen=True, slots=True)
class MapInfo:
    """Description of a base map.

    Attributes:
        min_zoom: Lowest zoom level with tiles.
        max_zoom: Highest zoom level with tiles.
        attribution: Name of the owner of the data, as plain text.
    """

    min_zoom: int
    max_zoom: int
    attribution: str


class BaseMap(Protocol):
    """Source of tiles."""

    info: MapInfo

    def tile(self, zoom: int, x: int, y: int) -> bytes | None:
        """Return a tile in Web Mercator, or None if there is none. The method reads a file."""
        ...


class TileDirectory:
    """Tiles in files Z/X/Y.png (or jpg, jpeg, webp). The optional file `attribution.txt` names the owner of the data.

    Args:
        root: The directory.

    Raises:
        UnsuitableMap: The directory contains no zoom levels.
        OSError: The directory cannot be read.
    """

    def __init__(self, root: Path) -> None:
        self._root = root.resolve()
        names = (path.name for path in self._root.iterdir() if path.is_dir())
        zooms = [int(name) for name in names if re.fullmatch("[0-9]{1,2}", name) and int(name) <= MAX_ZOOM]
        if not zooms:
            raise UnsuitableMap(f"{path_text(root)} contains no tiles; specify a directory with files Z/X/Y.png")
        attribution = self._root / "attribution.txt"
        text = read_file(attribution, MAX_TILE_BYTES).decode(errors="replace") if attribution.exists() else ""
        self.info = MapInfo(min(zooms), max(zooms), _plain(text))

    def tile(self, zoom: int, x: int, y: int) -> bytes | None:
        """See `BaseMap`. Links out of the directory are not followed."""
        for suffix in TILE_TYPES:
            path = (self._root / str(zoom) / str(x) / f"{y}.{suffix}").resolve()
            if path.is_relative_to(self._root):
                try:
                    return read_file(path, MAX_TILE_BYTES)
                except OSError:
                    continue
        return None


class TileArchive:
    """Raster tiles in a PMTiles archive (version 3).

    Args:
        path: The archive.

    Raises:
        UnsuitableMap: The file is no PMTiles archive, is damaged, or contains vector tiles.
        OSError: The file cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self._file = open_file(path)
        self._reader = Reader(self._read)
        try:
            header = self._reader.header()
            metadata = self._reader.metadata()
        except Exception as error:  # The library raises errors of many types for damaged archives.
            raise UnsuitableMap(
                f"{path_text(path)} is not a PMTiles archive of version 3; specify such an archive, or a directory of tiles"
            ) from error
        if header["tile_type"] not in _RASTER or header["tile_compression"] not in {
            Compression.NONE,
            Compression.UNKNOWN,
        }:
            raise UnsuitableMap(
                f"{path_text(path)} contains no PNG, JPEG or WebP tiles; convert it to an archive with raster tiles"
            )
        text = metadata.get("attribution", "") if isinstance(metadata, dict) else ""
        self.info = MapInfo(header["min_zoom"], header["max_zoom"], _plain(str(text)))

    def _read(self, offset: int, length: int) -> bytes:
        if length > MAX_READ_BYTES:
            raise ValueError("too large")
        # Several threads read at the same time, so the position of the file must not change.
        return os.pread(self._file.fileno(), length, offset)

    def tile(self, zoom: int, x: int, y: int) -> bytes | None:
        """See `BaseMap`. The result is also None if the archive is damaged."""
        try:
            data: bytes | None = self._reader.get(zoom, x, y)
        except Exception:  # The library raises errors of many types for damaged archives.
            return None
        return data if data and len(data) <= MAX_TILE_BYTES else None


def open_map(path: Path) -> BaseMap:
    """Open a directory of tiles or a PMTiles archive.

    Raises:
        UnsuitableMap: The path is not a base map that the page can show.
        OSError: The path cannot be read.
    """
    return TileDirectory(path) if path.is_dir() else TileArchive(path)


def image_type(data: bytes) -> str | None:
    """Return the content type of a tile by its first bytes, or None if it is no PNG, JPEG or WebP image."""
    return next((type_ for signature, type_ in _SIGNATURES if data.startswith(signature)), None)


def _plain(text: str) -> str:
    """Return text without HTML tags, which attributions often contain."""
    return " ".join(re.sub(r"<[^>]*>", "", text).split())[:MAX_ATTRIBUTION]
