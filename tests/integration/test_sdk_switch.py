"""SDK requests while traffic moves between a cloud and an edge instance: no request is lost or executed twice."""

from __future__ import annotations

import asyncio
import json
import subprocess
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from fractus_agent.redirector.connections import Conntrack, PodNamespaces
from fractus_agent.redirector.nft_maps import Redirect
from fractus_agent.redirector.redirector import Redirector
from redirect_rig import DIRECT, POD, VIP, Rig, rig, run

pytestmark = pytest.mark.root

SERVER = """
import asyncio, sys
import fractus
name, port = sys.argv[1], int(sys.argv[2])
async def check(request):
    print(request.id, flush=True)
    return name.encode()
async def serve():
    responder = fractus.Responder({"check": check}, port, connection_age_s=float(sys.argv[3]))
    await responder.start()
    print("ready", flush=True)
    await asyncio.Event().wait()
asyncio.run(serve())
"""

CLIENT = """
import asyncio, json, sys
import fractus
address, count, pause_s, size = sys.argv[1], int(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4])
async def request():
    loop = asyncio.get_running_loop()
    async with fractus.Requester(address, attempt_timeout_s=2.0) as checker:
        print("ready", flush=True)
        for number in range(count):
            begun = loop.time()
            who = await checker.request("check", bytes(size), request_id=str(number))
            print(json.dumps({"number": number, "who": who.decode(), "at": loop.time()}), flush=True)
            await asyncio.sleep(max(pause_s - (loop.time() - begun), 0))
asyncio.run(ask())
"""


@pytest.fixture
def world() -> Iterator[Rig]:
    with rig() as found:
        yield found


@pytest.fixture
def redirector(world: Rig, tmp_path: Path) -> Iterator[Redirector]:
    (tmp_path / "pod").symlink_to(world.path("dpod"))
    conntrack = Conntrack(world.netlink("drone"))
    found = Redirector(world.maps("drone"), conntrack, PodNamespaces(tmp_path, node_namespace=world.path("drone")))
    found.set_services([VIP])
    yield found
    found.close()


class SdkTraffic:
    """SDK client in the drone's pod, and instances in the cloud and on the edge node."""

    def __init__(self, world: Rig, count: int, pause_s: float, size: int, age_s: float = 5.0) -> None:
        self.count = count
        self.servers = {
            name: world.python(node, SERVER, name, port, age_s)
            for name, node, port in (("cloud", "cloud", VIP.port), ("edge", "epod", POD.port))
        }
        self.client = world.python("dpod", CLIENT, f"{VIP.address}:{VIP.port}", count, pause_s, size)

    def answers(self, count: int | None = None) -> list[dict[str, object]]:
        """Return the next replies to the client, or all remaining ones without a count."""
        found: list[dict[str, object]] = []
        assert self.client.stdout is not None
        while count is None or len(found) < count:
            line = self.client.stdout.readline()
            if not line:
                break
            found.append(json.loads(line))
        return found

    def executed_ids(self) -> dict[str, list[str]]:
        """Return the ids of the requests that each instance has executed."""
        return {name: _rest(process) for name, process in self.servers.items()}


def _rest(process: subprocess.Popen[str]) -> list[str]:
    process.terminate()
    assert process.stdout is not None
    return process.stdout.read().split()


@pytest.mark.parametrize(("pause_s", "size"), [(0.03, 10), (0.1, 200_000)])
async def test_planned_switches_lose_and_repeat_no_sdk_request(
    world: Rig, redirector: Redirector, pause_s: float, size: int
) -> None:
    talk = SdkTraffic(world, round(6.0 / pause_s), pause_s, size)
    keeping = asyncio.create_task(redirector.run())
    for number in range(6):
        await asyncio.sleep(0.5)
        await redirector.switch({VIP: None if number % 2 else DIRECT}, planned=True)
    found = await asyncio.to_thread(talk.answers)
    keeping.cancel()
    assert [answer["number"] for answer in found] == list(range(talk.count))
    assert {answer["who"] for answer in found} == {"cloud", "edge"}
    carried = talk.executed_ids()
    times = Counter(carried["cloud"] + carried["edge"])
    assert set(times) == {str(number) for number in range(talk.count)}
    # A request whose reply was cut off is repeated to the other instance with the same id.
    assert all(count == 1 for each in carried.values() for count in Counter(each).values())


async def test_lost_direct_link_loses_no_sdk_request(world: Rig, redirector: Redirector) -> None:
    await redirector.switch({VIP: DIRECT}, planned=True)
    talk = SdkTraffic(world, 100, 0.02, 100_000)
    before = await asyncio.to_thread(talk.answers, 20)
    run(*world.inside("edge"), "ip", "link", "set", "fxl0", "down")
    await asyncio.sleep(0.4)  # until the loss of the link is detected
    await redirector.switch({VIP: None}, planned=False)
    found = before + await asyncio.to_thread(talk.answers)
    assert [answer["number"] for answer in found] == list(range(100))
    assert found[-1]["who"] == "cloud"
    carried = talk.executed_ids()
    assert set(carried["cloud"]) | set(carried["edge"]) == {str(number) for number in range(100)}
    assert all(count == 1 for each in carried.values() for count in Counter(each).values())


@pytest.mark.usefixtures("redirector")
async def test_aged_sdk_connections_move_to_the_new_path_without_a_switch(world: Rig) -> None:
    """Change the map without closing the connection of a busy client."""
    talk = SdkTraffic(world, 400, 0.01, 10, age_s=1.0)
    await asyncio.to_thread(talk.answers, 20)
    world.maps("drone").write([Redirect(VIP, DIRECT)], None, 600.0)
    found = await asyncio.to_thread(talk.answers)
    assert found[-1]["who"] == "edge"
    assert found[-1]["number"] == 399
