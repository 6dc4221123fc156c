"""A WiFi radio, which joins the network of its pairing through the node's wpa_supplicant: ad hoc, or of an access point."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Iterator
from contextlib import suppress
from ipaddress import IPv4Address
from pathlib import Path

from fractus_core.api.nodes import Pairing

from fractus_agent.links.interfaces.controller import InterfaceProblem
from fractus_agent.links.interfaces.simulated import Plain

REPLY_TIMEOUT_S = 2.0
JOIN_TIMEOUT_S = 8.0
JOIN_POLL_S = 0.2
REPLY_BYTES = 16 * 1024
CHANNEL_MHZ = 2412
"""Where an ad hoc network is made; nodes that come later find it."""

_JOINED = "COMPLETED"


class Supplicant:
    """wpa_supplicant's control socket for one device.

    Its events are not asked for, since they would mix with its replies. The socket's own name is an abstract one, so that no
    directory needs to be shared for it.

    Args:
        path: of the socket, /run/wpa_supplicant/DEVICE.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def there(self) -> bool:
        """Whether wpa_supplicant controls the device."""
        return self._path.is_socket()

    async def ask(self, *words: str) -> str:
        """A command's reply.

        Raises:
            InterfaceProblem: it does not answer, or refuses.
        """
        loop = asyncio.get_running_loop()
        command = " ".join(words)
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as asking:
            try:
                asking.bind("")  # any free abstract name
                asking.connect(str(self._path))
                async with asyncio.timeout(REPLY_TIMEOUT_S):
                    await loop.sock_sendall(asking, command.encode())
                    reply = (await loop.sock_recv(asking, REPLY_BYTES)).decode(errors="replace").strip()
            except (OSError, TimeoutError) as error:
                problem = f"wpa_supplicant does not answer at {self._path}: {error or 'time-out'}"
                raise InterfaceProblem("NoSupplicant", problem) from error
        if reply in {"FAIL", "UNKNOWN COMMAND"}:
            raise InterfaceProblem("SupplicantRefused", f"wpa_supplicant refuses {command}")
        return reply

    async def network(self, name: str) -> str | None:
        """The number of a network of this name; None when it knows none."""
        for line in (await self.ask("LIST_NETWORKS")).splitlines()[1:]:
            number, ssid, *_ = [*line.split("\t"), "", ""]
            if ssid == name:
                return number
        return None

    async def state(self) -> tuple[str, str]:
        """How far the device is, and with which network."""
        said = dict(_pairs(await self.ask("STATUS")))
        return said.get("wpa_state", "UNKNOWN"), said.get("id", "")


class Wifi:
    """Joins the network of the pairing, and gives the device its address.

    A network of this name in the node's own configuration is used as it is, with the key that it has there; else an open one is
    made: who may link, the nodes' certificates decide. Where no wpa_supplicant controls the device, the node's own software
    has to join.

    Args:
        device: its name.
        address: of this node on its direct links.
        pairing: which network.
        directory: of wpa_supplicant's control sockets.
    """

    def __init__(self, device: str, address: IPv4Address, pairing: Pairing, directory: Path) -> None:
        self.device = device
        self._plain = Plain(device, address)
        self._pairing = pairing
        self._supplicant = Supplicant(directory / device)
        self._made = ""

    def check(self) -> None:
        """Look whether the device is there, and for direct links alone.

        Raises:
            InterfaceProblem: it is not.
        """
        self._plain.check()

    async def up(self) -> None:
        """Join, and set the address.

        Raises:
            InterfaceProblem: the device is gone, or does not join.
        """
        await self._plain.up()
        if self._supplicant.there():
            await self._join()

    async def down(self) -> None:
        """Leave a network that was made, and take the address away.

        Raises:
            InterfaceProblem: the kernel refuses.
        """
        if self._made:
            # What wpa_supplicant does not do any more, it has forgotten.
            with suppress(InterfaceProblem):
                await self._supplicant.ask("REMOVE_NETWORK", self._made)
            self._made = ""
        await self._plain.down()

    async def _join(self) -> None:
        number = await self._supplicant.network(self._pairing.network_id)
        if number is None:
            number = self._made = await self._make()
        if await self._supplicant.state() == (_JOINED, number):
            return
        await self._supplicant.ask("SELECT_NETWORK", number)
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
            f"{self.device} has not joined the network {self._pairing.network_id} (it is {state or 'silent'})",
        )

    async def _make(self) -> str:
        """Describe the network to wpa_supplicant; its number."""
        number = await self._supplicant.ask("ADD_NETWORK")
        settings = {"ssid": self._pairing.network_id.encode().hex(), "key_mgmt": "NONE"}
        if self._pairing.mode == "adhoc":
            settings |= {"mode": "1", "frequency": str(CHANNEL_MHZ)}
        else:
            settings |= {"scan_ssid": "1"}
        for name, value in settings.items():
            await self._supplicant.ask("SET_NETWORK", number, name, value)
        return number


def _pairs(text: str) -> Iterator[tuple[str, str]]:
    for line in text.splitlines():
        name, separator, value = line.partition("=")
        if separator:
            yield name, value
