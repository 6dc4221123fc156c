"""`fractus view`: serve the page until interrupted."""

from __future__ import annotations

import asyncio
import secrets
import signal
from collections.abc import Callable, Iterable
from contextlib import aclosing, suppress
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path

import click
from aiohttp import web
from fractus_runtime.kubernetes import Client, KubeError, Unconfigured, from_environment, kubeconfig
from fractus_runtime.metrics import serve_metrics
from prometheus_client import Metric

from fractus_view.cluster import Cluster
from fractus_view.mcap_tail import MAGIC
from fractus_view.server import View
from fractus_view.sources import Following, Replay, Source

DEFAULT_LISTEN = "127.0.0.1:8650"
MIN_TOKEN = 16
TOKEN_PERIOD_S = 1.0
"""Seconds after which the token file is read again."""

_REMEDIES = {
    0: "check the cluster and --context, or give recordings to replay",
    404: "install the chart fractus-crds",
}


@dataclass(frozen=True, slots=True)
class Site:
    """Parse the options of the server: address, additional host names, and token file (None creates a token).

    Attributes:
        metrics: where Prometheus is answered; empty: nowhere.
    """

    host: str
    port: int
    hostnames: tuple[str, ...]
    token_file: Path | None
    metrics: str = ""


def _listen(_context: click.Context, _option: click.Parameter, text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise click.BadParameter(f"{text!r} is not HOST:PORT, such as {DEFAULT_LISTEN}")
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
    help="Follow what services record below it now.",
)
@click.option("-n", "--namespace", default="", help="Only the applications of this namespace of the cluster.")
@click.option("--context", help="Of the kubeconfig; else its current one.")
@click.option(
    "--kubeconfig",
    "config",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    help="Which cluster; else KUBECONFIG, then ~/.kube/config.",
)
@click.option(
    "--listen",
    callback=_listen,
    default=DEFAULT_LISTEN,
    show_default=True,
    metavar="HOST:PORT",
    help="Where to serve; port 0 takes a free one.",
)
@click.option(
    "--hostname", "hostnames", multiple=True, metavar="NAME", help="What browsers may call it as well; repeat."
)
@click.option(
    "--token-file",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    help="Who knows what is in it now may look; else a new token is made at each start.",
)
@click.option(
    "--metrics",
    default="",
    metavar="[HOST]:PORT",
    help="Where to answer GET /metrics, without a token; else nowhere.",
)
def view(
    *,
    recordings: tuple[Path, ...],
    directory: Path | None,
    namespace: str,
    context: str | None,
    config: Path | None,
    listen: tuple[str, int],
    hostnames: tuple[str, ...],
    token_file: Path | None,
    metrics: str,
) -> None:
    """Show flights on a web page: those of a cluster, as they happen, or a replay of RECORDINGs (MCAP files).

    It prints the page's address, which has a token in it, and serves until interrupted. It changes nothing.
    """
    of_cluster = bool(namespace or context or config)
    if bool(recordings) + (directory is not None) + of_cluster > 1:
        raise click.UsageError("give recordings to replay, --recordings, or the options of a cluster: one of them")
    site = Site(*listen, hostnames, token_file, metrics)
    if directory is not None:
        asyncio.run(_serve(Following(directory), site))
    elif recordings:
        asyncio.run(_serve(_replay(recordings), site))
    else:
        asyncio.run(_serve_cluster(config, context, namespace, site))


def _token(path: Path) -> str:
    try:
        token = path.read_bytes().decode(errors="replace").strip()
    except OSError as error:
        raise click.ClickException(f"{path} cannot be read: {error.strerror or error}") from error
    if len(token) < MIN_TOKEN or not token.isascii() or not token.isprintable():
        raise click.ClickException(
            f"{path} has no token: write {MIN_TOKEN} ASCII characters or more, of chance, into it"
        )
    return token


async def _follow_token(path: Path, shown: View) -> None:
    """Use the current token of the file. Earlier tokens become invalid."""
    told = ""
    failed = False
    while True:
        await asyncio.sleep(TOKEN_PERIOD_S)
        try:
            shown.token = _token(path)
            problem = ""
            failed = False
        except click.ClickException as error:
            # A file is empty for a moment while it is written.
            problem = error.message if failed else told
            failed = True
            if problem:
                # A random token that nobody knows.
                shown.token = secrets.token_urlsafe(32)
        if problem != told:
            said = f"view: no one may look: {problem}" if problem else f"view: {path} has a token again"
            with suppress(OSError):  # The reader of standard output may have ended.
                click.echo(said, err=True)
        told = problem


def _replay(recordings: tuple[Path, ...]) -> Source:
    for path in recordings:
        with path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise click.ClickException(
                    f"{path} is not an MCAP file; give a file that a service wrote with --recordings"
                )
    return Replay(recordings)


async def _serve_cluster(config: Path | None, context: str | None, namespace: str, site: Site) -> None:
    try:
        access = await (kubeconfig(config, context) if config is not None else from_environment(context))
        client = Client(access, "fractus-view")
    except Unconfigured as error:
        raise click.ClickException(f"{error}; or give recordings to replay") from error
    async with aclosing(client):
        cluster = Cluster(client, namespace)
        try:
            await cluster.check()
        except KubeError as error:
            remedy = _REMEDIES.get(error.status, "check your permissions: the role view is enough")
            raise click.ClickException(f"{error}; {remedy}") from error
        await _serve(cluster, site, cluster.metrics)


async def _serve(source: Source, where: Site, metrics: Callable[[], Iterable[Metric]] = tuple) -> None:
    stopped = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stopped.set)
    served = View(source, frozenset(name.lower() for name in (where.host, *where.hostnames)))
    given = where.token_file
    if given is not None:
        served.token = _token(given)
    host = where.host
    port = where.port
    runner = web.AppRunner(served.application(), access_log=None, handle_signals=False, shutdown_timeout=1.0)
    await runner.setup()
    try:
        site = web.TCPSite(runner, host, port)
        try:
            await site.start()
        except OSError as error:
            raise click.ClickException(
                f"cannot listen on {host}:{port}: {error.strerror or error}; choose another with --listen"
            ) from error
        bound = runner.addresses[0][1]
        name = f"[{host}]" if ":" in host else host
        # The user knows a given token, and more people can read logs.
        said = f"?token={served.token}" if given is None else "?token=..."
        click.echo(f"view: open http://{name}:{bound}/{said}")
        if not _loopback(host):
            click.echo("view: others on this network can read what is sent, the token too: put TLS before it", err=True)
        following = None if given is None else asyncio.create_task(_follow_token(given, served))
        async with serve_metrics(where.metrics, lambda: [*served.metrics(), *metrics()]):
            await stopped.wait()
        if following is not None:
            following.cancel()
    finally:
        await runner.cleanup()


def _loopback(host: str) -> bool:
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
