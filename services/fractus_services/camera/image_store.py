"""Pictures on disk, one folder for each component instance, within quotas."""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import re
import shutil
import stat
import threading
from collections.abc import Callable, Iterable
from pathlib import Path

from fractus_runtime.files import write_file

from fractus_services.camera.image_record import ImageRecord
from fractus_services.errors import NotFound, ResourceExhausted
from fractus_services.grant_files import ActiveGrant

log = logging.getLogger(__name__)

FOLDER_MODE, FILE_MODE = 0o700, 0o600
"""No other user of the node reads pictures or their records, filtered or not: both tell where someone was."""

_NAME = re.compile(r"[0-9]{17}-[0-9]{4}\.jpg")
_FOLDER = re.compile(r"[0-9a-f]{32}")


_REMEDY = "delete each picture once it is fetched (camera.delete of the SDK; the component's methods need DeleteImage)"


class ImageStoreFull(ResourceExhausted):
    """A quota is used up."""

    def __init__(self, reason: str) -> None:
        super().__init__("AlbumFull", reason)


class NoSuchImage(NotFound):
    """An instance has no picture of that name."""

    def __init__(self, reason: str) -> None:
        super().__init__("NoSuchImage", reason)


def owner_of(grant: ActiveGrant) -> str:
    """Whose pictures they are: an instance of this very application, not of a later one of the same name."""
    return f"{grant.spec.application.uid}/{grant.identity}"


