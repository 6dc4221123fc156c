"""The node's certificate: requested through the CSR API, stored, renewed in time, and replaced when the CA rotates."""

from __future__ import annotations

import asyncio
import base64
import binascii
import contextlib
import hashlib
import json
import logging
import shutil
import sys
import uuid
from collections.abc import Awaitable, Callable
from datetime import datetime
from pathlib import Path

from fractus_runtime.files import read_set, write_set

from fractus_agent.cluster.store import Backoff, KubeError, Store
from fractus_agent.conditions import Condition
from fractus_agent.identity.certificates import Unusable, Validity, inspect

LOG = logging.getLogger(__name__)

FILES = ("tls.crt", "tls.key", "ca.crt")
LIFE_S = 30 * 86400
CHECK_INTERVAL_S = 10.0
"""Seconds between checks of the files and the clock."""
AUTHORITY_INTERVAL_S = 300.0
"""Seconds between reads of the published authority."""
SIGNING_TIMEOUT_S = 600.0

RequestMaker = Callable[[str], Awaitable[tuple[bytes, bytes]]]


class NotYet(Exception):
    """A step did not succeed this time: try again later."""


class SigningRefused(Exception):
    """The signer denied the request, or failed."""

    def __init__(self, reason: str, message: str) -> None:
        self.reason = reason
        super().__init__(message)


async def make_request_in_process(node: str) -> tuple[bytes, bytes]:
    """A key and a signing request, made by a process of its own.

    Raises:
        NotYet: the process failed or took longer than a minute.
    """
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "fractus_agent.identity.csr", node,
        stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE,
    )  # fmt: skip
    try:
        output, complaint = await asyncio.wait_for(process.communicate(), 60.0)
        if process.returncode != 0:
            raise NotYet(f"the key could not be made: {complaint.decode(errors='replace')[-500:]}")
        made = json.loads(output)
        return made["key"].encode(), made["request"].encode()
    except TimeoutError as error:
        raise NotYet("making the key took longer than a minute") from error
    finally:
        if process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()


