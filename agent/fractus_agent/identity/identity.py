"""The node's certificate: asked for through the CSR API, kept on disk, renewed in time, followed through CA rotations."""

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
from typing import Protocol

from fractus_storage import read_set, write_set

from fractus_agent.cluster.store import Backoff, KubeError, Object
from fractus_agent.conditions import Finding
from fractus_agent.identity.certificates import Unusable, Validity, inspect

LOG = logging.getLogger(__name__)

FILES = ("tls.crt", "tls.key", "ca.crt")
LIFE_S = 30 * 86400
LOOK_S = 10.0
"""Seconds between looks at the files and the clock."""
ASK_CA_S = 300.0
"""Seconds between looks at the published authority."""
SIGNING_TIMEOUT_S = 600.0

RequestMaker = Callable[[str], Awaitable[tuple[bytes, bytes]]]


class Authority(Protocol):
    """What identity needs of the store."""

    async def authority(self) -> bytes | None:
        """The PEM certificates that nodes trust."""

    async def request_certificate(self, name: str, request_pem: bytes, life_s: int) -> None:
        """Create a signing request."""

    async def certificate_request(self, name: str) -> Object | None:
        """What became of it."""

    async def drop_certificate_requests(self) -> None:
        """Delete this node's signing requests."""


class NotYet(Exception):
    """A step did not succeed this time: try again later."""


class Refused(Exception):
    """The signer denied the request, or failed."""

    def __init__(self, reason: str, message: str) -> None:
        self.reason = reason
        super().__init__(message)


async def make_request_apart(node: str) -> tuple[bytes, bytes]:
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
        store: Authority,
        directory: Path,
        node: str,
        clock: Callable[[], datetime],
        *,
        changed: Callable[[], None] = lambda: None,
        make_request: RequestMaker = make_request_apart,
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
        self._doubted = False
        self.ready = asyncio.Event()
        self.serial = 0
        self.finding = Finding("Certified", "False", "Requested", "The node has no certificate yet.")

    async def run(self) -> None:
        """Keep the certificate usable, for ever."""
        asked_s = float("-inf")
        loop = asyncio.get_running_loop()
        while True:
            delay_s = LOOK_S
            try:
                ask = self._doubted or loop.time() - asked_s >= ASK_CA_S or self._wanting()
                self._doubted = False
                await self.step(ask)
                if ask:
                    asked_s = loop.time()
                self._backoff.succeeded()
            except Refused as refusal:
                self._refused(refusal)
                # A new installation's operator is about to publish its authority; a refusal wants patience.
                pause_s = self._backoff.delay_s()
                delay_s = min(5.0, pause_s) if refusal.reason == "NoAuthority" else max(30.0, pause_s)
            except (KubeError, NotYet, OSError) as error:
                if self._wanting():
                    self._find("False", "Requested", f"The node has no usable certificate yet: {error}")
                    delay_s = min(15.0, self._backoff.delay_s())
                else:
                    LOG.debug("the certificate cannot be looked after now: %s", error)
                    asked_s = loop.time() - ASK_CA_S + 15.0
            await asyncio.sleep(delay_s)

    def doubt_authority(self) -> None:
        """Look at the published authority soon: a certificate of another one was presented."""
        self._doubted = True

    async def step(self, ask: bool = True) -> None:
        """Look at files, authority and clock once, and do what is due.

        Args:
            ask: whether to look at the published authority too.

        Raises:
            Refused: the signer denied the request, or failed.
            KubeError: something is due and the API server is out of reach.
        """
        validity, now = self._validity(), self._clock()
        authority = await self._store.authority() if ask else None
        if validity is not None and authority is not None:
            validity = self._follow_authority(authority, validity)
        if validity is not None and not validity.begun(now):
            self._find("False", "ClockSkew", f"The node's clock says {now:%F %T}, before the certificate begins.")
            return
        if validity is not None and now < validity.renewal(self._jitter):
            self._usable(validity)
            return
        if authority is None:
            authority = await self._store.authority()
        if authority is None:
            raise Refused("NoAuthority", "ConfigMap fractus-ca in fractus-system has no ca.crt: is the operator up?")
        if validity is not None and now < validity.not_after:
            self._usable(validity)
        await self._renew(authority)

    def _wanting(self) -> bool:
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
                    LOG.warning("the certificate in %s is of no use: %s", self._directory, problem)
            self._known = (stamp, validity)
        return self._known[1]

    def _follow_authority(self, authority: bytes, validity: Validity) -> Validity | None:
        """Take a changed authority; None when it does not cover our certificate, which then is asked for anew."""
        current = read_set(self._directory, FILES)
        if current is None or current["ca.crt"] == authority:
            return validity
        files = {**current, "ca.crt": authority}
        try:
            self._inspect_apart(files)
        except Unusable as problem:
            LOG.warning("the new authority does not cover the node's certificate: %s", problem)
            return None
        self._install(files)
        LOG.info("took the changed authority")
        return self._validity()

    async def _renew(self, authority: bytes) -> None:
        key, request = await self._make_request(self._node)
        name = f"fractus-{self._node}-{hashlib.sha256(request).hexdigest()[:10]}"
        await self._store.drop_certificate_requests()
        await self._store.request_certificate(name, request, LIFE_S)
        LOG.info("asked for a certificate: signing request %s", name)
        certificate = await self._signed(name)
        files = {"tls.crt": certificate, "tls.key": key, "ca.crt": authority}
        try:
            validity = self._inspect_apart(files)
        except Unusable as problem:
            raise Refused("Failed", f"The signed certificate is of no use: {problem}.") from problem
        self._install(files)
        with contextlib.suppress(KubeError):
            await self._store.drop_certificate_requests()
        now = self._clock()
        if not validity.begun(now) or now >= validity.not_after:
            raise Refused("ClockSkew", f"The node's clock says {now:%F %T}, outside the new certificate's life.")
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
                    raise Refused(condition["type"], f"Signing request {name}: {said}")
            if status.get("certificate"):
                try:
                    return base64.b64decode(status["certificate"], validate=True)
                except binascii.Error as error:
                    raise Refused("Failed", f"Signing request {name} holds no base64: {error}") from error
            if self._wanting():
                self._find("False", "Requested", f"Signing request {name} waits for the operator.")
            await asyncio.sleep(backoff.delay_s())
        raise NotYet(f"no one signed {name} in {SIGNING_TIMEOUT_S:.0f} s")

    def _inspect_apart(self, files: dict[str, bytes]) -> Validity:
        trial = self._directory / f"..{uuid.uuid4().hex}"
        try:
            write_set(trial, files)
            return inspect(trial, self._node)
        finally:
            shutil.rmtree(trial, ignore_errors=True)

    def _install(self, files: dict[str, bytes]) -> None:
        write_set(self._directory, files)
        self._known = None
        self.serial += 1
        self._changed()

    def _usable(self, validity: Validity) -> None:
        self._find("True", "Issued", f"Valid until {validity.not_after:%F %T} UTC.")
        self.ready.set()

    def _refused(self, refusal: Refused) -> None:
        validity = self._validity()
        if validity is None or self._wanting():
            self._find("False", refusal.reason, str(refusal))
        else:
            until = f"Valid until {validity.not_after:%F %T} UTC"
            self._find("True", "Issued", f"{until}, but not renewed: {refusal.reason}: {refusal}")

    def _find(self, status: str, reason: str, message: str) -> None:
        found = Finding("Certified", "True" if status == "True" else "False", reason, message)
        if found == self.finding:
            return
        LOG.log(logging.INFO if found.holds else logging.WARNING, "certificate %s: %s", reason, message)
        self.finding = found
        self._changed()
