"""Check of a driver program before it gets control, and its errors as one exception."""

from __future__ import annotations

import inspect
from collections.abc import Awaitable, Callable
from typing import Any

from fractus.control import Control
from fractus.drone import Mobility
from fractus.errors import ControlLost, Interrupted, InvalidRequest, MissionComplete

Program = Callable[[Mobility, Control], Awaitable[None]]
"""Program that performs the task of one control point. It is called again after an interruption or a restart."""

_FORM = "define it as `async def program(drone, control)`"


def check_program(program: Any) -> None:
    """Check that a program is a coroutine function of drone and control.

    Raises:
        InvalidRequest: It is not. The message contains the remedy.
    """
    if inspect.iscoroutine(program):
        program.close()
        raise InvalidRequest(
            "the program was called already: pass the function without parentheses, `fractus.run(program)`"
        )
    if not callable(program):
        raise InvalidRequest(f"a program is a coroutine function, not {program!r}: {_FORM}")
    name = getattr(program, "__name__", type(program).__name__)
    function = inspect.unwrap(program)
    if inspect.isasyncgenfunction(function):
        raise InvalidRequest(f"{name} contains `yield`, so it is not a coroutine function: remove the `yield`")
    if _is_synchronous(function):
        raise InvalidRequest(
            f"{name} is a synchronous function: {_FORM} and await its calls, or fly with `fractus.sync.mobility()`"
        )
    try:
        inspect.signature(program).bind(None, None)
    except TypeError as error:
        raise InvalidRequest(f"{name} cannot be called with drone and control ({error}): {_FORM}") from None
    except ValueError:  # a builtin without signature
        return


def _is_synchronous(function: Any) -> bool:
    """Return True for a plain function that does not declare to return an awaitable."""
    if not inspect.isfunction(function) or inspect.iscoroutinefunction(function) or function.__name__ == "<lambda>":
        return False
    return function.__annotations__.get("return") in {None, "None"}


async def call_program(program: Program, drone: Mobility, control: Control) -> None:
    """Call a program once. The errors of its `asyncio.TaskGroup` become one error.

    Raises:
        InvalidRequest: The program did not return an awaitable.
        BaseException: The error of the program.
    """
    try:
        running = program(drone, control)
        if not inspect.isawaitable(running):
            raise InvalidRequest(f"the program returned {running!r} and no awaitable: {_FORM}")
        await running
    except BaseExceptionGroup as group:
        raise decisive_error(group) from group


def decisive_error(group: BaseExceptionGroup[BaseException]) -> BaseException:
    """Return the error of a group that determines how the mission continues.

    An error that a retry cannot resolve comes first, then the loss of control, then the end of the mission. A restart of
    the program is sufficient only if all tasks were interrupted.
    """
    errors = list(_leaves(group))
    for kinds in ((ControlLost, MissionComplete, Interrupted), (MissionComplete, Interrupted), (Interrupted,)):
        for error in errors:
            if not isinstance(error, kinds):
                return error
    return errors[0]


def _leaves(error: BaseException) -> list[BaseException]:
    if not isinstance(error, BaseExceptionGroup):
        return [error]
    return [leaf for part in error.exceptions for leaf in _leaves(part)]
