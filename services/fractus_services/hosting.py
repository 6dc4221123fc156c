"""What both services do when they start: read the node's description, bind their port, say why they cannot."""

from __future__ import annotations

import asyncio
import logging
import signal
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click
from fractus_core.api.model import InvalidObject
from fractus_core.api.nodes import Drone, EdgeNode

if TYPE_CHECKING:
    import grpc

    from fractus_services.auth import TlsFiles

log = logging.getLogger(__name__)

_Options = TypeVar("_Options")

_LAST_PORT = 65535
_SOCKET_FILES = ("unix:", "unix-abstract:")

DIRECTORY = click.Path(file_okay=False, path_type=Path)
FILE = click.Path(dir_okay=False, path_type=Path)


def address(_context: click.Context, _parameter: click.Parameter, value: str) -> str:
    """Check an option that says HOST:PORT; gRPC itself takes 99999 for port 34463.

    Raises:
        click.BadParameter: it is none.
    """
    host, _, port = value.rpartition(":")
    if not value.startswith(_SOCKET_FILES) and not (host and port.isdecimal() and int(port) <= _LAST_PORT):
        raise click.BadParameter(f"{value!r} is not HOST:PORT with a port of at most {_LAST_PORT}")
    return value


class CannotServe(Exception):
    """The service cannot run as it is told to; the message names what is wrong and the remedy."""


def read_description(path: Path, *kinds: type[Drone | EdgeNode]) -> Drone | EdgeNode | None:
    """Read the manifest that describes this node; None where there is none.

    Raises:
        CannotServe: the file is not a valid manifest of one of these kinds.
    """
    import yaml  # noqa: PLC0415 - only for this

    try:
        body: Any = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
        body = None
    except (OSError, UnicodeDecodeError) as error:
        raise CannotServe(f"--description {path}: cannot be read: {error}") from None
    except yaml.YAMLError as error:
        raise CannotServe(f"--description {path}: is not YAML: {' '.join(str(error).split())}") from None
    if body is None:
        log.warning("hosting: this node has no description (path=%s)", path)
        return None
    said = body.get("kind") if isinstance(body, dict) else None
    kind = next((kind for kind in kinds if said == kind.KIND), None)
    if kind is None:
        wanted = " or ".join(kind.KIND for kind in kinds)
        raise CannotServe(f"--description {path}: must hold one manifest of kind {wanted}")
    try:
        return kind.from_body(body)
    except InvalidObject as error:
        raise CannotServe(f"--description {path}: {error}") from None


async def bind(server: grpc.aio.Server, listen: str, tls: TlsFiles) -> None:
    """Wait for certificates, then take calls.

    Raises:
        CannotServe: the address cannot be bound.
    """
    await tls.wait()
    try:
        server.add_secure_port(listen, tls.server_credentials())
    except RuntimeError:
        raise CannotServe(
            f"--listen {listen}: cannot listen there; give HOST:PORT with an address of this machine and a free port,"
            " and in --tls a tls.key that belongs to tls.crt"
        ) from None
    await server.start()


def until_signalled(
    run: Callable[[_Options, asyncio.Event], Coroutine[Any, Any, None]],
    options: _Options,
    level: int,
    *known: type[Exception],
) -> None:
    """Run a service until SIGTERM or SIGINT.

    Args:
        run: serves until the event is set.
        options: of the command line.
        level: of the log.
        known: errors of the service whose message tells the user enough.

    Raises:
        click.ClickException: the service cannot run as it is told to.
    """
    logging.basicConfig(level=level, format="%(asctime)s %(levelname)s %(name)s: %(message)s")

    expected: tuple[type[Exception], ...] = (CannotServe, *known)

    async def main() -> None:
        stop = asyncio.Event()
        for number in (signal.SIGTERM, signal.SIGINT):
            asyncio.get_running_loop().add_signal_handler(number, stop.set)
        await run(options, stop)

    try:
        asyncio.run(main())
    except expected as error:
        raise click.ClickException(str(error)) from None
    except ExceptionGroup as failures:
        raise _one_sentence(failures) from None


def _one_sentence(failures: ExceptionGroup[Exception]) -> click.ClickException:
    """What to tell the user of a service whose parts failed so.

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
