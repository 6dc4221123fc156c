"""Process of the gateway: TLS connections of programs, one session for each connection."""

from __future__ import annotations

import asyncio
import logging
import os
import ssl
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from fractus_core.api.names import ComponentIdentity
from fractus_runtime.audit import AuditLog
from fractus_runtime.files import write_file
from fractus_runtime.metrics import BackgroundReader, serve_metrics

from fractus_services.auth import FILES, Callers, TlsFiles
from fractus_services.clock import Clock
from fractus_services.errors import NotAuthenticated, ResourceExhausted
from fractus_services.gateway.gateway_metrics import GatewayMetrics
from fractus_services.gateway.instance import Instance
from fractus_services.gateway.session import Session
from fractus_services.grpc_server import RateLimiter
from fractus_services.options import CannotServe
from fractus_services.recording.mavlink_messages import MavlinkDecoder
from fractus_services.recording.recorder import Recorder
from fractus_services.recording.segment_directory import segments_in

log = logging.getLogger(__name__)

READ_BYTES = 512
"""Number of bytes that are parsed at once. Other connections wait while bytes, perhaps of damaged frames, are parsed."""

MAX_UNSENT_BYTES = 64 * 1024
"""Maximum size of unsent data. Further messages for a program that does not read are dropped."""

TICK_S = 0.02
"""Interval at which due messages are sent."""

AUDITED_PER_S = 2.0
AUDITED_BURST = 50.0
"""Rate and burst of audit entries about refused messages of an instance. Further refusals are not logged."""

PROBLEM_INTERVAL_S = 5.0
"""Interval at which the certificate and the socket of the mobility service are checked."""

MISSIONS_KEPT_S = 7 * 86_400.0
"""Time for which the stored lists of an instance are kept after its last connection."""

REMOVAL_INTERVAL_S = 3600.0
"""Interval at which unused lists are removed. After a start, programs have this time to connect again."""

