"""`fractus mobility` and `fractus camera`: the services of a node, with or without Kubernetes around them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import click

from fractus_services.camera.settings import CameraSettings
from fractus_services.launch import DIRECTORY, FILE, address, metrics_address, until_signalled
from fractus_services.options import MobilityOptions
from fractus_services.service_lock import DEFAULT_LOCK_TIMEOUT_S

_DESCRIPTION = click.Path(path_type=Path)
_COUNT = click.IntRange(min=1)
_SECONDS = click.FloatRange(min=0)

DEFAULT_RECORDINGS_MB = 500


def _option(
    name: str, default: object, text: str, kind: click.ParamType[Any] | None = None, **more: Any
) -> Callable[[Any], Any]:
    return click.option(name, type=kind, default=default, show_default=True, help=text, **more)


def _service_options(service: str, port: int, kinds: str, state: str, recorded: str) -> Callable[[Any], Any]:
    """The options that both services take."""
    options = (
        _option("--grants", "/var/lib/fractus/grants", "Directory of Grant manifests (JSON).", DIRECTORY),
        _option("--tls", "/var/lib/fractus/tls", "Directory of tls.crt, tls.key and ca.crt.", DIRECTORY),
        _option("--state", f"/var/lib/fractus/{service}", f"Directory of {state}.", DIRECTORY),
        _option("--audit", f"/var/lib/fractus/audit/{service}.jsonl", "Audit log.", FILE),
        _option(
            "--node-object",
            "/var/lib/fractus/node.json",
            f"{kinds} of this node as its agent stores it; counts before --description.",
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
            help=f"Directory to record {recorded} into (docs/recordings.md); nothing is recorded without it.",
        ),
        _option(
            "--recordings-mb",
            DEFAULT_RECORDINGS_MB,
            "Megabytes that recordings may take; the oldest are removed first. 0: none are made.",
            click.IntRange(min=0),
        ),
        click.option(
            "--metrics",
            envvar="FRACTUS_METRICS",
            default="",
            callback=metrics_address,
            help="HOST:PORT to answer GET /metrics of Prometheus on (docs/metrics.md); nothing is told without it.",
        ),
        click.option(
            "--node", envvar="FRACTUS_NODE", help="Name of this node; by default the description's, else the host's."
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
@_service_options("mobility", 50051, "Optional: Drone", "what survives a restart", "flights")
@click.option(
    "--autopilot",
    help="Link to the autopilot: tcp:HOST:PORT, udpin:HOST:PORT, udpout:HOST:PORT or serial:DEVICE:BAUD; by default the"
    " description's, else tcp:127.0.0.1:5760.",
)
@_option("--driver-grace", 15.0, "Seconds that a lost driver may take to come back.", _SECONDS)
@_option("--boarding", 60.0, "Seconds a drone without a driver waits for the first call of its passengers.", _SECONDS)
@click.option(
    "--flat-terrain",
    is_flag=True,
    help="Assume that the ground is level with home everywhere; otherwise limits above terrain refuse.",
)
@click.option("--verbose", "-v", is_flag=True, help="Log more.")
def serve_mobility(verbose: bool, **given: Any) -> None:
    """Serve until stopped; waits for certificates and for the autopilot."""
    from fractus_services.mobility.mavlink.startup import with_heartbeats  # noqa: PLC0415 - the command line stays quick

    async def run(options: MobilityOptions, stop: asyncio.Event) -> None:
        # Most of the start is importing, on a small computer for longer than a drone in flight is left alone.
        serve = await with_heartbeats(asyncio.to_thread(_mobility_server), options.state, options.autopilot)
        await serve(options, stop)

    until_signalled("mobility", run, MobilityOptions(**given), verbose)


def _mobility_server() -> Callable[[MobilityOptions, asyncio.Event], Coroutine[Any, Any, None]]:
    from fractus_services.mobility.rpc.server import run  # noqa: PLC0415 - takes long

    return run


@click.group()
def camera() -> None:
    """The camera service of a node."""


@camera.command("serve")
@_service_options("camera", 50052, "Drone or EdgeNode", "the pictures", "pictures and decisions")
@_option("--mobility", "127.0.0.1:50051", "Mobility service that reports a drone's position.")
@_option("--keep", 200, "Pictures kept for each component instance.", _COUNT)
@_option("--keep-mb", 200, "Megabytes of pictures kept for each component instance.", _COUNT)
@_option(
    "--keep-total-mb",
    2000,
    "Megabytes of pictures kept altogether; those of components that are gone are removed first.",
    _COUNT,
)
@click.option(
    "--camera",
    help="Where pictures come from: http://HOST/snapshot.jpg, v4l2:/dev/video0, picamera2:0, directory:/PATH or test:;"
    " by default the description's.",
)
@click.option("--face-model", type=FILE, help="Face detector (YuNet, ONNX) to use instead of OpenCV's cascades.")
@_option(
    "--face-px",
    48,
    "Width in pixels from which on faces are found reliably; where they may be smaller, a policy's fallback applies.",
    click.FloatRange(min=12, max=1000),
)
@_option(
    "--relief",
    0.0,
    "How many metres the ground around may lie below home; pictures are judged by what they may show of it.",
    click.FloatRange(min=0, max=5000),
)
def serve_camera(**given: Any) -> None:
    """Serve until stopped; waits for certificates."""
    from fractus_services.camera.server import run  # noqa: PLC0415 - the command line stays quick

    until_signalled("camera", run, CameraSettings(**given))
