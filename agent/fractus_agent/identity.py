"""Certificate of the node: requested through the CSR API, stored, renewed in time, and replaced if the CA rotates."""

from __future__ import annotations

import asyncio
import base64
import binascii
import contextlib
import hashlib
import logging
import shutil
import uuid
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

from fractus_core.api.conditions import ConditionUpdate
from fractus_runtime.backoff import Backoff
from fractus_runtime.files import read_set, write_set

from fractus_agent.certificates import (
    CERTIFICATE_FILES,
    InvalidCertificate,
    ValidityPeriod,
    create_request,
    inspect_certificate,
)
from fractus_agent.store import KubeError, Store

log = logging.getLogger(__name__)

LIFETIME_S = 30 * 86400
FILE_CHECK_INTERVAL_S = 10.0
"""Seconds between checks of the files and the clock."""
AUTHORITY_INTERVAL_S = 300.0
"""Seconds between reads of the published authority."""
SIGNING_TIMEOUT_S = 600.0

RequestFactory = Callable[[str], tuple[bytes, bytes]]
"""Creates a key and a signing request for a node, both PEM."""


class RetryLater(Exception):
    """A step failed, and should be repeated later."""


class SigningRefused(Exception):
    """The signer denied the request, or failed.

    Args:
        reason: Reason in CamelCase.
        message: One sentence for people.
    """

    def __init__(self, reason: str, message: str) -> None:
        self.reason = reason
        super().__init__(message)


