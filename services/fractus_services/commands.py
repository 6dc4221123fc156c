"""`fractus mobility` and `fractus camera`: the services of a node, with or without Kubernetes around them."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from fractus_services.launch import DIRECTORY, FILE, address, until_signalled
from fractus_services.options import CameraOptions, MobilityOptions


def _service_options(service: str, port: int, kinds: str, state: str) -> Callable[[Any], Any]:
    """The options that both services take."""
    options = (
        click.option(
            "--grants",
            type=DIRECTORY,
            default="/var/lib/fractus/grants",
            show_default=True,
            help="Directory of Grant manifests (JSON).",
        ),
        click.option(
            "--tls",
            type=DIRECTORY,
            default="/var/lib/fractus/tls",
            show_default=True,
            help="Directory of tls.crt, tls.key and ca.crt.",
        ),
        click.option(
            "--state",
            type=DIRECTORY,
            default=f"/var/lib/fractus/{service}",
            show_default=True,
            help=f"Directory of {state}.",
        ),
        click.option(
            "--audit",
            type=FILE,
            default=f"/var/lib/fractus/audit/{service}.jsonl",
            show_default=True,
            help="Audit log.",
        ),
        click.option(
            "--node", envvar="FRACTUS_NODE", help="Name of this node; by default the description's, else the host's."
        ),
        click.option(
            "--description",
            type=click.Path(path_type=Path),
            default="/etc/fractus/node.yaml",
            show_default=True,
            help=f"{kinds} manifest of this node.",
        ),
        click.option(
            "--listen",
            callback=address,
            default=f"[::]:{port}",
            show_default=True,
            help="Address of the gRPC server.",
        ),
    )

    def add(command: Any) -> Any:
        for option in reversed(options):
            command = option(command)
        return command

    return add


@click.group()
def mobility() -> None:
    """The mobility service of a drone."""


@mobility.command("serve")
@_service_options("mobility", 50051, "Optional: Drone", "what survives a restart")
@click.option(
    "--autopilot",
    help="Link to the autopilot: tcp:HOST:PORT, udpin:HOST:PORT, udpout:HOST:PORT or serial:DEVICE:BAUD; by default the description's, else tcp:127.0.0.1:5760.",
)
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
def serve_mobility(verbose: bool, **given: Any) -> None:
    """Serve until stopped; waits for certificates and for the autopilot."""
    from fractus_services.mobility.rpc.server import run  # noqa: PLC0415 - the command line stays quick

    until_signalled(run, MobilityOptions(**given), logging.DEBUG if verbose else logging.INFO)


@click.group()
def camera() -> None:
    """The camera service of a node."""


@camera.command("serve")
@_service_options("camera", 50052, "Drone or EdgeNode", "the pictures")
@click.option(
    "--mobility", default="127.0.0.1:50051", show_default=True, help="Mobility service that tells a drone's position."
)
@click.option(
    "--keep",
    type=click.IntRange(min=1),
    default=200,
    show_default=True,
    help="Pictures kept for each component instance.",
)
@click.option(
    "--keep-mb",
    type=click.IntRange(min=1),
    default=200,
    show_default=True,
    help="Megabytes of pictures kept for each component instance.",
)
@click.option(
    "--keep-total-mb",
    type=click.IntRange(min=1),
    default=2000,
    show_default=True,
    help="Megabytes of pictures kept altogether; those of components that are gone make room.",
)
@click.option(
    "--camera",
    help="Where pictures come from: http://HOST/snapshot.jpg, v4l2:/dev/video0, picamera2:0, directory:/PATH or test:;"
    " by default what the description says.",
)
@click.option("--face-model", type=FILE, help="Face detector (YuNet, ONNX) to use instead of OpenCV's cascades.")
@click.option(
    "--face-px",
    type=click.FloatRange(min=12, max=1000),
    default=48,
    show_default=True,
    help="Width in pixels from which on faces are found reliably; where they may be smaller, a policy's fallback applies.",
)
@click.option(
    "--relief",
    type=click.FloatRange(min=0, max=5000),
    default=0.0,
    show_default=True,
    help="How many metres the ground around may lie below home; pictures are judged by what they may show of it.",
)
def serve_camera(**given: Any) -> None:
    """Serve until stopped; waits for certificates."""
    from fractus_services.camera.rpc.server import run  # noqa: PLC0415 - the command line stays quick

    until_signalled(run, CameraOptions(**given))
