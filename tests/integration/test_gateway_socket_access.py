"""Access of the gateway's user to the socket of the mobility service, and to the directories of its node."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from chart import render
from fractus_runtime.files import write_set
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


WITHOUT_CAPABILITIES = ("setpriv", "--reuid=0", "--regid=0", "--bounding-set=-all", "--inh-caps=-all", "--no-new-privs")
RENEW = "import pathlib, sys; from fractus_runtime.files import write_set; write_set(pathlib.Path(sys.argv[1]), {'tls.key': b'key'})"


def _as(user: int, *argv: str) -> int:
    done = subprocess.run(argv, user=user, group=user, extra_groups=[], capture_output=True, check=False)
    return done.returncode


@pytest.mark.skipif(os.getuid() != 0, reason="starts processes of other users")
def test_gateway_reads_certificates_also_after_their_renewal_and_writes_only_its_directory() -> None:
    """Run the init container of the chart like a container: as root without capabilities, twice."""
    pods = render("--set=gateway.enabled=true")
    (mobility,) = (b for b in pods if b["kind"] == "DaemonSet" and b["metadata"]["name"] == "fractus-mobility")
    pod = mobility["spec"]["template"]["spec"]
    (access,) = pod["initContainers"]
    group = pod["securityContext"]["fsGroup"]
    with tempfile.TemporaryDirectory() as name:
        state = Path(name)
        state.chmod(0o755)
        tls = state / "tls"
        own = state / "gateway"
        own.mkdir()
        write_set(tls, {"tls.key": b"first"})
        (script,) = access["args"]
        script = script.replace("/tls", str(tls)).replace("/gateway", str(own))
        for attempt in range(2):
            shell = [*WITHOUT_CAPABILITIES, f"--groups=0,{group}", *access["command"], script]
            subprocess.run(shell, check=True, timeout=60)
            assert _as(group, "cat", str(tls / "tls.key")) == 0
            assert _as(group, "touch", str(own / f"{attempt}.jsonl")) == 0
            # The agent is not in the group.
            renewal = [*WITHOUT_CAPABILITIES, "--clear-groups", sys.executable, "-c", RENEW, str(tls)]
            subprocess.run(renewal, check=True, timeout=60)
            assert _as(group, "cat", str(tls / "tls.key")) == 0
        assert _as(group, "touch", str(tls / "other")) != 0
        assert _as(group + 1, "cat", str(tls / "tls.key")) != 0
        assert _as(group + 1, "ls", str(own)) != 0
