"""Programs of the bad applications: `python -m fractus_testing.malice NAME`. Their parameters are environment variables."""

from __future__ import annotations

import asyncio
import json
import logging
import math
import os
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import NoReturn

import fractus
from fractus.environment import Endpoint, endpoint
from fractus_cli.standalone import StandalonePki

from fractus_testing.malice import BREACH

METRES_PER_DEGREE = 111_320.0
ALTITUDE_M = 10.0
STEP_M = 10.0
TOLERANCE_M = 3.0
"""Distance by which a drone may pass a border because of wind and braking."""

ATTACK_TIMEOUT_S = 5.0
log = logging.getLogger("malice")
Attack = Callable[[fractus.Mobility], Awaitable[None]]


def breach(text: str) -> NoReturn:
    """End the program, because the platform did not prevent the attack."""
    log.error("breach: %s", text)
    sys.exit(BREACH)


def _number(name: str) -> float:
    return float(json.loads(os.environ[name]))


async def leaves_corridor(drone: fractus.Mobility) -> None:
    """Request a position far north, and then the same position in short steps.

    The program does not know the border: the test checks the track.
    """
    start = (await drone.position()).position
    distance_m = _number("DISTANCE_M")
    steps = [distance_m, *(STEP_M * step for step in range(1, math.ceil(distance_m / STEP_M) + 1))]
    for metres in steps:
        try:
            await drone.goto(start.lat + metres / METRES_PER_DEGREE, start.lon, ALTITUDE_M)
        except fractus.PolicyDenied as refusal:
            log.info("%.0f m north: %s", metres, refusal)
        here = (await drone.position()).position
        if (here.lat - start.lat) * METRES_PER_DEGREE > distance_m - TOLERANCE_M:
            breach(f"the drone flew {distance_m:g} m north")


async def presses_border(drone: fractus.Mobility) -> None:
    """Send velocity commands to the north. The test checks where the drone was."""
    end = time.monotonic() + _number("SECONDS")
    speed_mps = _number("SPEED_MPS")
    while time.monotonic() < end:
        try:
            await drone.set_velocity(speed_mps, 0.0, 0.0)
        except fractus.PolicyDenied as refusal:
            log.info("velocity: %s", refusal)
        await asyncio.sleep(0.1)
    await drone.hover()


async def floods(drone: fractus.Mobility) -> None:
    """Send many calls at once, and then require an answer to one call."""
    calls = [drone.position() for _ in range(round(_number("CALLS")))]
    answers = await asyncio.gather(*calls, return_exceptions=True)
    refused = sum(isinstance(answer, BaseException) for answer in answers)
    log.info("%d of %d calls refused", refused, len(answers))
    try:
        async with asyncio.timeout(ATTACK_TIMEOUT_S):
            await drone.hover()
    except TimeoutError:
        breach("the service does not answer after the flood")


async def wrong_frames(drone: fractus.Mobility) -> None:
    """Request positions that no drone may fly to."""
    here = (await drone.position()).position
    bad = {
        "latitude and longitude exchanged": (here.lon, here.lat, ALTITUDE_M),
        "altitude above mean sea level": (here.lat, here.lon, ALTITUDE_M + 1000.0),
        "altitude in centimetres": (here.lat, here.lon, 100 * ALTITUDE_M),
        "degrees with seven digits as integer": (here.lat * 1e7, here.lon * 1e7, ALTITUDE_M),
        "NaN": (math.nan, here.lon, ALTITUDE_M),
        "infinite altitude": (here.lat, here.lon, math.inf),
    }
    for title, (lat, lon, alt) in bad.items():
        try:
            flown = await drone.goto(lat, lon, alt)
        except (fractus.PolicyDenied, fractus.InvalidRequest) as refusal:
            log.info("%s: %s", title, refusal)
        else:
            if not flown.corrected:
                breach(f"{title}: the drone flew to {flown.target}")
            log.info("%s: %s", title, flown.decision.reason)


