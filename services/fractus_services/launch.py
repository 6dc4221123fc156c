"""The command lines of both services: types of options, logging, signals, and errors in one sentence."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any, TypeVar

import click
from fractus_runtime import logs

from fractus_services.options import CannotServe, ServiceOptions
from fractus_services.service_lock import ServiceLock

# gRPC reads it when it is imported, which is later. Below that, its core writes a line for each handshake that fails, past any
# limit of ours.
os.environ.setdefault("GRPC_VERBOSITY", "ERROR")

_Options = TypeVar("_Options", bound=ServiceOptions)

_MAX_PORT = 65535
_UNIX_SOCKETS = ("unix:", "unix-abstract:")

DIRECTORY = click.Path(file_okay=False, path_type=Path)
FILE = click.Path(dir_okay=False, path_type=Path)


def address(_context: click.Context, _parameter: click.Parameter, value: str) -> str:
    """Check an option that says HOST:PORT; gRPC itself takes 99999 for port 34463.

    Raises:
        click.BadParameter: it is none.
    """
    host, _, port = value.rpartition(":")
    if not value.startswith(_UNIX_SOCKETS) and not (host and port.isdecimal() and int(port) <= _MAX_PORT):
        raise click.BadParameter(f"{value!r} is not HOST:PORT with a port of at most {_MAX_PORT}")
    return value


def metrics_address(context: click.Context, parameter: click.Parameter, value: str) -> str:
    """Check an option that says HOST:PORT, or nothing.

    Raises:
        click.BadParameter: it is none.
    """
    return address(context, parameter, value) if value else ""


def until_signalled(
    service: str,
    run: Callable[[_Options, asyncio.Event], Coroutine[Any, Any, None]],
    options: _Options,
    verbose: bool = False,
) -> None:
    """Run a service until SIGTERM or SIGINT, once no other process runs it on this state directory.

    Args:
        service: its name.
        run: serves until the event is set; opens all that only one process may have open.
        options: of the command line.
        verbose: whether to log more than FRACTUS_LOG_LEVEL says, which is INFO by default.

    Raises:
        click.ClickException: the service cannot run as it is told to.
    """
    level = "DEBUG" if verbose else os.environ.get("FRACTUS_LOG_LEVEL") or "INFO"
    try:
        logs.configure(level.upper(), os.environ.get("FRACTUS_LOG_FORMAT") or "text")
    except ValueError as error:
        raise click.ClickException(f"FRACTUS_LOG_LEVEL, FRACTUS_LOG_FORMAT: {error}") from None

    async def main() -> None:
        stop = asyncio.Event()
        for number in (signal.SIGTERM, signal.SIGINT):
            asyncio.get_running_loop().add_signal_handler(number, stop.set)
        lock = ServiceLock(service, options.state, options.audit)
        if await lock.acquire(options.lock_timeout, stop):
            with lock.watched():
                await run(options, stop)

    try:
        asyncio.run(main())
    except CannotServe as error:
        raise click.ClickException(str(error)) from None
    except ExceptionGroup as failures:
        raise _one_sentence(failures) from None


def _one_sentence(failures: ExceptionGroup[Exception]) -> click.ClickException:
    """What to tell the user of a service whose parts failed.

    Raises:
        ExceptionGroup: there is more to it than that it cannot serve.
    """
    known, rest = failures.split(CannotServe)
    if known is None or rest is not None:
        raise failures
    error: BaseException = known
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    return click.ClickException(str(error))
