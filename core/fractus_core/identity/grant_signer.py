"""Signing and verification of Grants by the operator."""

from __future__ import annotations

import itertools
import uuid
from collections.abc import Callable
from datetime import datetime, timedelta
from typing import Any

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec

from fractus_core.api import Grant
from fractus_core.identity.authority import Authority, renewal_time
from fractus_core.policy.grant_signatures import SIGNATURE_ANNOTATION, SIGNER_ANNOTATION, BadSignature, sign, verify

_TICK = timedelta(microseconds=1)
_MAX_VERIFIED = 4096
"""Maximum number of cached valid signatures, so that unchanged Grants are verified only once."""


class GrantSigner:
    """Signs Grants with a key that never leaves this process. The authority issues a certificate for the key.

    Args:
        authority: Authority that all nodes trust.
        clock: Returns the current time.
    """

    def __init__(self, authority: Authority, clock: Callable[[], datetime]) -> None:
        self._authority = authority
        self._clock = clock
        self._signer: tuple[ec.EllipticCurvePrivateKey, x509.Certificate] | None = None
        self._last_issued = authority.certificate.not_valid_before_utc
        self._verified: dict[tuple[object, ...], None] = {}

    def sign(self, body: dict[str, Any], replaces: Grant | None = None) -> dict[str, Any]:
        """Return the signed manifest of a Grant, issued later than the Grant that it replaces.

        Args:
            body: Manifest of the Grant.
            replaces: Existing Grant, if any.
        """
        now = self._clock()
        key, certificate = self._present_signer(now)
        before = replaces.spec.issued_at if replaces is not None else None
        # Ignore a time of issue after the expiry of the certificate. Such a time is forged or damaged, and the
        # certificate does not permit a later time.
        if before is not None and before.tzinfo is not None and before < certificate.not_valid_after_utc:
            self._last_issued = max(self._last_issued, before)
        # The time must increase even if the clock stops or goes back, because nodes keep the latest Grant.
        self._last_issued = issued_at = max(now, self._last_issued + _TICK)
        named = {**body, "spec": {**body["spec"], "mission": _mission(body, replaces)}}
        return sign(named, key, certificate, issued_at)

    def problem(self, grant: Grant) -> str | None:
        """Return why a Grant is invalid, or None if the operator of this system signed it."""
        annotations = grant.metadata.annotations
        metadata = grant.metadata
        fingerprint = (
            metadata.uid,
            metadata.generation,
            annotations.get(SIGNATURE_ANNOTATION),
            annotations.get(SIGNER_ANNOTATION),
        )
        if fingerprint in self._verified:
            return None
        try:
            verify(grant, (self._authority.certificate,))
        except BadSignature as problem:
            return str(problem)
        self._verified[fingerprint] = None
        for oldest in tuple(itertools.islice(self._verified, max(len(self._verified) - _MAX_VERIFIED, 0))):
            del self._verified[oldest]
        return None

    def _present_signer(self, now: datetime) -> tuple[ec.EllipticCurvePrivateKey, x509.Certificate]:
        if self._signer is None or now >= renewal_time(self._signer[1]):
            self._signer = self._authority.issue_signer(now)
        return self._signer


def _mission(body: dict[str, Any], replaces: Grant | None) -> str:
    """Return the identifier of the mission of a Grant.

    This is the mission in the spec of the Grant, or else the mission of the Grant that it replaces. Otherwise it is a
    new mission, identified by the uid of the Grant or by a random identifier.

    If a Grant moves to another node, a new mission begins. The first node has ended the old mission, and would refuse
    to fly it again if the Grant moved back.
    """
    uid = (body.get("metadata") or {}).get("uid")
    kept = None
    if replaces is not None and replaces.spec.node == body["spec"]["node"] and uid in {None, replaces.metadata.uid}:
        kept = replaces.spec.mission
    return str(body["spec"].get("mission") or kept or uid or uuid.uuid4())
