"""Pairing: both ends of a direct link prove their node certificates over TLS before any traffic moves, and stay in contact.

The session is a line of JSON objects over TLS 1.3. The drone asks; the peer accepts, or refuses with a reason. After that the
session carries heartbeats both ways, by which each end notices the loss of the link, short probes of its bandwidth, and what
the ends tell each other of the traffic.
"""

from __future__ import annotations

import asyncio
import json
import ssl
import time
from collections.abc import Callable, Mapping
from ipaddress import IPv4Address
from pathlib import Path
from typing import Any

from fractus_core.api.names import node_identity, node_server_name

PORT = 46811
HANDSHAKE_TIMEOUT_S = 3.0
HEARTBEAT_S = 0.1
LOSS_TIMEOUT_S = 0.6
"""Without a word for so long the link is lost; a link at the edge of its reach is no use either. Traffic must be back on the
cloud path within a second; what of that is left is for a peer that was kept from running."""

MAX_LINE_BYTES = 64 * 1024
PROBE_BYTES = (6_000, 12_000, 24_000, 48_000)
"""Of a probe's bursts: the next size is sent only if the one before it was so quick that this one cannot delay heartbeats for
long; else the same once more, for one burst that met a picture of the components' says little."""
PROBE_TIMEOUT_S = 2.0
BURST_LIMIT_S = 0.15
SMOOTHING = 0.2


class PairingFailed(Exception):
    """The peer did not answer, is not who it should be, or refused."""


class LinkLost(Exception):
    """The other end has fallen silent, or ended the session."""


def client_context(directory: Path) -> ssl.SSLContext:
    """TLS of the end that asks.

    Raises:
        OSError: a file is missing.
        ssl.SSLError: the files do not belong together.
    """
    context = ssl.create_default_context(cafile=str(directory / "ca.crt"))
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.load_cert_chain(directory / "tls.crt", directory / "tls.key")
    return context


def server_context(directory: Path) -> ssl.SSLContext:
    """TLS of the end that is asked; it takes no session without a certificate."""
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH, cafile=str(directory / "ca.crt"))
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.verify_mode = ssl.CERT_REQUIRED
    context.load_cert_chain(directory / "tls.crt", directory / "tls.key")
    return context


def proven_node(writer: asyncio.StreamWriter) -> str:
    """The node that the other end's certificate names.

    Raises:
        PairingFailed: it names none: components and operators have certificates of the same authority.
    """
    certificate: Mapping[str, Any] = writer.get_extra_info("peercert") or {}
    prefix = node_identity("")
    for kind, value in certificate.get("subjectAltName", ()):
        if kind == "URI" and value.startswith(prefix) and len(value) > len(prefix):
            return str(value[len(prefix) :])
    raise PairingFailed("the other end's certificate is not a node's")