class NodeIdentity:
    """Keeps a valid certificate of the node in a directory.

    Args:
        store: The node's objects at the API server.
        directory: Directory of certificate, key and authority.
        node: Name of the node.
        clock: Returns the current UTC time.
        on_change: Called when the files or the condition have changed.
        create_request: Creates keys and signing requests.

    Attributes:
        ready: Set when there is a usable certificate.
        serial: Number of file sets written, so that clients know when to reconnect.
        condition: Condition Certified of the node.
    """

    def __init__(
        self,
        store: Store,
        directory: Path,
        node: str,
        clock: Callable[[], datetime],
        *,
        on_change: Callable[[], None] = lambda: None,
        create_request: RequestFactory = create_request,
    ) -> None:
        self._store = store
        self._directory = directory
        self._node = node
        self._clock = clock
        self._on_change = on_change
        self._create_request = create_request
        self._jitter = int(hashlib.sha256(node.encode()).hexdigest()[:4], 16) / 0xFFFF / 30
        self._backoff = Backoff(0.5, 300.0)
        self._inspected: tuple[object, ValidityPeriod | None] | None = None
        self._authority_outdated = False
        self.ready = asyncio.Event()
        self.serial = 0
        self.condition = ConditionUpdate("Certified", "False", "Requested", "The node has no certificate yet.")

    @property
    def expires_s(self) -> float | None:
        """Expiry of the certificate in Unix time, None without a certificate."""
        validity = self._inspected[1] if self._inspected is not None else None
        return validity.not_after.timestamp() if validity is not None else None

    async def run(self) -> None:
        """Keep the certificate usable until cancelled."""
        checked_s = float("-inf")
        loop = asyncio.get_running_loop()
        while True:
            delay_s = FILE_CHECK_INTERVAL_S
            try:
                read_authority = (
                    self._authority_outdated
                    or loop.time() - checked_s >= AUTHORITY_INTERVAL_S
                    or self._needs_certificate()
                )
                self._authority_outdated = False
                await self.step(read_authority)
                if read_authority:
                    checked_s = loop.time()
                self._backoff.succeeded()
            except SigningRefused as refusal:
                self._set_refused(refusal)
                # NoAuthority ends soon: the operator of a new installation has not published its authority yet.
                # Refusals for other reasons last longer.
                pause_s = self._backoff.delay_s()
                delay_s = min(5.0, pause_s) if refusal.reason == "NoAuthority" else max(30.0, pause_s)
            except (KubeError, RetryLater, OSError) as error:
                if self._needs_certificate():
                    self._set_condition("False", "Requested", f"The node has no usable certificate yet: {error}")
                    delay_s = min(15.0, self._backoff.delay_s())
                else:
                    log.debug("identity: API server failed, certificate still valid (error=%s)", error)
                    checked_s = loop.time() - AUTHORITY_INTERVAL_S + 15.0
            await asyncio.sleep(delay_s)

    def refresh_authority(self) -> None:
        """Read the published authority soon, because a Grant was signed under an unknown authority."""
        self._authority_outdated = True

    async def step(self, read_authority: bool = True) -> None:
        """Check files, authority and clock once, and request a certificate if due.

        Args:
            read_authority: True to read the published authority as well.

        Raises:
            SigningRefused: The signer denied the request, or failed.
            RetryLater: The request was deleted, or not signed in time.
            KubeError: The API server is unreachable.
        """
        validity = self._validity()
        now = self._clock()
        authority = await self._store.authority() if read_authority else None
        if validity is not None and authority is not None:
            validity = self._follow_authority(authority, validity)
        if validity is not None and not validity.has_begun(now):
            self._set_condition(
                "False", "ClockSkew", f"The node's clock ({now:%F %T}) is before the start of the certificate."
            )
            return
        if validity is not None and now < validity.renewal(self._jitter):
            self._set_usable(validity)
            return
        if authority is None:
            authority = await self._store.authority()
        if authority is None:
            raise SigningRefused(
                "NoAuthority",
                "ConfigMap fractus-ca in fractus-system has no ca.crt; check that the operator is running.",
            )
        if validity is not None and now < validity.not_after:
            self._set_usable(validity)
        await self._renew(authority)

    def _needs_certificate(self) -> bool:
        validity = self._validity()
        return validity is None or self._clock() >= validity.not_after

    def _validity(self) -> ValidityPeriod | None:
        """Return the validity of the files, None if they are invalid. The files are inspected only after a change."""
        try:
            stamp: object = tuple(
                (s.st_ino, s.st_mtime_ns) for s in ((self._directory / name).stat() for name in CERTIFICATE_FILES)
            )
        except OSError:
            stamp = None
        if self._inspected is None or self._inspected[0] != stamp:
            validity = None
            if stamp is not None:
                try:
                    validity = inspect_certificate(self._directory, self._node)
                except InvalidCertificate as problem:
                    log.warning("identity: invalid certificate (directory=%s error=%s)", self._directory, problem)
            self._inspected = (stamp, validity)
        return self._inspected[1]

    def _follow_authority(self, authority: bytes, validity: ValidityPeriod) -> ValidityPeriod | None:
        """Store the published authority if it has changed. Return the validity of the certificate under this authority.

        Return None if the published authority did not issue the certificate. A new certificate must then be requested.
        """
        current = read_set(self._directory, CERTIFICATE_FILES)
        if current is None or current["ca.crt"] == authority:
            return validity
        files = {**current, "ca.crt": authority}
        try:
            self._inspect_copy(files)
        except InvalidCertificate as problem:
            log.warning("identity: certificate not issued by the new authority, requesting another (error=%s)", problem)
            return None
        self._install(files)
        log.info("identity: changed authority stored")
        return self._validity()

    async def _renew(self, authority: bytes) -> None:
        key, request = self._create_request(self._node)
        name = f"fractus-{self._node}-{hashlib.sha256(request).hexdigest()[:10]}"
        await self._store.delete_certificate_requests()
        await self._store.request_certificate(name, request, LIFETIME_S)
        log.info("identity: certificate requested (request=%s)", name)
        certificate = await self._wait_until_signed(name)
        files = {"tls.crt": certificate, "tls.key": key, "ca.crt": authority}
        try:
            validity = self._inspect_copy(files)
        except InvalidCertificate as problem:
            raise SigningRefused("Failed", f"The signed certificate is invalid: {problem}.") from problem
        self._install(files)
        with contextlib.suppress(KubeError):
            await self._store.delete_certificate_requests()
        now = self._clock()
        if not validity.has_begun(now) or now >= validity.not_after:
            raise SigningRefused(
                "ClockSkew", f"The node's clock ({now:%F %T}) is outside the validity of the new certificate."
            )
        self._set_usable(validity)

    async def _wait_until_signed(self, name: str) -> bytes:
        """Wait for the certificate of a signing request, and return it."""
        backoff = Backoff(0.2, 5.0)
        loop = asyncio.get_running_loop()
        deadline_s = loop.time() + SIGNING_TIMEOUT_S
        while loop.time() < deadline_s:
            request = await self._store.certificate_request(name)
            if request is None:
                raise RetryLater(f"signing request {name} was deleted")
            status = request.get("status") or {}
            for condition in status.get("conditions") or ():
                if condition["type"] in ("Denied", "Failed"):
                    message = condition.get("message") or condition.get("reason") or "no reason given"
                    raise SigningRefused(condition["type"], f"Signing request {name}: {message}")
            if status.get("certificate"):
                try:
                    return base64.b64decode(status["certificate"], validate=True)
                except binascii.Error as error:
                    raise SigningRefused(
                        "Failed", f"The certificate of signing request {name} is not base64: {error}"
                    ) from error
            if self._needs_certificate():
                self._set_condition("False", "Requested", f"Signing request {name} waits for the operator.")
            await asyncio.sleep(backoff.delay_s())
        raise RetryLater(f"signing request {name} was not signed within {SIGNING_TIMEOUT_S:.0f} s")

    def _inspect_copy(self, files: dict[str, bytes]) -> ValidityPeriod:
        trial = self._directory / f"..{uuid.uuid4().hex}"
        try:
            write_set(trial, files)
            return inspect_certificate(trial, self._node)
        finally:
            shutil.rmtree(trial, ignore_errors=True)

    def _install(self, files: dict[str, bytes]) -> None:
        write_set(self._directory, files)
        self._inspected = None
        self._validity()
        self.serial += 1
        self._on_change()

    def _set_usable(self, validity: ValidityPeriod) -> None:
        self._set_condition("True", "Issued", f"Valid until {validity.not_after:%F %T} UTC.")
        self.ready.set()

    def _set_refused(self, refusal: SigningRefused) -> None:
        validity = self._validity()
        if validity is None or self._needs_certificate():
            self._set_condition("False", refusal.reason, str(refusal))
        else:
            until = f"Valid until {validity.not_after:%F %T} UTC"
            self._set_condition("True", "Issued", f"{until}, but not renewed: {refusal.reason}: {refusal}")

    def _set_condition(self, status: str, reason: str, message: str) -> None:
        condition = ConditionUpdate("Certified", "True" if status == "True" else "False", reason, message)
        if condition == self.condition:
            return
        level = logging.INFO if status == "True" else logging.WARNING
        log.log(level, "identity: condition changed (reason=%s): %s", reason, message)
        self.condition = condition
        self._on_change()
