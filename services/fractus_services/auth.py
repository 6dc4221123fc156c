"""Authentication of callers by client certificates, and TLS files that may change while the service runs."""

from __future__ import annotations

import asyncio
import logging
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grpc
from cryptography import x509
from fractus_core.api.names import SPIFFE_SCHEME
from fractus_core.policy.decision_types import UncertainTime
from fractus_runtime.files import check_regular, read_file

from fractus_services.clock import steady_s
from fractus_services.errors import NotAuthenticated

log = logging.getLogger(__name__)

FILES = ("tls.key", "tls.crt", "ca.crt")
MAX_SEEN = 256
"""Maximum number of remembered certificates. The least recently used certificate is forgotten."""
MAX_SKEW_S = 60.0
"""Maximum time by which the validity of a client certificate may start in the future, in seconds."""


@dataclass(frozen=True, slots=True)
class Caller:
    """An authenticated caller.

    Attributes:
        identity: SPIFFE ID.
        until_s: Steady time at which the certificate expires, in seconds.
    """

    identity: str
    until_s: float

    @property
    def left_s(self) -> float:
        """Time until the certificate expires, in seconds."""
        return max(self.until_s - steady_s(), 0.0)

    def check(self) -> None:
        """Check that the certificate is still valid. The TLS handshake checks a long connection only once.

        Raises:
            NotAuthenticated: The certificate has expired.
        """
        if self.until_s <= steady_s():
            raise NotAuthenticated("the client certificate has expired; reconnect with the renewed one")


class Callers:
    """Authenticates callers by their client certificates.

    The first use of a certificate is checked against the system clock. From then on, its remaining lifetime is measured with
    the monotonic clock. A clock step therefore neither disconnects a driver in flight nor makes an expired certificate valid
    again. The TLS handshake of each new connection also checks the certificate, but only against the system clock.

    Args:
        clock: Returns Unix time.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._seen: OrderedDict[bytes, Caller] = OrderedDict()

    def of(self, auth_context: Mapping[str, Any], urgent: bool = False) -> Caller:
        """Return the caller of a call.

        Args:
            auth_context: gRPC's authentication context of the call.
            urgent: True if the call only makes the flight safer. The TLS handshake is then sufficient.

        Raises:
            NotAuthenticated: The certificate is missing, contains no identity, or is not valid now.
        """
        chain = auth_context.get("x509_pem_cert") or ()
        if not chain:
            raise NotAuthenticated("no client certificate; connect with mutual TLS")
        pem = bytes(chain[0])
        caller = self._seen.get(pem)
        if caller is None:
            caller = self._first_seen(pem, urgent)
        else:
            self._seen.move_to_end(pem)
        if not urgent:
            caller.check()
        return caller

    def _first_seen(self, pem: bytes, urgent: bool) -> Caller:
        try:
            identity, begin_s, end_s = _read(pem)
        except ValueError:
            raise NotAuthenticated("cannot parse the client certificate") from None
        now_s = self._clock()
        caller = Caller(identity, steady_s() + end_s - now_s)
        started = now_s >= begin_s - MAX_SKEW_S
        if not (started or urgent):
            raise NotAuthenticated("the client certificate is not valid yet; check the clocks")
        if started and caller.left_s and not isinstance(now_s, UncertainTime):
            # Do not remember a certificate while the clock is uncertain, or outside the certificate's validity: the
            # clock may be corrected.
            self._seen[pem] = caller
            if len(self._seen) > MAX_SEEN:
                self._seen.popitem(last=False)
        return caller


def _read(pem: bytes) -> tuple[str, float, float]:
    """Return the identity, start and end of validity of a certificate."""
    certificate = x509.load_pem_x509_certificate(pem)
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        raise NotAuthenticated("the client certificate contains no identity") from None
    uris = [uri for uri in names.get_values_for_type(x509.UniformResourceIdentifier) if uri.startswith(SPIFFE_SCHEME)]
    if len(uris) != 1:
        raise NotAuthenticated(f"the client certificate must contain one SPIFFE ID, not {len(uris)}")
    return uris[0], certificate.not_valid_before_utc.timestamp(), certificate.not_valid_after_utc.timestamp()


class TlsFiles:
    """Key, certificate and CA of a service. They are read again when they change."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._stamp: tuple[tuple[int, int, int], ...] = ()
        self._waiting = False

    async def wait(self, poll_s: float = 0.5) -> None:
        """Wait until all files exist. The first wait is logged."""
        while True:
            missing = [name for name in FILES if not self._present(name)]
            if not missing:
                return
            if not self._waiting:
                log.warning("tls: waiting for files (directory=%s missing=%s)", self._directory, ",".join(missing))
                self._waiting = True
            await asyncio.sleep(poll_s)

    def _present(self, name: str) -> bool:
        try:
            check_regular(self._directory / name)
            return (self._directory / name).stat().st_size > 0
        except OSError:
            return False

    def _stamps(self) -> tuple[tuple[int, int, int], ...]:
        stats = [(self._directory / name).stat() for name in FILES]
        return tuple((stat.st_mtime_ns, stat.st_size, stat.st_ino) for stat in stats)

    def _load(self) -> tuple[bytes, bytes, bytes]:
        key, certificate, ca = (read_file(self._directory / name) for name in FILES)
        return key, certificate, ca

    def _configuration(self) -> Any:
        stamp = self._stamps()
        key, certificate, ca = self._load()
        configuration = grpc.ssl_server_certificate_configuration([(key, certificate)], root_certificates=ca)
        self._stamp = stamp
        return configuration

    def expires_s(self) -> float | None:
        """Return the Unix time at which the certificate expires, or None if it is missing or unreadable."""
        try:
            pem = read_file(self._directory / "tls.crt")
            return x509.load_pem_x509_certificate(pem).not_valid_after_utc.timestamp()
        except (OSError, ValueError):
            return None

    def _changed(self) -> Any:
        """Return a new configuration, or None to keep the current one. gRPC calls this at each handshake."""
        try:
            return self._configuration() if self._stamps() != self._stamp else None
        except OSError as error:
            log.critical("tls: cannot read the renewed certificate, keeping the current one (error=%s)", error)
            return None

    def server_credentials(self) -> Any:
        """Return the credentials of a server that requires client certificates."""
        return grpc.dynamic_ssl_server_credentials(self._configuration(), self._changed, True)

    def client_credentials(self) -> Any:
        """Return the credentials of a client from the current files."""
        key, certificate, ca = self._load()
        return grpc.ssl_channel_credentials(ca, key, certificate)


SERVER_OPTIONS = (
    ("grpc.keepalive_time_ms", 2_000),
    ("grpc.keepalive_timeout_ms", 2_000),
    ("grpc.http2.ping_timeout_ms", 2_000),
    ("grpc.keepalive_permit_without_calls", 1),
    ("grpc.http2.max_pings_without_data", 0),
    ("grpc.http2.min_recv_ping_interval_without_data_ms", 1_000),
    ("grpc.http2.max_ping_strikes", 0),
    ("grpc.so_reuseport", 0),
    ("grpc.max_receive_message_length", 64 * 1024),
    ("grpc.max_concurrent_streams", 128),
    ("grpc.max_metadata_size", 8 * 1024),
    ("grpc.absolute_max_metadata_size", 16 * 1024),
    ("grpc.server_handshake_timeout_ms", 5_000),
    ("grpc.max_allowed_incoming_connections", 512),
)
"""Options of gRPC servers. A peer that does not reply to pings is disconnected within 4 s.

A peer that does not complete the TLS handshake is disconnected within 5 s.
"""
