"""Images on disk with their records. Each component instance has a directory. A record suffices to authorize its image later."""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import math
import re
import shutil
import stat
import threading
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from fractus_core.policy.decision_types import Filter, Situation
from fractus_runtime.files import UnsuitableFile, read_json, write_file

from fractus_services.camera.pose import Pose
from fractus_services.errors import NotFound, ResourceExhausted
from fractus_services.grant_files import ActiveGrant

log = logging.getLogger(__name__)

DIRECTORY_MODE = 0o700
FILE_MODE = 0o600
"""Modes that deny access to other users of the node, because images and records disclose where someone was."""

_NAME = re.compile(r"[0-9]{17}-[0-9]{4}\.jpg")
_DIRECTORY = re.compile(r"[0-9a-f]{32}")

_REMEDY = (
    "delete each image after fetching it (camera.delete of the SDK; the component's methods must include DeleteImage)"
)


class ImageStoreFull(ResourceExhausted):
    """A quota is exhausted."""

    def __init__(self, reason: str) -> None:
        super().__init__("AlbumFull", reason)


class NoSuchImage(NotFound):
    """The component instance has no image of this name."""

    def __init__(self, reason: str) -> None:
        super().__init__("NoSuchImage", reason)


@dataclass(frozen=True, slots=True)
class ImageRecord:
    """Record of a stored image, sufficient to authorize it under future policies.

    Attributes:
        name: Name, unique within its component instance.
        time_s: Unix time in seconds.
        width: Width in pixels.
        height: Height in pixels.
        size_bytes: Size of the file.
        poses: Poses of the camera from the start to the end of the exposure.
        face_px: Width of the smallest face that the image may show, in pixels, or 0 if it is unknown.
        filters: Filters that were applied.
        whole: True if the image shows the full view of the camera. A part of the view may show cut faces, so `face_px` is then 0.
    """

    name: str
    time_s: float
    width: int
    height: int
    size_bytes: int
    poses: tuple[Pose, ...]
    face_px: float = 0.0
    filters: tuple[Filter, ...] = ()
    whole: bool = False

    def to_json(self) -> dict[str, Any]:
        """Return the record as JSON values."""
        return asdict(self)

    @classmethod
    def from_json(cls, body: dict[str, Any]) -> ImageRecord:
        """Parse a record. Records of an earlier release may have no poses. Their position is unknown.

        Raises:
            ValueError: The record is invalid.
        """
        try:
            if "poses" not in body:
                known = {key: value for key, value in body.items() if key in cls.__slots__}
                unknown_pose = asdict(Pose.from_situation(Situation(0.0)))
                body = {**known, "poses": [unknown_pose], "face_px": 0.0}
            if not body.get("whole"):
                # Earlier releases stored the face size of cropped images too, but cropped images may show cut faces.
                body = {**body, "face_px": 0.0}
            poses = tuple(Pose.from_json(pose) for pose in body["poses"])
            filters = tuple(Filter(**fields) for fields in body["filters"])
            record = cls(**{**body, "poses": poses, "filters": filters})
            finite = math.isfinite(record.face_px + record.time_s)
            sound = finite and all(pose.apply_to(Situation(0.0)).is_plausible for pose in poses)
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"invalid image record: {error}") from None
        if not poses or not sound:
            raise ValueError("invalid image record: it has no valid pose")
        return record


def owner_of(grant: ActiveGrant) -> str:
    """Return the owner of the images taken under a Grant.

    The uid distinguishes applications that use the same name one after the other.
    """
    return f"{grant.spec.application.uid}/{grant.identity}"


