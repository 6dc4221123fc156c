"""Whether a text tells a secret: private keys and tokens of any kind, and given ones however they are spelled."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterable, Iterator, Mapping

from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec

_PEM_KEY = re.compile(rb"-----BEGIN ([A-Z ]*)PRIVATE KEY-----.*?-----END \1PRIVATE KEY-----", re.DOTALL)
_ANY_KEY = re.compile(r"BEGIN [A-Z ]*PRIVATE KEY")
_ANY_TOKEN = re.compile(r"eyJ[\w-]{10,}\.eyJ[\w-]{10,}\.[\w-]{20,}")
"""A JSON Web Token, such as those of service accounts."""

MIN_BYTES = 16
"""A secret that is shorter may be a word."""


def spellings(secret: bytes) -> Iterator[str]:
    """A secret as text, in hexadecimal digits, and as part of something in base64 wherever it begins there."""
    yield secret.decode(errors="replace")
    yield secret.hex()
    for before in range(3):
        whole = base64.b64encode(bytes(before) + secret).decode()
        # The first and the last characters also tell of what is before and after it.
        part = whole[-(-before * 8 // 6) : len(whole) // 4 * 4 - 4]
        yield from {part, part.replace("+", "-").replace("/", "_")}


def parts(value: bytes) -> Iterator[bytes]:
    """What is secret of a value: of private keys in PEM the numbers and the lines, of certificates nothing, else all."""
    keys = [found[0] for found in _PEM_KEY.finditer(value)]
    for pem in keys:
        key = serialization.load_pem_private_key(pem, password=None)
        assert isinstance(key, ec.EllipticCurvePrivateKey)
        yield key.private_numbers().private_value.to_bytes(key.curve.key_size // 8)
        # The last ones are of the public key.
        yield from pem.splitlines()[1:3]
    if not keys and b"-----BEGIN " not in value and len(value) >= MIN_BYTES:
        yield value.strip()


def leaks(told: Mapping[str, str], secrets: Mapping[str, bytes]) -> list[str]:
    """Which of the texts tell which of the secrets, by their names, and which tell any private key or token at all."""
    sought = {name: {s for part in parts(value) for s in spellings(part)} for name, value in secrets.items()}
    return [f"{where} tells {what}" for where, text in told.items() for what in _found(text, sought)]


def _found(text: str, sought: Mapping[str, Iterable[str]]) -> Iterator[str]:
    if _ANY_KEY.search(text) or any(s in text for s in spellings(b"PRIVATE KEY-----")):
        yield "a private key"
    if _ANY_TOKEN.search(text):
        yield "a token"
    yield from (name for name, spelled in sought.items() if any(s in text for s in spelled))
