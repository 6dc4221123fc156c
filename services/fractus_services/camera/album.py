"""Pictures on disk, one folder for each component instance, within a quota."""

from __future__ import annotations

import hashlib
import json
import os
import re
from dataclasses import asdict, dataclass
from pathlib import Path

_NAME = re.compile(r"^[0-9]{17}-[0-9]{4}\.jpg$")


class AlbumFull(Exception):
    """The quota of an instance is used up."""


class NoSuchImage(Exception):
    """An instance has no picture of that name."""


@dataclass(frozen=True, slots=True)
class Shot:
    """A picture that was taken.

    Attributes:
        name: unique within its instance.
        time_s: Unix time.
        width: pixels.
        height: pixels.
        size_bytes: of the file.
        lat: where the camera was; None when that was unknown.
        lon: as lat.
        altitude_m: above home.
        position_error_m: bound of the error of lat and lon.
    """

    name: str
    time_s: float
    width: int
    height: int
    size_bytes: int
    lat: float | None
    lon: float | None
    altitude_m: float
    position_error_m: float = 10.0


class Album:
    """The pictures of all instances on this node; an owner is one instance of one application.

    Args:
        directory: where they are kept.
        keep: pictures that one instance may have.
        keep_bytes: bytes that the pictures of one instance may take.
    """

    def __init__(self, directory: Path, keep: int, keep_bytes: int) -> None:
        self._directory = directory
        self._keep = keep
        self._keep_bytes = keep_bytes

    def _folder(self, owner: str) -> Path:
        return self._directory / hashlib.sha256(owner.encode()).hexdigest()[:32]

    def list(self, owner: str) -> tuple[Shot, ...]:
        """The pictures of an instance, oldest first."""
        return tuple(Shot(**json.loads(path.read_bytes())) for path in sorted(self._folder(owner).glob("*.json")))

    def room(self, owner: str) -> str:
        """Why an instance may not add a picture; empty when it may."""
        shots = self.list(owner)
        used = sum(shot.size_bytes for shot in shots)
        if len(shots) >= self._keep:
            return f"{len(shots)} pictures are kept, as many as allowed; delete some"
        if used >= self._keep_bytes:
            return f"{used / 1e6:.0f} MB of pictures are kept, as much as allowed; delete some"
        return ""

    def add(self, owner: str, shot: Shot, data: bytes) -> None:
        """Keep a picture.

        Raises:
            AlbumFull: the quota is used up.
            OSError: the disk is full.
        """
        problem = self.room(owner)
        if problem:
            raise AlbumFull(problem)
        folder = self._folder(owner)
        folder.mkdir(parents=True, exist_ok=True)
        picture = folder / shot.name
        try:
            _write(picture, data)
            _write(picture.with_suffix(".json"), json.dumps(asdict(shot)).encode())
        except OSError:
            picture.unlink(missing_ok=True)
            raise

    def find(self, owner: str, name: str) -> Shot:
        """What is known of a picture.

        Raises:
            NoSuchImage: there is none of that name.
        """
        path = self._folder(owner) / name
        if not _NAME.match(name) or not path.with_suffix(".json").is_file():
            raise NoSuchImage(f"there is no picture {name[:64]!r} of this component; ListImages tells which there are")
        return Shot(**json.loads(path.with_suffix(".json").read_bytes()))

    def read(self, owner: str, name: str) -> bytes:
        """A picture's bytes.

        Raises:
            NoSuchImage: there is none of that name.
        """
        self.find(owner, name)
        return (self._folder(owner) / name).read_bytes()

    def delete(self, owner: str, name: str) -> None:
        """Remove a picture.

        Raises:
            NoSuchImage: there is none of that name.
        """
        self.find(owner, name)
        path = self._folder(owner) / name
        path.unlink(missing_ok=True)
        path.with_suffix(".json").unlink()


def _write(path: Path, data: bytes) -> None:
    fresh = path.with_suffix(path.suffix + ".new")
    try:
        with fresh.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        fresh.replace(path)
    except OSError:
        fresh.unlink(missing_ok=True)
        raise
