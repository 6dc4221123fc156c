"""Grants of this node: from the API server to the disk, and what became of them back to the API server."""

from __future__ import annotations

import asyncio
import hashlib
import json
import logging
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from fractus_core.api.grants import ENDED, MAX_MESSAGE, Grant, GrantPhase, GrantSpec, ReportedGrant
from fractus_core.api.model import InvalidObject
from fractus_core.control import Outcome, OutcomeKind
from fractus_core.policy.grant_signatures import BadSignature, UnknownAuthority
from fractus_runtime.files import remove_file, write_file

from fractus_agent.cluster.store import Granted, Object, Store
from fractus_agent.supervisor import repeat

LOG = logging.getLogger(__name__)

_OUTCOMES: dict[OutcomeKind, GrantPhase] = {
    OutcomeKind.COMPLETE: "Complete",
    OutcomeKind.REVOKED: "Revoked",
    OutcomeKind.FAILED: "Failed",
}
REVIEW_INTERVAL_S = 60.0
"""Seconds after which reports are tried again."""
DISK_INTERVAL_S = 5.0
"""Seconds after which what the disk did not take is tried again."""
UNVERIFIED_TIMEOUT_S = 120.0
"""Seconds for which a stored Grant outlives a newer one whose authority is unknown: a change of authorities takes that
long to reach every node."""


class GrantDirectory:
    """The stored grants: one complete JSON file each, whenever the machine stops."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def open(self) -> None:
        """Make the directory, and clear what a kill left half-written."""
        self._path.mkdir(parents=True, exist_ok=True, mode=0o700)
        for left in self._path.glob(".*.tmp"):
            left.unlink()

    def names(self) -> set[str]:
        """Names of the grants on disk."""
        return {path.stem for path in self._path.glob("*.json")}

    def holds(self, grant: Grant) -> bool:
        """Whether this very grant is stored."""
        try:
            return self.read(grant.name) == stored_form(grant)
        except FileNotFoundError:
            return False

    def read(self, name: str) -> bytes:
        """A grant as it is stored.

        Raises:
            OSError: it cannot be read.
        """
        return self._file(name).read_bytes()

    def put(self, grant: Grant) -> bool:
        """Store a grant; False when the same was stored already."""
        if self.holds(grant):
            return False
        write_file(self._file(grant.name), stored_form(grant))
        return True

    def drop(self, name: str) -> bool:
        """Remove a grant; False when it was not there."""
        return remove_file(self._file(name))

    def _file(self, name: str) -> Path:
        return self._path / f"{name}.json"


def stored_form(grant: Grant) -> bytes:
    """The manifest as services read it: without what changes when only the status does.

    Defaults are left out, so that an agent which knows a new field does not write it for services that do not.
    """
    body = grant.to_dict()
    body["spec"] = grant.spec.model_dump(mode="json", by_alias=True, exclude_defaults=True)
    body.pop("status", None)
    body["metadata"].pop("resourceVersion", None)
    return json.dumps(body, sort_keys=True, indent=1).encode() + b"\n"


def outcome_of(grant: Grant, missions: Mapping[str, Outcome]) -> tuple[GrantPhase, str] | None:
    """How the grant's mission ended, as the mobility service tells; None while it has not."""
    outcome = missions.get(grant.spec.mission_key)
    return (_OUTCOMES[outcome.kind], outcome.reason) if outcome is not None else None


def report_of(grant: Grant, missions: Mapping[str, Outcome], problem: str | None) -> ReportedGrant:
    """What became of a grant."""
    phase, message = outcome_of(grant, missions) or ("Active", "")
    if problem is not None:
        phase, message = "Pending", problem
    return _report(grant.metadata.model_dump(by_alias=True), phase, message)


def unless_ended(report: ReportedGrant, reported: ReportedGrant | None) -> ReportedGrant:
    """What is reported of a grant of which something was reported before: an end is never taken back."""
    if reported is None or reported.phase not in ENDED:
        return report
    return reported.model_copy(update={"observed_generation": report.observed_generation})


def _digest(text: bytes) -> bytes:
    return hashlib.sha256(text).digest()


def _report(metadata: Mapping[str, Any], phase: GrantPhase, message: str) -> ReportedGrant:
    return ReportedGrant(
        uid=metadata.get("uid") or "",
        name=metadata["name"],
        phase=phase,
        message=message[:MAX_MESSAGE],
        observed_generation=metadata.get("generation") or 0,
    )