MAX_CONNECTIONS = 64
MAX_CONNECTIONS_PER_INSTANCE = 4
HANDSHAKE_TIMEOUT_S = 5.0
RELOAD_S = 10.0
"""Interval at which renewed certificates are loaded."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GatewayOptions:
    """Options of `fractus gateway serve`."""

    tls: Path
    mobility: Path
    listen: str
    state: Path
    audit: Path
    lock_timeout: float
    recordings: Path | None = None
    recordings_mb: int = 0
    metrics: str = ""

    @property
    def problem(self) -> Path:
        """File with the reason why programs cannot fly, if there is one. The agent reads it as a member of the group."""
        return self.state / "gateway.problem"


class Gateway:
    """Accepts connections of programs.

    Args:
        socket: Unix socket of the mobility service.
        callers: Authenticates the instances by their certificates.
        audit: Audit log of refused messages.
        open_recorder: Returns the recorder of an instance.
        missions: Directory that keeps the stored missions of the instances.
        expiry: Returns the Unix time at which the certificate expires, or None if it is unknown.

    Attributes:
        metrics: Metrics of all connections.
    """

    def __init__(
        self,
        socket: Path,
        callers: Callers,
        audit: AuditLog,
        open_recorder: Callable[[str], Recorder],
        *,
        missions: Path,
        expiry: Callable[[], float | None] = lambda: None,
    ) -> None:
        self.metrics = GatewayMetrics(
            audit,
            expiry,
            lambda: len(self._writers),
            lambda: [instance.connected for instance, _ in self._instances.values()],
        )
        self._missions = missions
        self._open_recorder = open_recorder
        self._socket = socket
        self._callers = callers
        self._audit = audit
        self._audited = RateLimiter(AUDITED_PER_S, AUDITED_BURST)
        self._instances: dict[str, tuple[Instance, asyncio.Task[None]]] = {}
        self._recorders: dict[str, Recorder] = {}
        self._writers: dict[asyncio.StreamWriter, str] = {}
        self._ended = asyncio.Event()
        self._ended.set()

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve one connection until it ends."""
        try:
            certificate = _certificate_of(writer)
            identity = self._callers.of({"x509_pem_cert": (certificate,)}).identity
        except NotAuthenticated as refusal:
            log.warning("gateway: connection refused (reason=%s)", refusal)
            writer.close()
            return
        await self.serve_instance(identity, certificate, reader, writer)

    async def serve_instance(
        self, identity: str, certificate: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        """Serve one connection of an authenticated instance until it ends.

        Args:
            identity: SPIFFE ID.
            certificate: PEM certificate of the instance.
            reader: Bytes from the program.
            writer: Bytes for the program.
        """
        instance = self._attach(identity, certificate)
        if instance is None:
            log.warning("gateway: connection refused, too many connections (instance=%s)", identity)
            writer.close()
            return
        recorder = self._recorders.get(identity)
        if recorder is None:
            recorder = self._recorders[identity] = self._open_recorder(identity)
        session = Session(
            instance.vehicle, instance.parameters, instance.missions, recorder.take_sent, self.metrics.count
        )
        instance.sessions.add(session)
        self._writers[writer] = identity
        self._ended.clear()
        log.info("gateway: program connected (instance=%s)", identity)
        sending = asyncio.get_running_loop().create_task(self._send(session, writer, recorder))
        try:
            await self._receive(instance, session, reader, writer, recorder)
        except (ConnectionError, ssl.SSLError, TimeoutError):
            pass
        finally:
            sending.cancel()
            session.close()
            instance.sessions.discard(session)
            writer.close()
            log.info("gateway: program disconnected (instance=%s)", identity)
            if not instance.sessions:
                await self._detach(identity)
            del self._writers[writer]
            if not self._writers:
                self._ended.set()

    def _attach(self, identity: str, certificate: bytes) -> Instance | None:
        """Return the instance of a new connection; None if there are too many connections."""
        entry = self._instances.get(identity)
        if len(self._writers) >= MAX_CONNECTIONS:
            return None
        if entry is None:
            instance = Instance(identity, self._socket, self._missions_of(identity), self.metrics.observe)
            instance.certificate = certificate
            task = asyncio.get_running_loop().create_task(instance.run())
            task.add_done_callback(partial(self._close_failed, identity))
            self._instances[identity] = instance, task
            return instance
        if len(entry[0].sessions) >= MAX_CONNECTIONS_PER_INSTANCE:
            return None
        entry[0].certificate = certificate
        return entry[0]

    def _close_failed(self, identity: str, task: asyncio.Task[None]) -> None:
        """Close the connections of an instance after an unexpected error. Its program may connect again."""
        if task.cancelled() or task.exception() is None:
            return
        log.error("gateway: unexpected error, connections closed (instance=%s)", identity, exc_info=task.exception())
        for writer, owner in self._writers.items():
            if owner == identity:
                writer.close()

    def _missions_of(self, identity: str) -> Path:
        """Return the file with the stored lists of an instance."""
        return self._missions / f"{_file_name(identity)}.json"

    def remove_unused_missions(self, now_s: float) -> None:
        """Remove the stored lists of instances that have not been connected for `MISSIONS_KEPT_S`.

        Args:
            now_s: Unix time.
        """
        for identity in self._instances:
            _note_use(self._missions_of(identity))
        for file in self._missions.glob("*.json"):
            with suppress(OSError):  # tried again after the next interval
                if now_s - file.stat().st_mtime > MISSIONS_KEPT_S:
                    file.unlink()
                    log.info("gateway: unused missions removed (file=%s)", file.name)

    async def _detach(self, identity: str) -> None:
        _note_use(self._missions_of(identity))
        _, task = self._instances.pop(identity)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    async def _receive(
        self,
        instance: Instance,
        session: Session,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        recorder: Recorder,
    ) -> None:
        loop = asyncio.get_running_loop()
        while data := await reader.read(READ_BYTES):
            for call in session.receive(data, loop.time()):
                instance.start(session, call)
            for refusal in session.take_refusals():
                try:
                    self._audited.take(instance.identity, loop.time())
                except ResourceExhausted:
                    continue
                entry = {"identity": instance.identity, "message": refusal.name, "reason": refusal.reason}
                self._audit.append("mavlink_refused", entry)
            self._write(session, writer, recorder)
            delay_s = session.delay_s(loop.time())
            if delay_s > TICK_S:
                await asyncio.sleep(delay_s)
            elif len(data) == READ_BYTES:
                await asyncio.sleep(0.0)  # the next bytes have arrived already, and other connections run in between

    async def _send(self, session: Session, writer: asyncio.StreamWriter, recorder: Recorder) -> None:
        loop = asyncio.get_running_loop()
        while not writer.is_closing():
            session.step(loop.time())
            self._write(session, writer, recorder)
            await asyncio.sleep(TICK_S)

    @staticmethod
    def _write(session: Session, writer: asyncio.StreamWriter, recorder: Recorder) -> None:
        """Send what the session has for the program. Drop it while the program does not read."""
        data = session.take()
        if data and writer.transport.get_write_buffer_size() < MAX_UNSENT_BYTES:
            writer.write(data)
            recorder.take_received(data)

    async def close(self) -> None:
        """Close all connections, and wait until their instances have ended."""
        for writer in self._writers:
            writer.close()
        await self._ended.wait()
        for recorder in self._recorders.values():
            await recorder.close()


async def run(options: GatewayOptions, stop: asyncio.Event) -> None:
    """Serve until `stop` is set.

    Raises:
        CannotServe: An option is wrong.
    """
    tls = TlsFiles(options.tls)
    reporting = asyncio.get_running_loop().create_task(_report_problems(options, tls))
    try:
        await _serve(options, tls, stop)
    finally:
        reporting.cancel()
        await asyncio.gather(reporting, return_exceptions=True)
        options.problem.unlink(missing_ok=True)


async def _serve(options: GatewayOptions, tls: TlsFiles, stop: asyncio.Event) -> None:
    await tls.wait()
    clock = Clock()
    audit = AuditLog(options.audit, clock, tls=options.tls)
    gateway = Gateway(
        options.mobility,
        Callers(clock),
        audit,
        partial(open_recorder, options),
        missions=options.state / "missions",
        expiry=BackgroundReader(tls.expires_s),
    )
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.verify_mode = ssl.CERT_REQUIRED
    host, _, port = options.listen.rpartition(":")
    try:
        _load(context, options.tls)
        server = await asyncio.start_server(
            gateway.serve,
            host.strip("[]"),
            int(port),
            ssl=context,
            ssl_handshake_timeout=HANDSHAKE_TIMEOUT_S,
            limit=MAX_UNSENT_BYTES,
        )
    except OSError as error:
        raise CannotServe(
            f"--listen {options.listen}, --tls {options.tls}: cannot serve ({error.strerror or error})"
        ) from None
    audit.append("started", {"listen": options.listen})
    log.info("gateway: serving (address=%s)", options.listen)
    loop = asyncio.get_running_loop()
    helpers = (loop.create_task(_reload(context, options.tls)), loop.create_task(_remove_unused_missions(gateway)))
    try:
        async with serve_metrics(options.metrics, gateway.metrics.collect):
            await stop.wait()
    finally:
        for helper in helpers:
            helper.cancel()
        server.close()
        await gateway.close()
        await audit.close()


async def _remove_unused_missions(gateway: Gateway) -> None:
    while True:
        await asyncio.sleep(REMOVAL_INTERVAL_S)
        gateway.remove_unused_missions(time.time())


async def _report_problems(options: GatewayOptions, tls: TlsFiles) -> None:
    """Write the reason why programs cannot fly to a file, and remove the file when the problem is solved."""
    reported: str | None = None
    while True:
        problem = current_problem(options.mobility, tls, time.time())
        if problem != reported:
            reported = problem
            if problem:
                log.warning("gateway: programs cannot fly (problem=%s)", problem)
            with suppress(OSError):  # a full disk is reported by the audit log
                if problem:
                    write_file(options.problem, problem.encode(), 0o640, durable=False)
                else:
                    options.problem.unlink(missing_ok=True)
        await asyncio.sleep(PROBLEM_INTERVAL_S)


def current_problem(socket: Path, tls: TlsFiles, now_s: float) -> str:
    """Return why programs cannot fly, or an empty string.

    Args:
        socket: Socket of the mobility service.
        tls: Certificate of the node.
        now_s: Unix time.
    """
    expires_s = tls.expires_s()
    if expires_s is None:
        return "The gateway cannot read the certificate of the node."
    if expires_s <= now_s:
        return "The certificate of the node has expired."
    if not socket.is_socket():
        return (
            f"The mobility service does not offer the socket {socket}; it is not running, or has no --gateway-socket."
        )
    return ""


def open_recorder(options: GatewayOptions, identity: str) -> Recorder:
    """Return the recorder of an instance. It records what the instance sends and receives around its flights."""
    name = _file_name(identity)
    directory = options.recordings / name if options.recordings is not None else None
    return Recorder(segments_in(directory, options.recordings_mb), name, MavlinkDecoder(name))


def _note_use(file: Path) -> None:
    """Set the time of the latest use of a file, if there is one."""
    with suppress(OSError):
        os.utime(file)


def _file_name(identity: str) -> str:
    """Return the name of the files of an instance."""
    parsed = ComponentIdentity.parse(identity)
    return f"{parsed.namespace}.{parsed.instance}" if parsed is not None else "unknown"


def _load(context: ssl.SSLContext, directory: Path) -> None:
    context.load_cert_chain(directory / "tls.crt", directory / "tls.key")
    context.load_verify_locations(directory / "ca.crt")


async def _reload(context: ssl.SSLContext, directory: Path) -> None:
    """Load renewed certificates. New connections use them."""
    loaded = _stamps(directory)
    while True:
        await asyncio.sleep(RELOAD_S)
        present = _stamps(directory)
        if present == loaded:
            continue
        try:
            _load(context, directory)
            loaded = present
        except OSError as error:
            log.critical("gateway: cannot read the renewed certificate, keeping the current one (error=%s)", error)


def _stamps(directory: Path) -> tuple[int, ...]:
    with suppress(OSError):
        return tuple((directory / name).stat().st_mtime_ns for name in FILES)
    return ()


def _certificate_of(writer: asyncio.StreamWriter) -> bytes:
    connection = writer.get_extra_info("ssl_object")
    certificate = connection.getpeercert(binary_form=True)
    return ssl.DER_cert_to_PEM_cert(certificate).encode() if certificate else b""
