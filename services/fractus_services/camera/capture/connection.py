"""From a connection as manifests spell it to the driver of that kind of camera."""

from __future__ import annotations

from pathlib import Path

from fractus_services.camera.capture.driver import BadConnection, Driver


def driver_for(connection: str) -> Driver:
    """The driver of a connection as manifests spell it.

    Raises:
        BadConnection: it names no kind of camera.
    """
    kind, _, rest = connection.partition(":")
    if kind in {"http", "https"}:
        from fractus_services.camera.capture.drivers.snapshot import Snapshot  # noqa: PLC0415 - only the one that is used

        return Snapshot(connection)
    if kind == "v4l2" and rest:
        from fractus_services.camera.capture.drivers.v4l2 import VideoDevice  # noqa: PLC0415

        return VideoDevice(rest)
    if kind == "picamera2" and rest.isdigit():
        from fractus_services.camera.capture.drivers.raspberry import RaspberryCamera  # noqa: PLC0415

        return RaspberryCamera(int(rest))
    if kind == "directory" and rest:
        from fractus_services.camera.capture.drivers.directory import GeotaggedDirectory  # noqa: PLC0415

        return GeotaggedDirectory(Path(rest))
    if connection == "test:":
        from fractus_services.camera.capture.drivers.rendered import Rendered  # noqa: PLC0415

        return Rendered()
    raise BadConnection(
        f"{connection!r} names no camera; give http://HOST/snapshot.jpg, v4l2:/dev/video0, picamera2:0,"
        " directory:/PATH or test:"
    )
