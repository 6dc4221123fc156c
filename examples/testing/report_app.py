"""Application under test: flies its waypoints, and reports each of them to a collector on an edge node."""

from __future__ import annotations

import asyncio
import logging
import os

import fractus

TIMEOUT_S = 3.0
REPORT_BYTES = 20_000
log = logging.getLogger("report_app")


async def fly(drone: fractus.Mobility, control: fractus.Control) -> None:
    """Visit all waypoints. A report that cannot be sent is logged."""
    await drone.arm()
    await drone.takeoff(10)
    async for waypoint in control.remaining():
        await drone.goto(waypoint.lat, waypoint.lon, waypoint.alt)
        try:
            async with asyncio.timeout(TIMEOUT_S):
                log.info("report %s received", await report(f"{waypoint.lat} {waypoint.lon}"))
        except (OSError, TimeoutError) as error:
            log.info("report not sent: %s", type(error).__name__)


async def report(text: str) -> str:
    """Send a report and return the answer of the collector."""
    host, _, port = os.environ["FRACTUS_SERVICE_COLLECTOR"].rpartition(":")
    reader, writer = await asyncio.open_connection(host, int(port))
    try:
        writer.write(text.ljust(REPORT_BYTES).encode() + b"\n")
        return (await reader.readline()).decode().strip()
    finally:
        writer.close()


if __name__ == "__main__":
    fractus.run(fly)
