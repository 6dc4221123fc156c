"""Signatures of Grants: signing and verification.

A Grant contains its signature and the signer's certificate as annotations. The certificate must be valid at the Grant's
time of issue, not at the present time. Otherwise, an expired certificate would end the Grant of a drone in flight.
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

from fractus_core.api.grants import Grant
from fractus_core.api.model import GROUP, InvalidObject
from fractus_core.api.names import OPERATOR_IDENTITY

SIGNATURE_ANNOTATION = f"{GROUP}/signature"
SIGNER_ANNOTATION = f"{GROUP}/signed-by"

DOCUMENT_SIGNING = ObjectIdentifier("1.3.6.1.5.5.7.3.36")
"""Extended key usage of RFC 9336, which TLS certificates do not have."""

MAX_CLOCK_SKEW = timedelta(minutes=5)
"""Largest difference between the clocks of the signer and of the issuer of its certificate."""

_CONTEXT = b"fractus.dev grant 1\n"


class BadSignature(Exception):
    """The operator did not sign this Grant in its present form. The message states the reason."""


class UnknownAuthority(BadSignature):
    """The signer's certificate was issued by an authority that this node does not (yet) know."""


def signed_bytes(grant: Grant) -> bytes:
    """Return the signed content: name and spec as JSON with sorted keys, without fields at their default value.

    So a field that a later release adds does not invalidate Grants that do not use it, and a different spelling of
    numbers by the API server has no effect.
    """
    spec = grant.spec.model_dump(mode="json", by_alias=True, exclude_defaults=True)
    signed = {"kind": grant.KIND, "name": grant.name, "spec": spec}
    return _CONTEXT + json.dumps(signed, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def sign(
    body: Mapping[str, Any], key: ec.EllipticCurvePrivateKey, certificate: x509.Certificate, issued_at: datetime
) -> dict[str, Any]:
    """Return the manifest of a Grant with its time of issue and a signature over both.

    Args:
        body: Manifest. An existing signature is replaced.
        key: Key of the signer.
        certificate: Certificate of the signer, for the identity of the operator.
        issued_at: Time of issue. Of two Grants for one instance, the later one is valid.

    Raises:
        InvalidObject: The manifest is not a Grant, or does not bound its drone.
    """
    spec = {**body["spec"], "issuedAt": issued_at.astimezone(UTC).isoformat().replace("+00:00", "Z")}
    grant = Grant.from_body({**body, "spec": spec})
    if grant.spec.unbounded:
        raise InvalidObject("spec.operationArea", f"{grant.spec.unbounded}; specify where its drone may be")
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
    """Return the authorities in a ca.crt. There are several authorities during a rotation.

    Raises:
        ValueError: It contains no certificate.
    """
    return tuple(x509.load_pem_x509_certificates(pem))


def verify(grant: Grant, authorities: Sequence[x509.Certificate]) -> datetime:
    """Verify that the operator signed a Grant in its present form, and return its time of issue.

    Raises:
        BadSignature: The signature is missing or invalid.
        UnknownAuthority: The certificate was issued by none of these authorities.
    """
    annotations = grant.metadata.annotations
    try:
        signature = base64.b64decode(annotations[SIGNATURE_ANNOTATION], validate=True)
        signer = x509.load_der_x509_certificate(base64.b64decode(annotations[SIGNER_ANNOTATION], validate=True))
    except KeyError:
        raise BadSignature("the Grant is not signed; sign it with the operator or with `fractus grants sign`") from None
    except (binascii.Error, ValueError):
        raise BadSignature("the signature cannot be decoded") from None
    issued_at = grant.spec.issued_at
    if issued_at is None or issued_at.tzinfo is None:
        raise BadSignature("spec.issuedAt must be a time with its zone")
    if grant.spec.unbounded:
        raise BadSignature(f"the Grant does not bound its drone ({grant.spec.unbounded})")
    key = _signing_key(signer)
    _check_time(issued_at, signer, _issuer(signer, authorities))
    try:
        key.verify(signature, signed_bytes(grant), ec.ECDSA(hashes.SHA256()))
    except InvalidSignature:
        raise BadSignature("the Grant was changed after signing") from None
    return issued_at


def _signing_key(certificate: x509.Certificate) -> ec.EllipticCurvePublicKey:
    """Return the key of a certificate that is valid only for signing Grants."""
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        usage = certificate.extensions.get_extension_for_class(x509.KeyUsage).value
        purposes = certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
        limits = certificate.extensions.get_extension_for_class(x509.BasicConstraints).value
        identities = [name.value for name in names]
        key = certificate.public_key()
    except (ValueError, x509.ExtensionNotFound):
        raise BadSignature("the signer's certificate is not valid for signing Grants") from None
    if identities != [OPERATOR_IDENTITY]:
        raise BadSignature(f"it was signed by {', '.join(map(str, identities))} instead of the operator")
    alone = usage.content_commitment and not (usage.digital_signature or usage.key_cert_sign)
    if not alone or list(purposes) != [DOCUMENT_SIGNING] or limits.ca:
        raise BadSignature("the signer's certificate is not valid for signing Grants")
    if not isinstance(key, ec.EllipticCurvePublicKey) or not isinstance(key.curve, ec.SECP256R1):
        raise BadSignature("the signer's key is not P-256")
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
    raise UnknownAuthority("the signer's certificate was issued by an authority that is not in ca.crt")


def _check_time(issued_at: datetime, *certificates: x509.Certificate) -> None:
    for certificate in certificates:
        begin = certificate.not_valid_before_utc
        end = certificate.not_valid_after_utc
        if not begin - MAX_CLOCK_SKEW <= issued_at <= end + MAX_CLOCK_SKEW:
            raise BadSignature(f"it was issued at {issued_at:%F %T}, when its certificate was not valid")
