"""Why a Grant is not trusted; apart from `signatures`, so that a caller need not load the cryptography to catch it."""

from __future__ import annotations


class BadSignature(Exception):
    """The operator did not sign this Grant as it stands; the message says why."""


class UnknownAuthority(BadSignature):
    """The signer's certificate comes from an authority that this node does not know (yet)."""
