"""`fractus camera`: the camera service of a drone or an edge node, with or without Kubernetes around it."""

from __future__ import annotations

import asyncio
import logging
import signal
from dataclasses import dataclass
from pathlib import Path

import click

from fractus_services.hosting import DIRECTORY, FILE, CannotServe, address, one_sentence


@dataclass(frozen=True, slots=True)
class Options:
    """What the command line says."""

    grants: Path
    tls: Path
    state: Path
    audit: Path
    node: str | None
    description: Path
    mobility: str
    listen: str
    keep: int
    keep_mb: int
    keep_total_mb: int
    camera: str | None
    face_model: Path | None
    face_px: float
    relief: float


@click.group()
def camera() -> None:
    """The camera service of a node."""


@camera.command()
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
    "--state", type=DIRECTORY, default="/var/lib/fractus/camera", show_default=True, help="Directory of the pictures."
)
@click.option("--audit", type=FILE, default="/var/lib/fractus/audit/camera.jsonl", show_default=True, help="Audit log.")
@click.option("--node", envvar="FRACTUS_NODE", help="Name of this node; by default the description's, else the host's.")
@click.option(
    "--description",
    type=click.Path(path_type=Path),
    default="/etc/fractus/node.yaml",
    show_default=True,
    help="Drone or EdgeNode manifest of this node.",
)
@click.option(
    "--mobility", default="127.0.0.1:50051", show_default=True, help="Mobility service that tells a drone's position."
)
@click.option("--listen", callback=address, default="[::]:50052", show_default=True, help="Address of the gRPC server.")
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
def serve(**given: object) -> None:
    """Serve until stopped; waits for certificates."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    asyncio.run(_until_signalled(Options(**given)))  # type: ignore[arg-type]


async def _until_signalled(options: Options) -> None:
    from fractus_services.camera.capture.driver import BadConnection  # noqa: PLC0415 - the command line stays quick
    from fractus_services.camera.imaging.faces import BadModel  # noqa: PLC0415
    from fractus_services.camera.rpc.server import run  # noqa: PLC0415

    loop = asyncio.get_running_loop()
    stop = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    try:
        await run(options, stop)
    except (BadConnection, BadModel, CannotServe) as error:
        raise click.ClickException(str(error)) from None
    except ExceptionGroup as failures:
        raise one_sentence(failures) from None


if __name__ == "__main__":
    camera()
