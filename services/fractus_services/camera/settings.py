"""Settings of the camera process."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from fractus_services.options import ServiceOptions


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraSettings(ServiceOptions):
    """Settings of the camera process: the options of `fractus camera serve`, and tunable values with defaults.

    Attributes:
        mobility: HOST:PORT of the mobility service that reports the position of a drone.
        keep: Maximum number of images stored for each component instance.
        keep_mb: Maximum size of the images stored for each component instance, in megabytes.
        keep_total_mb: Maximum size of all stored images, in megabytes.
        camera: Camera connection, such as `v4l2:/dev/video0`. None uses the connection in the node description.
        face_model: YuNet face detection model (ONNX). None uses OpenCV's cascades.
        face_px: Minimum width of faces for reliable detection, in pixels.
        relief: Maximum depth of the surrounding ground below home, in metres. It limits the area that an image may show.
        capture_timeout_s: Time after which a camera that has returned no image counts as failed, in seconds.
        motion_frame_interval_s: Interval between the three frames for motion detection, in seconds.
        max_requests_per_instance: Maximum number of requests of one component instance in each queue.
        max_captures: Maximum number of captures of all component instances that wait or run.
        max_filtering: Maximum number of filter jobs of all component instances that wait or run. Each takes tens of
            megabytes of memory.
        max_unrecorded_images: Maximum number of images that wait for the recorder. Each takes about a megabyte of
            memory.
        telemetry_interval_s: Requested interval between telemetry messages, in seconds.
        telemetry_retry_s: Delay before the telemetry subscription is renewed after a failure, in seconds.
    """

    mobility: str
    keep: int
    keep_mb: int
    keep_total_mb: int
    camera: str | None
    face_model: Path | None
    face_px: float
    relief: float
    capture_timeout_s: float = 6.0
    motion_frame_interval_s: float = 0.25
    max_requests_per_instance: int = 4
    max_captures: int = 8
    max_filtering: int = 8
    max_unrecorded_images: int = 16
    telemetry_interval_s: float = 0.1
    telemetry_retry_s: float = 1.0

    @property
    def picture_counts(self) -> Path:
        """File with the numbers of taken and refused pictures of each Grant. The agent reads it."""
        return self.state / "picture-counts.json"
