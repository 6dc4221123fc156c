"""Pairing session of a direct link: mutual authentication by node certificates, heartbeats and bandwidth probes.

The session is a sequence of JSON objects, one per line, over TLS 1.3. The drone requests pairing. The edge node accepts,
or refuses with a reason. After that the session carries heartbeats in both directions, short bandwidth probes, and messages
about the traffic. Each end detects the loss of the link by missing heartbeats.
"""

from __future__ import annotations

import asyncio
import json
import math
import ssl
import time
from collections.abc import Callable, Mapping
from ipaddress import IPv4Address
from pathlib import Path
from typing import Any

from fractus_core.api.names import node_identity, node_server_name
from fractus_runtime.files import check_regular, parse_json

from fractus_agent.certificates import CERTIFICATE_FILES

PAIRING_PORT = 46811
HANDSHAKE_TIMEOUT_S = 3.0
HEARTBEAT_S = 0.1
LOSS_TIMEOUT_S = 0.6
"""The link counts as lost after this time without a message, in seconds.

Traffic must be back on the cloud path within a second. The remaining 0.4 s are for a peer whose process was not
scheduled.
"""

MAX_LINE_BYTES = 64 * 1024
PROBE_BYTES = (6_000, 12_000, 24_000, 48_000)
"""Sizes of the bursts of a probe.

The next size is used only if the previous burst was so fast that the larger burst cannot delay heartbeats. Otherwise the same
size is repeated, because one burst may have competed with a picture.
"""
ACKNOWLEDGEMENT_TIMEOUT_S = 2.0
BURST_LIMIT_S = 0.15
SMOOTHING = 0.2
MAX_ECHO_AGE_S = 60.0
"""Maximum age of an echoed heartbeat, in seconds.

An echo of an older heartbeat, or of a time in the future, was not sent in this session.
"""
MAX_REASON_CHARS = 200
"""Maximum length of the peer's reason for a refusal, which is logged and audited."""


class PairingFailed(Exception):
    """The peer did not respond, has the wrong identity, or refused."""


class LinkLost(Exception):
    """The other end is silent, or has ended the session."""


def client_context(directory: Path) -> ssl.SSLContext:
    """Return the TLS context of the end that requests pairing.

    Raises:
        OSError: A file is missing.
        ssl.SSLError: The files do not belong together.
    """
    _check_files(directory)
    context = ssl.create_default_context(cafile=str(directory / "ca.crt"))
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.load_cert_chain(directory / "tls.crt", directory / "tls.key")
    return context


def server_context(directory: Path) -> ssl.SSLContext:
    """Return the TLS context of the end that accepts pairing. It requires a client certificate."""
    _check_files(directory)
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH, cafile=str(directory / "ca.crt"))
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.verify_mode = ssl.CERT_REQUIRED
    context.load_cert_chain(directory / "tls.crt", directory / "tls.key")
    return context


def _check_files(directory: Path) -> None:
    for name in CERTIFICATE_FILES:
        check_regular(directory / name)


def authenticated_node(writer: asyncio.StreamWriter) -> str:
    """Return the node name in the certificate of the other end.

    Raises:
        PairingFailed: The certificate does not belong to a node. Components have certificates of the same authority.
    """
    certificate: Mapping[str, Any] = writer.get_extra_info("peercert") or {}
    prefix = node_identity("")
    for kind, value in certificate.get("subjectAltName", ()):
        if kind == "URI" and value.startswith(prefix) and len(value) > len(prefix):
            return str(value[len(prefix) :])
    raise PairingFailed("the certificate of the other end does not belong to a node")


