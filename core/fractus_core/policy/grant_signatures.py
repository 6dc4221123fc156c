"""Signatures over Grants: what is signed, by whom, and whether a node may believe it.

A Grant carries its signature and the certificate of who signed it as annotations. It is judged by the moment it was
issued at and not by the present one, so that no certificate that expires meanwhile takes the grant from a drone in the air.
"""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta
from typing import Any

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ObjectIdentifier

from fractus_core.api.model import GROUP, InvalidObject
from fractus_core.api.names import OPERATOR_IDENTITY
from fractus_core.api.plans import Grant

SIGNATURE_ANNOTATION = f"{GROUP}/signature"
SIGNER_ANNOTATION = f"{GROUP}/signed-by"

DOCUMENT_SIGNING = ObjectIdentifier("1.3.6.1.5.5.7.3.36")
"""Extended key usage of RFC 9336; no certificate for TLS has it."""

MAX_CLOCK_SKEW = timedelta(minutes=5)
"""How far the clocks of the signer and of the issuer of its certificate may be apart."""

_CONTEXT = b"fractus.dev grant 1\n"


class BadSignature(Exception):
    """The operator did not sign this Grant as it stands; the message says why."""


class UnknownAuthority(BadSignature):
    """The signer's certificate comes from an authority that this node does not know (yet)."""


def signed_bytes(grant: Grant) -> bytes:
    """What is signed: name and spec as JSON with sorted keys, without fields that have their default value.

    So a field that a later release adds breaks no signature where it is not used, and neither the API server nor a disk
    changes it by spelling numbers in another way.
    """
    spec = grant.spec.model_dump(mode="json", by_alias=True, exclude_defaults=True)
    signed = {"kind": grant.KIND, "name": grant.name, "spec": spec}
    return _CONTEXT + json.dumps(signed, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def sign(
    body: Mapping[str, Any], key: ec.EllipticCurvePrivateKey, certificate: x509.Certificate, issued_at: datetime
) -> dict[str, Any]:
    """The manifest of a Grant with the time of issue and a signature over both.

    Args:
        body: The manifest; its signature, if it has one, is replaced.
        key: The signer's.
        certificate: The signer's, for the identity of the operator.
        issued_at: Of two Grants for one instance the one that was issued later counts.

    Raises:
        InvalidObject: the manifest is not a Grant, or bounds no drone.
    """
    spec = {**body["spec"], "issuedAt": issued_at.astimezone(UTC).isoformat().replace("+00:00", "Z")}
    grant = Grant.from_body({**body, "spec": spec})
    if grant.spec.unbounded:
        raise InvalidObject("spec.operationArea", f"{grant.spec.unbounded}; say where its drone may be")
    signature = key.sign(signed_bytes(grant), ec.ECDSA(hashes.SHA256()))
    signer = certificate.public_bytes(serialization.Encoding.DER)
    metadata = dict(body["metadata"])
    metadata["annotations"] = {
        **(metadata.get("annotations") or {}),
        SIGNATURE_ANNOTATION: base64.b64encode(signature).decode(),
        SIGNER_ANNOTATION: base64.b64encode(signer).decode(),
    }
    return {**body, "metadata": metadata, "spec": spec}


def read_authorities(pem: bytes) -> tuple[x509.Certificate, ...]:
    """The authorities of a ca.crt; several while one takes over from another.

    Raises:
        ValueError: it holds no certificate.
    """
    return tuple(x509.load_pem_x509_certificates(pem))


def verify(grant: Grant, authorities: Sequence[x509.Certificate]) -> datetime:
    """Check that the operator signed a Grant as it stands; the moment it was issued at.

    Raises:
        BadSignature: it did not.
        UnknownAuthority: its certificate is of no authority among these.
    """
    annotations = grant.metadata.annotations
    try:
        signature = base64.b64decode(annotations[SIGNATURE_ANNOTATION], validate=True)
        signer = x509.load_der_x509_certificate(base64.b64decode(annotations[SIGNER_ANNOTATION], validate=True))
    except KeyError:
        raise BadSignature("it is not signed; the operator signs Grants, and so does `fractus grants sign`") from None
    except (binascii.Error, ValueError):
        raise BadSignature("its signature cannot be read") from None
    issued_at = grant.spec.issued_at
    if issued_at is None or issued_at.tzinfo is None:
        raise BadSignature("spec.issuedAt must be a time with its zone")
    if grant.spec.unbounded:
        raise BadSignature(f"it bounds no drone ({grant.spec.unbounded})")
    key = _signing_key(signer)
    _check_time(issued_at, signer, _issuer(signer, authorities))
    try:
        key.verify(signature, signed_bytes(grant), ec.ECDSA(hashes.SHA256()))
    except InvalidSignature:
        raise BadSignature("it was changed after it was signed") from None
    return issued_at


def _signing_key(certificate: x509.Certificate) -> ec.EllipticCurvePublicKey:
    """The key of a certificate that is for signing Grants and for nothing else."""
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        usage = certificate.extensions.get_extension_for_class(x509.KeyUsage).value
        purposes = certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
        limits = certificate.extensions.get_extension_for_class(x509.BasicConstraints).value
        identities = [name.value for name in names]
        key = certificate.public_key()
    except (ValueError, x509.ExtensionNotFound):
        raise BadSignature("it was signed with a certificate that is not for signing Grants") from None
    if identities != [OPERATOR_IDENTITY]:
        raise BadSignature(f"it was signed by {', '.join(map(str, identities))}, and not by the operator")
    alone = usage.content_commitment and not (usage.digital_signature or usage.key_cert_sign)
    if not alone or list(purposes) != [DOCUMENT_SIGNING] or limits.ca:
        raise BadSignature("it was signed with a certificate that is not for signing Grants")
    if not isinstance(key, ec.EllipticCurvePublicKey) or not isinstance(key.curve, ec.SECP256R1):
        raise BadSignature("it was signed with a key that is not P-256")
    return key


def _issuer(certificate: x509.Certificate, authorities: Sequence[x509.Certificate]) -> x509.Certificate:
    for authority in authorities:
        try:
            limits = authority.extensions.get_extension_for_class(x509.BasicConstraints).value
            certificate.verify_directly_issued_by(authority)
        except (ValueError, TypeError, InvalidSignature, x509.ExtensionNotFound):
            continue
        if limits.ca:
            return authority
    raise UnknownAuthority("it was signed with a certificate of an authority that is not in ca.crt")


def _check_time(issued_at: datetime, *certificates: x509.Certificate) -> None:
    for certificate in certificates:
        begin, end = certificate.not_valid_before_utc, certificate.not_valid_after_utc
        if not begin - MAX_CLOCK_SKEW <= issued_at <= end + MAX_CLOCK_SKEW:
            raise BadSignature(f"it was issued at {issued_at:%F %T}, when its certificate was not valid")
