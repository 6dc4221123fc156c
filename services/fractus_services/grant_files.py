"""The grants of this node, as files: watched, compiled, matched to callers."""

from __future__ import annotations

import asyncio
import json
import logging
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from fractus_core.api.grants import Grant, GrantSpec
from fractus_core.api.model import InvalidObject
from fractus_core.policy.compiled_grant import CompiledGrant, compile_grant
from fractus_core.policy.grant_signatures import BadSignature

from fractus_services.directory_watch import DirectoryWatch
from fractus_services.grant_verifier import GrantVerifier

log = logging.getLogger(__name__)

RESCAN_INTERVAL_S = 2.0
"""Files are also read this often: inotify misses changes on some file systems."""
_Stamp = tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class ActiveGrant:
    """A grant that is in force on this node.

    Attributes:
        key: tells the mission from all others; made of what is signed.
        digest: of the grant with its signature.
    """

    key: str
    name: str
    spec: GrantSpec
    compiled: CompiledGrant
    digest: str = ""

    @property
    def identity(self) -> str:
        """SPIFFE id of the instance."""
        return self.compiled.identity


Listener = Callable[[ActiveGrant | None, ActiveGrant | None], None]
"""Called with the grant before and after a change; None: there is none."""

Refusal = Callable[[str, str], None]
"""Called with the name of a file that grants nothing, and why."""


class GrantFiles:
    """Watches a directory of Grant manifests.

    A file that cannot be read or parsed, or is not signed by the operator, is no grant: when a file turns bad, its grant is
    revoked, as nothing tells any more what it forbids.

    Args:
        directory: where the agent stores the grants; it may not exist yet.
        node: the node that grants must be for.
        verifier: verifies their signatures.
        flat_terrain: see `compile_grant`.
        refused: called for files that grant nothing.
    """

    def __init__(
        self,
        directory: Path,
        node: str,
        verifier: GrantVerifier,
        flat_terrain: bool = False,
        refused: Refusal = lambda _name, _why: None,
    ) -> None:
        self._directory = directory
        self._node = node
        self._verifier = verifier
        self._flat_terrain = flat_terrain
        self._refused = refused
        self._saving: asyncio.Task[None] | None = None
        self._stamps: dict[Path, _Stamp] = {}
        self._loaded: dict[Path, ActiveGrant | None] = {}
        self._active: dict[str, ActiveGrant] = {}
        self._listeners: list[Listener] = []
        self._reading = threading.Lock()

    @property
    def active(self) -> Mapping[str, ActiveGrant]:
        """Grants in force by identity."""
        return self._active

    def of(self, identity: str) -> ActiveGrant | None:
        """The grant of a caller."""
        return self._active.get(identity)

    def listen(self, listener: Listener) -> None:
        """Call a listener at every change."""
        self._listeners.append(listener)

    async def run(self) -> None:
        """Watch until cancelled: changes are read at once, and all files every 2 s."""
        told = ""
        while True:
            try:
                self._directory.mkdir(parents=True, exist_ok=True)
                with DirectoryWatch(self._directory) as watch:
                    while True:
                        await watch.changed(RESCAN_INTERVAL_S)
                        await self._scan_aside()
                        self._remember()
            except OSError as error:
                if str(error) != told:
                    told = str(error)
                    log.warning("grants: cannot watch, scanning instead (directory=%s): %s", self._directory, error)
            await asyncio.sleep(RESCAN_INTERVAL_S)
            await self._scan_aside()
            self._remember()

    def _remember(self) -> None:
        """Store what was seen, in a thread: a disk that hangs must not delay a change of grants."""
        if self._saving is None or self._saving.done():
            content = self._verifier.unsaved()
            if content is not None:
                self._saving = asyncio.create_task(asyncio.to_thread(self._verifier.store, content))

    def scan(self) -> None:
        """Read what changed."""
        if self._read_changes():
            self._replace()

    async def _scan_aside(self) -> None:
        """Read what changed, in a thread: grants of large areas take seconds, in which a flight is watched all the same."""
        if await asyncio.to_thread(self._read_changes):
            self._replace()

    def _read_changes(self) -> bool:
        """Read the files that changed; whether there are any."""
        # The thread of a watch that was cancelled may still read.
        with self._reading:
            return self._read_changed()

    def _read_changed(self) -> bool:
        found, whole = self._list()
        trusted = self._verifier.reload_authorities()
        if found == self._stamps and not trusted:
            return False
        before = dict(self._loaded)
        for path in self._stamps.keys() - found.keys():
            self._loaded.pop(path, None)
        for path, stamp in found.items():
            if self._stamps.get(path) != stamp or (trusted and self._loaded.get(path) is None):
                self._loaded[path] = self._load(path)
        self._stamps = found
        if whole:
            renamed = {grant.digest for grant in self._loaded.values() if grant is not None}
            for path in before.keys() - self._loaded.keys():
                gone = before[path]
                if gone is not None and gone.digest not in renamed:
                    self._revoke(gone)
        return True

    def _list(self) -> tuple[dict[Path, _Stamp], bool]:
        """The files, and whether those that are missing were certainly removed, and are not just unreadable."""
        found: dict[Path, _Stamp] = {}
        whole = True
        try:
            for path in sorted(self._directory.glob("*.json")):
                try:
                    stat = path.stat()
                except FileNotFoundError:
                    continue
                except OSError as error:
                    whole = False
                    log.critical("grants: file cannot be read, grants nothing (file=%s): %s", path, error)
                    continue
                found[path] = (stat.st_mtime_ns, stat.st_size, stat.st_ino)
        except OSError as error:
            whole = False
            log.critical(
                "grants: directory cannot be read, nothing is granted (directory=%s): %s", self._directory, error
            )
        return found, whole and self._directory.is_dir()

    def _load(self, path: Path) -> ActiveGrant | None:
        """The grant of a file; the one that was there before and no longer is gets revoked."""
        before = self._loaded.get(path)
        try:
            grant = self._read(path)
        except (OSError, ValueError, InvalidObject, BadSignature) as error:
            log.critical("grants: file is no valid grant, grants nothing (file=%s): %s", path, error)
            self._refused(path.name, str(error))
            if not isinstance(error, OSError):
                self._revoke(before)
            return None
        except Exception as error:
            log.exception("grants: reading failed, grants nothing (file=%s)", path)
            self._refused(path.name, f"{type(error).__name__}: {error}")
            return None
        if grant is None or (before is not None and before.identity != grant.identity):
            self._revoke(before)
        return grant

    def _read(self, path: Path) -> ActiveGrant | None:
        grant = Grant.from_body(json.loads(path.read_bytes()))
        if grant.spec.node != self._node:
            log.error("grants: for another node, ignored (file=%s node=%s)", path, grant.spec.node)
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
                log.error("grants: replaced by a later one, ignored (file=%s identity=%s)", path, grant.identity)
                continue
            if grant.identity in fresh:
                log.error("grants: second grant of an identity, ignored (file=%s identity=%s)", path, grant.identity)
                continue
            fresh[grant.identity] = grant
        before, self._active = self._active, fresh
        for identity in sorted(before.keys() | fresh.keys()):
            old, new = before.get(identity), fresh.get(identity)
            if old is not new:
                change = "added" if old is None else "removed" if new is None else "changed"
                log.info("grants: %s (identity=%s)", change, identity)
                self._notify(old, new)

    def _notify(self, old: ActiveGrant | None, new: ActiveGrant | None) -> None:
        for listener in self._listeners:
            try:
                listener(old, new)
            except Exception:
                log.exception("grants: a listener failed, the others are still called")
