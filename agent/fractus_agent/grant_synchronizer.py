"""Grants of this node: verified, stored on disk for the services, and their phases reported to the API server."""

from __future__ import annotations

import asyncio
import hashlib
import json
import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from fractus_core.api.grants import (
    ENDED,
    MAX_MESSAGE,
    Grant,
    GrantPhase,
    GrantSpec,
    ReportedGrant,
    ReportedPictures,
    ReportedWaypoints,
)
from fractus_core.api.model import InvalidObject
from fractus_core.control import Outcome, OutcomeKind, WaypointCounts
from fractus_core.policy.grant_signatures import BadSignature, UnknownAuthority, read_authorities, verify
from fractus_runtime.files import (
    UnsuitableFile,
    list_files,
    parse_json,
    read_file,
    remove_file,
    remove_temporary_files,
    write_file,
)

from fractus_agent.store import GrantList, Object, Store
from fractus_agent.supervisor import repeat

log = logging.getLogger(__name__)

_OUTCOMES: dict[OutcomeKind, GrantPhase] = {
    OutcomeKind.COMPLETE: "Complete",
    OutcomeKind.REVOKED: "Revoked",
    OutcomeKind.FAILED: "Failed",
}
REVIEW_INTERVAL_S = 60.0
"""Seconds after which the reports are compared with the last written reports, even if no Grant has changed."""
DISK_INTERVAL_S = 5.0
"""Seconds after which failed disk operations are repeated."""
UNVERIFIED_TIMEOUT_S = 120.0
"""Seconds for which a stored Grant stays valid while its replacement has an unknown authority.

A new authority reaches every node within this time.
"""


