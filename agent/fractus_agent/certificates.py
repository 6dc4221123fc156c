"""Certificate files of the node: new keys and signing requests, and validation by a TLS handshake in memory."""

from __future__ import annotations

import ssl
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from fractus_core.api.names import node_identity, node_server_name
from fractus_runtime.files import check_regular

CERTIFICATE_FILES = ("tls.crt", "tls.key", "ca.crt")

_IGNORE_DATES = 0x200000
"""X509_V_FLAG_NO_CHECK_TIME of OpenSSL: OpenSSL ignores the validity dates.

The caller checks the dates with its own clock.
"""


class InvalidCertificate(Exception):
    """The certificate is invalid for clients, regardless of the date."""


@dataclass(frozen=True, slots=True)
class ValidityPeriod:
    """Validity period of a certificate."""

    not_before: datetime
    not_after: datetime

    def renewal(self, jitter: float = 0.0) -> datetime:
        """Return the time to request the next certificate: after two thirds of the lifetime.

        Args:
            jitter: Additional delay, as a share of the lifetime.
        """
        return self.not_before + (self.not_after - self.not_before) * (2 / 3 + jitter)

    def has_begun(self, now: datetime) -> bool:
        """Return True if the validity period has begun. One minute of clock difference is tolerated."""
        return now >= self.not_before - timedelta(minutes=1)


def create_request(node: str) -> tuple[bytes, bytes]:
    """Create a P-256 key and a signing request with the node's names.

    Returns:
        Key and request, both PEM.
    """
    key = ec.generate_private_key(ec.SECP256R1())
    names = [x509.UniformResourceIdentifier(node_identity(node)), x509.DNSName(node_server_name(node))]
    request = (
        x509.CertificateSigningRequestBuilder()
        .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, node[:64])]))
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
        .sign(key, hashes.SHA256())
    )
    key_pem = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    return key_pem, request.public_bytes(serialization.Encoding.PEM)


def inspect_certificate(directory: Path, node: str) -> ValidityPeriod:
    """Validate tls.crt, tls.key and ca.crt of a directory as a client of the node's services would.

    Raises:
        InvalidCertificate: A file is missing or malformed, the files do not belong together, or the certificate names another
            node.
    """
    try:
        for name in CERTIFICATE_FILES:
            check_regular(directory / name)
        server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        server.load_cert_chain(directory / "tls.crt", directory / "tls.key")
        client = ssl.create_default_context(cafile=str(directory / "ca.crt"))
        client.verify_flags |= _IGNORE_DATES
        certificate = _handshake(server, client, node_server_name(node))
    except (OSError, ssl.SSLError, ValueError) as error:
        raise InvalidCertificate(f"{type(error).__name__}: {error}") from error
    if ("URI", node_identity(node)) not in certificate.get("subjectAltName", ()):
        raise InvalidCertificate(f"the certificate does not name {node_identity(node)}")
    return ValidityPeriod(_parse_date(certificate["notBefore"]), _parse_date(certificate["notAfter"]))


def _handshake(server: ssl.SSLContext, client: ssl.SSLContext, name: str) -> dict[str, Any]:
    """Connect a client and a server in memory, and return the server certificate that the client has accepted."""
    to_server = ssl.MemoryBIO()
    to_client = ssl.MemoryBIO()
    client_side = client.wrap_bio(to_client, to_server, server_hostname=name)
    server_side = server.wrap_bio(to_server, to_client, server_side=True)
    for _ in range(8):
        for side in (client_side, server_side):
            try:
                side.do_handshake()
            except ssl.SSLWantReadError:
                continue
            if side is client_side:
                return dict(client_side.getpeercert() or {})
    raise ssl.SSLError("the handshake did not finish")


def _parse_date(text: object) -> datetime:
    return datetime.fromtimestamp(ssl.cert_time_to_seconds(str(text)), UTC)
