"""What mutual TLS costs RetrieveImage, against the same service without it.

Both sides are the camera service as it is installed, each a process of its own with the same photographs. The one without
TLS exists in this file only: its server opens a plain port, and takes every caller for the one with the grant.
"""

from __future__ import annotations

import argparse
import asyncio
import functools
import http.server
import json
import math
import os
import statistics
import subprocess
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
from fractus_services import grpc_server
from fractus_services.auth import Caller
from fractus_services.commands import camera
from skimage.data import astronaut

NODE = "bench"
SIZES = {"VGA": (640, 480), "720p": (1280, 720), "1080p": (1920, 1080), "8MP": (3264, 2448)}
TARGET = 1.2
METHODS = ["CaptureImage", "RetrieveImage", "ListImages", "DeleteImage"]
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


class Photographs(http.server.BaseHTTPRequestHandler):
    """An IP camera with one photograph, at any size."""

    def do_GET(self) -> None:
        query = parse_qs(urlsplit(self.path).query)
        size = int(query.get("width", ["3264"])[0]), int(query.get("height", ["2448"])[0])
        body = photograph(size)
        self.send_response(200)
        self.send_header("Content-Type", "image/jpeg")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: Any) -> None:
        """Keep quiet."""


@functools.cache
def photograph(size: tuple[int, int]) -> bytes:
    """A photograph with the noise of a small sensor, as JPEG."""
    picture = cv2.resize(np.ascontiguousarray(astronaut()[..., ::-1]), size, interpolation=cv2.INTER_CUBIC)
    noise = np.random.default_rng(1).normal(0, 6, picture.shape)
    _, encoded = cv2.imencode(".jpg", np.clip(picture + noise, 0, 255).astype(np.uint8))
    return encoded.tobytes()


def serve_plainly(arguments: list[str]) -> None:
    """Run the camera service with a plain port, for one caller."""
    real = grpc.aio.server

    def server(**options: Any) -> Any:
        made = real(**options)
        made.add_secure_port = lambda address, _credentials: made.add_insecure_port(address)
        return made

    grpc.aio.server = server
    grpc_server.Callers.of = lambda _self, _context, _urgent: Caller(IDENTITY, math.inf)
    camera(arguments)


class Side:
    """One service, and its client."""

    def __init__(self, name: str, folder: Path, pki: StandalonePki, camera: str) -> None:
        self.name = name
        self.times: dict[str, list[float]] = {}
        self.names: dict[str, str] = {}
        home = folder / name
        certificate = pki.node(NODE)
        pki.grant(dict(GRANT), home / "grants")
        (home / "node.yaml").write_text(DESCRIPTION)
        self._address = f"127.0.0.1:{free_port()}"
        arguments = [
            "serve", "--grants", str(home / "grants"), "--tls", str(certificate), "--state", str(home / "state"),
            "--audit", str(home / "audit.jsonl"), "--node", NODE, "--description", str(home / "node.yaml"),
            "--listen", self._address, "--camera", camera, "--keep-mb", "500",
        ]  # fmt: skip
        module = ["-m", "fractus_services.camera"] if name == "tls" else [__file__, "--serve-plainly"]
        with (home / "log").open("wb") as log:
            self.process = subprocess.Popen([sys.executable, *module, *arguments], stdout=log, stderr=log)
        self._tls = pki.component(IDENTITY)
        self._channel: Any = None

    def connect(self) -> Any:
        """A new connection."""
        options = [
            ("grpc.ssl_target_name_override", node_server_name(NODE)), ("grpc.max_receive_message_length", 8 * 2**20),
            ("grpc.use_local_subchannel_pool", 1),
        ]  # fmt: skip
        if self.name == "plain":
            return grpc.aio.insecure_channel(self._address, options)
        ca, key, chain = ((self._tls / name).read_bytes() for name in ("ca.crt", "tls.key", "tls.crt"))
        return grpc.aio.secure_channel(self._address, grpc.ssl_channel_credentials(ca, key, chain), options)

    async def take(self) -> dict[str, int]:
        """Take one picture of each size; their bytes."""
        self._channel = self.connect()
        stub = camera_pb2_grpc.CameraServiceStub(self._channel)
        sizes = {}
        for name, (width, height) in SIZES.items():
            request = camera_pb2.CaptureImageRequest(width=width, height=height)
            reply = await stub.CaptureImage(request, timeout=60, wait_for_ready=True)
            self.names[name] = reply.image.name
            sizes[name] = reply.image.size_bytes
        return sizes

    async def fetch(self, size: str, channel: Any = None) -> float:
        """Fetch a picture; seconds."""
        stub = camera_pb2_grpc.CameraServiceStub(channel or self._channel)
        begun = time.perf_counter()
        count = 0
        request = camera_pb2.RetrieveImageRequest(name=self.names[size])
        async for chunk in stub.RetrieveImage(request, timeout=60):
            count += len(chunk.data)
        took = time.perf_counter() - begun
        assert count > 10_000
        return took

    async def close(self) -> None:
        if self._channel is not None:
            await self._channel.close()
        self.process.terminate()
        self.process.wait(20)


