"""The operator's signature for tests of what checks it."""

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
    """The grant, signed later than all before."""
    return _SIGNER.sign(manifest, Grant.from_body(before) if before is not None else None)
