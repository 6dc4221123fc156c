"""`fractus view`: serve the page until interrupted."""

from __future__ import annotations

import asyncio
import signal
from ipaddress import ip_address
from pathlib import Path

import click
from aiohttp import web

from fractus_view.mcap_tail import MAGIC
from fractus_view.server import View
from fractus_view.sources import Following, Replay, Source

DEFAULT_LISTEN = "127.0.0.1:8650"


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
@click.option(
    "--listen",
    callback=_listen,
    default=DEFAULT_LISTEN,
    show_default=True,
    metavar="HOST:PORT",
    help="Where to serve; port 0 takes a free one.",
)
def view(recordings: tuple[Path, ...], directory: Path | None, listen: tuple[str, int]) -> None:
    """Show flights on a web page: a replay of RECORDINGs (MCAP files), or what happens now.

    It prints the page's address, which has a token in it, and serves until interrupted. It changes nothing.
    """
    asyncio.run(_serve(_source(recordings, directory), *listen))


def _source(recordings: tuple[Path, ...], directory: Path | None) -> Source:
    if bool(recordings) == (directory is not None):
        raise click.UsageError("give recordings to replay, or --recordings with the directory that services write to")
    if directory is not None:
        return Following(directory)
    for path in recordings:
        with path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise click.ClickException(f"{path} is no MCAP file; give one that a service wrote with --recordings")
    return Replay(recordings)


async def _serve(source: Source, host: str, port: int) -> None:
    stopped = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stopped.set)
    served = View(source, host)
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
        click.echo(f"view: open http://{name}:{bound}/?token={served.token}")
        if not _loopback(host):
            click.echo("view: others on this network can read what is sent, the token too: put TLS before it", err=True)
        await stopped.wait()
    finally:
        await runner.cleanup()


def _loopback(host: str) -> bool:
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
