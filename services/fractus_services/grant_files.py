"""Grant files of this node: rescanned, verified, compiled, and looked up by caller identity."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from fractus_core.api.grants import Grant, GrantSpec
from fractus_core.api.model import InvalidObject
from fractus_core.policy.compiled_grant import CompiledGrant, compile_grant
from fractus_core.policy.grant_signatures import BadSignature
from fractus_runtime.files import UnsuitableFile, list_files, path_text, read_json

from fractus_services.grant_verifier import GrantVerifier

log = logging.getLogger(__name__)

RESCAN_INTERVAL_S = 0.25
"""Interval at which the directory is scanned. It bounds the time until a removed Grant is revoked, on any file system."""
SETTLE_S = 0.05
"""Delay between the detection of a changed file and its reading."""
MAX_GRANT_BYTES = 64 * 2**20
"""Maximum size of a Grant file, as large as all Grants of a node together."""
_Stamp = tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class ActiveGrant:
    """A Grant in force on this node.

    Attributes:
        key: Key of the mission, derived from signed content.
        name: Name of the Grant.
        spec: Spec of the Grant.
        compiled: Compiled policies.
        digest: Digest of the Grant with its signature.
    """

    key: str
    name: str
    spec: GrantSpec
    compiled: CompiledGrant
    digest: str = ""

    @property
    def identity(self) -> str:
        """SPIFFE ID of the component instance."""
        return self.compiled.identity


Listener = Callable[[ActiveGrant | None, ActiveGrant | None], None]
"""Callback invoked with the Grant before and after a change, or None for no Grant."""

RejectionCallback = Callable[[str, str], None]
"""Callback invoked with the name of a rejected file and the reason."""


class GrantFiles:
    """Grants in a directory of Grant manifests.

    A file that cannot be read or parsed, or that the operator did not sign, grants nothing. If a file becomes invalid, its Grant
    is revoked, because its restrictions are then unknown. The same applies if the path is not a regular file, or the file is too large. After
    a disk error the Grant returns when the file can be read again.

    Args:
        directory: Directory in which the agent stores the Grants. It may not exist yet.
        node: Node for which the Grants must be issued.
        verifier: Verifies signatures.
        flat_terrain: See `compile_grant`.
        refused: Callback invoked for rejected files.
    """

    def __init__(
        self,
        directory: Path,
        node: str,
        verifier: GrantVerifier,
        flat_terrain: bool = False,
        refused: RejectionCallback = lambda _name, _reason: None,
    ) -> None:
        self._directory = directory
        self._node = node
        self._verifier = verifier
        self._flat_terrain = flat_terrain
        self._refused = refused
        self._saving: asyncio.Task[None] | None = None
        self._stamps: dict[Path, _Stamp] = {}
        self._loaded: dict[Path, ActiveGrant | None] = {}
        self._problems: dict[Path, str] = {}
        """Reported reason why each file cannot be read now. These files are read again at each scan."""
        self._unreadable: dict[Path, ActiveGrant] = {}
        """Grants whose files cannot be read now. They are not in force, and are revoked if their files are removed."""
        self._directory_listed = False
        self._directory_problem = ""
        self._active: dict[str, ActiveGrant] = {}
        self._listeners: list[Listener] = []
        self._reading = threading.Lock()

    @property
    def active(self) -> Mapping[str, ActiveGrant]:
        """Grants in force, by identity."""
        return self._active

    def listen(self, listener: Listener) -> None:
        """Add a listener that is called at each change."""
        self._listeners.append(listener)

    async def run(self) -> None:
        """Scan the directory every `RESCAN_INTERVAL_S` seconds until cancelled."""
        # Create the directory only once. If it disappears later, its disk may have failed. An empty new directory would
        # then look as if all Grants had been removed.
        with contextlib.suppress(OSError):
            self._directory.mkdir(parents=True, exist_ok=True)
        while True:
            await self._scan_in_thread()
            self._store_memory()
            await asyncio.sleep(RESCAN_INTERVAL_S)

    def _store_memory(self) -> None:
        """Store the latest Grants in a thread, because a hanging disk must not delay a change of Grants."""
        if self._saving is None or self._saving.done():
            content = self._verifier.unsaved()
            if content is not None:
                self._saving = asyncio.create_task(asyncio.to_thread(self._verifier.store, content))

    def scan(self) -> None:
        """Read changed files and update the Grants in force."""
        if self._read_changes():
            self._replace()

    async def _scan_in_thread(self) -> None:
        """Scan in a thread, because Grants of large areas take seconds to compile while a flight has to be monitored."""
        if await asyncio.to_thread(self._read_changes):
            self._replace()

    def _read_changes(self) -> bool:
        """Read the files that changed. Return True if there are any."""
        # A cancelled scan may still be reading in its thread.
        with self._reading:
            return self._read_changes_locked()

    def _read_changes_locked(self) -> bool:
        stamps, complete = self._list()
        authorities_changed = self._verifier.reload_authorities()
        may_revoke = complete and bool(self._unreadable)
        if stamps == self._stamps and not authorities_changed and not self._problems and not may_revoke:
            return False
        if self._stamps and stamps != self._stamps:
            # A file that is copied in place is incomplete for a moment.
            time.sleep(SETTLE_S)
            stamps, complete = self._list()
        before = dict(self._loaded)
        for path in self._stamps.keys() - stamps.keys():
            missing = self._loaded.pop(path, None)
            self._problems.pop(path, None)
            if missing is not None and not complete:
                self._unreadable[path] = missing
        for path, stamp in stamps.items():
            if (
                self._stamps.get(path) != stamp
                or path in self._problems
                or (authorities_changed and self._loaded.get(path) is None)
            ):
                self._loaded[path] = self._load(path)
        changed = authorities_changed or stamps != self._stamps
        self._stamps = stamps
        if complete:
            renamed = {grant.digest for grant in self._loaded.values() if grant is not None}
            for path in (before.keys() | self._unreadable.keys()) - self._loaded.keys():
                removed = before.get(path) or self._unreadable.pop(path, None)
                if removed is not None and removed.digest not in renamed:
                    self._revoke(removed)
        return changed or any(before.get(path) is not grant for path, grant in self._loaded.items())

    def _list(self) -> tuple[dict[Path, _Stamp], bool]:
        """Return the stamps of the files. The second value is False if missing files may be unreadable rather than removed."""
        stamps: dict[Path, _Stamp] = {}
        complete = True
        try:
            for path in list_files(self._directory, ".json"):
                try:
                    stat = path.stat()
                    stamps[path] = (stat.st_mtime_ns, stat.st_size, stat.st_ino)
                except FileNotFoundError:
                    continue
                except OSError as error:
                    stamps[path] = (0, 0, -(error.errno or 1))  # reading the file reports the error
        except OSError as error:
            stamps = {}
            complete = False
            # Before the first start, the directory does not exist yet.
            expected = isinstance(error, FileNotFoundError) and not self._directory_listed
            if self._directory_problem != str(error) and not expected:
                log.critical(
                    "grants: cannot read directory, nothing is granted (directory=%s error=%s)", self._directory, error
                )
            self._directory_problem = str(error)
        else:
            self._directory_listed = True
            self._directory_problem = ""
        return stamps, complete

    def _load(self, path: Path) -> ActiveGrant | None:
        """Return the Grant of a file. Revoke the previous Grant of the file if it is no longer valid."""
        before = self._loaded.get(path) or self._unreadable.pop(path, None)
        try:
            grant = self._read(path)
        except (UnsuitableFile, IsADirectoryError, ValueError, InvalidObject, BadSignature) as error:
            log.critical("grants: invalid file, it grants nothing (file=%s error=%s)", path_text(path), error)
            self._refused(path_text(path.name), str(error))
            self._revoke(before)
            self._problems.pop(path, None)
            return None
        except OSError as error:
            # After a disk error, the Grant returns when the file can be read again.
            if self._problems.get(path) != str(error):
                log.critical("grants: cannot read file, it grants nothing (file=%s error=%s)", path_text(path), error)
                self._refused(path_text(path.name), str(error))
            self._problems[path] = str(error)
            if before is not None:
                self._unreadable[path] = before
            return None
        except Exception as error:
            log.exception("grants: reading failed, the file grants nothing (file=%s)", path_text(path))
            self._refused(path_text(path.name), f"{type(error).__name__}: {error}")
            self._revoke(before)
            self._problems.pop(path, None)
            return None
        self._problems.pop(path, None)
        if grant is None or (before is not None and before.identity != grant.identity):
            self._revoke(before)
        return grant

    def _read(self, path: Path) -> ActiveGrant | None:
        grant = Grant.from_body(read_json(path, MAX_GRANT_BYTES))
        if grant.spec.node != self._node:
            log.error("grants: Grant of another node ignored (file=%s node=%s)", path_text(path), grant.spec.node)
            return None
        digest = self._verifier.verify(grant)
        compiled = compile_grant(grant.spec, flat_terrain=self._flat_terrain)
        return ActiveGrant(grant.spec.mission_key, grant.name, grant.spec, compiled, digest)

    def _revoke(self, grant: ActiveGrant | None) -> None:
        if grant is not None:
            self._verifier.revoke(grant.identity, grant.digest)

    def _replace(self) -> None:
        fresh: dict[str, ActiveGrant] = {}
        for path, grant in sorted(self._loaded.items()):
            if grant is None:
                continue
            if not self._verifier.is_latest(grant.identity, grant.digest):
                log.error(
                    "grants: Grant ignored because a later one was seen (file=%s identity=%s)",
                    path_text(path),
                    grant.identity,
                )
                continue
            if grant.identity in fresh:
                log.error(
                    "grants: second Grant of an identity ignored (file=%s identity=%s)", path_text(path), grant.identity
                )
                continue
            fresh[grant.identity] = grant
        before = self._active
        self._active = fresh
        for identity in sorted(before.keys() | fresh.keys()):
            old = before.get(identity)
            new = fresh.get(identity)
            if old is not new:
                change = "changed"
                if old is None:
                    change = "added"
                elif new is None:
                    change = "removed"
                log.info("grants: %s (identity=%s)", change, identity)
                self._notify(old, new)

    def _notify(self, old: ActiveGrant | None, new: ActiveGrant | None) -> None:
        for listener in self._listeners:
            try:
                listener(old, new)
            except Exception:
                log.exception("grants: listener failed, the others are still called")
