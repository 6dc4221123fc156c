"""Duration of RetrieveImage over mutual TLS, against the same camera service without TLS.

Both services run in separate processes with the same photographs, and are called alternately. The service without TLS
exists in this file only. Its server opens an insecure port and identifies every caller as the only component with a
Grant.
"""

from __future__ import annotations

import asyncio
import functools
import http.server
import math
import os
import statistics
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import cv2
import grpc
import numpy as np
from fractus_cli.standalone import StandalonePki
from fractus_cluster.ports import free_port
from fractus_core.api import Grant
from fractus_core.api.names import node_server_name
from fractus_proto.v1 import camera_pb2, camera_pb2_grpc
from fractus_services.auth import Caller, Callers
from fractus_services.commands import camera
from harness import ROOT, Processes, Report, parser

NODE = "bench"
SIZES = {"VGA": (640, 480), "720p": (1280, 720), "1080p": (1920, 1080), "8MP": (3264, 2448)}
WARM_UP = 3
METHODS = ["CaptureImage", "RetrieveImage", "ListImages", "DeleteImage"]
PAUSE_S = 0.045
"""Pause after each call, which keeps the client below the service's limit of calls per second."""
GRANT = {
    "apiVersion": "fractus.dev/v1alpha1",
    "kind": "Grant",
    "metadata": {"name": "bench"},
    "spec": {
        "node": NODE,
        "application": {"namespace": "default", "name": "bench", "uid": "bench"},
        "component": "Viewer",
        "instance": "viewer",
        "services": [{"service": "camera", "methods": METHODS}],
    },
}
DESCRIPTION = f"""
apiVersion: fractus.dev/v1alpha1
kind: EdgeNode
metadata: {{name: {NODE}}}
spec:
  location: {{lat: 39.36, lon: 22.95, alt: 10, altitudeReference: amsl}}
  services:
    camera: {{model: bench, resolution: 3264x2448, horizontalFieldOfView: 60, mount: {{pitch: -90, height: 4}}, methods: {METHODS}}}
"""
IDENTITY = Grant.from_body(GRANT).spec.identity


