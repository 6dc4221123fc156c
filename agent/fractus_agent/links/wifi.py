"""WiFi interface that joins the network of its pairing through wpa_supplicant: ad hoc, or of an access point."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Iterator
from contextlib import suppress
from ipaddress import IPv4Address
from pathlib import Path

from fractus_core.api.nodes import Pairing

from fractus_agent.links.wired import InterfaceProblem, WiredInterface

REPLY_TIMEOUT_S = 2.0
JOIN_TIMEOUT_S = 8.0
JOIN_POLL_S = 0.2
REPLY_BYTES = 16 * 1024
CHANNEL_MHZ = 2412
"""Frequency on which a new ad hoc network is created, in MHz.

Nodes that join later use the frequency of the network.
"""

_JOINED = "COMPLETED"


class WpaSupplicant:
    """Control socket of wpa_supplicant for one device.

    The client does not subscribe to events, because they would mix with replies. The client socket has an abstract
    name, so that no directory needs to be shared for it.

    Args:
        path: Path of the control socket, /run/wpa_supplicant/DEVICE.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def controls_device(self) -> bool:
        """Return True if wpa_supplicant controls the device."""
        return self._path.is_socket()

    async def request(self, *words: str) -> str:
        """Send a command, and return the reply.

        Raises:
            InterfaceProblem: wpa_supplicant does not respond, or refused the command.
        """
        loop = asyncio.get_running_loop()
        command = " ".join(words)
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as client:
            try:
                client.bind("")  # the kernel selects a free abstract name
                client.connect(str(self._path))
                async with asyncio.timeout(REPLY_TIMEOUT_S):
                    await loop.sock_sendall(client, command.encode())
                    reply = (await loop.sock_recv(client, REPLY_BYTES)).decode(errors="replace").strip()
            except (OSError, TimeoutError) as error:
                problem = f"wpa_supplicant does not respond at {self._path}: {error or 'timeout'}"
                raise InterfaceProblem("NoSupplicant", problem) from error
        if reply in {"FAIL", "UNKNOWN COMMAND"}:
            raise InterfaceProblem("SupplicantRefused", f"wpa_supplicant refused {command}")
        return reply

    async def find_network(self, name: str) -> str | None:
        """Return the number of the network with this name, None if it is unknown."""
        for line in (await self.request("LIST_NETWORKS")).splitlines()[1:]:
            number, ssid, *_ = [*line.split("\t"), "", ""]
            if ssid == name:
                return number
        return None

    async def state(self) -> tuple[str, str]:
        """Return the state of the device and the number of its network."""
        status = dict(_pairs(await self.request("STATUS")))
        return status.get("wpa_state", "UNKNOWN"), status.get("id", "")


class WifiInterface:
    """Joins the network of the pairing, and sets the address of the device.

    If the node's configuration of wpa_supplicant contains a network with this name, it is used with its key. Otherwise
    an open network is created, because the node certificates decide who may link. If wpa_supplicant does not control
    the device, the node's own software must join the network.

    Args:
        device: Name of the network device.
        address: Address of this node on its direct links.
        pairing: Network to join.
        directory: Directory of wpa_supplicant's control sockets.
    """

    def __init__(self, device: str, address: IPv4Address, pairing: Pairing, directory: Path) -> None:
        self.device = device
        self._wired = WiredInterface(device, address)
        self._pairing = pairing
        self._supplicant = WpaSupplicant(directory / device)
        self._created_network = ""

    async def check(self) -> None:
        """Check that the device exists and is reserved for direct links.

        Raises:
            InterfaceProblem: The device is missing, or carries other traffic.
        """
        await self._wired.check()

    async def up(self) -> None:
        """Set the address and join the network.

        Raises:
            InterfaceProblem: The device is missing, or has not joined.
        """
        await self._wired.up()
        if self._supplicant.controls_device():
            await self._join()

    async def down(self) -> None:
        """Leave a network that the agent created, and remove the address.

        Raises:
            InterfaceProblem: The kernel refused.
        """
        if self._created_network:
            # If wpa_supplicant has ended, it has forgotten the network.
            with suppress(InterfaceProblem):
                await self._supplicant.request("REMOVE_NETWORK", self._created_network)
            self._created_network = ""
        await self._wired.down()

    async def _join(self) -> None:
        number = await self._supplicant.find_network(self._pairing.network_id)
        if number is None:
            number = self._created_network = await self._create_network()
        if await self._supplicant.state() == (_JOINED, number):
            return
        await self._supplicant.request("SELECT_NETWORK", number)
        state = ""
        with suppress(TimeoutError):
            async with asyncio.timeout(JOIN_TIMEOUT_S):
                while True:
                    state, current = await self._supplicant.state()
                    if (state, current) == (_JOINED, number):
                        return
                    await asyncio.sleep(JOIN_POLL_S)
        raise InterfaceProblem(
            "NotJoined",
            f"{self.device} has not joined the network {self._pairing.network_id} (state {state or 'unknown'})",
        )

    async def _create_network(self) -> str:
        """Add the network to wpa_supplicant, and return its number."""
        number = await self._supplicant.request("ADD_NETWORK")
        settings = {"ssid": self._pairing.network_id.encode().hex(), "key_mgmt": "NONE"}
        if self._pairing.mode == "adhoc":
            settings |= {"mode": "1", "frequency": str(CHANNEL_MHZ)}
        else:
            settings |= {"scan_ssid": "1"}
        for name, value in settings.items():
            await self._supplicant.request("SET_NETWORK", number, name, value)
        return number


def _pairs(text: str) -> Iterator[tuple[str, str]]:
    for line in text.splitlines():
        name, separator, value = line.partition("=")
        if separator:
            yield name, value
