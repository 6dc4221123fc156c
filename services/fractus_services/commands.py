"""Commands `fractus mobility`, `fractus camera` and `fractus gateway`: options, logging, signals and the process lock of the services."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any, TypeVar

import click
from fractus_runtime import logs
from fractus_runtime.open_files import TooFewOpenFiles, raise_open_files

from fractus_services.camera.settings import CameraSettings
from fractus_services.options import CannotServe, LockedOptions, MobilityOptions
from fractus_services.service_lock import DEFAULT_LOCK_TIMEOUT_S, ServiceLock

# gRPC reads this variable when it is imported later. At lower levels it logs each failed handshake, without a limit.
os.environ.setdefault("GRPC_VERBOSITY", "ERROR")

_Options = TypeVar("_Options", bound=LockedOptions)

_MAX_PORT = 65535
_UNIX_SOCKETS = ("unix:", "unix-abstract:")

DIRECTORY = click.Path(file_okay=False, path_type=Path)
FILE = click.Path(dir_okay=False, path_type=Path)


def address(_context: click.Context, _parameter: click.Parameter, value: str) -> str:
    """Validate a HOST:PORT option. gRPC itself accepts 99999 and uses port 34463.

    Raises:
        click.BadParameter: The value is not HOST:PORT.
    """
    host, _, port = value.rpartition(":")
    if not value.startswith(_UNIX_SOCKETS) and not (host and port.isdecimal() and int(port) <= _MAX_PORT):
        raise click.BadParameter(f"{value!r} is not HOST:PORT with a port of at most {_MAX_PORT}")
    return value


def metrics_address(context: click.Context, parameter: click.Parameter, value: str) -> str:
    """Validate a HOST:PORT option that may be empty.

    Raises:
        click.BadParameter: The value is not HOST:PORT.
    """
    return address(context, parameter, value) if value else ""


def until_signalled(
    service: str,
    run: Callable[[_Options, asyncio.Event], Coroutine[Any, Any, None]],
    options: _Options,
    verbose: bool = False,
) -> None:
    """Run a service until SIGTERM or SIGINT, after acquiring the lock of its state directory.

    Args:
        service: Name of the service.
        run: Serves until the event is set. It opens everything that only one process may open.
        options: Options of the command line.
        verbose: True to log at DEBUG instead of FRACTUS_LOG_LEVEL, which is INFO by default.

    Raises:
        click.ClickException: The service cannot run with its options.
    """

    async def run_locked(stop: asyncio.Event) -> None:
        lock = ServiceLock(service, options.state, options.audit)
        if await lock.acquire(options.lock_timeout, stop):
            with lock.watched():
                await run(options, stop)

    _run_process(run_locked, verbose)


def _run_process(run: Callable[[asyncio.Event], Coroutine[Any, Any, None]], verbose: bool) -> None:
    """Configure logging, and run until SIGTERM or SIGINT.

    Raises:
        click.ClickException: The process cannot run with its options.
    """
    level = "DEBUG" if verbose else os.environ.get("FRACTUS_LOG_LEVEL") or "INFO"
    try:
        logs.configure(level.upper(), os.environ.get("FRACTUS_LOG_FORMAT") or "text")
    except ValueError as error:
        raise click.ClickException(f"FRACTUS_LOG_LEVEL, FRACTUS_LOG_FORMAT: {error}") from None

    try:
        raise_open_files()
    except TooFewOpenFiles as error:
        raise click.ClickException(str(error)) from None

    async def main() -> None:
        stop = asyncio.Event()
        for number in (signal.SIGTERM, signal.SIGINT):
            asyncio.get_running_loop().add_signal_handler(number, stop.set)
        await run(stop)

    try:
        asyncio.run(main())
    except CannotServe as error:
        raise click.ClickException(str(error)) from None
    except ExceptionGroup as failures:
        raise _one_sentence(failures) from None


def _one_sentence(failures: ExceptionGroup[Exception]) -> click.ClickException:
    """Return the error of a service whose parts failed, as one sentence.

    Raises:
        ExceptionGroup: The group contains other exceptions than `CannotServe`.
    """
    expected, others = failures.split(CannotServe)
    if expected is None or others is not None:
        raise failures
    error: BaseException = expected
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    return click.ClickException(str(error))


_DESCRIPTION = click.Path(path_type=Path)
_COUNT = click.IntRange(min=1)
_SECONDS = click.FloatRange(min=0)

DEFAULT_RECORDINGS_MB = 500


def _option(
    name: str, default: object, text: str, kind: click.ParamType[Any] | None = None, **more: Any
) -> Callable[[Any], Any]:
    return click.option(name, type=kind, default=default, show_default=True, help=text, **more)


_METRICS = click.option(
    "--metrics",
    envvar="FRACTUS_METRICS",
    default="",
    callback=metrics_address,
    help="HOST:PORT that serves /metrics for Prometheus (docs/metrics.md). Without it there are no metrics.",
)


def _service_options(service: str, port: int, kinds: str, state: str, recorded: str) -> Callable[[Any], Any]:
    """Return a decorator that adds the options of both services."""
    options = (
        _option("--grants", "/var/lib/fractus/grants", "Directory of Grant manifests (JSON).", DIRECTORY),
        _option("--tls", "/var/lib/fractus/tls", "Directory of tls.crt, tls.key and ca.crt.", DIRECTORY),
        _option("--state", f"/var/lib/fractus/{service}", f"Directory of {state}.", DIRECTORY),
        _option("--audit", f"/var/lib/fractus/audit/{service}.jsonl", "Audit log.", FILE),
        _option(
            "--node-object",
            "/var/lib/fractus/node.json",
            f"{kinds} of this node as its agent stores it; takes precedence over --description.",
            _DESCRIPTION,
        ),
        _option("--description", "/etc/fractus/node.yaml", f"{kinds} manifest of this node.", _DESCRIPTION),
        _option("--listen", f"[::]:{port}", "Address of the gRPC server.", callback=address),
        _option(
            "--lock-timeout",
            DEFAULT_LOCK_TIMEOUT_S,
            "Seconds to wait for another process with the same --state or --audit to end.",
            _SECONDS,
        ),
        click.option(
            "--recordings",
            type=DIRECTORY,
            help=f"Directory to record {recorded} into (docs/recordings.md). Without it nothing is recorded.",
        ),
        _option(
            "--recordings-mb",
            DEFAULT_RECORDINGS_MB,
            "Maximum size of the recordings in megabytes; the oldest are removed first. 0 disables recording.",
            click.IntRange(min=0),
        ),
        _METRICS,
        click.option(
            "--node",
            envvar="FRACTUS_NODE",
            help="Name of this node; by default the name in the description, or the host name.",
        ),
    )

    def add(command: Any) -> Any:
        for option in reversed(options):
            command = option(command)
        return command

    return add


@click.group()
def mobility() -> None:
    """Run the mobility service of a drone."""


@mobility.command("serve")
@_service_options("mobility", 50051, "Optional: Drone", "state that survives a restart", "flights")
@click.option(
    "--autopilot",
    help="Link to the autopilot: tcp:HOST:PORT, udpin:HOST:PORT, udpout:HOST:PORT or serial:DEVICE:BAUD; by default the"
    " link in the description, or tcp:127.0.0.1:5760.",
)
@_option("--driver-grace", 15.0, "Seconds in which a lost driver may reconnect.", _SECONDS)
@_option(
    "--boarding",
    60.0,
    "Seconds for which a drone without a driver waits for the first call of its passengers.",
    _SECONDS,
)
@click.option(
    "--flat-terrain",
    is_flag=True,
    help="Assume that the ground is level with home everywhere; otherwise limits above terrain deny calls.",
)
@click.option(
    "--gateway-socket",
    type=FILE,
    help="Unix socket for `fractus gateway serve` (docs/mavlink-gateway.md). Without it there is no MAVLink interface.",
)
@click.option(
    "--gateway-user",
    type=click.IntRange(min=1),
    help="Id of the user that runs the gateway, if it is another user. The directory of the socket must belong to a group of"
    " this user and have the set-group-ID bit.",
)
@click.option("--verbose", "-v", is_flag=True, help="Log more.")
def serve_mobility(verbose: bool, **options: Any) -> None:
    """Serve until stopped. Waits for certificates and for the autopilot."""
    from fractus_services.mobility.mavlink.startup_heartbeat import with_heartbeats  # noqa: PLC0415 - keeps the command line fast

    async def run(options: MobilityOptions, stop: asyncio.Event) -> None:
        # Imports take most of the start. On a small computer they take longer than the heartbeat timeout of a drone in
        # flight.
        serve = await with_heartbeats(asyncio.to_thread(_mobility_server), options.state, options.autopilot)
        await serve(options, stop)

    until_signalled("mobility", run, MobilityOptions(**options), verbose)


def _mobility_server() -> Callable[[MobilityOptions, asyncio.Event], Coroutine[Any, Any, None]]:
    from fractus_services.mobility.rpc.server import run  # noqa: PLC0415 - imported while heartbeats are sent

    return run


@click.group()
def camera() -> None:
    """Run the camera service of a node."""


@camera.command("serve")
@_service_options("camera", 50052, "Drone or EdgeNode", "the pictures", "pictures and decisions")
@_option("--mobility", "127.0.0.1:50051", "Mobility service that reports a drone's position.")
@_option("--keep", 200, "Maximum number of images for each component instance.", _COUNT)
@_option("--keep-mb", 200, "Maximum size of the images of each component instance, in megabytes.", _COUNT)
@_option(
    "--keep-total-mb",
    2000,
    "Maximum size of all images in megabytes; images of components without a Grant are removed first.",
    _COUNT,
)
@click.option(
    "--camera",
    help="Camera: http://HOST/snapshot.jpg, v4l2:/dev/video0, picamera2:0, directory:/PATH or test:;"
    " by default the connection in the description.",
)
@click.option("--face-model", type=FILE, help="Face detector (YuNet, ONNX) to use instead of OpenCV's cascades.")
@_option(
    "--face-px",
    48,
    "Minimum face width in pixels for reliable detection; if faces may be smaller, a policy's fallback applies.",
    click.FloatRange(min=12, max=1000),
)
@_option(
    "--relief",
    0.0,
    "Maximum depth of the surrounding ground below home in metres, for the area that an image may show.",
    click.FloatRange(min=0, max=5000),
)
def serve_camera(**options: Any) -> None:
    """Serve until stopped. Waits for certificates."""
    from fractus_services.camera.server import run  # noqa: PLC0415 - imports libraries that only this command needs

    until_signalled("camera", run, CameraSettings(**options))


@click.group()
def gateway() -> None:
    """Run the gateway for MAVLink programs, or connect a program to the gateway of a node."""


@gateway.command("serve")
@_option("--tls", "/var/lib/fractus/tls", "Directory of tls.crt, tls.key and ca.crt of the node.", DIRECTORY)
@_option("--mobility-socket", "/run/fractus/gateway.sock", "--gateway-socket of the mobility service.", FILE)
@_option("--listen", "[::]:50053", "Address for connections of instances.", callback=address)
@_option("--state", "/var/lib/fractus/gateway", "Directory of the lock of this process.", DIRECTORY)
@_option("--audit", "/var/lib/fractus/audit/gateway.jsonl", "Audit log of refused messages.", FILE)
@_option(
    "--lock-timeout",
    DEFAULT_LOCK_TIMEOUT_S,
    "Seconds to wait for another process with the same --state or --audit to end.",
    _SECONDS,
)
@click.option(
    "--recordings",
    type=DIRECTORY,
    help="Directory to record the messages of each instance into (docs/recordings.md). Without it nothing is recorded.",
)
@_option(
    "--recordings-mb",
    DEFAULT_RECORDINGS_MB,
    "Maximum size of the recordings of each instance in megabytes; the oldest are removed first.",
    click.IntRange(min=0),
)
@_METRICS
def serve_gateway(mobility_socket: Path, **options: Any) -> None:
    """Serve until stopped. Waits for certificates and for the mobility service."""
    from fractus_services.gateway.gateway_server import GatewayOptions, run  # noqa: PLC0415 - keeps the command line fast

    until_signalled("gateway", run, GatewayOptions(mobility=mobility_socket, **options))


@gateway.command("connect")
@_option("--gateway", "127.0.0.1:50053", "Address of the gateway of the node.", callback=address)
@click.option("--node", envvar="FRACTUS_NODE", required=True, help="Name of the node.")
@click.option(
    "--tls",
    type=DIRECTORY,
    envvar="FRACTUS_TLS_DIR",
    required=True,
    help="Directory of tls.crt, tls.key and ca.crt of the component instance.",
)
@_option("--tcp", 5760, "TCP port on the loopback interface for MAVLink programs.", click.IntRange(1, _MAX_PORT))
@_option(
    "--udp",
    (14550, 14540),
    "UDP port on the loopback interface to which heartbeats are sent; may be repeated.",
    click.IntRange(1, _MAX_PORT),
    multiple=True,
)
def connect_gateway(**options: Any) -> None:
    """Carry MAVLink between programs on this machine and the gateway, until stopped."""
    from fractus_services.gateway import sidecar  # noqa: PLC0415 - keeps the command line fast

    settings = sidecar.SidecarOptions(**options)

    async def run(stop: asyncio.Event) -> None:
        await sidecar.run(settings, stop)

    _run_process(run, verbose=False)
