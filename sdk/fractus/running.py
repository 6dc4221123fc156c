"""The skeleton of a driver: a program that may be killed at any moment, and goes on where it was."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import sys
from collections.abc import Awaitable, Callable

from fractus.control import Control
from fractus.drone import Mobility, mobility
from fractus.environment import Endpoint
from fractus.errors import ControlHeld, ControlLost, FractusError, Interrupted, MissionComplete, MissionEnded

MAX_INTERRUPTIONS = 5
"""How many times in a row a program begins again after a motion was stopped, without getting further in its task."""

RETRY_S = 2.0
"""The pause before control is asked for again, or a program begins again."""

Program = Callable[[Mobility, Control], Awaitable[None]]
"""Does the task of one control point; begun again after an interruption or a restart, it goes on where it was."""

_log = logging.getLogger("fractus")


def run(program: Program, *, endpoint: Endpoint | None = None, strict: bool = False, stay: bool | None = None) -> None:
    """Fly a mission: take control at each control point, run the program there, return control.

    The program may be begun again at any point of its flight, in this process or in the next: `arm` and `takeoff` pass in the
    air, and `control.remaining()` gives what is left. So a restart, an update or an interrupted motion goes on with the rest.

    | What happens | What is done |
    |---|---|
    | a motion is stopped (`Interrupted`) | the program is begun again, under the same control |
    | the system or a pilot takes the drone (`ControlLost`) | control is asked for again |
    | the mission is over before its end (`MissionEnded`) | the process ends with 1 (in a pod it stays, for another start would change nothing) |
    | the program raises any other error, `PolicyDenied` say | the drone hovers, and the process ends with 1 |
    | SIGTERM or SIGINT | the program is cancelled, the drone hovers, the process ends with 0 |

    A hovering drone waits for the program's next start during the grace period (15 s); then the system flies it home, and the
    mission has failed.

    Args:
        program: is given the drone and its control.
        endpoint: where the service is; by default, what the environment says.
        strict: raise `Corrected` when a policy changes what was asked.
        stay: wait for SIGTERM after the mission; by default in a Kubernetes pod, which would be started again otherwise.

    Raises:
        SystemExit: the mission could not be flown to its end; the message says why, and what to do.
    """
    if not logging.getLogger().handlers:
        logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S", stream=sys.stderr)
    stays = "KUBERNETES_SERVICE_HOST" in os.environ if stay is None else stay
    try:
        asyncio.run(_run(program, endpoint, strict, stays))
    except (asyncio.CancelledError, KeyboardInterrupt):
        _log.info("told to stop: the drone hovers, and the system flies it home unless this is started again soon")
    except FractusError as error:
        raise SystemExit(_told(error)) from None


async def _run(program: Program, endpoint: Endpoint | None, strict: bool, stays: bool) -> None:
    flight = asyncio.current_task()
    assert flight is not None
    for signum in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(signum, flight.cancel)
    try:
        async with mobility(endpoint, strict=strict) as drone:
            await fly(program, drone)
        _log.info("the mission is over; nothing is left to fly")
    except MissionEnded as error:
        if not stays:
            raise
        _log.error("%s", _told(error))
    if stays:
        with contextlib.suppress(asyncio.CancelledError):  # told to stop, with nothing to stop
            await asyncio.Event().wait()


async def fly(program: Program, drone: Mobility) -> None:
    """Fly a mission as `run` does, in an event loop of one's own: each control point in turn, until the last one is done.

    Raises:
        MissionEnded: it is over before its end.
        FractusError: what the program raised, and does not pass by itself.
    """
    complete = False
    while not complete:
        try:
            async with drone.control(progress=lambda reason: _log.info("waiting for the drone: %s", reason)) as control:
                reached = control.waypoints_reached
                _log.info("in control at control point %d (waypoints reached=%d)", control.control_point + 1, reached)
                await _carry_out(program, drone, control)
            complete = control.mission_complete
            _log.info("control returned%s", ": the system flies the drone home" if complete else "")
        except MissionComplete:
            complete = True
        except MissionEnded:
            raise
        except (ControlLost, ControlHeld) as error:
            _log.warning("%s; asking for control again", error)
            await asyncio.sleep(RETRY_S)


async def _carry_out(program: Program, drone: Mobility, control: Control) -> None:
    """The program, begun again after each interruption as long as it gets further."""
    reached, interruptions = control.waypoints_reached, 0
    while True:
        try:
            await program(drone, control)
        except Interrupted as stopped:
            interruptions = interruptions + 1 if control.waypoints_reached == reached else 1
            reached = control.waypoints_reached
            if interruptions > MAX_INTERRUPTIONS:
                raise
            _log.warning("%s; going on with the rest (interruption=%d)", stopped, interruptions)
            await asyncio.sleep(RETRY_S)
        else:
            return


def _told(error: FractusError) -> str:
    return f"{error}; {error.remedy}" if error.remedy else str(error)