async def measured(sides: tuple[Side, Side], runs: int) -> dict[str, tuple[int, float, float]]:
    """Bytes, and seconds with TLS and without, for each size; the sides take turns.

    The lower quartile is taken, so that what else the machine does counts little.
    """
    sizes = [await side.take() for side in sides]
    found = {}
    for size in SIZES:
        times: tuple[list[float], list[float]] = ([], [])
        for turn in range(runs + 3):
            order = (0, 1) if turn % 2 else (1, 0)
            for which in order:
                took = await sides[which].fetch(size)
                await asyncio.sleep(0.045)  # below the limit of calls a second
                if turn >= 3:
                    times[which].append(took)
        ours, theirs = (statistics.quantiles(side, n=4)[0] for side in times)
        found[size] = (sizes[0][size], ours, theirs)
    return found


async def run(options: argparse.Namespace) -> list[dict[str, Any]]:
    for pixels in SIZES.values():
        photograph(pixels)
    source = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Photographs)
    threading.Thread(target=source.serve_forever, daemon=True).start()
    url = f"http://127.0.0.1:{source.server_address[1]}/snapshot.jpg"
    claims = []
    with tempfile.TemporaryDirectory() as directory:
        pki = StandalonePki.create(Path(directory) / "pki")
        sides = (Side("tls", Path(directory), pki, url), Side("plain", Path(directory), pki, url))
        try:
            found = await measured(sides, 30 if options.quick else options.runs)
        finally:
            for side in sides:
                await side.close()
            source.shutdown()
    print(f"{'RetrieveImage':>14} {'bytes':>10} {'mutual TLS':>12} {'plain':>10} {'ratio':>7}")
    for size, (count, ours, theirs) in found.items():
        ratio = ours / theirs
        holds = ratio < TARGET
        print(
            f"{size:>14} {count:10d} {ours * 1e3:9.2f} ms {theirs * 1e3:7.2f} ms {ratio:6.2f}x{'' if holds else '  MISSED'}"
        )
        claims.append(
            {
                "name": f"RetrieveImage over mutual TLS, {size}", "ours": ours * 1e3, "theirs": theirs * 1e3, "unit": "ms",
                "ratio": ratio, "target": TARGET, "holds": holds, "bytes": count,
            }
        )  # fmt: skip
    return claims


def main() -> int:
    if sys.argv[1:2] == ["--serve-plainly"]:
        serve_plainly(sys.argv[2:])
        return 0
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="thirty fetches of each size")
    parser.add_argument("--runs", type=int, default=60, help="fetches of each size")
    parser.add_argument("--json", type=Path, help="write the claims to a file")
    options = parser.parse_args()
    os.environ["GRPC_VERBOSITY"] = "ERROR"
    claims = asyncio.run(run(options))
    if options.json:
        options.json.write_text(json.dumps({"claims": claims}, indent=1))
    return 0 if all(claim["holds"] for claim in claims) else 1


if __name__ == "__main__":
    sys.exit(main())
