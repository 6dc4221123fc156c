"""Keys, certificates and kubeconfigs of a cluster, created once and kept in its state directory."""

from __future__ import annotations

import base64
import datetime
from collections.abc import Sequence
from dataclasses import dataclass
from ipaddress import IPv4Address
from pathlib import Path

import yaml
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
from fractus_runtime.files import write_file

_LIFETIME = datetime.timedelta(days=3650)
_SKEW = datetime.timedelta(hours=1)

AlternativeName = str | IPv4Address


@dataclass(frozen=True, slots=True)
class Credential:
    """Files of a certificate and its private key."""

    certificate: Path
    key: Path

    @property
    def complete(self) -> bool:
        """True if both files exist."""
        return self.certificate.is_file() and self.key.is_file()


class Authority:
    """Certificate authority of the cluster. Credentials are created on demand in its directory."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        directory.mkdir(parents=True, exist_ok=True, mode=0o700)
        self.credential = Credential(directory / "ca.crt", directory / "ca.key")
        if not self.credential.complete:
            self._create()
        self._key = _load_key(self.credential.key)
        self._certificate = x509.load_pem_x509_certificate(self.credential.certificate.read_bytes())

    def _create(self) -> None:
        key = ec.generate_private_key(ec.SECP256R1())
        name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "fractus-sim cluster")])
        certificate = (
            _builder(name, name, key.public_key())
            .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
            .add_extension(_key_usage(signs_certificates=True), critical=True)
            .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
            .sign(key, hashes.SHA256())
        )
        _store(self.credential, key, certificate)

    def issue(
        self,
        name: str,
        *,
        common_name: str,
        organizations: Sequence[str] = (),
        alternative_names: Sequence[AlternativeName] = (),
    ) -> Credential:
        """Return the credential `name`. Create it if it is missing or was issued for other names.

        Args:
            name: File name without suffix.
            common_name: Kubernetes user name.
            organizations: Kubernetes groups.
            alternative_names: DNS names and addresses. If set, a server certificate is created.
        """
        credential = Credential(self._directory / f"{name}.crt", self._directory / f"{name}.key")
        if credential.complete and _alternative_names(credential.certificate) == set(map(str, alternative_names)):
            return credential
        key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name(
            [
                *(x509.NameAttribute(NameOID.ORGANIZATION_NAME, group) for group in organizations),
                x509.NameAttribute(NameOID.COMMON_NAME, common_name),
            ]
        )
        usages = [ExtendedKeyUsageOID.CLIENT_AUTH]
        if alternative_names:
            usages.append(ExtendedKeyUsageOID.SERVER_AUTH)
        builder = (
            _builder(subject, self._certificate.subject, key.public_key())
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_key_usage(signs_certificates=False), critical=True)
            .add_extension(x509.ExtendedKeyUsage(usages), critical=False)
            .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(self._key.public_key()), critical=False)
        )
        if alternative_names:
            names: list[x509.GeneralName] = [
                x509.IPAddress(entry) if isinstance(entry, IPv4Address) else x509.DNSName(entry)
                for entry in alternative_names
            ]
            builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
        _store(credential, key, builder.sign(self._key, hashes.SHA256()))
        return credential

    def service_account_key(self) -> Credential:
        """Return the key pair for service account tokens. Its certificate file contains only the public key."""
        pair = Credential(self._directory / "service-accounts.pub", self._directory / "service-accounts.key")
        if not pair.complete:
            key = ec.generate_private_key(ec.SECP256R1())
            _write(pair.key, _key_bytes(key))
            public = key.public_key().public_bytes(
                serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo
            )
            _write(pair.certificate, public)
        return pair

    def kubeconfig(self, credential: Credential, *, server: str, cluster: str) -> str:
        """Return a kubeconfig that contains all certificates."""
        ca = _base64(self.credential.certificate)
        user = {
            "client-certificate-data": _base64(credential.certificate),
            "client-key-data": _base64(credential.key),
        }
        content = {
            "apiVersion": "v1",
            "kind": "Config",
            "clusters": [{"name": cluster, "cluster": {"server": server, "certificate-authority-data": ca}}],
            "users": [{"name": cluster, "user": user}],
            "contexts": [{"name": cluster, "context": {"cluster": cluster, "user": cluster}}],
            "current-context": cluster,
        }
        return yaml.safe_dump(content, sort_keys=False)


def write_private(path: Path, text: str) -> None:
    """Write a file atomically that only its owner may read."""
    _write(path, text.encode())


def _builder(subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey) -> x509.CertificateBuilder:
    now = datetime.datetime.now(datetime.UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _SKEW)
        .not_valid_after(now + _LIFETIME)
    )


def _key_usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=True,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _alternative_names(path: Path) -> set[str]:
    certificate = x509.load_pem_x509_certificate(path.read_bytes())
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return set()
    return {str(entry.value) for entry in names}


def _load_key(path: Path) -> ec.EllipticCurvePrivateKey:
    key = serialization.load_pem_private_key(path.read_bytes(), password=None)
    assert isinstance(key, ec.EllipticCurvePrivateKey)
    return key


def _key_bytes(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def _store(credential: Credential, key: ec.EllipticCurvePrivateKey, certificate: x509.Certificate) -> None:
    credential.certificate.unlink(missing_ok=True)  # written last, so that the pair is complete if it exists
    _write(credential.key, _key_bytes(key))
    _write(credential.certificate, certificate.public_bytes(serialization.Encoding.PEM))


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_file(path, content, durable=False)


def _base64(path: Path) -> str:
    return base64.b64encode(path.read_bytes()).decode()
