"""Whether a Grant is the operator's word, by the authority that the node trusts."""

from __future__ import annotations

from pathlib import Path

from fractus_core.api.plans import Grant


class Unsigned(Exception):
    """The operator did not sign this Grant as it stands."""


class Undecided(Exception):
    """Nobody can tell yet: the authority behind the signature is not known on this node."""


class Seals:
    """Checks the signatures of Grants.

    Args:
        directory: where ca.crt is, now or later.
    """

    def __init__(self, directory: Path) -> None:
        self._path = directory / "ca.crt"

    def check(self, grant: Grant) -> None:
        """Check one.

        Raises:
            Unsigned: the operator did not sign it as it stands.
            Undecided: its authority is not known here yet.
        """
        # Imported here: the cryptography is a fifth of the memory, and nodes without a Grant do not need it.
        from fractus_core.policy.signatures import BadSignature, UnknownAuthority, read_authorities, verify  # noqa: PLC0415

        try:
            authorities = read_authorities(self._path.read_bytes())
        except (OSError, ValueError) as error:
            raise Undecided(f"the node has no authority to check its signature by ({error})") from None
        try:
            verify(grant, authorities)
        except UnknownAuthority as error:
            raise Undecided(str(error)) from None
        except BadSignature as error:
            raise Unsigned(str(error)) from None
