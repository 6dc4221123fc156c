"""TAP devices in the network namespaces of nodes, the endpoints of the simulated radio."""

from __future__ import annotations

import fcntl
import os
import struct
import subprocess
from pathlib import Path

from fractus_agent.redirector.netlink import in_namespace

TUN = Path("/dev/net/tun")
TUNSETIFF = 0x400454CA
IFF_TAP = 0x0002
IFF_NO_PI = 0x1000
MAX_NAME = 15
FRAME_BYTES = 2048


class Tap:
    """A network device whose frames this process reads and writes.

    The device is created in a namespace and stays there. It is removed when the process exits, unless it is an existing
    persistent device.

    Args:
        namespace: Namespace of the node, /run/netns/NAME or /proc/PID/ns/net.
        device: Device name in the namespace.
        address: MAC address; None to keep the default.
        mtu: MTU of the device.

    Raises:
        OSError: The device cannot be created: /dev/net/tun is missing, permission is denied, or the name is in use.
    """

    def __init__(self, namespace: Path, device: str, address: bytes | None, *, mtu: int = 1500) -> None:
        if len(device) > MAX_NAME:
            raise ValueError(f"device name {device!r} is longer than {MAX_NAME} characters")
        self.device = device

        def create() -> int:
            number = os.open(TUN, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
            try:
                fcntl.ioctl(number, TUNSETIFF, struct.pack("16sH22x", device.encode(), IFF_TAP | IFF_NO_PI))
            except OSError:
                os.close(number)
                raise
            return number

        self._number = in_namespace(namespace, create)
        inside = ["nsenter", f"--net={namespace}", "ip", "link", "set", device]
        if address is not None:
            inside += ["address", address.hex(":")]
        try:
            subprocess.run([*inside, "mtu", str(mtu)], check=True, capture_output=True, timeout=10)
        except (OSError, subprocess.SubprocessError):
            os.close(self._number)
            raise

    def fileno(self) -> int:
        """File descriptor for a selector."""
        return self._number

    def read(self) -> bytes | None:
        """Return a frame sent by the node, or None if no frame is available.

        Raises:
            OSError: The device was removed.
        """
        try:
            return os.read(self._number, FRAME_BYTES)
        except BlockingIOError:
            return None

    def write(self, frame: bytes) -> None:
        """Deliver a frame to the node. The frame is lost while the device is down."""
        try:
            os.write(self._number, frame)
        except OSError:
            return

    def close(self) -> None:
        """Remove the device."""
        os.close(self._number)
