"""Search of texts for secrets: private keys and tokens of any kind, and given values in several encodings."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterable, Iterator, Mapping

from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec

_PEM_KEY = re.compile(rb"-----BEGIN ([A-Z ]*)PRIVATE KEY-----.*?-----END \1PRIVATE KEY-----", re.DOTALL)
_ANY_KEY = re.compile(r"BEGIN [A-Z ]*PRIVATE KEY")
_ANY_TOKEN = re.compile(r"eyJ[\w-]{10,}\.eyJ[\w-]{10,}\.[\w-]{20,}")
"""JSON Web Token, as service accounts have."""

MIN_BYTES = 16
"""Minimum length of a secret. A shorter one could be a common word."""


def spellings(secret: bytes) -> Iterator[str]:
    """Return a secret as text, as hexadecimal digits, and as part of longer base64 text at each possible offset."""
    yield secret.decode(errors="replace")
    yield secret.hex()
    for before in range(3):
        whole = base64.b64encode(bytes(before) + secret).decode()
        # The first and last characters depend on the surrounding bytes.
        part = whole[-(-before * 8 // 6) : len(whole) // 4 * 4 - 4]
        yield from {part, part.replace("+", "-").replace("/", "_")}


def parts(value: bytes) -> Iterator[bytes]:
    """Return the secret parts of a value: number and lines of PEM private keys, nothing of certificates, or all of it."""
    keys = [found[0] for found in _PEM_KEY.finditer(value)]
    for pem in keys:
        key = serialization.load_pem_private_key(pem, password=None)
        assert isinstance(key, ec.EllipticCurvePrivateKey)
        yield key.private_numbers().private_value.to_bytes(key.curve.key_size // 8)
        # The remaining lines contain the public key.
        yield from pem.splitlines()[1:3]
    if not keys and b"-----BEGIN " not in value and len(value) >= MIN_BYTES:
        yield value.strip()


def leaks(texts: Mapping[str, str], secrets: Mapping[str, bytes]) -> list[str]:
    """Return a finding for each text that contains a named secret, or any private key or token."""
    sought = {name: {s for part in parts(value) for s in spellings(part)} for name, value in secrets.items()}
    return [f"{name} contains {finding}" for name, text in texts.items() for finding in _found(text, sought)]


def _found(text: str, sought: Mapping[str, Iterable[str]]) -> Iterator[str]:
    if _ANY_KEY.search(text) or any(s in text for s in spellings(b"PRIVATE KEY-----")):
        yield "a private key"
    if _ANY_TOKEN.search(text):
        yield "a token"
    yield from (name for name, spelled in sought.items() if any(s in text for s in spelled))
