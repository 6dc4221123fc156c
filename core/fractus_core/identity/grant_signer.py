"""Signs Grants in the operator's name, and verifies which are signed already."""

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
"""Signatures that are remembered as good, so that an unchanged Grant costs nothing."""


class GrantSigner:
    """Signs Grants with a key that never leaves this process; a certificate of the authority is its proof.

    Args:
        authority: The authority that all nodes trust.
        clock: The present time.
    """

    def __init__(self, authority: Authority, clock: Callable[[], datetime]) -> None:
        self._authority = authority
        self._clock = clock
        self._signer: tuple[ec.EllipticCurvePrivateKey, x509.Certificate] | None = None
        self._last_issued = authority.certificate.not_valid_before_utc
        self._verified: dict[tuple[object, ...], None] = {}

    def sign(self, body: dict[str, Any], replaces: Grant | None = None) -> dict[str, Any]:
        """The manifest of a Grant, signed, and issued later than the one that it replaces.

        Args:
            body: The manifest.
            replaces: The Grant as it is, if there is one.
        """
        now = self._clock()
        key, certificate = self._present_signer(now)
        before = replaces.spec.issued_at if replaces is not None else None
        # A time beyond the life of every certificate is forged or damaged: following it would end all signing.
        if before is not None and before.tzinfo is not None and before < certificate.not_valid_after_utc:
            self._last_issued = max(self._last_issued, before)
        # Strictly later also when the clock stands still or went back: nodes keep the Grant that was issued last.
        self._last_issued = issued_at = max(now, self._last_issued + _TICK)
        named = {**body, "spec": {**body["spec"], "mission": _mission(body, replaces)}}
        return sign(named, key, certificate, issued_at)

    def problem(self, grant: Grant) -> str | None:
        """Why a Grant, as it is, is not valid; None if the operator of this system signed it."""
        annotations, metadata = grant.metadata.annotations, grant.metadata
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
    """The mission of a Grant: the one that it names, or else that of the same object before, or else a new one.

    `metadata.uid` names the mission where no API server gives objects their uid. On another node it is a new mission: the
    first node has ended its own when the Grant left, and would refuse to fly it again.
    """
    uid = (body.get("metadata") or {}).get("uid")
    kept = None
    if replaces is not None and replaces.spec.node == body["spec"]["node"] and uid in {None, replaces.metadata.uid}:
        kept = replaces.spec.mission
    return str(body["spec"].get("mission") or kept or uid or uuid.uuid4())