async def forges_identity(drone: fractus.Mobility) -> None:
    """Call the service with forged certificates, while the own connection works."""
    await drone.position()
    real = endpoint("mobility")
    with tempfile.TemporaryDirectory() as scratch:
        for title, tls in _forged_certificates(real, Path(scratch)).items():
            forged = Endpoint(real.address, real.server_name, tls)
            try:
                async with fractus.mobility(forged, reconnect_timeout_s=ATTACK_TIMEOUT_S) as impostor:
                    await impostor.position()
            except fractus.FractusError as refusal:
                log.info("%s: %s", title, refusal)
            else:
                breach(f"{title}: the service answered")


def _forged_certificates(real: Endpoint, scratch: Path) -> Mapping[str, Path]:
    """Return directories with forged certificates of this instance and of another instance."""
    own = (
        "spiffe://fractus.dev/ns/{FRACTUS_NAMESPACE}/app/{FRACTUS_APPLICATION}/component/{FRACTUS_COMPONENT}/instance/"
    )
    identity = own.format_map(os.environ) + os.environ["FRACTUS_INSTANCE"]
    pki = StandalonePki.create(scratch / "pki")
    forged = {
        "own identity, foreign authority": pki.component(identity),
        "other identity": pki.component(identity + "-2"),
    }
    for tls in forged.values():
        # The attacker trusts the real service, which must not trust the attacker.
        (tls / "ca.crt").write_bytes((real.tls_dir / "ca.crt").read_bytes())
    return forged


async def forces_arming(drone: fractus.Mobility) -> None:
    """Stop the motors in flight, and arm in flight. `main` has tried to arm without control before."""
    for title, call in (("disarm in flight", drone.disarm), ("arm in flight", drone.arm)):
        try:
            await call()
        except fractus.FractusError as refusal:
            log.info("%s: %s", title, refusal)
        else:
            if title == "disarm in flight":
                breach("the motors were stopped in flight")


async def reads_foreign_pictures(_drone: fractus.Mobility) -> None:
    """Retrieve and delete pictures of other components."""
    names = [
        *json.loads(os.environ["NAMES"]),
        "../grants-seen.json",
        "../../state/journal.json",
        "20200101000000000001",
    ]
    async with fractus.camera() as camera:
        if await camera.list():
            breach("the list contains pictures, but this program took none")
        for name in names:
            for title, attempt in (("retrieve", camera.retrieve), ("delete", camera.delete)):
                try:
                    await attempt(name)
                except fractus.FractusError as refusal:
                    log.info("%s %s: %s", title, name, refusal)
                else:
                    breach(f"{title} {name} succeeded")


async def stalls(_drone: fractus.Mobility) -> None:
    """Block the event loop."""
    time.sleep(_number("SECONDS"))  # noqa: ASYNC251 - the attack


async def crashes(_drone: fractus.Mobility) -> None:
    """End the process at once."""
    sys.stderr.flush()
    os._exit(1)


ATTACKS: Mapping[str, Attack] = {
    "leaves-corridor": leaves_corridor,
    "presses-border": presses_border,
    "floods": floods,
    "wrong-frames": wrong_frames,
    "forges-identity": forges_identity,
    "forces-arming": forces_arming,
    "reads-foreign-pictures": reads_foreign_pictures,
    "stalls": stalls,
    "crashes": crashes,
}


async def arm_without_control() -> None:
    """Arm before control is requested."""
    async with fractus.mobility() as drone:
        try:
            await drone.arm()
        except fractus.FractusError as refusal:
            log.info("arm without control: %s", refusal)
        else:
            breach("the drone armed without control")


def main(name: str) -> None:
    """Run an attack in flight, and return control."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S", stream=sys.stderr)

    async def fly(drone: fractus.Mobility, _control: fractus.Control) -> None:
        """Take off, and attack above the start."""
        await drone.arm()
        await drone.takeoff(ALTITUDE_M)
        await ATTACKS[name](drone)

    if name == "forces-arming":
        asyncio.run(arm_without_control())
    fractus.run(fly)


if __name__ == "__main__":
    main(sys.argv[1])
