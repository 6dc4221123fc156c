"""Checkpoints of an audit log: how far it had come, signed by its node, to be kept elsewhere."""

from __future__ import annotations

import base64
import json
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

from fractus_runtime.audit_chain import Link, canonical

_CONTEXT = b"fractus.dev audit checkpoint 1\n"
_NODES = node_identity("")
_NOTED = re.compile(r"(?P<log>[^:/]+):(?P<number>\d{1,15}):(?P<hash>[0-9a-f]{64})")


class InvalidCheckpoint(Exception):
    """A checkpoint proves nothing; the message says why."""


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """An entry that an audit log had, and all entries before it.

    Attributes:
        log: name of the log, without directory and extension.
        node: identity of the node that signed it; empty where it was noted without its signature.
        link: the entry.
        certified: whether an authority was given that issued the node's certificate.
    """

    log: str
    node: str
    link: Link
    certified: bool


def signed(log: str, link: Link, time: str, tls: Path) -> bytes:
    """A checkpoint as JSON, which holds the certificate that its signature is checked by.

    Args:
        log: name of the log.
        link: its last entry that is on disk.
        time: now, ISO 8601.
        tls: directory of the node's tls.key and tls.crt.

    Raises:
        OSError: these cannot be read.
        ValueError: these are no key and certificate.
        TypeError: the key is of another kind than those of nodes.
    """
    key = serialization.load_pem_private_key((tls / "tls.key").read_bytes(), None)
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise TypeError(f"{tls / 'tls.key'}: is no key of an elliptic curve")
    certificate = x509.load_pem_x509_certificate((tls / "tls.crt").read_bytes())
    said = {
        "log": log, "seq": link.sequence, "hash": link.hash, "time": time,
        "certificate": certificate.public_bytes(serialization.Encoding.PEM).decode(),
    }  # fmt: skip
    signature = key.sign(_CONTEXT + canonical(said), ec.ECDSA(hashes.SHA256()))
    return canonical({**said, "signature": base64.b64encode(signature).decode()}) + b"\n"


def noted(text: str) -> Checkpoint | None:
    """A checkpoint as the status of a node has it, LOG:NUMBER:HASH; None where the text is none."""
    found = _NOTED.fullmatch(text)
    return Checkpoint(found["log"], "", Link(int(found["number"]), found["hash"]), False) if found else None


def read_checkpoint(content: bytes, authorities: Sequence[x509.Certificate] = ()) -> Checkpoint:
    """Check the signature of a checkpoint, and its node's certificate where authorities are given.

    Raises:
        InvalidCheckpoint: no node signed it as it stands.
    """
    try:
        said = json.loads(content)
        signature = base64.b64decode(said.pop("signature"), validate=True)
        certificate = x509.load_pem_x509_certificate(said["certificate"].encode())
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        nodes = [uri for uri in names.get_values_for_type(x509.UniformResourceIdentifier) if uri.startswith(_NODES)]
        log, link = str(said["log"]), Link(int(said["seq"]), str(said["hash"]))
        moment, key = datetime.fromisoformat(said["time"]), certificate.public_key()
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError, x509.ExtensionNotFound):
        raise InvalidCheckpoint("is no checkpoint; keep copies of the .checkpoint files beside the log") from None
    if len(nodes) != 1 or not isinstance(key, ec.EllipticCurvePublicKey):
        raise InvalidCheckpoint("is not signed by a node")
    try:
        key.verify(signature, _CONTEXT + canonical(said), ec.ECDSA(hashes.SHA256()))
    except InvalidSignature:
        raise InvalidCheckpoint("was changed after it was signed") from None
    if authorities:
        _check_issuer(certificate, moment, authorities)
    return Checkpoint(log, nodes[0], link, bool(authorities))


def _check_issuer(certificate: x509.Certificate, moment: datetime, authorities: Sequence[x509.Certificate]) -> None:
    if not certificate.not_valid_before_utc <= moment <= certificate.not_valid_after_utc:
        raise InvalidCheckpoint("was signed when its node's certificate was not valid")
    for authority in authorities:
        try:
            certificate.verify_directly_issued_by(authority)
        except (ValueError, TypeError, InvalidSignature):
            continue
        return
    raise InvalidCheckpoint("is signed with a certificate of another authority")
