"""From a connection as manifests spell it to the driver of that kind of camera."""

from __future__ import annotations

from pathlib import Path

from fractus_services.camera.drivers.driver import BadConnection, Driver


def driver_for(connection: str) -> Driver:
    """The driver of a connection as manifests spell it.

    Raises:
        BadConnection: it names no kind of camera.
    """
    kind, _, rest = connection.partition(":")
    if kind in {"http", "https"}:
        from fractus_services.camera.drivers.http_snapshot import HttpSnapshot  # noqa: PLC0415 - only the one that is used

        return HttpSnapshot(connection)
    if kind == "v4l2" and rest:
        from fractus_services.camera.drivers.v4l2 import VideoDevice  # noqa: PLC0415

        return VideoDevice(rest)
    if kind == "picamera2" and rest.isdigit():
        from fractus_services.camera.drivers.raspberry_pi import RaspberryPiCamera  # noqa: PLC0415

        return RaspberryPiCamera(int(rest))
    if kind == "directory" and rest:
        from fractus_services.camera.drivers.geotagged_directory import GeotaggedDirectory  # noqa: PLC0415

        return GeotaggedDirectory(Path(rest))
    if connection == "test:":
        from fractus_services.camera.drivers.test_pattern import TestPattern  # noqa: PLC0415

        return TestPattern()
    raise BadConnection(
        f"{connection!r} names no camera; give http://HOST/snapshot.jpg, v4l2:/dev/video0, picamera2:0,"
        " directory:/PATH or test:"
    )
