"""Whether the operator signed a Grant, by the authority that the node trusts."""

from __future__ import annotations

from pathlib import Path

from fractus_core.api.grants import Grant
from fractus_core.policy.grant_signatures import UnknownAuthority


class GrantVerifier:
    """Verifies the signatures of Grants.

    Args:
        directory: where ca.crt is, now or later.
    """

    def __init__(self, directory: Path) -> None:
        self._path = directory / "ca.crt"

    def verify(self, grant: Grant) -> None:
        """Verify one.

        Raises:
            BadSignature: the operator did not sign it as it stands.
            UnknownAuthority: its authority is not known here yet.
        """
        # Imported here: the cryptography is a fifth of the memory, and nodes without a Grant do not need it.
        from fractus_core.policy.grant_signatures import read_authorities, verify  # noqa: PLC0415

        try:
            authorities = read_authorities(self._path.read_bytes())
        except (OSError, ValueError) as error:
            raise UnknownAuthority(f"the node has no authority to check its signature by ({error})") from None
        verify(grant, authorities)
