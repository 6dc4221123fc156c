"""`fractus gateway connect`: carries bytes between a MAVLink program on this machine and the gateway of the node."""

from __future__ import annotations

import asyncio
import logging
import ssl
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from fractus_core.api.names import node_server_name

from fractus_services.options import CannotServe

log = logging.getLogger(__name__)

READ_BYTES = 4096
MAX_UNSENT_BYTES = 64 * 1024
RETRY_S = 1.0
LOOPBACK = "127.0.0.1"


@dataclass(frozen=True, slots=True, kw_only=True)
class SidecarOptions:
    """Options of `fractus gateway connect`."""

    gateway: str
    node: str
    tls: Path
    tcp: int
    udp: tuple[int, ...]


class Sidecar:
    """Opens one connection to the gateway for each TCP client, and one for each UDP port."""

    def __init__(self, options: SidecarOptions) -> None:
        self._options = options
        self._host, _, port = options.gateway.rpartition(":")
        self._port = int(port)
        self._writers: set[asyncio.StreamWriter] = set()
        self._ended = asyncio.Event()
        self._ended.set()

    async def open(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        """Connect to the gateway with the certificate of the instance.

        Raises:
            OSError: The gateway cannot be reached, or TLS failed.
        """
        tls = self._options.tls
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.load_verify_locations(tls / "ca.crt")
        context.load_cert_chain(tls / "tls.crt", tls / "tls.key")
        return await asyncio.open_connection(
            self._host.strip("[]"), self._port, ssl=context, server_hostname=node_server_name(self._options.node)
        )

    async def serve_tcp(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Carry bytes between a TCP client and the gateway until one of them closes."""
        try:
            remote_reader, remote_writer = await self.open()
        except OSError as error:
            log.warning("gateway: not reachable (gateway=%s error=%s)", self._options.gateway, error)
            writer.close()
            return
        self._writers.add(writer)
        self._ended.clear()
        # Each direction closes both ends when its source closes, so the other direction ends too.
        await asyncio.gather(_pump(reader, remote_writer, writer), _pump(remote_reader, writer, remote_writer))
        self._writers.discard(writer)
        if not self._writers:
            self._ended.set()

    async def close(self) -> None:
        """Close the connections of all TCP clients."""
        for writer in self._writers:
            writer.close()
        await self._ended.wait()

    async def serve_udp(self, port: int) -> None:
        """Send the gateway's messages to a local UDP port, and the datagrams from this port to the gateway."""
        loop = asyncio.get_running_loop()
        logged = False
        while True:
            try:
                reader, writer = await self.open()
            except OSError as error:
                if not logged:
                    log.warning("gateway: not reachable, retrying (gateway=%s error=%s)", self._options.gateway, error)
                logged = True
                await asyncio.sleep(RETRY_S)
                continue
            logged = False
            transport, _ = await loop.create_datagram_endpoint(
                lambda: _Datagrams(writer),  # noqa: B023  (called before the next iteration)
                remote_addr=(LOOPBACK, port),
            )
            try:
                while data := await reader.read(READ_BYTES):
                    transport.sendto(data)
            except OSError:
                pass
            finally:
                transport.close()
                writer.close()
            await asyncio.sleep(RETRY_S)


class _Datagrams(asyncio.DatagramProtocol):
    """Writes received datagrams to the gateway. Errors are ignored, because no program may listen on the port yet."""

    def __init__(self, writer: asyncio.StreamWriter) -> None:
        self._writer = writer

    def datagram_received(self, data: bytes, addr: object) -> None:
        """Forward a datagram. Drop it while the gateway does not read."""
        del addr
        if self._writer.transport.get_write_buffer_size() < MAX_UNSENT_BYTES:
            self._writer.write(data)


async def _pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, source: asyncio.StreamWriter) -> None:
    """Carry bytes from a reader to a writer. Then close the writer, and the writer of the source's connection."""
    with suppress(ConnectionError, ssl.SSLError):
        while data := await reader.read(READ_BYTES):
            writer.write(data)
            await writer.drain()
    writer.close()
    source.close()


async def run(options: SidecarOptions, stop: asyncio.Event) -> None:
    """Serve the loopback ports until `stop` is set.

    Raises:
        CannotServe: The TCP port is in use.
    """
    sidecar = Sidecar(options)
    try:
        server = await asyncio.start_server(sidecar.serve_tcp, LOOPBACK, options.tcp)
    except OSError as error:
        raise CannotServe(f"--tcp {options.tcp}: cannot listen there ({error.strerror}); choose a free port") from None
    log.info("gateway: waiting for MAVLink programs (tcp=%d udp=%s)", options.tcp, options.udp)
    tasks = [asyncio.create_task(sidecar.serve_udp(port)) for port in options.udp]
    try:
        await stop.wait()
    finally:
        # Do not call `Server.wait_closed`: since Python 3.12 it waits for connections, which may wait for the gateway.
        server.close()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await sidecar.close()
