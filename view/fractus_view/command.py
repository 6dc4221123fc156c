"""`fractus view`: serves the page until interrupted."""

from __future__ import annotations

import asyncio
import secrets
import shutil
import signal
from collections.abc import Callable, Iterable
from contextlib import aclosing, suppress
from dataclasses import dataclass
from pathlib import Path

import click
from aiohttp import web
from fractus_runtime.connection_limit import ConnectionLimit
from fractus_runtime.files import open_file, path_text, read_file
from fractus_runtime.kubernetes import Client, KubeError, Unconfigured, from_environment, kubeconfig
from fractus_runtime.loopback import is_loopback
from fractus_runtime.mcap_tail import MAGIC
from fractus_runtime.metrics import serve_metrics
from fractus_runtime.open_files import TooFewOpenFiles, raise_open_files
from prometheus_client import Metric

from fractus_view.base_map import BaseMap, UnsuitableMap, open_map
from fractus_view.cluster import ClusterSource
from fractus_view.server import ViewServer
from fractus_view.sources import GrowingRecordings, Replay, Source

DEFAULT_LISTEN = "127.0.0.1:8650"
MIN_TOKEN_LENGTH = 16
MAX_TOKEN_BYTES = 64 * 1024
TOKEN_INTERVAL_S = 1.0
"""Interval at which the token file is read again, in seconds."""

_REMEDIES = {
    0: "check the cluster and --context, or specify recordings to replay",
    404: "install the chart fractus-crds",
}
"""Remedies by status of the API server's response. 0 means no response."""


@dataclass(frozen=True, slots=True)
class ServerOptions:
    """Options of the server.

    Attributes:
        host: Address to listen on.
        port: Port to listen on. 0 selects a free port.
        hostnames: Additional host names by which browsers may address the server.
        token_file: File that contains the token. None creates a token at each start.
        metrics: HOST:PORT for Prometheus metrics. An empty string serves no metrics.
        base_map: Base map of the page. None: plain background.
    """

    host: str
    port: int
    hostnames: tuple[str, ...]
    token_file: Path | None
    metrics: str = ""
    base_map: BaseMap | None = None


