"""The operator's signature for tests of what checks it."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from fractus_core.api import Grant
from fractus_operator.identity.authority import Authority
from fractus_operator.identity.grantor import Grantor

AUTHORITY = Authority.generate(datetime.now(UTC))
CA_PEM = AUTHORITY.certificate_pem
_GRANTOR = Grantor(AUTHORITY, lambda: datetime.now(UTC))


def signed(manifest: dict[str, Any], before: dict[str, Any] | None = None) -> dict[str, Any]:
    """The grant, signed later than all before."""
    return _GRANTOR.signed(manifest, Grant.from_body(before) if before is not None else None)
