"""Runner for driver programs, which continue at their current waypoint after a restart at any time."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import sys

from fractus.control import RESPONSE_TIMEOUT_S, Control
from fractus.drone import Mobility, mobility
from fractus.environment import Endpoint
from fractus.errors import (
    ControlHeld,
    ControlLost,
    FractusError,
    Interrupted,
    InvalidRequest,
    MissionComplete,
    MissionEnded,
)
from fractus.program import Program, call_program, check_program

MAX_INTERRUPTIONS = 5
"""Maximum number of consecutive restarts after interrupted motions while no further waypoint is reached."""

RETRY_S = 2.0
"""Delay in seconds before control is requested again, or a program is restarted."""

_log = logging.getLogger("fractus")


def run(
    program: Program,
    *,
    endpoint: Endpoint | None = None,
    strict: bool = False,
    stay: bool | None = None,
    response_timeout_s: float = RESPONSE_TIMEOUT_S,
) -> None:
    """Fly a mission: acquire control at each control point, run the program there, return control.

    The program may be restarted at any point of its flight, in this process or in the next one: `arm` and `takeoff` complete
    at once in the air, and `control.remaining()` yields the remaining waypoints. The mission therefore continues after a
    restart, an update or an interrupted motion.

    | Event | Reaction |
    |---|---|
    | A motion is stopped (`Interrupted`) | The program is restarted with the same control |
    | The system or a pilot takes the drone (`ControlLost`) | Control is requested again |
    | The program causes the same takeover three times without another completed waypoint | The mission ends early |
    | Another process of this component has control (`ControlHeld`) | Control is requested again |
    | An earlier run completed the mission | The program is not called. A warning names the remedy, and the process ends like after the mission |
    | The mission ends early (`MissionEnded`) | The process exits with 1 (in a pod it stays, because a restart would have no effect) |
    | The program raises another error, for example `PolicyDenied` | The drone hovers, and the process exits with 1 |
    | Tasks of an `asyncio.TaskGroup` fail | The reaction to the most severe of their errors |
    | The program blocks the event loop for longer than `response_timeout_s` | The system takes the drone (`ControlLost`) |
    | SIGTERM or SIGINT | The program is cancelled, the drone hovers, and the process exits with 0 |

    A hovering drone waits for the next start of the program for the grace period (15 s). Then the system flies it home, and
    the mission has failed.

    Args:
        program: Function that is called with the drone and its control.
        endpoint: Endpoint of the service; by default from the environment.
        strict: Raise `Corrected` if a policy changes a request.
        stay: Wait for SIGTERM after the mission; by default in a Kubernetes pod, which would be restarted otherwise.
        response_timeout_s: Seconds for which the program may block the event loop; see `Mobility.control`.

    Raises:
        SystemExit: The program is not a coroutine function of drone and control, or the mission could not be completed. The
            message contains the reason and the remedy.
        InvalidRequest: An event loop is running already, as in a notebook.
    """
    if _loop_runs():
        raise InvalidRequest("an event loop is running already, as in a notebook: use `await fractus.fly(program)`")
    if not logging.getLogger().handlers:
        logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S", stream=sys.stderr)
    stays = "KUBERNETES_SERVICE_HOST" in os.environ if stay is None else stay
    try:
        check_program(program)
        asyncio.run(_run(program, endpoint, strict, stays, response_timeout_s))
    except (asyncio.CancelledError, KeyboardInterrupt):
        _log.info("run: stopping; the drone hovers, and the system flies it home unless the program restarts soon")
    except FractusError as error:
        raise SystemExit(_describe(error)) from None


def _loop_runs() -> bool:
    try:
        asyncio.get_running_loop()
    except RuntimeError:
        return False
    return True


async def _run(
    program: Program, endpoint: Endpoint | None, strict: bool, stays: bool, response_timeout_s: float
) -> None:
    flight = asyncio.current_task()
    assert flight is not None
    for signum in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(signum, flight.cancel)
    try:
        await fly(program, endpoint=endpoint, strict=strict, response_timeout_s=response_timeout_s)
        _log.info("run: mission complete")
    except MissionEnded as error:
        if not stays:
            raise
        _log.error("%s", _describe(error))
    if stays:
        with contextlib.suppress(asyncio.CancelledError):  # SIGTERM after the mission
            await asyncio.Event().wait()


async def fly(
    program: Program,
    drone: Mobility | None = None,
    *,
    endpoint: Endpoint | None = None,
    strict: bool = False,
    response_timeout_s: float = RESPONSE_TIMEOUT_S,
) -> None:
    """Fly a mission like `run`, inside a running event loop, for example in a notebook: `await fractus.fly(program)`.

    Args:
        program: Function that is called with the drone and its control.
        drone: Client of the mobility service; by default a client that is closed after the mission.
        endpoint: Endpoint of the service if `drone` is not given; by default from the environment.
        strict: Raise `Corrected` if a policy changes a request, if `drone` is not given.
        response_timeout_s: Seconds for which the program may block the event loop; see `Mobility.control`.

    Raises:
        InvalidRequest: The program is not a coroutine function of drone and control.
        MissionEnded: The mission ended early.
        FractusError: An error of the program that a retry cannot resolve.
    """
    check_program(program)
    if drone is None:
        async with mobility(endpoint, strict=strict) as own:
            await _fly(program, own, response_timeout_s)
    else:
        await _fly(program, drone, response_timeout_s)


async def _fly(program: Program, drone: Mobility, response_timeout_s: float) -> None:
    complete = False
    flown = False
    while not complete:
        try:
            async with drone.control(
                progress=lambda reason: _log.info("run: waiting for the drone (reason=%s)", reason),
                response_timeout_s=response_timeout_s,
            ) as control:
                flown = True
                reached = control.waypoints_reached
                _log.info(
                    "run: control granted (control_point=%d waypoints_reached=%d)", control.control_point + 1, reached
                )
                await _carry_out(program, drone, control)
            complete = control.mission_complete
            _log.info("run: control returned (mission_complete=%s)", complete)
        except MissionComplete as error:
            complete = True
            if not flown:
                _log.warning("run: no flight, because an earlier run completed this mission; %s", error.remedy)
        except MissionEnded:
            raise
        except (ControlLost, ControlHeld) as error:
            _log.warning("run: requesting control again (reason=%s)", error)
            await asyncio.sleep(RETRY_S)


async def _carry_out(program: Program, drone: Mobility, control: Control) -> None:
    """Run the program, and restart it after each interruption while it makes progress."""
    reached = control.waypoints_reached
    interruptions = 0
    while True:
        try:
            await call_program(program, drone, control)
        except Interrupted as stopped:
            interruptions = interruptions + 1 if control.waypoints_reached == reached else 1
            reached = control.waypoints_reached
            if interruptions > MAX_INTERRUPTIONS:
                raise
            _log.warning(
                "run: motion interrupted, restarting the program (interruptions=%d reason=%s)", interruptions, stopped
            )
            await asyncio.sleep(RETRY_S)
        else:
            return


def _describe(error: FractusError) -> str:
    return f"{error}; {error.remedy}" if error.remedy else str(error)