def _parse_address(_context: click.Context, _option: click.Parameter, text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise click.BadParameter(f"{text!r} is not HOST:PORT, for example {DEFAULT_LISTEN}")
    return host.removeprefix("[").removesuffix("]"), int(port)


@click.command()
@click.argument(
    "recordings", nargs=-1, metavar="[RECORDING]...", type=click.Path(path_type=Path, exists=True, dir_okay=False)
)
@click.option(
    "--recordings",
    "directory",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    metavar="DIRECTORY",
    help="Follow the recordings that services are writing below this directory.",
)
@click.option("-n", "--namespace", default="", help="Show only the applications of this namespace.")
@click.option(
    "--system-namespace",
    default="fractus-system",
    show_default=True,
    help="Namespace of the mobility and camera services, whose logs contain the verdicts.",
)
@click.option("--context", help="Context of the kubeconfig. Default: its current context.")
@click.option(
    "--kubeconfig",
    "config",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    help="Kubeconfig of the cluster. Default: KUBECONFIG, or ~/.kube/config.",
)
@click.option(
    "--pictures",
    is_flag=True,
    help="Show thumbnails of pictures from a cluster, after privacy filters. Needs kubectl and the permission pods/exec.",
)
@click.option(
    "--listen",
    callback=_parse_address,
    default=DEFAULT_LISTEN,
    show_default=True,
    metavar="HOST:PORT",
    help="Address of the page. Port 0 selects a free port.",
)
@click.option(
    "--hostname",
    "hostnames",
    multiple=True,
    metavar="NAME",
    help="Additional host name by which browsers may address the page. Repeatable.",
)
@click.option(
    "--token-file",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    help="File with the access token. The file is read again when it changes. Default: a new token at each start.",
)
@click.option(
    "--map",
    "map_path",
    type=click.Path(path_type=Path, exists=True),
    metavar="PATH",
    help="Base map: a PMTiles archive with raster tiles, or a directory with files Z/X/Y.png. Default: plain background.",
)
@click.option(
    "--metrics",
    default="",
    metavar="[HOST]:PORT",
    help="Address of the Prometheus metrics, which need no token. Default: no metrics.",
)
def view(
    *,
    recordings: tuple[Path, ...],
    directory: Path | None,
    namespace: str,
    system_namespace: str,
    context: str | None,
    config: Path | None,
    pictures: bool,
    listen: tuple[str, int],
    hostnames: tuple[str, ...],
    token_file: Path | None,
    map_path: Path | None,
    metrics: str,
) -> None:
    """Show flights on a web page.

    Without arguments, the page shows the current flights of a cluster. With RECORDING arguments (MCAP files), it replays them.

    The command prints the address of the page, which contains an access token, and serves the page until interrupted. The page
    is read-only.
    """
    uses_cluster = bool(namespace or context or config or pictures)
    if bool(recordings) + (directory is not None) + uses_cluster > 1:
        raise click.UsageError("specify only one source: recordings to replay, --recordings, or options of a cluster")
    options = ServerOptions(*listen, hostnames, token_file, metrics, _open_map(map_path))
    if directory is not None:
        asyncio.run(_serve(GrowingRecordings(directory), options))
    elif recordings:
        asyncio.run(_serve(_replay(recordings), options))
    else:
        asyncio.run(
            _serve_cluster(
                config,
                context,
                options,
                namespace=namespace,
                system_namespace=system_namespace,
                pictures=pictures,
            )
        )


def _open_map(path: Path | None) -> BaseMap | None:
    if path is None:
        return None
    try:
        return open_map(path)
    except UnsuitableMap as error:
        raise click.ClickException(f"--map: {error}") from error
    except OSError as error:
        raise click.ClickException(f"--map: cannot read {path_text(path)}: {error.strerror or error}") from error


def _read_token(path: Path) -> str:
    """Read the token from its file.

    Raises:
        click.ClickException: The file cannot be read, or contains no suitable token.
    """
    try:
        token = read_file(path, MAX_TOKEN_BYTES).decode(errors="replace").strip()
    except OSError as error:
        raise click.ClickException(f"cannot read {path}: {error.strerror or error}") from error
    if len(token) < MIN_TOKEN_LENGTH or not token.isascii() or not token.isprintable():
        raise click.ClickException(
            f"{path} contains no token; write at least {MIN_TOKEN_LENGTH} random ASCII characters into it"
        )
    return token


async def _follow_token(path: Path, server: ViewServer) -> None:
    """Use the current token of the file. Earlier tokens become invalid."""
    reported = ""
    failed = False
    while True:
        await asyncio.sleep(TOKEN_INTERVAL_S)
        try:
            server.token = _read_token(path)
            problem = ""
            failed = False
        except click.ClickException as error:
            # Ignore a single failure, because a file may be empty for a moment while it is written.
            problem = error.message if failed else reported
            failed = True
            if problem:
                # Lock the page with a random token that nobody knows.
                server.token = secrets.token_urlsafe(32)
        if problem != reported:
            text = f"view: access denied to all pages: {problem}" if problem else f"view: token read again from {path}"
            with suppress(OSError):  # The process that reads standard error may have ended.
                click.echo(text, err=True)
        reported = problem


def _replay(recordings: tuple[Path, ...]) -> Source:
    for path in recordings:
        try:
            with open_file(path) as file:
                is_recording = file.read(len(MAGIC)) == MAGIC
        except OSError as error:
            raise click.ClickException(f"{path_text(path)}: {error.strerror or error}") from None
        if not is_recording:
            raise click.ClickException(
                f"{path_text(path)} is not an MCAP file; specify a file that a service wrote with --recordings"
            )
    return Replay(recordings)


def _kubectl(config: Path | None, context: str | None) -> tuple[str, ...]:
    """Return the command of kubectl for the selected cluster.

    Raises:
        click.ClickException: kubectl is not installed.
    """
    path = shutil.which("kubectl")
    if path is None:
        raise click.ClickException("--pictures needs kubectl, which is not installed; install it, or omit --pictures")
    command = [path]
    if config is not None:
        command.append(f"--kubeconfig={config}")
    if context is not None:
        command.append(f"--context={context}")
    return tuple(command)


async def _serve_cluster(
    config: Path | None,
    context: str | None,
    options: ServerOptions,
    *,
    namespace: str,
    system_namespace: str,
    pictures: bool,
) -> None:
    kubectl = _kubectl(config, context) if pictures else ()
    try:
        access = await (kubeconfig(config, context) if config is not None else from_environment(context))
        client = Client(access, "fractus-view")
    except Unconfigured as error:
        raise click.ClickException(f"{error}; or specify recordings to replay") from error
    async with aclosing(client):
        cluster = ClusterSource(client, namespace, system_namespace=system_namespace, kubectl=kubectl)
        try:
            await cluster.check()
        except KubeError as error:
            remedy = _REMEDIES.get(error.status, "check your permissions; the role view is sufficient")
            raise click.ClickException(f"{error}; {remedy}") from error
        await _serve(cluster, options, cluster.metrics)


async def _serve(source: Source, options: ServerOptions, metrics: Callable[[], Iterable[Metric]] = tuple) -> None:
    try:
        raise_open_files()
    except TooFewOpenFiles as error:
        raise click.ClickException(str(error)) from None
    stopped = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stopped.set)
    names = frozenset(name.lower() for name in (options.host, *options.hostnames))
    server = ViewServer(source, names, base_map=options.base_map)
    token_file = options.token_file
    if token_file is not None:
        server.token = _read_token(token_file)
    host = options.host
    port = options.port
    runner = web.AppRunner(server.application(), access_log=None, handle_signals=False, shutdown_timeout=1.0)
    await runner.setup()
    assert runner.server is not None
    listener: asyncio.Server | None = None
    try:
        try:
            listener = await loop.create_server(ConnectionLimit(runner.server), host, port, backlog=128)
        except OSError as error:
            raise click.ClickException(
                f"cannot listen on {host}:{port}: {error.strerror or error}; choose another with --listen"
            ) from error
        actual_port = listener.sockets[0].getsockname()[1]
        url_host = f"[{host}]" if ":" in host else host
        # Do not print the token of a file: the user knows it, and other people may read the log.
        token = server.token if token_file is None else "..."
        click.echo(f"view: open http://{url_host}:{actual_port}/?token={token}")
        if not is_loopback(host):
            click.echo(
                "view: connections are not encrypted, so others on this network can read them and the token; put a TLS proxy in"
                " front of this server",
                err=True,
            )
        token_task = None if token_file is None else asyncio.create_task(_follow_token(token_file, server))
        async with serve_metrics(options.metrics, lambda: [*server.metrics(), *metrics()]):
            await stopped.wait()
        if token_task is not None:
            token_task.cancel()
    finally:
        if listener is not None:
            listener.close()
        await runner.cleanup()