class Session:
    """Authenticated session with the other end of a direct link.

    Attributes:
        peer: Name of the node at the other end, from its certificate.
        latency_ms: Smoothed one-way latency (half of the round trip) in milliseconds, None before the first echo.
        on_message: Called with each message that the session itself does not handle.
    """

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, peer: str) -> None:
        self.peer = peer
        self.latency_ms: float | None = None
        self.on_message: Callable[[Mapping[str, Any]], None] = _ignore_message
        self._min_latency_ms = 0.0
        self._probe_acknowledged: asyncio.Future[None] | None = None
        self._reader = reader
        self._writer = writer

    async def send(self, message: Mapping[str, Any]) -> None:
        """Send a message.

        Raises:
            LinkLost: The message cannot be sent.
        """
        try:
            self._writer.write(json.dumps(message).encode() + b"\n")
            async with asyncio.timeout(LOSS_TIMEOUT_S):
                await self._writer.drain()
        except (OSError, TimeoutError) as error:
            raise LinkLost(f"cannot send to {self.peer} ({str(error) or 'timeout'})") from error

    async def receive(self, timeout_s: float) -> dict[str, Any]:
        """Return the next message.

        Raises:
            LinkLost: No message arrived in time, the session ended, or the data is not a message.
        """
        reading = asyncio.ensure_future(self._reader.readline())
        try:
            # If the process was not scheduled for a while, asyncio.timeout() would raise although data has arrived.
            await asyncio.wait({reading}, timeout=timeout_s)
            if not reading.done():
                raise LinkLost(f"{self.peer} has been silent for {timeout_s:g} s")
            line = reading.result()
            message = parse_json(line) if line else None
        except (OSError, ValueError) as error:
            raise LinkLost(f"the session with {self.peer} broke: {error}") from error
        finally:
            reading.cancel()
        if not isinstance(message, dict):
            raise LinkLost(
                f"{self.peer} ended the session" if message is None else f"{self.peer} sent an invalid message"
            )
        return message

    async def run(self) -> None:
        """Exchange heartbeats until the link is lost.

        Raises:
            LinkLost: The link is lost, or the other end has ended the session.
        """
        both = [asyncio.create_task(self._send_heartbeats()), asyncio.create_task(self._receive_messages())]
        try:
            await asyncio.gather(*both)
        finally:
            for task in both:
                task.cancel()
            await asyncio.gather(*both, return_exceptions=True)

    async def _send_heartbeats(self) -> None:
        while True:
            await self.send({"beat": time.monotonic()})
            await asyncio.sleep(HEARTBEAT_S)

    async def _receive_messages(self) -> None:
        while True:
            message = await self.receive(LOSS_TIMEOUT_S)
            if "beat" in message:
                sent_s = _seconds(message["beat"])
                if sent_s is not None:
                    await self.send({"echo": sent_s})
            elif "echo" in message:
                self._measure_latency(_seconds(message["echo"]))
            elif "probe" in message:
                await self.send({"arrived": True})
            elif "arrived" in message:
                if self._probe_acknowledged is not None and not self._probe_acknowledged.done():
                    self._probe_acknowledged.set_result(None)
            else:
                self.on_message(message)

    def _measure_latency(self, sent_s: float | None) -> None:
        """Update the latency by an echoed heartbeat. Ignore an echo of a time at which no heartbeat was sent."""
        round_trip_s = time.monotonic() - sent_s if sent_s is not None else math.inf
        if not 0 <= round_trip_s <= MAX_ECHO_AGE_S:
            return
        latency_ms = round_trip_s / 2 * 1e3
        self._min_latency_ms = min(self._min_latency_ms or latency_ms, latency_ms)
        previous = self.latency_ms
        self.latency_ms = latency_ms if previous is None else previous + SMOOTHING * (latency_ms - previous)

    async def probe(self) -> float:
        """Measure the bandwidth towards the other end in Mbit/s, by a few short bursts.

        Other traffic on the link reduces the result. `run` must be running.

        Raises:
            LinkLost: The other end does not acknowledge the bursts.
        """
        best_mbps = 0.0
        step = 0
        for _ in PROBE_BYTES:
            size = PROBE_BYTES[step]
            self._probe_acknowledged = asyncio.get_running_loop().create_future()
            begin_s = time.monotonic()
            await self.send({"probe": "x" * size})
            try:
                async with asyncio.timeout(ACKNOWLEDGEMENT_TIMEOUT_S):
                    await self._probe_acknowledged
            except TimeoutError as error:
                raise LinkLost(f"{self.peer} does not acknowledge probes") from error
            elapsed_s = time.monotonic() - begin_s
            transfer_s = max(elapsed_s - 2e-3 * self._min_latency_ms, elapsed_s / 2)
            best_mbps = max(best_mbps, size * 8e-6 / transfer_s)
            next_step = min(step + 1, len(PROBE_BYTES) - 1)
            if elapsed_s * PROBE_BYTES[next_step] / size <= BURST_LIMIT_S:
                step = next_step
        return best_mbps

    def abort(self) -> None:
        """End the session at once."""
        self._writer.transport.abort()

    async def close(self) -> None:
        """End the session, with a TLS shutdown if the link still works."""
        self._writer.close()
        try:
            async with asyncio.timeout(LOSS_TIMEOUT_S):
                await self._writer.wait_closed()
        except (OSError, TimeoutError):
            self._writer.transport.abort()


def _seconds(value: object) -> float | None:
    """Return a time of a message, or None if it is not a finite number."""
    if not isinstance(value, int | float) or isinstance(value, bool):
        return None
    try:
        seconds = float(value)
    except OverflowError:
        return None
    return seconds if math.isfinite(seconds) else None


def _ignore_message(_message: Mapping[str, Any]) -> None:
    """Ignore a message that arrived before a handler is set."""


async def pair(node: str, peer: str, address: IPv4Address, directory: Path, link: Mapping[str, Any]) -> Session:
    """Pair with a peer.

    Args:
        node: Name of this node.
        peer: Name of the peer, which its certificate must prove.
        address: Address of the peer on the link.
        directory: Directory of this node's certificate, key and authority.
        link: Description of the link, sent to the peer.

    Raises:
        PairingFailed: No response in time, another node responded, or the peer refused.
    """
    try:
        async with asyncio.timeout(HANDSHAKE_TIMEOUT_S):
            reader, writer = await asyncio.open_connection(
                str(address), PAIRING_PORT, ssl=client_context(directory), server_hostname=node_server_name(peer),
                limit=MAX_LINE_BYTES,
            )  # fmt: skip
    except ssl.SSLCertVerificationError as error:
        raise PairingFailed(
            f"the node at the address of {peer} does not have its certificate: {error.verify_message}"
        ) from error
    except (OSError, TimeoutError) as error:
        raise PairingFailed(f"{peer} does not respond: {str(error) or 'timeout'}") from error
    session = Session(reader, writer, peer)
    try:
        if authenticated_node(writer) != peer:
            raise PairingFailed(f"{authenticated_node(writer)} responds at the address of {peer}")
        await session.send({"pair": node, "link": dict(link)})
        response = await session.receive(HANDSHAKE_TIMEOUT_S)
        if response.get("accepted") is not True:
            reason = str(response.get("reason") or "no reason given")[:MAX_REASON_CHARS]
            raise PairingFailed(f"{peer} refused: {reason}")
    except (LinkLost, PairingFailed) as error:
        await session.close()
        if isinstance(error, PairingFailed):
            raise
        raise PairingFailed(str(error)) from error
    except BaseException:
        session.abort()
        raise
    return session
