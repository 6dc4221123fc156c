"""`fractus telemetry`: state of a drone, one line per sample."""

from __future__ import annotations

import asyncio
import dataclasses
import datetime as dt
import enum
import json
import math
from pathlib import Path
from typing import Any

import click
from fractus.drone import Mobility
from fractus.environment import DEFAULT_TLS_DIR, MOBILITY_PORT, Endpoint
from fractus.telemetry import Telemetry

from fractus_cli.output import output_option


@click.command()
@click.option("--node", envvar="FRACTUS_NODE", required=True, help="Name of the node of the drone.")
@click.option(
    "--address",
    envvar="FRACTUS_MOBILITY_ADDRESS",
    default=f"127.0.0.1:{MOBILITY_PORT}",
    show_default=True,
    help="Address of the mobility service.",
)
@click.option(
    "--tls",
    envvar="FRACTUS_TLS_DIR",
    default=DEFAULT_TLS_DIR,
    show_default=True,
    type=click.Path(path_type=Path, file_okay=False),
    help="Directory with tls.crt, tls.key and ca.crt of the caller.",
)
@click.option("--interval", "interval_s", default=1.0, show_default=True, help="Seconds between lines, at least 0.05.")
@click.option("--count", type=click.IntRange(min=1), help="Stop after this many lines.")
@output_option
def telemetry(*, node: str, address: str, tls: Path, interval_s: float, count: int | None, output: str) -> None:
    """Print the state of a drone until interrupted.

    Requires the certificate of the node, or of a component that may call GetPosition.
    """
    endpoint = Endpoint.on_node(node, address, tls)
    asyncio.run(_follow(endpoint, interval_s, count, output))


async def _follow(endpoint: Endpoint, interval_s: float, count: int | None, output: str) -> None:
    async with Mobility(endpoint) as drone:
        number = 0
        async for sample in drone.telemetry(interval_s):
            click.echo(json.dumps(dataclasses.asdict(sample), default=_plain) if output == "json" else _line(sample))
            number += 1
            if number == count:
                return


def _plain(value: Any) -> Any:
    if isinstance(value, dt.datetime):
        return value.isoformat(timespec="milliseconds")
    if isinstance(value, enum.Enum):
        return value.name.lower()
    raise TypeError(f"{type(value).__name__} cannot be converted to JSON")


def _line(sample: Telemetry) -> str:
    speed = "speed unknown"
    if sample.velocity is not None:
        speed = f"{math.hypot(sample.velocity.north, sample.velocity.east):4.1f} m/s"
    controller = sample.controller.rpartition("/component/")[2].partition("/")[
        0
    ]  # system, pilot, or the driver's component
    return (
        f"{sample.time:%H:%M:%S}  {sample.flight_state:<9}  {sample.mode:<9}  {sample.position or 'position unknown'}  {speed}"
        f"  battery {sample.battery_remaining:.0%}  controller {controller or 'none'}"
    )
