"""Certificate authority for tests, and a fake of the CSR API with its signer."""

import base64
from datetime import UTC, datetime, timedelta
from typing import Any

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID


class TestAuthority:
    """Certificate authority that signs every request."""

    __test__ = False

    def __init__(self, name: str = "test authority") -> None:
        self.key = ec.generate_private_key(ec.SECP256R1())
        self.name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        now = datetime.now(UTC)
        usage = x509.KeyUsage(
            digital_signature=True, key_cert_sign=True, crl_sign=True, content_commitment=False,
            key_encipherment=False, data_encipherment=False, key_agreement=False, encipher_only=False,
            decipher_only=False,
        )  # fmt: skip
        self.certificate = (
            x509.CertificateBuilder()
            .subject_name(self.name)
            .issuer_name(self.name)
            .public_key(self.key.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - timedelta(days=3650))
            .not_valid_after(now + timedelta(days=3650))
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(usage, critical=True)
            .add_extension(x509.SubjectKeyIdentifier.from_public_key(self.key.public_key()), critical=False)
            .sign(self.key, hashes.SHA256())
        )
        self.pem = self.certificate.public_bytes(serialization.Encoding.PEM)

    def sign(self, request_pem: bytes, begin: datetime | None = None, life: timedelta = timedelta(days=30)) -> bytes:
        """Return a certificate for a signing request, with the requested names."""
        request = x509.load_pem_x509_csr(request_pem)
        assert request.is_signature_valid
        names = request.extensions.get_extension_for_class(x509.SubjectAlternativeName)
        begin = begin or datetime.now(UTC) - timedelta(minutes=5)
        issuer = x509.AuthorityKeyIdentifier.from_issuer_public_key(self.key.public_key())  # type: ignore[arg-type]
        return (
            x509.CertificateBuilder()
            .subject_name(request.subject)
            .issuer_name(self.name)
            .public_key(request.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(begin)
            .not_valid_after(begin + life)
            .add_extension(names.value, critical=False)
            .add_extension(issuer, critical=False)
            .sign(self.key, hashes.SHA256())
            .public_bytes(serialization.Encoding.PEM)
        )


class FakeSigner:
    """Fake store of an agent. It signs signing requests, or returns them with the given conditions.

    Attributes:
        published: Certificates of the published authority, or None.
        request_count: Number of created signing requests.
        conditions: Conditions of new signing requests. If there are any, requests are not signed.
        sign_with: Additional arguments for `TestAuthority.sign`.
        error: Exception that requests raise, or None.
    """

    def __init__(self, authority: TestAuthority) -> None:
        self.ca = authority
        self.published: bytes | None = authority.pem
        self.requests: dict[str, dict[str, Any]] = {}
        self.request_count = 0
        self.conditions: list[dict[str, str]] = []
        self.sign_with: dict[str, Any] = {}
        self.error: Exception | None = None

    async def authority(self) -> bytes | None:
        if self.error:
            raise self.error
        return self.published

    async def request_certificate(self, name: str, request_pem: bytes, lifetime_s: int) -> None:
        if self.error:
            raise self.error
        self.request_count += 1
        status: dict[str, Any] = {"conditions": self.conditions}
        if not self.conditions:
            status["certificate"] = base64.b64encode(self.ca.sign(request_pem, **self.sign_with)).decode()
        self.requests[name] = {"metadata": {"name": name}, "status": status}

    async def certificate_request(self, name: str) -> dict[str, Any] | None:
        return self.requests.get(name)

    async def delete_certificate_requests(self) -> None:
        self.requests.clear()
