"""Selects the camera driver for a connection string."""

from __future__ import annotations

from pathlib import Path

from fractus_services.camera.drivers.driver import CameraDriver, InvalidCameraConnection
from fractus_services.camera.drivers.geotagged_directory import GeotaggedDirectory
from fractus_services.camera.drivers.http_snapshot import HttpSnapshot
from fractus_services.camera.drivers.raspberry_pi import RaspberryPiCamera
from fractus_services.camera.drivers.test_pattern import TestPattern
from fractus_services.camera.drivers.v4l2 import VideoDevice


def create_driver(connection: str) -> CameraDriver:
    """Create the driver for a connection string of a manifest, such as `v4l2:/dev/video0`.

    Raises:
        InvalidCameraConnection: The connection string names no supported camera.
    """
    kind, _, rest = connection.partition(":")
    if kind in {"http", "https"}:
        return HttpSnapshot(connection)
    if kind == "v4l2" and rest:
        return VideoDevice(rest)
    if kind == "picamera2" and rest.isdigit():
        return RaspberryPiCamera(int(rest))
    if kind == "directory" and rest:
        return GeotaggedDirectory(Path(rest))
    if connection == "test:":
        return TestPattern()
    raise InvalidCameraConnection(
        f"{connection!r} names no supported camera; use http://HOST/snapshot.jpg, v4l2:/dev/video0, picamera2:0,"
        " directory:/PATH or test:"
    )