class PhotographHandler(http.server.BaseHTTPRequestHandler):
    """IP camera that returns one photograph in the requested size."""

    def do_GET(self) -> None:
        query = parse_qs(urlsplit(self.path).query)
        body = photograph(int(query.get("width", ["3264"])[0]), int(query.get("height", ["2448"])[0]))
        self.send_response(200)
        self.send_header("Content-Type", "image/jpeg")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Log nothing."""


@functools.cache
def photograph(width: int, height: int) -> bytes:
    """Return a JPEG photograph with the noise of a small sensor."""
    picture = cv2.imread(str(ROOT / "sim" / "fractus_world" / "astronaut.png"))
    picture = cv2.resize(picture, (width, height), interpolation=cv2.INTER_CUBIC)
    noise = np.random.default_rng(1).normal(0, 6, picture.shape)
    _, encoded = cv2.imencode(".jpg", np.clip(picture + noise, 0, 255).astype(np.uint8))
    return encoded.tobytes()


def serve_without_tls(arguments: list[str]) -> None:
    """Run the camera service with an insecure port, for one caller."""
    create_server = grpc.aio.server

    def create_insecure_server(**options: Any) -> Any:
        server = create_server(**options)
        server.add_secure_port = lambda address, _credentials: server.add_insecure_port(address)
        return server

    grpc.aio.server = create_insecure_server
    Callers.of = lambda _self, _context, _urgent=False: Caller(IDENTITY, math.inf)  # type: ignore[method-assign]
    camera(arguments)


class CameraService:
    """A camera service in its own process, and its client."""

    def __init__(
        self, processes: Processes, directory: Path, pki: StandalonePki, camera_url: str, *, tls: bool
    ) -> None:
        home = directory / ("tls" if tls else "plain")
        certificate = pki.node(NODE)
        pki.grant(dict(GRANT), home / "grants")
        (home / "node.yaml").write_text(DESCRIPTION)
        address = f"127.0.0.1:{free_port()}"
        program = ["-m", "fractus_services.camera"] if tls else [__file__, "--serve-without-tls"]
        processes.start(
            home.name, sys.executable, *program, "serve", "--grants", home / "grants", "--tls", certificate,
            "--state", home / "state", "--audit", home / "audit.jsonl", "--node", NODE,
            "--description", home / "node.yaml", "--listen", address, "--camera", camera_url, "--keep-mb", "500",
        )  # fmt: skip
        options = [
            ("grpc.ssl_target_name_override", node_server_name(NODE)),
            ("grpc.max_receive_message_length", 8 * 2**20),
            ("grpc.use_local_subchannel_pool", 1),
        ]
        if tls:
            component = pki.component(IDENTITY)
            ca, key, chain = ((component / name).read_bytes() for name in ("ca.crt", "tls.key", "tls.crt"))
            channel = grpc.aio.secure_channel(address, grpc.ssl_channel_credentials(ca, key, chain), options)
        else:
            channel = grpc.aio.insecure_channel(address, options)
        self._stub = camera_pb2_grpc.CameraServiceStub(channel)
        self._images: dict[str, str] = {}

    async def capture(self) -> None:
        """Take one picture of each size."""
        for name, (width, height) in SIZES.items():
            request = camera_pb2.CaptureImageRequest(width=width, height=height)
            reply = await self._stub.CaptureImage(request, timeout=60, wait_for_ready=True)
            self._images[name] = reply.image.name

    async def retrieve(self, size: str) -> float:
        """Retrieve the picture of a size, and return the duration in milliseconds."""
        begun_s = time.perf_counter()
        received = 0
        async for chunk in self._stub.RetrieveImage(
            camera_pb2.RetrieveImageRequest(name=self._images[size]), timeout=60
        ):
            received += len(chunk.data)
        took_ms = (time.perf_counter() - begun_s) * 1e3
        assert received > 10_000
        await asyncio.sleep(PAUSE_S)
        return took_ms


async def measure(report: Report, services: tuple[CameraService, CameraService], runs: int) -> None:
    """Compare the services at each size by the lower quartile of the durations, which other programs hardly affect."""
    for service in services:
        await service.capture()
    for size in SIZES:
        times_ms: tuple[list[float], list[float]] = ([], [])
        for turn in range(runs + WARM_UP):
            for index in (0, 1) if turn % 2 else (1, 0):
                took_ms = await services[index].retrieve(size)
                if turn >= WARM_UP:
                    times_ms[index].append(took_ms)
        secure_ms, plain_ms = (statistics.quantiles(times, n=4)[0] for times in times_ms)
        report.add("retrieve", secure_ms, plain_ms, size=size)


def main() -> int:
    if sys.argv[1:2] == ["--serve-without-tls"]:
        serve_without_tls(sys.argv[2:])
        return 0
    arguments = parser(__doc__, quick="thirty calls of each size")
    arguments.add_argument("--runs", type=int, default=60, help="calls of each size")
    options = arguments.parse_args()
    os.environ["GRPC_VERBOSITY"] = "ERROR"
    for size in SIZES.values():
        photograph(*size)
    source = http.server.ThreadingHTTPServer(("127.0.0.1", 0), PhotographHandler)
    threading.Thread(target=source.serve_forever, daemon=True).start()
    url = f"http://127.0.0.1:{source.server_address[1]}/snapshot.jpg"
    report = Report("tls", options)

    async def compare(processes: Processes, directory: Path) -> None:
        pki = StandalonePki.create(directory / "pki")
        secure = CameraService(processes, directory, pki, url, tls=True)
        plain = CameraService(processes, directory, pki, url, tls=False)
        await measure(report, (secure, plain), 30 if options.quick else options.runs)

    with tempfile.TemporaryDirectory() as name, Processes(Path(name)) as processes:
        asyncio.run(compare(processes, Path(name)))
    source.shutdown()
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
