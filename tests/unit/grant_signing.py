"""Signed Grants for tests of code that verifies signatures."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from fractus_core.api import Grant
from fractus_core.identity.authority import Authority
from fractus_core.identity.grant_signer import GrantSigner

AUTHORITY = Authority.generate(datetime.now(UTC))
CA_PEM = AUTHORITY.certificate_pem
_SIGNER = GrantSigner(AUTHORITY, lambda: datetime.now(UTC))


def signed(manifest: dict[str, Any], before: dict[str, Any] | None = None) -> dict[str, Any]:
    """Return a Grant manifest with a signature of the operator.

    Each signature has a later time than all earlier signatures of the process.
    """
    return _SIGNER.sign(manifest, Grant.from_body(before) if before is not None else None)
