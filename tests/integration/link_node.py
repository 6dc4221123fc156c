"""Program of the pairing tests: acceptor, connector and beacons of one node, in the network namespace of the process.

It reads commands from its standard input (`want PEER`, `refuse REASON`), and prints events.
"""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

from fractus_agent.links.acceptor import Acceptor
from fractus_agent.links.beacons import Beacons
from fractus_agent.links.connector import Connector
from fractus_agent.links.device_addresses import link_address
from fractus_agent.links.pairing import Session


def emit(*words: object) -> None:
    print(*words, flush=True)


async def main(node: str, files: Path, max_peers: int) -> None:
    refusal = ""
    peers: set[str] = set()

    def on_beacon(peer: str) -> None:
        if peer not in peers:
            peers.add(peer)
            emit("heard", peer)

    async def on_accepted(session: Session) -> None:
        emit("accepted", session.peer)
        try:
            await asyncio.Event().wait()
        finally:
            emit("ended", session.peer)

    async def on_paired(session: Session) -> None:
        while session.latency_ms is None:  # noqa: ASYNC110 - the session has no event for its first latency
            await asyncio.sleep(0.01)
        emit("latency", f"{session.latency_ms:.1f}")
        await asyncio.Event().wait()

    def on_change(link: object, reason: str) -> None:
        emit("link", connector.link.phase.value, connector.link.peer or "-", reason.replace(" ", "_"))

    connector = Connector(node, files, on_paired, on_change)
    acceptor = Acceptor(files, lambda _peer: refusal, on_accepted, max_peers=max_peers)
    tasks = [
        asyncio.create_task(acceptor.run(link_address(node))),
        asyncio.create_task(Beacons(node, on_beacon).run("wlan0")),
    ]
    loop = asyncio.get_running_loop()
    commands = asyncio.StreamReader()
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(commands), sys.stdin)
    emit("ready")
    while line := (await commands.readline()).decode().strip():
        verb, _, argument = line.partition(" ")
        if verb == "want":
            await connector.set_peer(argument)
        elif verb == "refuse":
            refusal = argument
    await connector.close()
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    emit("over")


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3])))
