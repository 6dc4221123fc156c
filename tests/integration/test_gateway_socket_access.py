"""Access to the Unix socket between the gateway and the mobility service."""

from __future__ import annotations

import asyncio
import os
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fractus_services.mobility.rpc.gateway_socket import GatewaySocket

GATEWAY = 10002
CONNECT = (
    "import socket, sys; s = socket.socket(socket.AF_UNIX); s.settimeout(0.5); s.connect(sys.argv[1]);"
    "\ntry: print('closed' if s.recv(1) == b'' else 'data')"
    "\nexcept TimeoutError: print('open')"
)


@pytest.fixture
def directory() -> Iterator[Path]:
    """Return the directory of a socket that is shared with the group of the gateway. Other users cannot enter `tmp_path`."""
    with tempfile.TemporaryDirectory() as path:
        os.chown(path, 0, GATEWAY)
        Path(path).chmod(0o2770)
        yield Path(path)


@pytest.mark.skipif(os.getuid() != 0, reason="starts a process of another user")
@pytest.mark.parametrize(("permitted", "state"), [(GATEWAY, "open"), (GATEWAY + 1, "closed"), (None, "refused")])
async def test_socket_admits_only_the_user_of_the_gateway(directory: Path, permitted: int | None, state: str) -> None:
    handlers: Any = None
    vehicle: Any = None
    serving = asyncio.create_task(GatewaySocket(directory / "a.sock", handlers, vehicle, (), permitted).run())
    await asyncio.sleep(0.1)
    argv = ["/usr/bin/python3", "-c", CONNECT, str(directory / "a.sock")]
    process = await asyncio.to_thread(
        subprocess.run, argv, user=GATEWAY, group=GATEWAY, extra_groups=[], capture_output=True, text=True, check=False
    )
    serving.cancel()
    await asyncio.gather(serving, return_exceptions=True)
    if state == "refused":
        assert "PermissionError" in process.stderr
    else:
        assert process.stdout.strip() == state, process.stderr
