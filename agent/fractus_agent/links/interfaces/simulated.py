"""A device without a radio of its own to control: a TAP of the simulated radio, or a cable."""

from __future__ import annotations

from ipaddress import IPv4Address

from fractus_agent.links.interfaces.addresses import Addresses, NetlinkError, NoDevice
from fractus_agent.links.interfaces.controller import InterfaceProblem


class Plain:
    """Gives the device an address; there is no network to join.

    Args:
        device: its name.
        address: of this node on its direct links.
    """

    def __init__(self, device: str, address: IPv4Address) -> None:
        self.device = device
        self._address = address
        self._addresses = Addresses(device)

    def check(self) -> None:
        """Look whether the device is there, and for direct links alone: the packet filter would cut any other traffic.

        Raises:
            InterfaceProblem: it is not.
        """
        try:
            other = self._addresses.other_traffic()
        except NoDevice as error:
            raise InterfaceProblem("DeviceMissing", str(error)) from error
        except (NetlinkError, OSError) as error:
            raise InterfaceProblem("DeviceFailed", f"{self.device} cannot be looked at: {error}") from error
        if other:
            raise InterfaceProblem(
                "DeviceInUse",
                f"{self.device} carries the node's own traffic ({other}); name one that is for direct links alone",
            )

    async def up(self) -> None:
        """Bring the device up with its address.

        Raises:
            InterfaceProblem: there is none, or the kernel refuses.
        """
        try:
            self._addresses.set(self._address)
        except NoDevice as error:
            raise InterfaceProblem("DeviceMissing", str(error)) from error
        except NetlinkError as error:
            raise InterfaceProblem("DeviceFailed", f"{self.device} takes no address: {error}") from error

    async def down(self) -> None:
        """Take the address away."""
        try:
            self._addresses.clear()
        except NetlinkError as error:
            raise InterfaceProblem("DeviceFailed", f"{self.device} keeps its address: {error}") from error
