"""Components written with the SDK while their traffic moves between a cloud and an edge instance: nothing lost or doubled."""

from __future__ import annotations

import asyncio
import json
import subprocess
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from fractus_agent.redirector.conntrack import Conntrack
from fractus_agent.redirector.nft import Redirect
from fractus_agent.redirector.redirector import Namespaces, Redirector
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
async def ask():
    loop = asyncio.get_running_loop()
    async with fractus.Requester(address, attempt_timeout_s=2.0) as checker:
        print("ready", flush=True)
        for number in range(count):
            begun = loop.time()
            who = await checker.ask("check", bytes(size), request_id=str(number))
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
    found = Redirector(world.maps("drone"), conntrack, Namespaces(tmp_path, own=world.path("drone")))
    found.serve([VIP])
    yield found
    found.close()


class Talk:
    """A client in the drone's pod, and an instance in the cloud and at the edge."""

    def __init__(self, world: Rig, count: int, pause_s: float, size: int, age_s: float = 5.0) -> None:
        self.count = count
        self.servers = {
            name: world.python(node, SERVER, name, port, age_s)
            for name, node, port in (("cloud", "cloud", VIP.port), ("edge", "epod", POD.port))
        }
        self.client = world.python("dpod", CLIENT, f"{VIP.address}:{VIP.port}", count, pause_s, size)

    def answers(self, count: int | None = None) -> list[dict[str, object]]:
        """The next answers that the client got; all that remain without a count."""
        found: list[dict[str, object]] = []
        assert self.client.stdout is not None
        while count is None or len(found) < count:
            line = self.client.stdout.readline()
            if not line:
                break
            found.append(json.loads(line))
        return found

    def carried_out(self) -> dict[str, list[str]]:
        """Ids of the requests that each instance has carried out."""
        return {name: _rest(process) for name, process in self.servers.items()}


def _rest(process: subprocess.Popen[str]) -> list[str]:
    process.terminate()
    assert process.stdout is not None
    return process.stdout.read().split()


@pytest.mark.parametrize(("pause_s", "size"), [(0.03, 10), (0.1, 200_000)])
async def test_nothing_is_lost_or_doubled_in_planned_switches(
    world: Rig, redirector: Redirector, pause_s: float, size: int
) -> None:
    talk = Talk(world, round(6.0 / pause_s), pause_s, size)
    keeping = asyncio.create_task(redirector.run())
    for number in range(6):
        await asyncio.sleep(0.5)
        await redirector.switch({VIP: None if number % 2 else DIRECT}, planned=True)
    found = await asyncio.to_thread(talk.answers)
    keeping.cancel()
    assert [answer["number"] for answer in found] == list(range(talk.count))
    assert {answer["who"] for answer in found} == {"cloud", "edge"}
    carried = talk.carried_out()
    times = Counter(carried["cloud"] + carried["edge"])
    assert set(times) == {str(number) for number in range(talk.count)}
    # A request whose answer was cut off with its connection is repeated to the other instance; its id tells.
    assert all(count == 1 for each in carried.values() for count in Counter(each).values())


async def test_nothing_is_lost_when_the_direct_link_is(world: Rig, redirector: Redirector) -> None:
    await redirector.switch({VIP: DIRECT}, planned=True)
    talk = Talk(world, 100, 0.02, 100_000)
    before = await asyncio.to_thread(talk.answers, 20)
    run(*world.inside("edge"), "ip", "link", "set", "fxl0", "down")
    await asyncio.sleep(0.4)  # what supervision of a link takes to notice
    await redirector.switch({VIP: None}, planned=False)
    found = before + await asyncio.to_thread(talk.answers)
    assert [answer["number"] for answer in found] == list(range(100))
    assert found[-1]["who"] == "cloud"
    carried = talk.carried_out()
    assert set(carried["cloud"]) | set(carried["edge"]) == {str(number) for number in range(100)}
    assert all(count == 1 for each in carried.values() for count in Counter(each).values())


@pytest.mark.usefixtures("redirector")
async def test_connections_of_some_age_find_the_new_path_by_themselves(world: Rig) -> None:
    """A client that is never idle, and a map that moves without anything done to its connection."""
    talk = Talk(world, 400, 0.01, 10, age_s=1.0)
    await asyncio.to_thread(talk.answers, 20)
    world.maps("drone").write([Redirect(VIP, DIRECT)], None, 600.0)
    found = await asyncio.to_thread(talk.answers)
    assert found[-1]["who"] == "edge"
    assert found[-1]["number"] == 399
