"""Number of calls that a gRPC client without retries loses in a planned switch of its service, by call rate.

A gRPC client sends calls while its service is switched between two servers, in network namespaces of this program. A
planned switch closes the connection when it is idle. A call is lost if the client sends its request in the short time
between this check and the moment when the client notices the close. The loss therefore grows with the call rate. The
comparator closes connections immediately, as after the loss of a link.

Needs root.
"""

from __future__ import annotations

import asyncio
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "integration"))

from fractus_agent.redirector.connections import Conntrack, PodNamespaces
from fractus_agent.redirector.redirector import Redirector
from harness import Report, parser
from redirect_rig import DIRECT, VIP, Rig, rig

RATES = (20, 50, 100, 200, 400)
SAFE_RATE = 20
"""Highest call rate, in calls per second, at which no call may be lost."""


async def lost_per_switch(
    world: Rig, redirector: Redirector, rate: int, switches: int, *, planned: bool
) -> tuple[float, float]:
    """Switch the service repeatedly.

    Return the number of failed calls per switch, and the achieved calls per second.
    """
    client = world.client(10_000_000, 1 / rate)
    loop = asyncio.get_running_loop()
    begun_s = loop.time()
    for number in range(switches):
        await asyncio.sleep(1.0)
        await redirector.switch({VIP: None if number % 2 else DIRECT}, planned=planned)
    took_s = loop.time() - begun_s
    client.terminate()
    assert client.stdout is not None
    replies = [line.split() for line in await asyncio.to_thread(client.stdout.readlines)]
    if switches % 2:
        await redirector.switch({VIP: None}, planned=False)
    return sum(reply[1:2] == ["FAILED"] for reply in replies) / switches, len(replies) / took_s


async def measure(report: Report, switches: int) -> None:
    """Measure the loss of planned and immediate switches at each call rate."""
    with tempfile.TemporaryDirectory() as folder, rig() as world:
        (Path(folder) / "pod").symlink_to(world.path("dpod"))
        namespaces = PodNamespaces(Path(folder), node_namespace=world.path("drone"))
        redirector = Redirector(world.maps("drone"), Conntrack(world.netlink("drone")), namespaces)
        redirector.set_services([VIP])
        world.servers(work_s=0.001)
        running = asyncio.create_task(redirector.run())
        for rate in RATES:
            lost, calls_s = await lost_per_switch(world, redirector, rate, switches, planned=True)
            abrupt, _ = await lost_per_switch(world, redirector, rate, max(switches // 4, 4), planned=False)
            report.add("slow" if rate <= SAFE_RATE else "fast", lost, abrupt, rate=rate, achieved=round(calls_s))
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        redirector.close()


def main() -> int:
    options = parser(__doc__, quick="10 switches instead of 60").parse_args()
    report = Report("drain", options)
    asyncio.run(measure(report, 10 if options.quick else 60))
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
