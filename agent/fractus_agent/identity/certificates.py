"""Whether a certificate, its key and its authority belong together: asked of OpenSSL by a handshake in memory.

The standard library suffices for that, so the agent need not keep an X.509 library in memory.
"""

from __future__ import annotations

import ssl
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from fractus_core.api.names import node_identity, node_server_name

_IGNORE_DATES = 0x200000
"""OpenSSL's X509_V_FLAG_NO_CHECK_TIME: dates are judged by the clock that is passed in."""


class Unusable(Exception):
    """No client would accept this certificate, whatever the date."""


@dataclass(frozen=True, slots=True)
class Validity:
    """When a certificate holds."""

    not_before: datetime
    not_after: datetime

    def renewal(self, jitter: float = 0.0) -> datetime:
        """When to ask for the next one: after two thirds of its life, plus jitter (a share of its life)."""
        return self.not_before + (self.not_after - self.not_before) * (2 / 3 + jitter)

    def begun(self, now: datetime) -> bool:
        """Whether it holds already; a minute of difference between clocks is forgiven."""
        return now >= self.not_before - timedelta(minutes=1)


def inspect(directory: Path, node: str) -> Validity:
    """Check tls.crt, tls.key and ca.crt of a directory as a client of the node's services would.

    Raises:
        Unusable: a file is missing or broken, they do not belong together, or the names are another node's.
    """
    try:
        server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        server.load_cert_chain(directory / "tls.crt", directory / "tls.key")
        client = ssl.create_default_context(cafile=str(directory / "ca.crt"))
        client.verify_flags |= _IGNORE_DATES
        certificate = _handshake(server, client, node_server_name(node))
    except (OSError, ssl.SSLError, ValueError) as error:
        raise Unusable(f"{type(error).__name__}: {error}") from error
    if ("URI", node_identity(node)) not in certificate.get("subjectAltName", ()):
        raise Unusable(f"the certificate does not name {node_identity(node)}")
    return Validity(_date(certificate["notBefore"]), _date(certificate["notAfter"]))


def _handshake(server: ssl.SSLContext, client: ssl.SSLContext, name: str) -> dict[str, Any]:
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    asking = client.wrap_bio(to_client, to_server, server_hostname=name)
    answering = server.wrap_bio(to_server, to_client, server_side=True)
    for _ in range(8):
        for side in (asking, answering):
            try:
                side.do_handshake()
            except ssl.SSLWantReadError:
                continue
            if side is asking:
                return dict(asking.getpeercert() or {})
    raise ssl.SSLError("the handshake came to no end")


def _date(text: object) -> datetime:
    return datetime.fromtimestamp(ssl.cert_time_to_seconds(str(text)), UTC)