class ImageStore:
    """Images of all component instances on this node. An owner is one instance of one application.

    Args:
        directory: Directory of the images.
        keep: Maximum number of images of an owner.
        keep_bytes: Maximum size of the images of an owner, in bytes.
        keep_total_bytes: Maximum size of all images, in bytes. Images of owners without a Grant are removed to stay below it.
        owners: Returns the owners that have a Grant now.
        on_added: Callback invoked with the owner, the time (Unix seconds) and the data of each new image, from any thread.
    """

    def __init__(
        self,
        directory: Path,
        keep: int,
        keep_bytes: int,
        keep_total_bytes: int = 10**13,
        owners: Callable[[], Iterable[str]] = tuple,
        *,
        on_added: Callable[[str, float, bytes], None] = lambda _owner, _time_s, _data: None,
    ) -> None:
        self._on_added = on_added
        self._directory = directory
        self._keep = keep
        self._keep_bytes = keep_bytes
        self._keep_total_bytes = keep_total_bytes
        self._owners = owners
        self._lock = threading.Lock()
        self._restrict_modes()
        self._remove_incomplete()

    def _owner_directory(self, owner: str) -> Path:
        return self._directory / hashlib.sha256(owner.encode()).hexdigest()[:32]

    def list(self, owner: str) -> tuple[ImageRecord, ...]:
        """Return the records of an owner's images, oldest first."""
        records = []
        for path in sorted(self._owner_directory(owner).glob("*.json")):
            try:
                records.append(ImageRecord.from_json(read_json(path)))
            except FileNotFoundError:
                continue
            except (UnsuitableFile, ValueError) as error:
                log.warning("images: damaged record skipped (file=%s error=%s)", path, error)
        return tuple(records)

    def quota_problem(self, owner: str) -> str:
        """Return the reason why an owner may not add an image, or an empty string."""
        sizes = _file_sizes(self._owner_directory(owner).glob("*.jpg"))
        used = sum(sizes)
        if len(sizes) >= self._keep:
            return f"{len(sizes)} images are stored, which is the limit; {_REMEDY}"
        if used >= self._keep_bytes:
            return f"{used / 1e6:.0f} MB of images are stored, which is the limit; {_REMEDY}"
        if self._total_bytes() >= self._keep_total_bytes and not self._make_room():
            return (
                f"the images on this node take {self._keep_total_bytes / 1e6:.0f} MB, which is the limit; {_REMEDY},"
                " or ask the node's administrator to raise --keep-total-mb"
            )
        return ""

    def add(self, owner: str, record: ImageRecord, data: bytes) -> None:
        """Store an image.

        Raises:
            ImageStoreFull: A quota is exhausted.
            OSError: The disk is full or failed.
        """
        with self._lock:
            problem = self.quota_problem(owner)
            if problem:
                raise ImageStoreFull(problem)
            directory = self._owner_directory(owner)
            directory.mkdir(DIRECTORY_MODE, parents=True, exist_ok=True)
            image = directory / record.name
            try:
                write_file(image, data, FILE_MODE)
                write_file(image.with_suffix(".json"), json.dumps(record.to_json()).encode(), FILE_MODE)
            except OSError:
                image.unlink(missing_ok=True)
                raise
        self._on_added(owner, record.time_s, data)

    def find(self, owner: str, name: str) -> ImageRecord:
        """Return the record of an image.

        Raises:
            NoSuchImage: The image does not exist, or its record is damaged. Without a record, policies cannot be applied.
        """
        path = self._record_path(owner, name)
        try:
            return ImageRecord.from_json(read_json(path))
        except FileNotFoundError:
            raise _not_found(name) from None
        except (UnsuitableFile, ValueError) as error:
            log.warning("images: image with damaged record not returned (image=%s error=%s)", name, error)
            raise NoSuchImage(
                f"the record of image {name!r} is damaged, so the image is not returned; DeleteImage removes it"
            ) from None

    def _record_path(self, owner: str, name: str) -> Path:
        if not _NAME.fullmatch(name):
            raise _not_found(name)
        return (self._owner_directory(owner) / name).with_suffix(".json")

    def path(self, owner: str, name: str) -> Path:
        """Return the file of an image for which `find` returned a record."""
        return self._owner_directory(owner) / name

    def delete(self, owner: str, name: str) -> None:
        """Delete an image, even if its record is damaged.

        Raises:
            NoSuchImage: The image does not exist.
        """
        record_path = self._record_path(owner, name)
        try:
            # Delete the record first. If the process ends now, the image has no record and is never returned.
            record_path.unlink()
        except FileNotFoundError:
            raise _not_found(name) from None
        record_path.with_suffix(".jpg").unlink(missing_ok=True)

    def _total_bytes(self) -> int:
        return sum(_file_sizes(self._directory.glob("*/*.jpg")))

    def _make_room(self) -> bool:
        """Remove images of owners without a Grant, oldest directory first. Return True once the total is below its limit."""
        kept = {self._owner_directory(owner) for owner in self._owners()}
        orphaned = [path for path in self._directory.iterdir() if path.is_dir() and path not in kept]
        for directory in sorted(orphaned, key=lambda path: path.stat().st_mtime):
            log.warning(
                "images: removing images of a component without a Grant to free space (directory=%s)", directory
            )
            shutil.rmtree(directory, ignore_errors=True)
            if self._total_bytes() < self._keep_total_bytes:
                return True
        return False

    def _restrict_modes(self) -> None:
        """Remove access for other users from directories and files of an earlier release."""
        # The state directory may also contain directories that do not belong to owners.
        directories = [path for path in self._directory.glob("*") if _DIRECTORY.fullmatch(path.name)]
        for path in (entry for directory in directories for entry in (directory, *directory.glob("*"))):
            try:
                mode = path.lstat().st_mode
                required = DIRECTORY_MODE if stat.S_ISDIR(mode) else FILE_MODE
                # Skip symbolic links, because chmod would follow them to other files.
                if not stat.S_ISLNK(mode) and stat.S_IMODE(mode) != required:
                    path.chmod(required)
            except OSError as error:
                log.critical(
                    "images: cannot restrict access, other users may read this file; run chmod (path=%s error=%s)",
                    path, error,
                )  # fmt: skip

    def _remove_incomplete(self) -> None:
        """Remove temporary files, images without a readable record, and damaged records with their images.

        These can remain after a crash, a disk failure or another release.
        """
        for record_path in self._directory.glob("*/*.json"):
            if not _NAME.fullmatch(record_path.with_suffix(".jpg").name):
                continue
            try:
                ImageRecord.from_json(read_json(record_path))
            except (UnsuitableFile, ValueError) as error:
                log.warning("images: removing damaged record and its image (file=%s error=%s)", record_path, error)
                record_path.unlink(missing_ok=True)
            except OSError as error:
                log.warning("images: cannot read record (file=%s error=%s)", record_path, error)
        for path in self._directory.glob("*/*"):
            orphan = path.suffix == ".jpg" and not path.with_suffix(".json").exists()
            if orphan or path.suffix == ".tmp":
                with contextlib.suppress(OSError):
                    path.unlink(missing_ok=True)


def _file_sizes(paths: Iterable[Path]) -> list[int]:
    """Return the sizes in bytes of the files that still exist."""
    sizes = []
    for path in paths:
        with contextlib.suppress(FileNotFoundError):
            sizes.append(path.stat().st_size)
    return sizes


def _not_found(name: str) -> NoSuchImage:
    return NoSuchImage(f"this component has no image {name[:64]!r}; ListImages returns the existing images")
