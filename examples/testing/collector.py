"""Edge component: collects the reports of a drone, and answers each line with the number of received lines."""

from __future__ import annotations

import asyncio
import os


async def main() -> None:
    """Serve until terminated."""
    received = 0

    async def collect(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal received
        while await reader.readline():
            received += 1
            writer.write(b"%d\n" % received)
        writer.close()

    server = await asyncio.start_server(collect, host="0.0.0.0", port=int(os.environ["PORT"]))
    await server.serve_forever()


if __name__ == "__main__":
    asyncio.run(main())