class GrantDirectory:
    """Stored Grants, one JSON file each. Files are always complete, even after a power loss.

    Args:
        path: Directory of the files.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def open(self) -> None:
        """Create the directory, and remove temporary files of a killed agent."""
        self._path.mkdir(parents=True, exist_ok=True, mode=0o700)
        remove_temporary_files(self._path)

    def names(self) -> set[str]:
        """Return the names of the stored Grants."""
        return {path.stem for path in list_files(self._path, ".json")}

    def contains(self, grant: Grant) -> bool:
        """Return True if exactly this Grant is stored."""
        try:
            return self.read(grant.name) == serialize_grant(grant)
        except (FileNotFoundError, UnsuitableFile):
            return False

    def read(self, name: str) -> bytes:
        """Return the content of a stored Grant.

        Raises:
            OSError: The file is missing, is not a regular file, is too large, or cannot be read.
        """
        return read_file(self._file(name))

    def write(self, grant: Grant) -> bool:
        """Store a Grant. Return False if it was stored already."""
        if self.contains(grant):
            return False
        write_file(self._file(grant.name), serialize_grant(grant))
        return True

    def remove(self, name: str) -> bool:
        """Remove a Grant. Return False if it was not stored."""
        return remove_file(self._file(name))

    def _file(self, name: str) -> Path:
        return self._path / f"{name}.json"


def serialize_grant(grant: Grant) -> bytes:
    """Serialize the manifest for the services, without the fields that change with the status.

    Defaults are left out, so that a newer agent does not write fields that older services do not know.
    """
    body = grant.to_dict()
    body["spec"] = grant.spec.model_dump(mode="json", by_alias=True, exclude_defaults=True)
    body.pop("status", None)
    body["metadata"].pop("resourceVersion", None)
    return json.dumps(body, sort_keys=True, indent=1).encode() + b"\n"


def mission_outcome(grant: Grant, missions: Mapping[str, Outcome]) -> tuple[GrantPhase, str] | None:
    """Return the final phase of a Grant and the reason for this phase. Return None while the mission is running."""
    outcome = missions.get(grant.spec.mission_key)
    return (_OUTCOMES[outcome.kind], outcome.reason) if outcome is not None else None


def grant_report(
    grant: Grant, missions: Mapping[str, Outcome], problem: str | None, pictures: ReportedPictures | None = None
) -> ReportedGrant:
    """Return the report of a Grant.

    Args:
        grant: The Grant.
        missions: Outcomes of missions by mission key.
        problem: Reason why the Grant is not stored, otherwise None.
        pictures: Pictures of the Application with the camera of this node. None if it requested no picture.
    """
    phase, message = mission_outcome(grant, missions) or ("Active", "")
    if problem is not None:
        phase = "Pending"
        message = problem
    report = _report(grant.metadata.model_dump(by_alias=True), phase, message)
    outcome = missions.get(grant.spec.mission_key)
    if phase not in ENDED or outcome is None:
        return report
    waypoints = None
    if outcome.waypoints != WaypointCounts():
        waypoints = ReportedWaypoints.model_validate(asdict(outcome.waypoints))
    return report.model_copy(update={"waypoints": waypoints, "pictures": pictures})


def keep_final_phase(report: ReportedGrant, reported: ReportedGrant | None) -> ReportedGrant:
    """Return the report, or the previous report if the phase in the previous report is final.

    A final phase never changes.
    """
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


class GrantVerifier:
    """Verifies the signatures of Grants against the authority that the node trusts.

    Args:
        directory: Directory of ca.crt. The file may appear later.
    """

    def __init__(self, directory: Path) -> None:
        self._path = directory / "ca.crt"

    def verify(self, grant: Grant) -> None:
        """Verify a Grant.

        Raises:
            BadSignature: The operator did not sign this content of the Grant.
            UnknownAuthority: The authority of the Grant is unknown on this node.
        """
        try:
            authorities = read_authorities(read_file(self._path))
        except (OSError, ValueError) as error:
            raise UnknownAuthority(f"the node cannot read the certificate of its authority ({error})") from None
        verify(grant, authorities)


class GrantSynchronizer:
    """Mirrors the node's Grants to disk, and reports their phases.

    A file is removed only if the operator's complete list does not contain its Grant, or if the operator did not sign
    the Grant. While the API server is unreachable, all files stay, so that a flight continues.

    Args:
        store: The node's objects at the API server.
        directory: Directory of the stored Grants.
        node: Name of the node.
        check: Raises BadSignature or UnknownAuthority for a Grant that must not be stored.
        refresh_authority: Called when the authority that the node trusts may be outdated.
        pictures: Returns the numbers of taken and refused pictures by mission key.
        monotonic: Returns seconds of a monotonic clock.
    """

    def __init__(
        self,
        store: Store,
        directory: GrantDirectory,
        node: str,
        check: Callable[[Grant], None],
        *,
        refresh_authority: Callable[[], None] = lambda: None,
        pictures: Callable[[], Mapping[str, tuple[int, int]]] = dict,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self._store = store
        self._directory = directory
        self._node = node
        self._check = check
        self._refresh_authority = refresh_authority
        self._pictures = pictures
        self._monotonic = monotonic
        self._unverified: dict[str, tuple[Object, float]] = {}
        self._grants: dict[str, Grant] = {}
        self._unusable: dict[str, ReportedGrant] = {}
        self._digests: dict[str, tuple[bytes, bytes | None]] = {}
        """Two digests by Grant: digest of the received Grant, and digest of the written file (None if unreadable)."""
        self._written: dict[str, GrantSpec] = {}
        """Last stored spec by Grant. It is used if the file of the Grant cannot be read."""
        self._unstored: dict[str, str] = {}
        self._unremoved: set[str] = set()
        self._generation = 0
        self._reported_generation = 0
        self._reported: Mapping[str, ReportedGrant] = {}
        self._missions: Mapping[str, Outcome] = {}
        self._work = asyncio.Event()
        self._retried_s = monotonic()

    def counts(self) -> dict[str, int]:
        """Return the number of Grants by state: stored, unverified, unusable, unstored (cannot be written to disk)."""
        return {
            "stored": len(self._grants) - len(self._unstored),
            "unverified": len(self._unverified),
            "unusable": len(self._unusable.keys() - self._unverified.keys()),
            "unstored": len(self._unstored),
        }

    @property
    def depends_on_contact(self) -> bool:
        """True if a stored Grant demands a reaction when contact with the API server is lost."""
        demands = (grant.spec.contact_lost for grant in self._grants.values())
        return any(demand is not None and demand.action != "continue" for demand in demands)

    def set_missions(self, missions: Mapping[str, Outcome]) -> None:
        """Set the outcomes of missions that the mobility service reports."""
        if dict(missions) != self._missions:
            self._missions = dict(missions)
            self._work.set()

    def on_authority_changed(self) -> None:
        """Repeat the verification of Grants that failed because their authority was unknown."""
        for body, _ in tuple(self._unverified.values()):
            self._put(body)
        self._work.set()

    async def follow(self) -> None:
        """Mirror the Grants until cancelled."""
        self._directory.open()
        async for grant_list in self._store.grants():
            self.apply(grant_list)
            del grant_list  # frees the unpacked Grants, because the next event may be hours away

    def apply(self, grant_list: GrantList) -> None:
        """Update the files so that they match a list of Grants."""
        self._generation = grant_list.generation
        self._reported_generation = grant_list.reported_generation
        self._reported = grant_list.reported
        if grant_list.grants is not None:
            names = {body["metadata"]["name"] for body in grant_list.grants}
            known = self._directory.names().union(self._grants, self._unusable, self._unverified)
            for removed in known - names:
                self._remove(removed)
            for body in grant_list.grants:
                # Skip unchanged Grants, because parsing, verifying and storing one takes about 15 ms.
                name = body["metadata"]["name"]
                digest = _digest(json.dumps(body, sort_keys=True).encode())
                if name not in self._grants or self._digests.get(name) != (digest, self._stored_digest(name)):
                    self._put(body)
                    self._digests[name] = digest, self._stored_digest(name)
        self._work.set()

    async def report(self) -> None:
        """Report phases to the API server until cancelled. Failed reports are repeated."""
        await repeat("grants", self._report_step, self._work)

    async def _report_step(self) -> float:
        if self._monotonic() - self._retried_s >= DISK_INTERVAL_S:
            self.retry_disk()
        self.expire_unverified()
        await self.report_once()
        return DISK_INTERVAL_S if self._unstored or self._unremoved else REVIEW_INTERVAL_S

    async def report_once(self) -> None:
        """Report all Grants if a report has changed."""
        pictures = self._pictures_by_application() if self._missions else {}
        current = {
            name: grant_report(
                grant, self._missions, self._unstored.get(name), pictures.get(grant.spec.application.uid)
            )
            for name, grant in self._grants.items()
        } | self._unusable
        reports = {
            report.uid: keep_final_phase(report, self._reported.get(report.uid))
            for _, report in sorted(current.items())
        }
        if self._generation == self._reported_generation and reports == self._reported:
            return
        if not await self._store.report_grants(self._generation, list(reports.values())):
            return
        for report in reports.values():
            if self._reported.get(report.uid) != report:
                log.info("grants: reported (grant=%s phase=%s): %s", report.name, report.phase, report.message or "-")
        self._reported_generation = self._generation
        self._reported = reports

    def _pictures_by_application(self) -> dict[str, ReportedPictures]:
        """Return the pictures that were requested under the present Grants, by uid of their Application."""
        counted = self._pictures()
        pictures: dict[str, ReportedPictures] = {}
        for grant in self._grants.values():
            counts = counted.get(grant.spec.mission_key)
            if counts is None:
                continue
            before = pictures.get(grant.spec.application.uid, ReportedPictures(taken=0, refused=0))
            pictures[grant.spec.application.uid] = ReportedPictures(
                taken=before.taken + counts[0], refused=before.refused + counts[1]
            )
        return pictures

    def _put(self, body: Object) -> None:
        name = body["metadata"]["name"]
        try:
            grant = Grant.from_body(body)
        except InvalidObject as error:
            # Fail closed: the limits of the Grant are unknown, so it is not stored. Without a Grant the services fly the drone home.
            log.error("grants: invalid Grant, not stored (grant=%s error=%s)", name, error)  # noqa: TRY400
            self._remove(name)
            self._report_unusable(body, "Failed", f"The agent of {self._node} cannot parse the Grant: {error}")
            return
        if grant.spec.node != self._node:
            self._remove(name)
            return
        try:
            self._check(grant)
        except UnknownAuthority as error:
            # A stored Grant was verified when it was stored, even if its authority is unknown now.
            if not self._is_stored(grant):
                self._defer(body, str(error))
                return
        except BadSignature as error:
            log.error("grants: bad signature, not stored (grant=%s error=%s)", name, error)  # noqa: TRY400
            self._remove(name)
            self._report_unusable(body, "Pending", self._waiting_message(error))
            return
        self._unverified.pop(name, None)
        self._unusable.pop(name, None)
        self._unremoved.discard(name)
        self._grants[name] = grant
        self._write(grant)

    def _is_stored(self, grant: Grant) -> bool:
        try:
            return self._directory.contains(grant)
        except OSError:
            return False

    def _stored_digest(self, name: str) -> bytes | None:
        """Return the digest of the stored file, None if it cannot be read."""
        try:
            return _digest(self._directory.read(name))
        except OSError:
            return None

    def _defer(self, body: Object, reason: str) -> None:
        """Keep the stored Grant, because this node may not have received the new authority yet.

        `expire_unverified` removes the stored Grant after `UNVERIFIED_TIMEOUT_S`.
        """
        name = body["metadata"]["name"]
        if name not in self._unverified:
            log.warning("grants: unknown authority, not stored yet (grant=%s error=%s)", name, reason)
            since_s = self._monotonic()
        else:
            since_s = self._unverified[name][1]
        self._unverified[name] = (body, since_s)
        if name not in self._grants:
            self._report_unusable(body, "Pending", self._waiting_message(reason))
        self._refresh_authority()

    def expire_unverified(self) -> None:
        """Remove stored Grants whose replacement could not be verified in time."""
        for name, (body, since_s) in tuple(self._unverified.items()):
            if name in self._directory.names() and self._monotonic() - since_s > UNVERIFIED_TIMEOUT_S:
                log.error("grants: removed, replacement has an unknown authority (grant=%s)", name)
                self._remove(name)
                self._defer(body, "its authority is unknown on this node")

    def _waiting_message(self, reason: object) -> str:
        return f"The agent of {self._node} waits for a valid signature of the operator: {reason}"

    def _report_unusable(self, body: Object, phase: GrantPhase, message: str) -> None:
        self._unusable[body["metadata"]["name"]] = _report(body["metadata"], phase, message)

    def _write(self, grant: Grant) -> None:
        try:
            try:
                stored = self._directory.write(grant)
            except OSError:
                if not self._remove_outdated(grant):
                    raise
                stored = self._directory.write(grant)  # The removal may have freed the required space.
            if stored:
                log.info("grants: stored (grant=%s identity=%s)", grant.name, grant.spec.identity)
            self._written[grant.name] = grant.spec.unsigned
            self._unstored.pop(grant.name, None)
        except OSError as error:
            if grant.name not in self._unstored:
                log.exception("grants: cannot write to disk, retrying (grant=%s)", grant.name)
            self._unstored[grant.name] = f"The node cannot store the Grant: {error.strerror or error}."

    def _remove_outdated(self, grant: Grant) -> bool:
        """Remove the stored version of a changed Grant, because services must not use an outdated Grant.

        Returns:
            True if a file was removed.
        """
        stored = None
        try:
            stored = Grant.from_body(parse_json(self._directory.read(grant.name))).spec.unsigned
        except FileNotFoundError:
            return False
        except OSError as error:
            # This process may have no free file descriptor. The services still use the stored version.
            log.warning("grants: stored Grant not readable (grant=%s error=%s)", grant.name, error)
            stored = self._written.get(grant.name)
        except (ValueError, InvalidObject) as error:
            log.warning("grants: stored Grant invalid (grant=%s error=%s)", grant.name, error)
        if stored == grant.spec.unsigned:
            return False
        removed = self._directory.remove(grant.name)
        log.error("grants: removed, its new version cannot be stored (grant=%s)", grant.name)
        return removed

    def retry_disk(self) -> None:
        """Repeat failed writes and removals of files."""
        self._retried_s = self._monotonic()
        for name in list(self._unstored):
            self._write(self._grants[name])
        for name in list(self._unremoved):
            self._remove(name)

    def _remove(self, name: str) -> None:
        for record in (self._grants, self._digests, self._unusable, self._written, self._unstored, self._unverified):
            record.pop(name, None)
        try:
            if self._directory.remove(name):
                log.info("grants: removed (grant=%s)", name)
            self._unremoved.discard(name)
        except OSError:
            if name not in self._unremoved:
                log.exception("grants: cannot remove from disk, retrying (grant=%s)", name)
            self._unremoved.add(name)