class Identity:
    """Keeps a valid certificate of the node in a directory.

    `ready` is set once there is a usable one; `serial` counts the sets written, so that clients know when to reconnect.
    """

    def __init__(
        self,
        store: Store,
        directory: Path,
        node: str,
        clock: Callable[[], datetime],
        *,
        changed: Callable[[], None] = lambda: None,
        make_request: RequestMaker = make_request_in_process,
    ) -> None:
        self._store = store
        self._directory = directory
        self._node = node
        self._clock = clock
        self._changed = changed
        self._make_request = make_request
        self._jitter = int(hashlib.sha256(node.encode()).hexdigest()[:4], 16) / 0xFFFF / 30
        self._backoff = Backoff(0.5, 300.0)
        self._known: tuple[object, Validity | None] | None = None
        self._authority_outdated = False
        self.ready = asyncio.Event()
        self.serial = 0
        self.condition = Condition("Certified", "False", "Requested", "The node has no certificate yet.")

    @property
    def expires_s(self) -> float | None:
        """Unix time at which the certificate expires, as last seen by what keeps it usable; None while there is none."""
        validity = self._known[1] if self._known is not None else None
        return validity.not_after.timestamp() if validity is not None else None

    async def run(self) -> None:
        """Keep the certificate usable until cancelled."""
        asked_s = float("-inf")
        loop = asyncio.get_running_loop()
        while True:
            delay_s = CHECK_INTERVAL_S
            try:
                ask = (
                    self._authority_outdated
                    or loop.time() - asked_s >= AUTHORITY_INTERVAL_S
                    or self._needs_certificate()
                )
                self._authority_outdated = False
                await self.step(ask)
                if ask:
                    asked_s = loop.time()
                self._backoff.succeeded()
            except SigningRefused as refusal:
                self._refused(refusal)
                # The operator of a new installation is about to publish its authority; other refusals last longer.
                pause_s = self._backoff.delay_s()
                delay_s = min(5.0, pause_s) if refusal.reason == "NoAuthority" else max(30.0, pause_s)
            except (KubeError, NotYet, OSError) as error:
                if self._needs_certificate():
                    self._set_condition("False", "Requested", f"The node has no usable certificate yet: {error}")
                    delay_s = min(15.0, self._backoff.delay_s())
                else:
                    LOG.debug("identity: the API server failed, certificate still valid: %s", error)
                    asked_s = loop.time() - AUTHORITY_INTERVAL_S + 15.0
            await asyncio.sleep(delay_s)

    def refresh_authority(self) -> None:
        """Read the published authority soon: a grant came that was signed under another one."""
        self._authority_outdated = True

    async def step(self, ask: bool = True) -> None:
        """Check files, authority and clock once, and do what is due.

        Args:
            ask: whether to read the published authority too.

        Raises:
            SigningRefused: the signer denied the request, or failed.
            KubeError: something is due and the API server is out of reach.
        """
        validity, now = self._validity(), self._clock()
        authority = await self._store.authority() if ask else None
        if validity is not None and authority is not None:
            validity = self._follow_authority(authority, validity)
        if validity is not None and not validity.begun(now):
            self._set_condition(
                "False", "ClockSkew", f"The node's clock says {now:%F %T}, before the certificate begins."
            )
            return
        if validity is not None and now < validity.renewal(self._jitter):
            self._usable(validity)
            return
        if authority is None:
            authority = await self._store.authority()
        if authority is None:
            raise SigningRefused(
                "NoAuthority", "ConfigMap fractus-ca in fractus-system has no ca.crt: is the operator up?"
            )
        if validity is not None and now < validity.not_after:
            self._usable(validity)
        await self._renew(authority)

    def _needs_certificate(self) -> bool:
        validity = self._validity()
        return validity is None or self._clock() >= validity.not_after

    def _validity(self) -> Validity | None:
        """What the files say; asked of OpenSSL only when they changed."""
        try:
            stamp: object = tuple((s.st_ino, s.st_mtime_ns) for s in ((self._directory / f).stat() for f in FILES))
        except OSError:
            stamp = None
        if self._known is None or self._known[0] != stamp:
            validity = None
            if stamp is not None:
                try:
                    validity = inspect(self._directory, self._node)
                except Unusable as problem:
                    LOG.warning("identity: certificate unusable (directory=%s): %s", self._directory, problem)
            self._known = (stamp, validity)
        return self._known[1]

    def _follow_authority(self, authority: bytes, validity: Validity) -> Validity | None:
        """Take a changed authority; None when it does not cover our certificate, which then is requested again."""
        current = read_set(self._directory, FILES)
        if current is None or current["ca.crt"] == authority:
            return validity
        files = {**current, "ca.crt": authority}
        try:
            self._inspect_copy(files)
        except Unusable as problem:
            LOG.warning("identity: the new authority did not issue this certificate, requesting another: %s", problem)
            return None
        self._install(files)
        LOG.info("identity: stored the changed authority")
        return self._validity()

    async def _renew(self, authority: bytes) -> None:
        key, request = await self._make_request(self._node)
        name = f"fractus-{self._node}-{hashlib.sha256(request).hexdigest()[:10]}"
        await self._store.drop_certificate_requests()
        await self._store.request_certificate(name, request, LIFE_S)
        LOG.info("identity: certificate requested (request=%s)", name)
        certificate = await self._signed(name)
        files = {"tls.crt": certificate, "tls.key": key, "ca.crt": authority}
        try:
            validity = self._inspect_copy(files)
        except Unusable as problem:
            raise SigningRefused("Failed", f"The signed certificate is of no use: {problem}.") from problem
        self._install(files)
        with contextlib.suppress(KubeError):
            await self._store.drop_certificate_requests()
        now = self._clock()
        if not validity.begun(now) or now >= validity.not_after:
            raise SigningRefused("ClockSkew", f"The node's clock says {now:%F %T}, outside the new certificate's life.")
        self._usable(validity)

    async def _signed(self, name: str) -> bytes:
        """Wait for the certificate of a signing request."""
        backoff = Backoff(0.2, 5.0)
        loop = asyncio.get_running_loop()
        until_s = loop.time() + SIGNING_TIMEOUT_S
        while loop.time() < until_s:
            found = await self._store.certificate_request(name)
            if found is None:
                raise NotYet(f"signing request {name} was deleted")
            status = found.get("status") or {}
            for condition in status.get("conditions") or ():
                if condition["type"] in ("Denied", "Failed"):
                    said = condition.get("message") or condition.get("reason") or "no reason given"
                    raise SigningRefused(condition["type"], f"Signing request {name}: {said}")
            if status.get("certificate"):
                try:
                    return base64.b64decode(status["certificate"], validate=True)
                except binascii.Error as error:
                    raise SigningRefused("Failed", f"Signing request {name} holds no base64: {error}") from error
            if self._needs_certificate():
                self._set_condition("False", "Requested", f"Signing request {name} waits for the operator.")
            await asyncio.sleep(backoff.delay_s())
        raise NotYet(f"no one signed {name} in {SIGNING_TIMEOUT_S:.0f} s")

    def _inspect_copy(self, files: dict[str, bytes]) -> Validity:
        trial = self._directory / f"..{uuid.uuid4().hex}"
        try:
            write_set(trial, files)
            return inspect(trial, self._node)
        finally:
            shutil.rmtree(trial, ignore_errors=True)

    def _install(self, files: dict[str, bytes]) -> None:
        write_set(self._directory, files)
        self._known = None
        self._validity()
        self.serial += 1
        self._changed()

    def _usable(self, validity: Validity) -> None:
        self._set_condition("True", "Issued", f"Valid until {validity.not_after:%F %T} UTC.")
        self.ready.set()

    def _refused(self, refusal: SigningRefused) -> None:
        validity = self._validity()
        if validity is None or self._needs_certificate():
            self._set_condition("False", refusal.reason, str(refusal))
        else:
            until = f"Valid until {validity.not_after:%F %T} UTC"
            self._set_condition("True", "Issued", f"{until}, but not renewed: {refusal.reason}: {refusal}")

    def _set_condition(self, status: str, reason: str, message: str) -> None:
        found = Condition("Certified", "True" if status == "True" else "False", reason, message)
        if found == self.condition:
            return
        LOG.log(logging.INFO if found.is_true else logging.WARNING, "identity: %s: %s", reason, message)
        self.condition = found
        self._changed()
