"""`fractus mobility`: the mobility service of a drone, with or without Kubernetes around it."""

from __future__ import annotations

import asyncio
import logging
import signal
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from fractus_services.hosting import DIRECTORY, FILE, CannotServe, address, one_sentence


@dataclass(frozen=True, slots=True)
class Options:
    """What the command line says; node and autopilot default to the description's."""

    grants: Path
    tls: Path
    state: Path
    audit: Path
    node: str | None
    description: Path
    autopilot: str | None
    listen: str
    driver_grace: float
    boarding: float
    flat_terrain: bool


@click.group()
def mobility() -> None:
    """The mobility service of a drone."""


@mobility.command()
@click.option(
    "--grants",
    type=DIRECTORY,
    default="/var/lib/fractus/grants",
    show_default=True,
    help="Directory of Grant manifests (JSON).",
)
@click.option(
    "--tls",
    type=DIRECTORY,
    default="/var/lib/fractus/tls",
    show_default=True,
    help="Directory of tls.crt, tls.key and ca.crt.",
)
@click.option(
    "--state",
    type=DIRECTORY,
    default="/var/lib/fractus/mobility",
    show_default=True,
    help="Directory of what survives a restart.",
)
@click.option(
    "--audit",
    type=FILE,
    default="/var/lib/fractus/audit/mobility.jsonl",
    show_default=True,
    help="Audit log.",
)
@click.option("--node", envvar="FRACTUS_NODE", help="Name of this node; by default the description's, else the host's.")
@click.option(
    "--description",
    type=click.Path(path_type=Path),
    default="/etc/fractus/node.yaml",
    show_default=True,
    help="Drone manifest of this node; optional.",
)
@click.option(
    "--autopilot",
    help="Link to the autopilot: tcp:HOST:PORT, udpin:HOST:PORT, udpout:HOST:PORT or serial:DEVICE:BAUD; by default the description's, else tcp:127.0.0.1:5760.",
)
@click.option("--listen", callback=address, default="[::]:50051", show_default=True, help="Address of the gRPC server.")
@click.option(
    "--driver-grace",
    type=click.FloatRange(min=0),
    default=15.0,
    show_default=True,
    help="Seconds a lost driver may take to come back.",
)
@click.option(
    "--boarding",
    type=click.FloatRange(min=0),
    default=60.0,
    show_default=True,
    help="Seconds a drone without a driver waits for the first call of its passengers.",
)
@click.option(
    "--flat-terrain",
    is_flag=True,
    help="Take the ground everywhere for as high as home; otherwise limits above terrain refuse.",
)
@click.option("--verbose", "-v", is_flag=True, help="Log more.")
def serve(verbose: bool, **given: Any) -> None:
    """Serve until stopped; waits for certificates and for the autopilot."""
    logging.basicConfig(
        level=logging.DEBUG if verbose else logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s"
    )
    asyncio.run(_until_signalled(Options(**given)))


async def _until_signalled(options: Options) -> None:
    from fractus_services.mobility.rpc.server import run  # noqa: PLC0415 - the command line stays quick

    loop = asyncio.get_running_loop()
    stop = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    try:
        await run(options, stop)
    except CannotServe as error:
        raise click.ClickException(str(error)) from None
    except ExceptionGroup as failures:
        raise one_sentence(failures) from None


if __name__ == "__main__":
    mobility()
