"""Checkpoints of an audit log: its last entry, signed by the node.

A copy on another computer later proves that no entry was removed.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from fractus_core.api.names import node_identity

from fractus_runtime.audit_chain import ChainEntry, canonical
from fractus_runtime.files import parse_json, read_file

_CONTEXT = b"fractus.dev audit checkpoint 1\n"
_NODES = node_identity("")
_STATUS_FORM = re.compile(r"(?P<log>[^:/]+):(?P<number>\d{1,15}):(?P<hash>[0-9a-f]{64})")


class InvalidCheckpoint(Exception):
    """The checkpoint is not valid."""


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """An entry that an audit log contained at some time. The log then also contained all entries before this entry.

    Attributes:
        log: Name of the log, without directory and extension.
        node: Identity of the node that signed the checkpoint. Empty if it has no signature.
        entry: The entry.
        certified: True if the node's certificate was verified with an authority.
    """

    log: str
    node: str
    entry: ChainEntry
    certified: bool


def sign_checkpoint(log: str, entry: ChainEntry, time: str, tls: Path) -> bytes:
    """Return a signed checkpoint as JSON, including the certificate that verifies the signature.

    Args:
        log: Name of the log.
        entry: Last entry of the log on disk.
        time: Current time in ISO 8601.
        tls: Directory of the node's tls.key and tls.crt.

    Raises:
        OSError: The key or the certificate cannot be read.
        ValueError: The key or the certificate is malformed.
        TypeError: The key is not an elliptic curve key.
    """
    key = serialization.load_pem_private_key(read_file(tls / "tls.key"), None)
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise TypeError(f"{tls / 'tls.key'}: not an elliptic curve key")
    certificate = x509.load_pem_x509_certificate(read_file(tls / "tls.crt"))
    content = {
        "log": log, "seq": entry.sequence, "hash": entry.hash, "time": time,
        "certificate": certificate.public_bytes(serialization.Encoding.PEM).decode(),
    }  # fmt: skip
    signature = key.sign(_CONTEXT + canonical(content), ec.ECDSA(hashes.SHA256()))
    return canonical({**content, "signature": base64.b64encode(signature).decode()}) + b"\n"


def parse_status_checkpoint(text: str) -> Checkpoint | None:
    """Parse a checkpoint of a node's status, LOG:NUMBER:HASH. Return None if the text does not have this format."""
    match = _STATUS_FORM.fullmatch(text)
    return Checkpoint(match["log"], "", ChainEntry(int(match["number"]), match["hash"]), False) if match else None


def read_checkpoint(data: bytes, authorities: Sequence[x509.Certificate] = ()) -> Checkpoint:
    """Verify the signature of a checkpoint and, if authorities are given, the certificate of its node.

    Raises:
        InvalidCheckpoint: The checkpoint is malformed, or its signature or certificate is not valid.
    """
    try:
        content = parse_json(data)
        signature = base64.b64decode(content.pop("signature"), validate=True)
        certificate = x509.load_pem_x509_certificate(content["certificate"].encode())
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        nodes = [uri for uri in names.get_values_for_type(x509.UniformResourceIdentifier) if uri.startswith(_NODES)]
        log = str(content["log"])
        entry = ChainEntry(int(content["seq"]), str(content["hash"]))
        moment = datetime.fromisoformat(content["time"])
        key = certificate.public_key()
    except (ValueError, TypeError, KeyError, AttributeError, x509.ExtensionNotFound):
        raise InvalidCheckpoint("is not a checkpoint; use a copy of a .checkpoint file of the log") from None
    if len(nodes) != 1 or not isinstance(key, ec.EllipticCurvePublicKey):
        raise InvalidCheckpoint("is not signed by a node")
    try:
        key.verify(signature, _CONTEXT + canonical(content), ec.ECDSA(hashes.SHA256()))
    except InvalidSignature:
        raise InvalidCheckpoint("was changed after it was signed") from None
    if authorities:
        _check_issuer(certificate, moment, authorities)
    return Checkpoint(log, nodes[0], entry, bool(authorities))


def _check_issuer(certificate: x509.Certificate, moment: datetime, authorities: Sequence[x509.Certificate]) -> None:
    if not certificate.not_valid_before_utc <= moment <= certificate.not_valid_after_utc:
        raise InvalidCheckpoint("was signed outside the validity period of the node's certificate")
    for authority in authorities:
        try:
            certificate.verify_directly_issued_by(authority)
        except (ValueError, TypeError, InvalidSignature):
            continue
        return
    raise InvalidCheckpoint("is signed with a certificate of another authority")
