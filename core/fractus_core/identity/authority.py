"""Certificate authority of the system: its key, and the short-lived certificates that it issues."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Self

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from fractus_core.api import GROUP, node_identity, node_server_name
from fractus_core.api.names import OPERATOR_IDENTITY, shortened
from fractus_core.policy.grant_signatures import DOCUMENT_SIGNING

CA_LIFE = timedelta(days=3650)
COMPONENT_LIFE = timedelta(hours=24)
NODE_LIFE = timedelta(days=30)
SIGNER_LIFE = timedelta(days=30)
_CLOCK_SKEW = timedelta(hours=2)
"""Backdating of certificates, so that a clock that is set back by an hour does not break new connections."""
_RENEW_AFTER = 2 / 3

Data = dict[str, str]
"""Data of a TLS Secret: tls.crt, tls.key and ca.crt in base64."""


class BrokenAuthority(Exception):
    """The stored key or certificate of an authority is unusable."""


@dataclass(frozen=True, slots=True)
class Authority:
    """A CA certificate and its P-256 key."""

    key: ec.EllipticCurvePrivateKey
    certificate: x509.Certificate

    @classmethod
    def generate(cls, now: datetime) -> Self:
        """Create a new authority, valid for ten years."""
        key = ec.generate_private_key(ec.SECP256R1())
        name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"{GROUP} authority")])
        certificate = (
            x509.CertificateBuilder()
            .subject_name(name)
            .issuer_name(name)
            .public_key(key.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - _CLOCK_SKEW)
            .not_valid_after(now + CA_LIFE)
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(_key_usage(signs_certificates=True), critical=True)
            .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
            .sign(key, hashes.SHA256())
        )
        return cls(key, certificate)

    @classmethod
    def from_data(cls, data: Data) -> Self:
        """Read an authority from the data of its Secret.

        Raises:
            BrokenAuthority: The data does not contain a matching P-256 key and certificate.
        """
        try:
            key = serialization.load_pem_private_key(base64.b64decode(data["tls.key"]), password=None)
            certificate = x509.load_pem_x509_certificate(base64.b64decode(data["tls.crt"]))
        except (KeyError, ValueError) as error:
            raise BrokenAuthority(f"the key or the certificate cannot be read: {error}") from error
        if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != certificate.public_key():
            raise BrokenAuthority("tls.key does not belong to tls.crt")
        return cls(key, certificate)

    def to_data(self) -> Data:
        """Return the data of the authority's Secret."""
        return {"tls.crt": _encoded(self.certificate_pem), "tls.key": _encoded(_key_pem(self.key))}

    @property
    def certificate_pem(self) -> bytes:
        """CA certificate in PEM format."""
        return self.certificate.public_bytes(serialization.Encoding.PEM)

    def issue_component(self, identity: str, now: datetime, life: timedelta = COMPONENT_LIFE) -> Data:
        """Create a key and a client certificate for a component instance.

        Args:
            identity: SPIFFE ID of the instance, the only subject alternative name.
            now: Current time.
            life: Validity period from now.
        """
        key = ec.generate_private_key(ec.SECP256R1())
        certificate = self._issue(
            key.public_key(),
            common_name=_short(identity),
            names=[x509.UniformResourceIdentifier(identity)],
            usages=[ExtendedKeyUsageOID.CLIENT_AUTH],
            life=life,
            now=now,
        )
        return self._data(key, certificate)

    def issue_node(self, node: str, now: datetime, life: timedelta = NODE_LIFE) -> Data:
        """Create a key and the certificate of a node's services, for nodes without an agent that has its own key.

        Args:
            node: Name of the node.
            now: Current time.
            life: Validity period from now.
        """
        key = ec.generate_private_key(ec.SECP256R1())
        return self._data(key, self._node_certificate(key.public_key(), node, now, life))

    def issue_signer(self, now: datetime) -> tuple[ec.EllipticCurvePrivateKey, x509.Certificate]:
        """Create a key and a certificate that is valid only for signing Grants."""
        key = ec.generate_private_key(ec.SECP256R1())
        pem = self._issue(
            key.public_key(),
            common_name=f"{GROUP} operator",
            names=[x509.UniformResourceIdentifier(OPERATOR_IDENTITY)],
            usages=[DOCUMENT_SIGNING],
            life=SIGNER_LIFE,
            now=now,
            signs_grants=True,
        )
        return key, x509.load_pem_x509_certificate(pem)

    def _data(self, key: ec.EllipticCurvePrivateKey, certificate: bytes) -> Data:
        return {
            "tls.crt": _encoded(certificate),
            "tls.key": _encoded(_key_pem(key)),
            "ca.crt": _encoded(self.certificate_pem),
        }

    def is_current(self, data: Data, identity: str, now: datetime) -> bool:
        """Return True if this authority issued a component certificate for this identity, and renewal is not due."""
        try:
            certificate = x509.load_pem_x509_certificate(base64.b64decode(data["tls.crt"]))
            certificate.verify_directly_issued_by(self.certificate)
            names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
            same_ca = base64.b64decode(data["ca.crt"]) == self.certificate_pem
        except (KeyError, ValueError, TypeError, InvalidSignature, x509.ExtensionNotFound):
            return False
        if not same_ca or names.get_values_for_type(x509.UniformResourceIdentifier) != [identity]:
            return False
        return now < renewal_time(certificate)

    def sign_node(self, request: x509.CertificateSigningRequest, node: str, now: datetime) -> bytes:
        """Issue the certificate of a node's services and agent for the key of a request, in PEM format.

        Only the key of the request is used. The names in the request are ignored.
        """
        key = request.public_key()
        if not isinstance(key, ec.EllipticCurvePublicKey):
            raise TypeError(f"the request of {node} has no elliptic curve key")
        return self._node_certificate(key, node, now, NODE_LIFE)

    def _node_certificate(self, key: ec.EllipticCurvePublicKey, node: str, now: datetime, life: timedelta) -> bytes:
        names: list[x509.GeneralName] = [
            x509.UniformResourceIdentifier(node_identity(node)),
            x509.DNSName(node_server_name(node)),
        ]
        usages = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
        return self._issue(
            key, common_name=_short(node_server_name(node)), names=names, usages=usages, life=life, now=now
        )

    def _issue(
        self,
        key: ec.EllipticCurvePublicKey,
        *,
        common_name: str,
        names: Sequence[x509.GeneralName],
        usages: list[x509.ObjectIdentifier],
        life: timedelta,
        now: datetime,
        signs_grants: bool = False,
    ) -> bytes:
        issuer_key = self.certificate.extensions.get_extension_for_class(x509.SubjectKeyIdentifier).value
        return (
            x509.CertificateBuilder()
            .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)]))
            .issuer_name(self.certificate.subject)
            .public_key(key)
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - _CLOCK_SKEW)
            .not_valid_after(min(now + life, self.certificate.not_valid_after_utc))
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_key_usage(signs_grants=signs_grants), critical=True)
            .add_extension(x509.ExtendedKeyUsage(usages), critical=False)
            .add_extension(x509.SubjectAlternativeName(names), critical=False)
            .add_extension(x509.AuthorityKeyIdentifier.from_issuer_subject_key_identifier(issuer_key), critical=False)
            .sign(self.key, hashes.SHA256())
            .public_bytes(serialization.Encoding.PEM)
        )


def renewal_time(certificate: x509.Certificate) -> datetime:
    """Return the time at which a certificate is due for renewal: after two thirds of its validity."""
    start = certificate.not_valid_before_utc
    end = certificate.not_valid_after_utc
    return start + (end - start) * _RENEW_AFTER


def _key_usage(*, signs_certificates: bool = False, signs_grants: bool = False) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not (signs_certificates or signs_grants),
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        content_commitment=signs_grants,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _short(text: str) -> str:
    """Shorten a common name to 64 characters (X.520). Identities are read from the alternative names instead."""
    return shortened(text, 64, digits=16)


def _key_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def _encoded(content: bytes) -> str:
    return base64.b64encode(content).decode()