class GrantKeeper:
    """Mirrors the node's grants to disk and reports their phases.

    Files are removed only when the API server says so: by absence from what the operator says are all of them, or by a Grant
    that the operator did not sign. An API server that is out of reach removes nothing, so a flight goes on.

    Args:
        store: the API server.
        directory: the disk.
        node: whose grants.
        check: raises BadSignature or UnknownAuthority for a Grant that is not to be stored.
        refresh_authority: called when the authority that the node trusts may be out of date.
        monotonic: seconds that never jump.
    """

    def __init__(
        self,
        store: Store,
        directory: GrantDirectory,
        node: str,
        check: Callable[[Grant], None],
        *,
        refresh_authority: Callable[[], None] = lambda: None,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self._store = store
        self._directory = directory
        self._node = node
        self._check = check
        self._refresh_authority = refresh_authority
        self._monotonic = monotonic
        self._unverified: dict[str, tuple[Object, float]] = {}
        self._grants: dict[str, Grant] = {}
        self._unusable: dict[str, ReportedGrant] = {}
        self._digests: dict[str, tuple[bytes, bytes | None]] = {}
        """Of each Grant as it was taken, and of its file as that was written."""
        self._written: dict[str, GrantSpec] = {}
        """What was stored last of each Grant, for a file that cannot be read for a while."""
        self._unstored: dict[str, str] = {}
        self._unremoved: set[str] = set()
        self._generation = self._reported_of = 0
        self._reported: Mapping[str, ReportedGrant] = {}
        self._missions: Mapping[str, Outcome] = {}
        self._work = asyncio.Event()
        self._retried_s = monotonic()

    def counts(self) -> dict[str, int]:
        """How many grants are stored, or why they are not: unverified, unusable, or the disk does not take them."""
        return {
            "stored": len(self._grants) - len(self._unstored),
            "unverified": len(self._unverified),
            "unusable": len(self._unusable.keys() - self._unverified.keys()),
            "unstored": len(self._unstored),
        }

    def missions_changed(self, missions: Mapping[str, Outcome]) -> None:
        """Take the outcomes of missions from the mobility service."""
        if dict(missions) != self._missions:
            self._missions = dict(missions)
            self._work.set()

    def authority_changed(self) -> None:
        """Verify again the Grants whose authority was not known."""
        for body, _ in tuple(self._unverified.values()):
            self._put(body)
        self._work.set()

    async def follow(self) -> None:
        """Keep the directory in step with the API server until cancelled."""
        self._directory.open()
        async for granted in self._store.grants():
            self.take(granted)
            del granted

    def take(self, granted: Granted) -> None:
        """Bring the disk in step with what the operator says."""
        self._generation = granted.generation
        self._reported_of, self._reported = granted.reported_of, granted.reported
        if granted.grants is not None:
            names = {body["metadata"]["name"] for body in granted.grants}
            known = self._directory.names().union(self._grants, self._unusable, self._unverified)
            for gone in known - names:
                self._remove(gone)
            for body in granted.grants:
                # Each costs some 15 ms to read, verify and store: most change alone.
                name, digest = body["metadata"]["name"], _digest(json.dumps(body, sort_keys=True).encode())
                if name not in self._grants or self._digests.get(name) != (digest, self._stored_digest(name)):
                    self._put(body)
                    self._digests[name] = digest, self._stored_digest(name)
        self._work.set()

    async def report(self) -> None:
        """Report phases to the API server until cancelled; what cannot be written now is written later."""
        await repeat("grants", self._report_step, self._work)

    async def _report_step(self) -> float:
        if self._monotonic() - self._retried_s >= DISK_INTERVAL_S:
            self.retry_disk()
        self.give_up_unverified()
        await self.report_once()
        return DISK_INTERVAL_S if self._unstored or self._unremoved else REVIEW_INTERVAL_S

    async def report_once(self) -> None:
        """Report every grant, where what the API server was told is not what the node knows."""
        wanted = {
            name: report_of(grant, self._missions, self._unstored.get(name)) for name, grant in self._grants.items()
        } | self._unusable
        reports = {
            report.uid: unless_ended(report, self._reported.get(report.uid)) for _, report in sorted(wanted.items())
        }
        if (self._generation, reports) == (self._reported_of, self._reported):
            return
        if not await self._store.report_grants(self._generation, list(reports.values())):
            return
        for report in reports.values():
            if self._reported.get(report.uid) != report:
                LOG.info("grants: reported (grant=%s phase=%s): %s", report.name, report.phase, report.message or "-")
        self._reported_of, self._reported = self._generation, reports

    def _put(self, body: Object) -> None:
        name = body["metadata"]["name"]
        try:
            grant = Grant.from_body(body)
        except InvalidObject as error:
            # What it forbids is unknown, so nothing of it is stored: without a grant the services bring the drone home.
            LOG.error("grants: cannot be read, nothing is granted (grant=%s): %s", name, error)  # noqa: TRY400
            self._remove(name)
            self._report_unusable(body, "Failed", f"The agent of {self._node} cannot read the grant: {error}")
            return
        if grant.spec.node != self._node:
            self._remove(name)
            return
        try:
            self._check(grant)
        except UnknownAuthority as doubt:
            # One that was stored once was verified then, whatever became of its authority since.
            if not self._stored(grant):
                self._hold(body, str(doubt))
                return
        except BadSignature as problem:
            LOG.error("grants: not stored (grant=%s): %s", name, problem)  # noqa: TRY400
            self._remove(name)
            self._report_unusable(body, "Pending", self._waits(problem))
            return
        self._unverified.pop(name, None)
        self._unusable.pop(name, None)
        self._unremoved.discard(name)
        self._grants[name] = grant
        self._write(grant)

    def _stored(self, grant: Grant) -> bool:
        try:
            return self._directory.holds(grant)
        except OSError:
            return False

    def _stored_digest(self, name: str) -> bytes | None:
        """Of the file as it is now; None where there is none that can be read."""
        try:
            return _digest(self._directory.read(name))
        except OSError:
            return None

    def _hold(self, body: Object, why: str) -> None:
        """Keep what is stored for a while: the authority may be about to change."""
        name = body["metadata"]["name"]
        if name not in self._unverified:
            LOG.warning("grants: not stored yet (grant=%s): %s", name, why)
        self._unverified[name] = (body, self._unverified.get(name, (body, self._monotonic()))[1])
        if name not in self._grants:
            self._report_unusable(body, "Pending", self._waits(why))
        self._refresh_authority()

    def give_up_unverified(self) -> None:
        """Remove stored grants whose replacement could not be verified in time."""
        for name, (body, since_s) in tuple(self._unverified.items()):
            if name in self._directory.names() and self._monotonic() - since_s > UNVERIFIED_TIMEOUT_S:
                LOG.error("grants: removed, its replacement is of an unknown authority (grant=%s)", name)
                self._remove(name)
                self._hold(body, "it is of an authority that this node does not know")

    def _waits(self, why: object) -> str:
        return f"The agent of {self._node} waits for the operator's signature: {why}"

    def _report_unusable(self, body: Object, phase: GrantPhase, message: str) -> None:
        self._unusable[body["metadata"]["name"]] = _report(body["metadata"], phase, message)

    def _write(self, grant: Grant) -> None:
        try:
            try:
                stored = self._directory.put(grant)
            except OSError:
                if not self._withdrawn(grant):
                    raise
                stored = self._directory.put(grant)  # there may be room now
            if stored:
                LOG.info("grants: stored (grant=%s identity=%s)", grant.name, grant.spec.identity)
            self._written[grant.name] = grant.spec.unsigned
            self._unstored.pop(grant.name, None)
        except OSError as error:
            if grant.name not in self._unstored:
                LOG.exception("grants: cannot be written to disk, trying again (grant=%s)", grant.name)
            self._unstored[grant.name] = f"The node cannot store the grant: {error.strerror or error}."

    def _withdrawn(self, grant: Grant) -> bool:
        """Remove what is stored of a Grant that has changed: services must not go on by what does not hold any more.

        Returns:
            Whether something was removed.
        """
        stored = None
        try:
            stored = Grant.from_body(json.loads(self._directory.read(grant.name))).spec.unsigned
        except FileNotFoundError:
            return False
        except OSError as error:
            # No descriptor is left, say: services still go on by what was written.
            LOG.warning("grants: what is stored cannot be read now (grant=%s): %s", grant.name, error)
            stored = self._written.get(grant.name)
        except (ValueError, RecursionError, InvalidObject) as error:
            LOG.warning("grants: what is stored cannot be read (grant=%s): %s", grant.name, error)
        if stored == grant.spec.unsigned:
            return False
        dropped = self._directory.drop(grant.name)
        LOG.error("grants: removed, its change cannot be stored (grant=%s)", grant.name)
        return dropped

    def retry_disk(self) -> None:
        """Try again to write and remove files."""
        self._retried_s = self._monotonic()
        for name in list(self._unstored):
            self._write(self._grants[name])
        for name in list(self._unremoved):
            self._remove(name)

    def _remove(self, name: str) -> None:
        for record in (self._grants, self._digests, self._unusable, self._written, self._unstored, self._unverified):
            record.pop(name, None)
        try:
            if self._directory.drop(name):
                LOG.info("grants: removed (grant=%s)", name)
            self._unremoved.discard(name)
        except OSError:
            if name not in self._unremoved:
                LOG.exception("grants: cannot be removed from disk, trying again (grant=%s)", name)
            self._unremoved.add(name)
