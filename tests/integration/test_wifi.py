"""WiFi interface with a real wpa_supplicant on a veth device. Its wired driver needs no radio."""

from __future__ import annotations

import asyncio
import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from fractus_agent.links import wifi as module
from fractus_agent.links.wifi import WifiInterface, WpaSupplicant
from fractus_agent.links.wired import InterfaceProblem
from fractus_core.api.nodes import Pairing
from linked_world import link_address
from redirect_rig import run

pytestmark = [
    pytest.mark.root,
    pytest.mark.skipif(shutil.which("wpa_supplicant") is None, reason="wpa_supplicant is not installed"),
]
DEVICE = f"fxr{os.getpid() % 100000}"
TIMEOUT_S = 20.0


@pytest.fixture
def device() -> Iterator[str]:
    run("ip", "link", "add", DEVICE, "type", "veth", "peer", "name", f"{DEVICE}p")
    run("ip", "link", "set", f"{DEVICE}p", "up")
    yield DEVICE
    run("ip", "link", "del", DEVICE)


@pytest.fixture
def sockets(device: str, tmp_path: Path) -> Iterator[Path]:
    """Start wpa_supplicant with a network of the owner, and return the directory of its control sockets."""
    directory = tmp_path / "wpa"
    configuration = tmp_path / "wpa.conf"
    configuration.write_text(
        f'ctrl_interface={directory}\nap_scan=0\nnetwork={{\n ssid="owner"\n key_mgmt=NONE\n disabled=1\n}}\n'
    )
    command = ["wpa_supplicant", "-D", "wired", "-i", device, "-c", str(configuration)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    deadline = time.monotonic() + TIMEOUT_S
    while not (directory / device).is_socket() and time.monotonic() < deadline:
        time.sleep(0.02)
    yield directory
    process.terminate()
    process.wait(TIMEOUT_S)


def controller(device: str, sockets: Path, network: str, mode: str = "infrastructure") -> WifiInterface:
    return WifiInterface(device, link_address("d1"), Pairing(mode=mode, network_id=network), sockets)


def addresses(device: str) -> str:
    return subprocess.run(["ip", "addr", "show", "dev", device], capture_output=True, text=True, check=True).stdout


async def networks(sockets: Path, device: str) -> list[str]:
    listed = await WpaSupplicant(sockets / device).request("LIST_NETWORKS")
    return [line.split("\t")[1] for line in listed.splitlines()[1:]]


async def test_wifi_network_is_created_joined_and_removed(device: str, sockets: Path) -> None:
    wifi = controller(device, sockets, "fleet")
    await wifi.up()
    assert await networks(sockets, device) == ["owner", "fleet"]
    supplicant = WpaSupplicant(sockets / device)
    assert await supplicant.state() == ("COMPLETED", await supplicant.find_network("fleet"))
    assert str(link_address("d1")) in addresses(device)
    await wifi.up()  # the agent calls this repeatedly while links are planned
    assert await networks(sockets, device) == ["owner", "fleet"]
    await wifi.down()
    assert await networks(sockets, device) == ["owner"]
    assert str(link_address("d1")) not in addresses(device)


async def test_wifi_network_of_the_owner_is_used_unchanged(device: str, sockets: Path) -> None:
    wifi = controller(device, sockets, "owner")
    await wifi.up()
    assert (await WpaSupplicant(sockets / device).state())[0] == "COMPLETED"
    await wifi.down()
    assert await networks(sockets, device) == ["owner"]


async def test_wifi_ad_hoc_network_has_ad_hoc_settings(
    device: str, sockets: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "JOIN_TIMEOUT_S", 0.5)
    wifi = controller(device, sockets, "fleet", "adhoc")
    try:
        await wifi.up()  # may fail, because the wired driver may not support this mode
    except InterfaceProblem as problem:
        assert problem.reason == "NotJoined"
    supplicant = WpaSupplicant(sockets / device)
    number = await supplicant.find_network("fleet")
    assert number is not None
    assert await supplicant.request("GET_NETWORK", number, "mode") == "1"
    assert await supplicant.request("GET_NETWORK", number, "frequency") == "2412"


async def test_unresponsive_wpa_supplicant_raises_interface_problem(device: str, tmp_path: Path) -> None:
    import socket

    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as silent:
        silent.bind(str(tmp_path / device))
        with pytest.raises(InterfaceProblem, match="does not respond") as problem:
            await asyncio.wait_for(controller(device, tmp_path, "fleet").up(), TIMEOUT_S)
    assert problem.value.reason == "NoSupplicant"


async def test_wifi_interface_gets_its_address_without_wpa_supplicant(device: str, tmp_path: Path) -> None:
    await controller(device, tmp_path, "fleet").up()
    assert str(link_address("d1")) in addresses(device)
