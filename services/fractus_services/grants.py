"""The grants of this node, as files: watched, compiled, matched to callers."""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from fractus_core.api.model import InvalidObject
from fractus_core.api.plans import Grant, GrantSpec
from fractus_core.policy.compiled import CompiledGrant, compile_grant
from fractus_core.policy.trust import BadSignature

from fractus_services.grant_verifier import GrantVerifier

log = logging.getLogger(__name__)

RESCAN_MS = 2_000
_Stamp = tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class ActiveGrant:
    """One grant that is in force on this node.

    Attributes:
        key: names the mission: the grant object's uid, or the identity where nobody gave it one.
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

Complaint = Callable[[str, str], None]
"""Called with the name of a file that grants nothing, and why."""


class GrantFiles:
    """Watches a directory of Grant manifests.

    What cannot be read or understood, or is not signed by the operator, is not a grant: a file that turns bad takes its
    grant away.

    Args:
        directory: where the agent stores the grants; it may not exist yet.
        node: the node that grants must be for.
        verifier: tells which are the operator's.
        flat_terrain: see `compile_grant`.
        refused: told of files that grant nothing.
    """

    def __init__(
        self,
        directory: Path,
        node: str,
        verifier: GrantVerifier,
        flat_terrain: bool = False,
        refused: Complaint = lambda _name, _why: None,
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
        """Watch until cancelled; every change is known within a moment, and all files are looked at every 2 s."""
        from watchfiles import awatch  # noqa: PLC0415 - starts a thread pool on import

        while True:
            self._directory.mkdir(parents=True, exist_ok=True)
            try:
                async for _ in awatch(
                    self._directory, debounce=50, step=20, rust_timeout=RESCAN_MS, yield_on_timeout=True,
                    recursive=False,
                ):  # fmt: skip
                    self.scan()
                    self._remember()
            except (OSError, RuntimeError) as error:
                log.warning("cannot watch %s, looking again: %s", self._directory, error)
            await asyncio.sleep(RESCAN_MS / 1000)
            self.scan()

    def _remember(self) -> None:
        """Store what was seen, beside the loop: a disk that hangs must hold up no news."""
        if self._saving is None or self._saving.done():
            content = self._verifier.unsaved()
            if content is not None:
                self._saving = asyncio.create_task(asyncio.to_thread(self._verifier.store, content))

    def scan(self) -> None:
        """Read what changed."""
        found, whole = self._look()
        trusted = self._verifier.reload_authorities()
        if found == self._stamps and not trusted:
            return
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
        self._replace()

    def _look(self) -> tuple[dict[Path, _Stamp], bool]:
        """The files, and whether those that are missing are gone for certain."""
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
                    log.critical("cannot look at %s, so nothing is granted by it: %s", path, error)
                    continue
                found[path] = (stat.st_mtime_ns, stat.st_size, stat.st_ino)
        except OSError as error:
            whole = False
            log.critical("cannot read the grants in %s: %s; nothing is granted", self._directory, error)
        return found, whole and self._directory.is_dir()

    def _load(self, path: Path) -> ActiveGrant | None:
        """The grant of a file; one that it held before and holds no more is revoked."""
        before = self._loaded.get(path)
        try:
            grant = self._read(path)
        except (OSError, ValueError, InvalidObject, BadSignature) as error:
            log.critical("%s is no grant, so nothing is granted by it: %s", path, error)
            self._refused(path.name, str(error))
            if not isinstance(error, OSError):
                self._revoke(before)
            return None
        except Exception as error:
            log.exception("%s cannot be made sense of, so nothing is granted by it", path)
            self._refused(path.name, f"{type(error).__name__}: {error}")
            return None
        if grant is None or (before is not None and before.identity != grant.identity):
            self._revoke(before)
        return grant

    def _read(self, path: Path) -> ActiveGrant | None:
        grant = Grant.from_body(json.loads(path.read_bytes()))
        if grant.spec.node != self._node:
            log.error("%s is a grant for node %s, not for %s; ignored", path, grant.spec.node, self._node)
            return None
        digest = self._verifier.verify(grant)
        compiled = compile_grant(grant.spec, flat_terrain=self._flat_terrain)
        return ActiveGrant(grant.metadata.uid or grant.spec.identity, grant.name, grant.spec, compiled, digest)

    def _revoke(self, grant: ActiveGrant | None) -> None:
        if grant is not None:
            self._verifier.revoke(grant.identity, grant.digest)

    def _replace(self) -> None:
        fresh: dict[str, ActiveGrant] = {}
        for path, grant in sorted(self._loaded.items()):
            if grant is None:
                continue
            if not self._verifier.is_latest(grant.identity, grant.digest):
                log.error("%s was replaced by a later grant of %s; ignored", path, grant.identity)
                continue
            if grant.identity in fresh:
                log.error("%s grants %s a second time; ignored", path, grant.identity)
                continue
            fresh[grant.identity] = grant
        before, self._active = self._active, fresh
        for identity in sorted(before.keys() | fresh.keys()):
            old, new = before.get(identity), fresh.get(identity)
            if old is not new:
                log.info(
                    "grant of %s %s", identity, "added" if old is None else "removed" if new is None else "changed"
                )
                self._tell(old, new)

    def _tell(self, old: ActiveGrant | None, new: ActiveGrant | None) -> None:
        for listener in self._listeners:
            try:
                listener(old, new)
            except Exception:
                log.exception("a listener failed on a change of grants; the others are told")
