"""Calls lost in a planned switch by a gRPC client without retries, by its call rate.

One gRPC client calls while its service is switched to and fro between two servers, in network namespaces of this program.
The second column closes the connections at once, as after the loss of a link. A call is lost if its request is sent between
the check that found the connection quiet and the moment at which the client notices that the connection was closed. So the
loss grows with the share of time in which the client has a call in progress.

Run as root: uv run python bench/drain.py [--quick] [--json FILE]
"""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "integration"))

from fractus_agent.redirector.connections import Conntrack, PodNamespaces
from fractus_agent.redirector.redirector import Redirector
from redirect_rig import DIRECT, VIP, Rig, rig

RATES = (20, 50, 100, 200, 400)
SAFE_RATE = 20
"""Highest call rate, in calls per second, at which no call may be lost."""


async def lost(world: Rig, redirector: Redirector, rate: int, switches: int, *, planned: bool) -> tuple[int, float]:
    """Return the number of failed calls, and the achieved calls per second."""
    client = world.client(10_000_000, 1 / rate)
    loop = asyncio.get_running_loop()
    begun = loop.time()
    for number in range(switches):
        await asyncio.sleep(1.0)
        await redirector.switch({VIP: None if number % 2 else DIRECT}, planned=planned)
    took_s = loop.time() - begun
    client.terminate()
    assert client.stdout is not None
    answers = [line.split() for line in await asyncio.to_thread(client.stdout.readlines)]
    if switches % 2:
        await redirector.switch({VIP: None}, planned=False)
    return sum(answer[1:2] == ["FAILED"] for answer in answers), len(answers) / took_s


async def measure(switches: int) -> list[dict[str, object]]:
    """Return a claim for each call rate."""
    claims: list[dict[str, object]] = []
    with tempfile.TemporaryDirectory() as folder, rig() as world:
        (Path(folder) / "pod").symlink_to(world.path("dpod"))
        namespaces = PodNamespaces(Path(folder), own=world.path("drone"))
        redirector = Redirector(world.maps("drone"), Conntrack(world.netlink("drone")), namespaces)
        redirector.set_services([VIP])
        world.servers(work_s=0.001)
        keeping = asyncio.create_task(redirector.run())
        for rate in RATES:
            ours, calls_s = await lost(world, redirector, rate, switches, planned=True)
            theirs, _ = await lost(world, redirector, rate, max(switches // 4, 4), planned=False)
            a_switch = ours / switches
            at_once = theirs / max(switches // 4, 4)
            holds = a_switch == 0 if rate <= SAFE_RATE else a_switch <= 1
            target = "none" if rate <= SAFE_RATE else "at most one"
            name = f"calls lost in a planned switch, {rate} calls/s"
            print(
                f"{name:45} {a_switch:7.3f} {at_once:7.3f}   ({calls_s:.0f} calls/s) {'holds' if holds else 'FAILS'} ({target})"
            )
            claims.append(
                {
                    "name": name,
                    "ours": a_switch,
                    "theirs": at_once,
                    "unit": "calls a switch",
                    "ratio": at_once / a_switch if a_switch else None,
                    "target": target,
                    "holds": holds,
                }
            )
        keeping.cancel()
        await asyncio.gather(keeping, return_exceptions=True)
        redirector.close()
    return claims


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer switches")
    parser.add_argument("--json", type=Path, help="write the claims to this file")
    options = parser.parse_args()
    claims = asyncio.run(measure(10 if options.quick else 60))
    if options.json:
        options.json.write_text(json.dumps({"claims": claims}, indent=1))


if __name__ == "__main__":
    main()
