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
async def send_requests():
    loop = asyncio.get_running_loop()
    async with fractus.Requester(address, attempt_timeout_s=2.0) as checker:
        print("ready", flush=True)
        for number in range(count):
            begun = loop.time()
            server = await checker.request("check", bytes(size), request_id=str(number))
            print(json.dumps({"number": number, "server": server.decode(), "at": loop.time()}), flush=True)
            await asyncio.sleep(max(pause_s - (loop.time() - begun), 0))
asyncio.run(send_requests())
"""


@pytest.fixture
def world() -> Iterator[Rig]:
    with rig() as world:
        yield world


@pytest.fixture
def redirector(world: Rig, tmp_path: Path) -> Iterator[Redirector]:
    (tmp_path / "pod").symlink_to(world.path("dpod"))
    conntrack = Conntrack(world.netlink("drone"))
    redirector = Redirector(world.maps("drone"), conntrack, PodNamespaces(tmp_path, node_namespace=world.path("drone")))
    redirector.set_services([VIP])
    yield redirector
    redirector.close()


class SdkTraffic:
    """Requests of an SDK client in the drone's pod to instances in the cloud and on the edge node."""

    def __init__(self, world: Rig, count: int, pause_s: float, size: int, age_s: float = 5.0) -> None:
        self.count = count
        self.servers = {
            name: world.python(node, SERVER, name, port, age_s)
            for name, node, port in (("cloud", "cloud", VIP.port), ("edge", "epod", POD.port))
        }
        self.client = world.python("dpod", CLIENT, f"{VIP.address}:{VIP.port}", count, pause_s, size)

    def responses(self, count: int | None = None) -> list[dict[str, object]]:
        """Return the next `count` responses to the client, or all remaining responses if `count` is None."""
        responses: list[dict[str, object]] = []
        assert self.client.stdout is not None
        while count is None or len(responses) < count:
            line = self.client.stdout.readline()
            if not line:
                break
            responses.append(json.loads(line))
        return responses

    def executed_ids(self) -> dict[str, list[str]]:
        """Stop the instances, and return the ids of the requests that each of them has executed."""
        return {name: _printed_ids(process) for name, process in self.servers.items()}


def _printed_ids(process: subprocess.Popen[str]) -> list[str]:
    process.terminate()
    assert process.stdout is not None
    return process.stdout.read().split()


# Larger replies need more time, so a switch is more likely to cut one.
@pytest.mark.parametrize(("pause_s", "size"), [pytest.param(0.03, 10, marks=pytest.mark.slow), (0.1, 200_000)])
async def test_planned_switches_lose_and_repeat_no_sdk_request(
    world: Rig, redirector: Redirector, pause_s: float, size: int
) -> None:
    traffic = SdkTraffic(world, round(6.0 / pause_s), pause_s, size)
    refresh = asyncio.create_task(redirector.run())
    for number in range(6):
        await asyncio.sleep(0.5)
        await redirector.switch({VIP: None if number % 2 else DIRECT}, planned=True)
    responses = await asyncio.to_thread(traffic.responses)
    refresh.cancel()
    assert [response["number"] for response in responses] == list(range(traffic.count))
    assert {response["server"] for response in responses} == {"cloud", "edge"}
    executed = traffic.executed_ids()
    assert set(executed["cloud"] + executed["edge"]) == {str(number) for number in range(traffic.count)}
    # Both instances may execute a request whose response was lost, so count the ids of each instance separately.
    assert all(count == 1 for ids in executed.values() for count in Counter(ids).values())


async def test_lost_direct_link_loses_no_sdk_request(world: Rig, redirector: Redirector) -> None:
    await redirector.switch({VIP: DIRECT}, planned=True)
    traffic = SdkTraffic(world, 100, 0.02, 100_000)
    before = await asyncio.to_thread(traffic.responses, 20)
    run(*world.inside("edge"), "ip", "link", "set", "fxl0", "down")
    await asyncio.sleep(0.4)  # until the loss of the link is detected
    await redirector.switch({VIP: None}, planned=False)
    responses = before + await asyncio.to_thread(traffic.responses)
    assert [response["number"] for response in responses] == list(range(100))
    assert responses[-1]["server"] == "cloud"
    executed = traffic.executed_ids()
    assert set(executed["cloud"]) | set(executed["edge"]) == {str(number) for number in range(100)}
    assert all(count == 1 for ids in executed.values() for count in Counter(ids).values())


@pytest.mark.usefixtures("redirector")
async def test_aged_sdk_connections_move_to_the_new_path_without_a_switch(world: Rig) -> None:
    """Change the redirection map, but do not close the connection of the busy client."""
    traffic = SdkTraffic(world, 400, 0.01, 10, age_s=1.0)
    await asyncio.to_thread(traffic.responses, 20)
    world.maps("drone").write([Redirect(VIP, DIRECT)], None, 600.0)
    responses = await asyncio.to_thread(traffic.responses)
    assert responses[-1]["server"] == "edge"
    assert responses[-1]["number"] == 399
