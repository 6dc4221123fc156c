"""Signs Grants in the operator's name, and knows which are signed already."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timedelta

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec
from fractus_core.api import Grant, InvalidObject
from fractus_core.policy.signatures import SIGNATURE_ANNOTATION, SIGNER_ANNOTATION, sign, verify
from fractus_core.policy.trust import BadSignature

from fractus_operator.cluster.kinds import Body
from fractus_operator.cluster.reading import read
from fractus_operator.identity.authority import Authority, renewal_time

logger = logging.getLogger(__name__)

_TICK = timedelta(microseconds=1)
_KNOWN = 4096
"""Signatures that are remembered as good, so that an unchanged Grant costs nothing."""


@dataclass(frozen=True, slots=True)
class Signer:
    """A signing key, and the certificate that says that Grants may be signed with it."""

    key: ec.EllipticCurvePrivateKey
    certificate: x509.Certificate


class Grantor:
    """Signs Grants with a key that never leaves this process; certificates of the authority vouch for it.

    Args:
        authority: whom all nodes trust.
        clock: The present time.
    """

    def __init__(self, authority: Authority, clock: Callable[[], datetime]) -> None:
        self._authority = authority
        self._clock = clock
        self._signer: Signer | None = None
        self._last = authority.certificate.not_valid_before_utc
        self._good: dict[tuple[object, ...], None] = {}

    def signed(self, body: Body, observed: Grant | None = None) -> Body:
        """The manifest of a Grant, signed, and issued later than the one that it replaces.

        Args:
            body: The manifest.
            observed: The Grant as it is, if there is one.
        """
        now = self._clock()
        signer = self._present_signer(now)
        before = observed.spec.issued_at if observed is not None else None
        if before is not None and before.tzinfo is not None and before < signer.certificate.not_valid_after_utc:
            self._last = max(self._last, before)
        self._last = issued_at = max(now, self._last + _TICK)
        return sign(body, signer.key, signer.certificate, issued_at)

    def vouches(self, grant: Grant) -> bool:
        """Whether a Grant, as it stands, is signed by this system's operator."""
        annotations, metadata = grant.metadata.annotations, grant.metadata
        fingerprint = (
            metadata.uid,
            metadata.generation,
            annotations.get(SIGNATURE_ANNOTATION),
            annotations.get(SIGNER_ANNOTATION),
        )
        if fingerprint in self._good:
            return True
        try:
            verify(grant, (self._authority.certificate,))
        except BadSignature as problem:
            logger.warning("Grant %s does not count and is made anew: %s", grant.name, problem)
            return False
        self._good[fingerprint] = None
        for oldest in tuple(itertools.islice(self._good, max(len(self._good) - _KNOWN, 0))):
            del self._good[oldest]
        return True

    def vouches_for(self, body: Body) -> bool:
        """As `vouches`, for a Grant as the API server has it."""
        try:
            return self.vouches(read(Grant, body))
        except InvalidObject:
            return False

    def _present_signer(self, now: datetime) -> Signer:
        if self._signer is None or now >= renewal_time(self._signer.certificate):
            self._signer = Signer(*self._authority.issue_signer(now))
        return self._signer
