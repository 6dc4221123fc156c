"""The certificate authority and the CSR controller: issued certificates, renewal, refused requests."""

from __future__ import annotations

import base64
from datetime import UTC, datetime, timedelta

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, ExtensionOID
from fractus_core.identity.authority import COMPONENT_LIFE, Authority, BrokenAuthority
from fractus_operator.csr_controller import NODE_NAME_CLAIM, review

NOW = datetime(2026, 6, 1, 12, 0, tzinfo=UTC)
IDENTITY = "spiffe://fractus.dev/ns/a/app/b/component/C/instance/b-c"
AUTHORITY = Authority.generate(NOW)


def certificate(data: dict[str, str]) -> x509.Certificate:
    return x509.load_pem_x509_certificate(base64.b64decode(data["tls.crt"]))


def test_component_gets_short_lived_client_certificate() -> None:
    issued = certificate(AUTHORITY.issue_component(IDENTITY, NOW))
    assert issued.not_valid_after_utc == NOW + COMPONENT_LIFE
    assert list(issued.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value) == [
        ExtendedKeyUsageOID.CLIENT_AUTH
    ]
    names = issued.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert [n.value for n in names] == [IDENTITY]
    key = issued.public_key()
    assert isinstance(key, ec.EllipticCurvePublicKey)
    assert isinstance(key.curve, ec.SECP256R1)
    issued.verify_directly_issued_by(AUTHORITY.certificate)


def test_certificate_is_kept_for_two_thirds_of_its_lifetime() -> None:
    data = AUTHORITY.issue_component(IDENTITY, NOW)
    assert AUTHORITY.is_current(data, IDENTITY, NOW + timedelta(hours=15))
    assert not AUTHORITY.is_current(data, IDENTITY, NOW + timedelta(hours=17))


def test_certificate_is_invalid_for_other_identity_or_authority() -> None:
    data = AUTHORITY.issue_component(IDENTITY, NOW)
    assert not AUTHORITY.is_current(data, IDENTITY + "2", NOW)
    assert not Authority.generate(NOW).is_current(data, IDENTITY, NOW)
    assert not AUTHORITY.is_current({}, IDENTITY, NOW)
    assert not AUTHORITY.is_current({**data, "tls.crt": "bm9uc2Vuc2U="}, IDENTITY, NOW)
    assert not AUTHORITY.is_current({**data, "ca.crt": ""}, IDENTITY, NOW)


def test_authority_is_restored_from_its_secret() -> None:
    restored = Authority.from_data(AUTHORITY.to_data())
    assert restored.certificate == AUTHORITY.certificate
    assert restored.is_current(AUTHORITY.issue_component(IDENTITY, NOW), IDENTITY, NOW)


def test_damaged_authority_secret_raises_error() -> None:
    other = Authority.generate(NOW).to_data()
    with pytest.raises(BrokenAuthority, match=r"tls\.key"):
        Authority.from_data({**AUTHORITY.to_data(), "tls.key": other["tls.key"]})
    with pytest.raises(BrokenAuthority):
        Authority.from_data({})


def test_authority_signs_no_ca_certificates() -> None:
    constraints = AUTHORITY.certificate.extensions.get_extension_for_class(x509.BasicConstraints).value
    assert (constraints.ca, constraints.path_length) == (True, 0)
    issued = certificate(AUTHORITY.issue_component(IDENTITY, NOW))
    assert not issued.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    assert not issued.extensions.get_extension_for_class(x509.KeyUsage).value.key_cert_sign


@pytest.mark.parametrize("names", ["3002a300", "3000ff", "30048202ffff"])
def test_csr_with_invalid_names_is_malformed(names: str) -> None:
    odd = x509.UnrecognizedExtension(ExtensionOID.SUBJECT_ALTERNATIVE_NAME, bytes.fromhex(names))
    builder = x509.CertificateSigningRequestBuilder().subject_name(x509.Name([])).add_extension(odd, critical=False)
    request = builder.sign(ec.generate_private_key(ec.SECP256R1()), hashes.SHA256())
    spec = {
        "username": "agent",
        "extra": {NODE_NAME_CLAIM: ["drone-1"]},
        "usages": ["server auth", "client auth"],
        "request": base64.b64encode(request.public_bytes(serialization.Encoding.PEM)).decode(),
    }
    review_result = review({"spec": spec}, {"agent"})
    assert (review_result.reason, review_result.node) == ("Malformed", None)
