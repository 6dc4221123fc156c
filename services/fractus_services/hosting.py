"""What both services do when they start: read the node's description, open the door, say why they cannot."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from fractus_core.api.model import InvalidObject
from fractus_core.api.nodes import Drone, EdgeNode

if TYPE_CHECKING:
    import grpc

    from fractus_services.auth import TlsFiles

log = logging.getLogger(__name__)

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
        log.warning("there is no description of this node at %s", path)
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


async def open_door(server: grpc.aio.Server, listen: str, tls: TlsFiles) -> None:
    """Wait for certificates, then take calls.

    Raises:
        CannotServe: the address cannot be listened at.
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


def one_sentence(failures: ExceptionGroup[Exception]) -> click.ClickException:
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