class ImageStore:
    """The pictures of all instances on this node; an owner is one instance of one application.

    Args:
        directory: where they are kept.
        keep: pictures that one instance may have.
        keep_bytes: bytes that the pictures of one instance may take.
        keep_total_bytes: bytes that all pictures may take; pictures of owners that are gone make room.
        owners: owners that have a grant at present.
        added: told when each new picture was taken (Unix seconds), and what it is; from any thread.
    """

    def __init__(
        self,
        directory: Path,
        keep: int,
        keep_bytes: int,
        keep_total_bytes: int = 10**13,
        owners: Callable[[], Iterable[str]] = tuple,
        *,
        added: Callable[[float, bytes], None] = lambda _time_s, _data: None,
    ) -> None:
        self._added = added
        self._directory = directory
        self._keep = keep
        self._keep_bytes = keep_bytes
        self._keep_total_bytes = keep_total_bytes
        self._owners = owners
        self._lock = threading.Lock()
        self._close_to_others()
        self._tidy()

    def _folder(self, owner: str) -> Path:
        return self._directory / hashlib.sha256(owner.encode()).hexdigest()[:32]

    def list(self, owner: str) -> tuple[ImageRecord, ...]:
        """The pictures of an instance, oldest first."""
        shots = []
        for path in sorted(self._folder(owner).glob("*.json")):
            try:
                shots.append(ImageRecord.parse(json.loads(path.read_bytes())))
            except FileNotFoundError:
                continue
            except ValueError as error:
                log.warning("album: record is damaged, its picture is not returned (file=%s): %s", path, error)
        return tuple(shots)

    def quota_problem(self, owner: str) -> str:
        """Why an instance may not add a picture; empty when it may."""
        sizes = _sizes(self._folder(owner).glob("*.jpg"))
        used = sum(sizes)
        if len(sizes) >= self._keep:
            return f"{len(sizes)} pictures are kept, as many as allowed; {_REMEDY}"
        if used >= self._keep_bytes:
            return f"{used / 1e6:.0f} MB of pictures are kept, as much as allowed; {_REMEDY}"
        if self._total() >= self._keep_total_bytes and not self._make_room():
            return (
                f"the pictures on this node take {self._keep_total_bytes / 1e6:.0f} MB, as much as allowed; {_REMEDY},"
                " or let the node's operator raise --keep-total-mb"
            )
        return ""

    def add(self, owner: str, shot: ImageRecord, data: bytes) -> None:
        """Keep a picture.

        Raises:
            ImageStoreFull: a quota is used up.
            OSError: the disk is full.
        """
        with self._lock:
            problem = self.quota_problem(owner)
            if problem:
                raise ImageStoreFull(problem)
            folder = self._folder(owner)
            folder.mkdir(FOLDER_MODE, parents=True, exist_ok=True)
            picture = folder / shot.name
            try:
                write_file(picture, data, FILE_MODE)
                write_file(picture.with_suffix(".json"), json.dumps(shot.to_json()).encode(), FILE_MODE)
            except OSError:
                picture.unlink(missing_ok=True)
                raise
        self._added(shot.time_s, data)

    def find(self, owner: str, name: str) -> ImageRecord:
        """What is known of a picture.

        Raises:
            NoSuchImage: there is none of that name, or its record is damaged: what it shows is then unknown,
                so no policy can be applied to it.
        """
        record = self._record(owner, name)
        try:
            return ImageRecord.parse(json.loads(record.read_bytes()))
        except FileNotFoundError:
            raise _missing(name) from None
        except ValueError as error:
            log.warning("album: record is damaged, its picture is not returned (picture=%s): %s", name, error)
            raise NoSuchImage(
                f"the record of picture {name!r} is damaged, so it is not returned; DeleteImage removes it"
            ) from None

    def _record(self, owner: str, name: str) -> Path:
        if not _NAME.fullmatch(name):
            raise _missing(name)
        return (self._folder(owner) / name).with_suffix(".json")

    def path(self, owner: str, name: str) -> Path:
        """The file of a picture that `find` knows."""
        return self._folder(owner) / name

    def delete(self, owner: str, name: str) -> None:
        """Remove a picture, also one with a damaged record.

        Raises:
            NoSuchImage: there is none of that name.
        """
        record = self._record(owner, name)
        try:
            # The record goes first: a picture without one is never returned, whenever the process ends.
            record.unlink()
        except FileNotFoundError:
            raise _missing(name) from None
        record.with_suffix(".jpg").unlink(missing_ok=True)

    def _total(self) -> int:
        return sum(_sizes(self._directory.glob("*/*.jpg")))

    def _make_room(self) -> bool:
        """Remove pictures of owners that are gone, oldest folder first, until there is room."""
        kept = {self._folder(owner) for owner in self._owners()}
        gone = [path for path in self._directory.iterdir() if path.is_dir() and path not in kept]
        for folder in sorted(gone, key=lambda path: path.stat().st_mtime):
            log.warning("album: removing pictures of a component that is gone, space is needed (folder=%s)", folder)
            shutil.rmtree(folder, ignore_errors=True)
            if self._total() < self._keep_total_bytes:
                return True
        return False

    def _close_to_others(self) -> None:
        """Give folders and pictures of an earlier release, which others could read, the modes of this one."""
        # The state directory may hold folders of others beside those of owners.
        folders = [path for path in self._directory.glob("*") if _FOLDER.fullmatch(path.name)]
        for path in (inner for folder in folders for inner in (folder, *folder.glob("*"))):
            try:
                found = path.lstat().st_mode
                wanted = FOLDER_MODE if stat.S_ISDIR(found) else FILE_MODE
                # A symbolic link is none of the album's: chmod would follow it to a file elsewhere.
                if not stat.S_ISLNK(found) and stat.S_IMODE(found) != wanted:
                    path.chmod(wanted)
            except OSError as error:
                log.critical(
                    "album: other users of the node may read this, chmod it by hand (path=%s): %s", path, error
                )

    def _tidy(self) -> None:
        """Remove what can never be returned: unfinished files, and pictures without a readable record.

        A crash, a damaged disk or another release may have left them.
        """
        for record in self._directory.glob("*/*.json"):
            if not _NAME.fullmatch(record.with_suffix(".jpg").name):
                continue
            try:
                ImageRecord.parse(json.loads(record.read_bytes()))
            except ValueError as error:
                log.warning("album: record is damaged, removing it and its picture (file=%s): %s", record, error)
                record.unlink(missing_ok=True)
            except OSError as error:
                log.warning("album: record cannot be read (file=%s): %s", record, error)
        for path in self._directory.glob("*/*"):
            orphan = path.suffix == ".jpg" and not path.with_suffix(".json").exists()
            if orphan or path.suffix == ".tmp":
                path.unlink(missing_ok=True)


def _sizes(paths: Iterable[Path]) -> list[int]:
    """Bytes of those files that are still there."""
    sizes = []
    for path in paths:
        with contextlib.suppress(FileNotFoundError):
            sizes.append(path.stat().st_size)
    return sizes


def _missing(name: str) -> NoSuchImage:
    return NoSuchImage(f"there is no picture {name[:64]!r} of this component; ListImages lists those that exist")
