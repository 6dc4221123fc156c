"""A node of the link tests: an acceptor, a connector and beacons in the network namespace that it is started in.

It takes commands on its standard input (`want PEER`, `permit PEER`, `refuse REASON`) and tells events on its output.
"""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

from fractus_agent.links.acceptor import Acceptor
from fractus_agent.links.addressing import link_address
from fractus_agent.links.beacons import Beacons
from fractus_agent.links.connector import Connector
from fractus_agent.links.pairing import Session


def tell(*words: object) -> None:
    print(*words, flush=True)


async def main(node: str, files: Path, max_peers: int) -> None:
    refusal = ""
    heard: set[str] = set()

    def hear(peer: str) -> None:
        if peer not in heard:
            heard.add(peer)
            tell("heard", peer)

    async def serves(session: Session) -> None:
        tell("accepted", session.peer)
        try:
            await asyncio.Event().wait()
        finally:
            tell("ended", session.peer)

    async def uses(session: Session) -> None:
        while session.latency_ms is None:  # noqa: ASYNC110 - the session has no event for it
            await asyncio.sleep(0.01)
        tell("latency", f"{session.latency_ms:.1f}")
        await asyncio.Event().wait()

    def changed(link: object, reason: str) -> None:
        tell("link", connector.link.phase.value, connector.link.peer or "-", reason.replace(" ", "_"))

    connector = Connector(node, files, uses, changed)
    acceptor = Acceptor(files, lambda _peer: refusal, serves, max_peers=max_peers)
    tasks = [
        asyncio.create_task(acceptor.run(link_address(node))),
        asyncio.create_task(Beacons(node, hear).run("wlan0")),
    ]
    loop = asyncio.get_running_loop()
    commands = asyncio.StreamReader()
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(commands), sys.stdin)
    tell("ready")
    while line := (await commands.readline()).decode().strip():
        verb, _, rest = line.partition(" ")
        if verb == "want":
            await connector.want(rest)
        elif verb == "refuse":
            refusal = rest
    await connector.close()
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    tell("over")


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3])))
