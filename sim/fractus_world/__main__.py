"""`fractus-camera-world`: a simulated camera above a simulated world, served like an IP camera."""

from __future__ import annotations

import logging
import signal
import sys
import threading
import time
from pathlib import Path

import click

from fractus_world.optics import Intrinsics, Mount, Pose

DEFAULT_LISTEN = "127.0.0.1:8090"
DEFAULT_VEHICLE = "tcp:127.0.0.1:5762"


def _listen(_context: click.Context, _option: click.Parameter, text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not host or not port.isdigit() or int(port) > 65535:
        raise click.BadParameter(f"{text!r} is not HOST:PORT, such as {DEFAULT_LISTEN}")
    return host.strip("[]"), int(port)


def _pose(_context: click.Context, _option: click.Parameter, text: str | None) -> Pose | None:
    if text is None:
        return None
    try:
        numbers = [float(part) for part in text.split(",")]
        if not 3 <= len(numbers) <= 6:
            raise ValueError(f"{len(numbers)} numbers")
        lat, lon, height_m, yaw, pitch, roll = [*numbers, 0.0, 0.0, 0.0][:6]
        return Pose(lat, lon, height_m, roll, pitch, yaw)
    except ValueError as error:
        raise click.BadParameter(f"expected LAT,LON,HEIGHT[,HEADING[,PITCH[,ROLL]]]: {error}") from error


def _resolution(_context: click.Context, _option: click.Parameter, text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdigit() and height.isdigit()):
        raise click.BadParameter(f"{text!r} is not WIDTHxHEIGHT, such as 1920x1080")
    return int(width), int(height)


def _origin(_context: click.Context, _option: click.Parameter, text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    try:
        lat, lon = (float(part) for part in text.split(","))
        Pose(lat, lon, 0.0)
    except ValueError as error:
        raise click.BadParameter(f"expected LAT,LON: {error}") from error
    return lat, lon


@click.command()
@click.option(
    "--listen",
    callback=_listen,
    default=DEFAULT_LISTEN,
    show_default=True,
    metavar="HOST:PORT",
    help="Address of the HTTP server.",
)
@click.option(
    "--vehicle",
    default=DEFAULT_VEHICLE,
    show_default=True,
    metavar="tcp:HOST:PORT",
    help="MAVLink server of the vehicle that carries the camera.",
)
@click.option(
    "--pose",
    callback=_pose,
    metavar="LAT,LON,HEIGHT[,HEADING[,PITCH[,ROLL]]]",
    help="Use a fixed camera instead of --vehicle. HEIGHT is in metres above the ground.",
)
@click.option(
    "--ground",
    "ground_amsl_m",
    type=float,
    help="Ground altitude above mean sea level, metres. Default: altitude of the vehicle's home.",
)
@click.option(
    "--fov", "fov_deg", type=float, default=62.2, show_default=True, help="Horizontal field of view, degrees."
)
@click.option(
    "--resolution",
    callback=_resolution,
    default="1920x1080",
    show_default=True,
    help="Largest picture, WIDTHxHEIGHT in pixels.",
)
@click.option(
    "--mount-pitch",
    "mount_pitch_deg",
    type=float,
    default=-90.0,
    show_default=True,
    help="Pitch of the camera, degrees: -90 is down, 0 is ahead.",
)
@click.option(
    "--mount-yaw",
    "mount_yaw_deg",
    type=float,
    default=0.0,
    show_default=True,
    help="Direction of the camera, degrees clockwise from the nose.",
)
@click.option(
    "--stabilised/--fixed-mount",
    default=True,
    show_default=True,
    help="Camera with or without a gimbal.",
)
@click.option("--seed", type=int, default=7, show_default=True, help="Seed of the landscape and of the moving objects.")
@click.option(
    "--origin",
    callback=_origin,
    metavar="LAT,LON",
    help="Centre of the landscape. Cameras with the same centre share a world.  [default: the first position, to 0.1 degrees]",
)
@click.option(
    "--orthophoto",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Aerial picture to use instead of the landscape: a GeoTIFF, or a PNG or JPEG with a world file.",
)
@click.option(
    "--crs",
    help="Coordinate system of the orthophoto's world file: EPSG:4326 (default), a projected system such as EPSG:32633, or "
    "local (metres from --origin).",
)
@click.option(
    "--photos",
    type=click.Path(path_type=Path, file_okay=False),
    help="Directory of geotagged pictures to serve instead of a world. The camera serves the picture that was taken nearest. "
    "Thermal pictures are in ir/ or have names that end in _ir.",
)
def camera_world(
    *,
    listen: tuple[str, int],
    vehicle: str,
    pose: Pose | None,
    ground_amsl_m: float | None,
    fov_deg: float,
    resolution: tuple[int, int],
    mount_pitch_deg: float,
    mount_yaw_deg: float,
    stabilised: bool,
    seed: int,
    origin: tuple[float, float] | None,
    orthophoto: Path | None,
    crs: str | None,
    photos: Path | None,
) -> None:
    """Serve the pictures of a camera above a simulated world: /snapshot.jpg, /truth.json, /orthophoto.png."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    from fractus_world.camera_api import CameraApi  # noqa: PLC0415 - imported late, so that --help is fast
    from fractus_world.photos import Photos  # noqa: PLC0415
    from fractus_world.pose_provider import FixedPose, VehiclePose, parse_address  # noqa: PLC0415
    from fractus_world.server import CameraServer  # noqa: PLC0415
    from fractus_world.world import World, WorldAround  # noqa: PLC0415

    try:
        intrinsics = Intrinsics(*resolution, fov_deg)
        mount = Mount(mount_pitch_deg, mount_yaw_deg, stabilised)
        poses: VehiclePose | FixedPose = VehiclePose(parse_address(vehicle), ground_amsl_m)
        if pose is not None:
            poses = FixedPose(pose, ground_amsl_m or 0.0)
        world = None
        if orthophoto is not None:
            from fractus_world.raster import read_raster  # noqa: PLC0415 - PROJ takes a second to load

            world = World.on(read_raster(orthophoto, crs, origin), seed)
        album = None if photos is None else Photos.of(photos)
    except ValueError as error:
        raise click.ClickException(str(error)) from error
    api = CameraApi(WorldAround(seed, origin, world), poses, intrinsics, mount, now=time.time, photos=album)
    try:
        server = CameraServer(listen, api)
    except OSError as error:
        raise click.ClickException(f"--listen {listen[0]}:{listen[1]}: {error}") from error
    if isinstance(poses, VehiclePose):
        poses.start()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: threading.Thread(target=server.shutdown).start())
    click.echo(f"camera world at http://{listen[0]}:{server.port}/", err=True)
    server.serve_forever()
    server.server_close()


def main() -> None:
    """Entry point of `fractus-camera-world`."""
    camera_world.main(args=sys.argv[1:], prog_name="fractus-camera-world")


if __name__ == "__main__":
    main()
