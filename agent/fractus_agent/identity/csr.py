"""A fresh key and the signing request for it; runs as a process of its own, so that the agent stays small.

`python -m fractus_agent.identity.csr NODE` prints {"key": PEM, "request": PEM} as JSON.
"""

from __future__ import annotations

import json
import sys

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from fractus_core.api.names import node_identity, node_server_name


def make_request(node: str) -> tuple[bytes, bytes]:
    """A P-256 key and a signing request with the node's names, both PEM."""
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


if __name__ == "__main__":
    made_key, made_request = make_request(sys.argv[1])
    json.dump({"key": made_key.decode(), "request": made_request.decode()}, sys.stdout)
