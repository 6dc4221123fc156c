"""Search for leaked secrets: it finds each secret in all encodings, and has no false positives."""

from __future__ import annotations

import base64
import json
from datetime import UTC, datetime

import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec
from fractus_core.identity.authority import Authority
from leaks import leaks

NOW = datetime(2026, 1, 1, tzinfo=UTC)
ISSUED = Authority.generate(NOW).issue_component("spiffe://fractus.dev/ns/n/app/a/component/C/instance/i", NOW)
DATA = {name: base64.b64decode(value) for name, value in ISSUED.items()}
KEY = DATA["tls.key"]
PRIVATE = serialization.load_pem_private_key(KEY, None)
assert isinstance(PRIVATE, ec.EllipticCurvePrivateKey)
NUMBER = PRIVATE.private_numbers().private_value.to_bytes(32)
DER = PRIVATE.private_bytes(
    serialization.Encoding.DER, serialization.PrivateFormat.TraditionalOpenSSL, serialization.NoEncryption()
)
PASSWORD = b"correct horse battery"
TOKEN = ".".join(
    base64.urlsafe_b64encode(part).decode().rstrip("=") for part in (b'{"alg":"RS256"}', b'{"sub":"node"}', bytes(40))
)

PLANTED = {
    "PEM": KEY.decode(),
    "PEM without its head": KEY.decode().splitlines()[1],
    "JSON": json.dumps({"data": KEY.decode()}),
    "Secret": base64.b64encode(KEY).decode(),
    "DER": base64.b64encode(DER).decode(),
    "within DER": base64.b64encode(b"x" + DER).decode(),
    "within more DER": base64.b64encode(b"xy" + DER).decode(),
    "hexadecimal": NUMBER.hex(),
    "URL": base64.urlsafe_b64encode(NUMBER).decode(),
    "Python": PASSWORD.decode(),
    "Python in base64": base64.b64encode(b"password: " + PASSWORD).decode(),
    "token": f"Authorization: Bearer {TOKEN}",
}


@pytest.mark.parametrize("text", PLANTED.values(), ids=PLANTED)
def test_secret_is_found_in_each_encoding(text: str) -> None:
    assert leaks({"log": f"agent: starts {text} and goes on"}, {"key": KEY, "password": PASSWORD})


def test_finding_names_the_text_and_the_secret() -> None:
    texts = {"log": "fine", "status": PASSWORD.decode()}
    assert leaks(texts, {"key": KEY, "password": PASSWORD}) == ["status contains password"]


def test_public_values_are_not_findings() -> None:
    certificate = DATA["tls.crt"].decode()
    der = PRIVATE.public_key().public_bytes(serialization.Encoding.DER, serialization.PublicFormat.SubjectPublicKeyInfo)
    texts = [
        certificate,
        base64.b64encode(DATA["tls.crt"]).decode(),
        base64.b64encode(der).decode(),
        der.hex(),
        "eyJ.eyJ.x",
    ]
    assert leaks({str(n): text for n, text in enumerate(texts)}, {"key": KEY, "certificate": DATA["tls.crt"]}) == []
