"""Formats of texts in manifests that are not names: images, connections, paths and times."""

from __future__ import annotations

IMAGE = (
    r"^([a-zA-Z0-9]([-a-zA-Z0-9.]*[a-zA-Z0-9])?(:[0-9]+)?/)?[a-z0-9]+(([._]|__|-+)[a-z0-9]+)*"
    r"(/[a-z0-9]+(([._]|__|-+)[a-z0-9]+)*)*(:[A-Za-z0-9_][-A-Za-z0-9_.]{0,127})?(@[a-z0-9]+:[0-9a-f]{32,128})?$"
)
VARIABLE = r"^[A-Za-z_][A-Za-z0-9_]*$"
MOUNT_PATH = r"^(/[^/:]+)+$"
DEVICE = r"^[A-Za-z0-9_][A-Za-z0-9_.-]*$"
SSID = r"^[ -~]+$"
_PORT = r"([1-9][0-9]{0,3}|[1-5][0-9]{4}|6[0-4][0-9]{3}|65[0-4][0-9]{2}|655[0-2][0-9]|6553[0-5])"
AUTOPILOT_CONNECTION = rf"^((tcp|udpin|udpout):.+:{_PORT}|serial:.+)$"
CAMERA_CONNECTION = r"^(https?://[^/].*|v4l2:/dev/.+|picamera2:[0-9]|directory:/.+|test:)$"
RESOLUTION = r"^[1-9][0-9]{1,4}x[1-9][0-9]{1,4}$"
CLOCK_TIME = r"^([01][0-9]|2[0-3]):[0-5][0-9]$"

FORMATS = {
    IMAGE: "an image with a lowercase name, such as registry.example/team/survey:1.0",
    VARIABLE: "letters, digits and underscores, not beginning with a digit",
    MOUNT_PATH: "an absolute path without a slash at the end, such as /data",
    DEVICE: "the name of a network device, such as wlan0",
    SSID: "printable ASCII characters",
    AUTOPILOT_CONNECTION: "tcp:HOST:PORT, udpin:HOST:PORT, udpout:HOST:PORT or serial:DEVICE:BAUD, with a port of 1 to 65535",
    CAMERA_CONNECTION: "http://HOST/PATH, https://HOST/PATH, v4l2:/dev/DEVICE, picamera2:NUMBER, directory:/PATH or test:",
    RESOLUTION: "WIDTHxHEIGHT in pixels, such as 1920x1080",
    CLOCK_TIME: "a time from 00:00 to 23:59, such as 08:30",
}
"""Description of the texts that match each pattern, for error messages."""
