"""`fractus telemetry`: a drone's state, line by line, for people, pipes and recorders."""

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
@click.option("--node", envvar="FRACTUS_NODE", required=True, help="Name of the drone's node.")
@click.option("--address", envvar="FRACTUS_MOBILITY_ADDRESS", default=f"127.0.0.1:{MOBILITY_PORT}", show_default=True)
@click.option(
    "--tls",
    envvar="FRACTUS_TLS_DIR",
    default=DEFAULT_TLS_DIR,
    show_default=True,
    type=click.Path(path_type=Path, file_okay=False),
    help="Folder with tls.crt, tls.key and ca.crt of the caller.",
)
@click.option("--interval", "interval_s", default=1.0, show_default=True, help="Seconds between lines, 0.05 at least.")
@click.option("--count", type=click.IntRange(min=1), help="Stop after this many lines.")
@output_option
def telemetry(*, node: str, address: str, tls: Path, interval_s: float, count: int | None, output: str) -> None:
    """Print the state of the drone of a node until interrupted.

    Needs the certificate of a component that may call GetPosition, or the node's own.
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
    raise TypeError(f"{type(value).__name__} has no JSON form")


def _line(sample: Telemetry) -> str:
    speed = "speed unknown"
    if sample.velocity is not None:
        speed = f"{math.hypot(sample.velocity.north, sample.velocity.east):4.1f} m/s"
    return (
        f"{sample.time:%H:%M:%S}  {sample.flight_state:<9}  {sample.mode:<9}  {sample.position or 'position unknown'}  {speed}"
        f"  battery {sample.battery_remaining:.0%}  by {sample.controller or 'no one'}"
    )