class Session:
    """An authenticated session with the other end of a direct link.

    Attributes:
        peer: the node at the other end, as its certificate says.
        latency_ms: one way, half of the round trip, smoothed; None before the first answer.
        told: called with each message of the other end that the session itself has no use for.
    """

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, peer: str) -> None:
        self.peer = peer
        self.latency_ms: float | None = None
        self.told: Callable[[Mapping[str, Any]], None] = _ignored
        self._least_ms = 0.0
        self._arrived: asyncio.Future[None] | None = None
        self._reader = reader
        self._writer = writer
        self._heard_at = time.monotonic()

    async def send(self, message: Mapping[str, Any]) -> None:
        """Send a message.

        Raises:
            LinkLost: it cannot be sent.
        """
        try:
            self._writer.write(json.dumps(message).encode() + b"\n")
            async with asyncio.timeout(LOSS_TIMEOUT_S):
                await self._writer.drain()
        except (OSError, TimeoutError) as error:
            raise LinkLost(f"the link to {self.peer} does not take messages ({str(error) or 'time-out'})") from error

    async def receive(self, timeout_s: float) -> dict[str, Any]:
        """The next message.

        Raises:
            LinkLost: none came in time, the session ended, or what came is no message.
        """
        reading = asyncio.ensure_future(self._reader.readline())
        try:
            # Not asyncio.timeout(): in a process that was kept from running, it prefers the time-out to what has arrived meanwhile.
            await asyncio.wait({reading}, timeout=timeout_s)
            if not reading.done():
                raise LinkLost(f"{self.peer} has been silent for {timeout_s:g} s")
            line = reading.result()
            message = json.loads(line) if line else None
        except (OSError, ValueError) as error:
            raise LinkLost(f"the session with {self.peer} broke: {error}") from error
        finally:
            reading.cancel()
        if not isinstance(message, dict):
            raise LinkLost(f"{self.peer} ended the session" if message is None else f"{self.peer} sent no message")
        self._heard_at = time.monotonic()
        return message

    async def keep(self) -> None:
        """Exchange heartbeats until the link is lost.

        Raises:
            LinkLost: always, in the end.
        """
        both = [asyncio.create_task(self._beat()), asyncio.create_task(self._listen())]
        try:
            await asyncio.gather(*both)
        finally:
            for task in both:
                task.cancel()
            await asyncio.gather(*both, return_exceptions=True)

    async def _beat(self) -> None:
        while True:
            await self.send({"beat": time.monotonic()})
            await asyncio.sleep(HEARTBEAT_S)

    async def _listen(self) -> None:
        while True:
            message = await self.receive(LOSS_TIMEOUT_S)
            if isinstance(sent := message.get("beat"), int | float):
                await self.send({"echo": sent})
            elif isinstance(sent := message.get("echo"), int | float):
                way_ms = max(time.monotonic() - sent, 0.0) / 2 * 1e3
                self._least_ms = min(self._least_ms or way_ms, way_ms)
                before = self.latency_ms
                self.latency_ms = way_ms if before is None else before + SMOOTHING * (way_ms - before)
            elif "probe" in message:
                await self.send({"arrived": True})
            elif "arrived" in message:
                if self._arrived is not None and not self._arrived.done():
                    self._arrived.set_result(None)
            else:
                self.told(message)

    async def probe(self) -> float:
        """Mbit/s towards the other end, by a few short bursts while the session is kept; what else goes over the link counts.

        Raises:
            LinkLost: they are not answered.
        """
        best, rung = 0.0, 0
        for _ in PROBE_BYTES:
            size = PROBE_BYTES[rung]
            self._arrived = asyncio.get_running_loop().create_future()
            begun = time.monotonic()
            await self.send({"probe": "x" * size})
            try:
                async with asyncio.timeout(PROBE_TIMEOUT_S):
                    await self._arrived
            except TimeoutError as error:
                raise LinkLost(f"{self.peer} does not answer probes") from error
            took_s = time.monotonic() - begun
            on_air_s = max(took_s - 2e-3 * self._least_ms, took_s / 2)
            best = max(best, size * 8e-6 / on_air_s)
            following = min(rung + 1, len(PROBE_BYTES) - 1)
            if took_s * PROBE_BYTES[following] / size <= BURST_LIMIT_S:
                rung = following
        return best

    def abort(self) -> None:
        """End the session at once."""
        self._writer.transport.abort()

    async def close(self) -> None:
        """End the session, politely if the link still works."""
        self._writer.close()
        try:
            async with asyncio.timeout(LOSS_TIMEOUT_S):
                await self._writer.wait_closed()
        except (OSError, TimeoutError):
            self._writer.transport.abort()


def _ignored(_message: Mapping[str, Any]) -> None:
    """No one waits for the other end's messages yet."""


async def ask(node: str, peer: str, address: IPv4Address, directory: Path, link: Mapping[str, Any]) -> Session:
    """Pair with a peer.

    Args:
        node: this node.
        peer: who must answer.
        address: of the peer on the link.
        directory: certificate, key and authority of this node.
        link: what the peer is told of the link.

    Raises:
        PairingFailed: no answer in time, another node answered, or the peer refused.
    """
    try:
        async with asyncio.timeout(HANDSHAKE_TIMEOUT_S):
            reader, writer = await asyncio.open_connection(
                str(address), PORT, ssl=client_context(directory), server_hostname=node_server_name(peer),
                limit=MAX_LINE_BYTES,
            )  # fmt: skip
    except ssl.SSLCertVerificationError as error:
        raise PairingFailed(f"who answers for {peer} does not have its certificate: {error.verify_message}") from error
    except (OSError, TimeoutError) as error:
        raise PairingFailed(f"{peer} does not answer: {str(error) or 'time-out'}") from error
    session = Session(reader, writer, peer)
    try:
        if proven_node(writer) != peer:
            raise PairingFailed(f"{proven_node(writer)} answers for {peer}")
        await session.send({"pair": node, "link": dict(link)})
        answer = await session.receive(HANDSHAKE_TIMEOUT_S)
        if answer.get("accepted") is not True:
            raise PairingFailed(f"{peer} refused: {answer.get('reason') or 'without a reason'}")
    except (LinkLost, PairingFailed) as error:
        await session.close()
        raise error if isinstance(error, PairingFailed) else PairingFailed(str(error)) from error
    return session
