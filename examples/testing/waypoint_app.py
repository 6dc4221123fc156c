"""Application under test: flies to waypoints and takes pictures on the way."""

from __future__ import annotations

import asyncio
import json
import logging
import os

import fractus

log = logging.getLogger("waypoint_app")


async def fly(drone: fractus.Mobility, control: fractus.Control) -> None:
    """Visit WAYPOINTS, a JSON list of latitude, longitude and altitude. Refused waypoints are skipped."""
    waypoints = json.loads(os.environ["WAYPOINTS"])
    await drone.arm()
    await drone.takeoff(float(os.environ["ALTITUDE"]))
    interval_s = float(os.environ.get("PHOTO_S", "0"))
    photographer = asyncio.create_task(take_photos(interval_s)) if interval_s else None
    for number, (lat, lon, alt) in enumerate(waypoints, 1):
        try:
            await drone.goto(lat, lon, alt)
            log.info("waypoint %d of %d reached", number, len(waypoints))
        except fractus.PolicyDenied as refusal:
            log.info("waypoint %d of %d refused: %s", number, len(waypoints), refusal)
    if photographer is not None:
        photographer.cancel()


async def take_photos(interval_s: float) -> None:
    """Take a picture every `interval_s` seconds. Refused pictures are skipped."""
    async with fractus.camera() as camera:
        while True:
            try:
                picture = await camera.take()
                log.info("picture of %d bytes", len(picture.data))
            except fractus.PolicyDenied as refusal:
                log.info("picture refused: %s", refusal)
            await asyncio.sleep(interval_s)


if __name__ == "__main__":
    fractus.run(fly)
