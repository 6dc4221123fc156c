"""TAP devices in the nodes' network namespaces: the ends of the simulated radio."""

from __future__ import annotations

import fcntl
import os
import struct
import subprocess
from pathlib import Path

from fractus_agent.redirector.netlink import in_namespace

TUN = Path("/dev/net/tun")
TUNSETIFF, IFF_TAP, IFF_NO_PI = 0x400454CA, 0x0002, 0x1000
MAX_NAME = 15
FRAME_BYTES = 2048


class Tap:
    """A network device whose frames this process reads and writes.

    It is made in a namespace, and stays there and open wherever the process is; it goes with the process, unless it was
    there before as a persistent one.

    Args:
        namespace: of the node, /run/netns/NAME or /proc/PID/ns/net.
        device: its name there.
        address: its MAC address; None leaves it as it is.
        mtu: of the device.

    Raises:
        OSError: it cannot be made: no /dev/net/tun, no right, or the name is taken.
    """

    def __init__(self, namespace: Path, device: str, address: bytes | None, *, mtu: int = 1500) -> None:
        if len(device) > MAX_NAME:
            raise ValueError(f"a device's name has at most {MAX_NAME} characters: {device}")
        self.device = device

        def make() -> int:
            number = os.open(TUN, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
            try:
                fcntl.ioctl(number, TUNSETIFF, struct.pack("16sH22x", device.encode(), IFF_TAP | IFF_NO_PI))
            except OSError:
                os.close(number)
                raise
            return number

        self._number = in_namespace(namespace, make)
        inside = ["nsenter", f"--net={namespace}", "ip", "link", "set", device]
        if address is not None:
            inside += ["address", address.hex(":")]
        try:
            subprocess.run([*inside, "mtu", str(mtu)], check=True, capture_output=True, timeout=10)
        except (OSError, subprocess.SubprocessError):
            os.close(self._number)
            raise

    def fileno(self) -> int:
        """For a selector."""
        return self._number

    def read(self) -> bytes | None:
        """A frame that the node sends; None when there is none.

        Raises:
            OSError: the device is gone.
        """
        try:
            return os.read(self._number, FRAME_BYTES)
        except BlockingIOError:
            return None

    def write(self, frame: bytes) -> None:
        """A frame for the node; lost while its device is down."""
        try:
            os.write(self._number, frame)
        except OSError:
            return

    def close(self) -> None:
        """Remove the device."""
        os.close(self._number)
