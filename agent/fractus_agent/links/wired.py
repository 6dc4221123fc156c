"""Direct interface without a radio to control: a cable, or a TAP device of the simulated radio."""

from __future__ import annotations

from ipaddress import IPv4Address
from typing import Protocol

from pyroute2 import NetlinkError

from fractus_agent.links.device_addresses import DeviceAddresses, NoDevice


class InterfaceProblem(Exception):
    """The interface is not usable now.

    Args:
        reason: Reason in CamelCase, for programs.
        message: One sentence for people.
    """

    def __init__(self, reason: str, message: str) -> None:
        self.reason = reason
        super().__init__(message)


class InterfaceController(Protocol):
    """Controls one direct interface.

    Attributes:
        device: Name of the network device.
    """

    device: str

    async def check(self) -> None:
        """Check that the device exists and is reserved for direct links. Change nothing.

        Raises:
            InterfaceProblem: The device is missing, or carries other traffic.
        """

    async def up(self) -> None:
        """Join the network of the pairing and set this node's address. Called repeatedly while links are planned.

        Raises:
            InterfaceProblem: The interface cannot be brought up.
        """

    async def down(self) -> None:
        """Leave the network and remove the address. A missing device is not an error.

        Raises:
            InterfaceProblem: The kernel refused.
        """


class WiredInterface:
    """Sets the address of the device. There is no network to join.

    Args:
        device: Name of the network device.
        address: Address of this node on its direct links.
    """

    def __init__(self, device: str, address: IPv4Address) -> None:
        self.device = device
        self._address = address
        self._addresses = DeviceAddresses(device)

    async def check(self) -> None:
        """Check that the device exists and is reserved for direct links: the packet filter would cut other traffic.

        Raises:
            InterfaceProblem: The device is missing, or carries other traffic.
        """
        try:
            evidence = await self._addresses.other_traffic()
        except NoDevice as error:
            raise InterfaceProblem("DeviceMissing", str(error)) from error
        except (NetlinkError, OSError) as error:
            raise InterfaceProblem("DeviceFailed", f"cannot check {self.device}: {error}") from error
        if evidence:
            raise InterfaceProblem(
                "DeviceInUse",
                f"{self.device} carries the node's own traffic ({evidence}); name a device reserved for direct links",
            )

    async def up(self) -> None:
        """Bring the device up with its address.

        Raises:
            InterfaceProblem: The device is missing, or the kernel refused.
        """
        try:
            await self._addresses.set(self._address)
        except NoDevice as error:
            raise InterfaceProblem("DeviceMissing", str(error)) from error
        except (NetlinkError, OSError) as error:
            raise InterfaceProblem("DeviceFailed", f"cannot set the address of {self.device}: {error}") from error

    async def down(self) -> None:
        """Remove the address.

        Raises:
            InterfaceProblem: The kernel refused.
        """
        try:
            await self._addresses.clear()
        except (NetlinkError, OSError) as error:
            raise InterfaceProblem("DeviceFailed", f"cannot remove the address of {self.device}: {error}") from error
