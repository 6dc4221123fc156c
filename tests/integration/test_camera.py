"""Camera service on edge nodes and on a flying drone: pictures under policies."""

from __future__ import annotations

import asyncio
import http.server
import io
import json
import threading
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import grpc
import numpy as np
import pytest
import yaml
from fractus_agent.registration.node_object_file import NodeObjectFile
from fractus_cluster.ports import free_port
from fractus_core.api.nodes import EdgeNode
from fractus_proto.v1 import camera_pb2, camera_pb2_grpc, types_pb2
from fractus_runtime.audit_chain import verify
from mobility_rig import (
    DRIVER,
    FRAME,
    HOME,
    NODE,
    PASSENGER,
    Driver,
    Rig,
    area,
    denied,
    grant,
    passenger_grant,
)
from PIL import Image

ALL = ["CaptureImage", "RetrieveImage", "ListImages", "DeleteImage"]
CAMERA = [{"service": "camera", "methods": ALL}]
EDGE = f"""
apiVersion: fractus.dev/v1alpha1
kind: EdgeNode
metadata: {{name: {NODE}}}
spec:
  location: {{lat: {HOME[0]}, lon: {HOME[1]}, alt: {HOME[2]}, altitudeReference: amsl}}
  services:
    camera:
      model: test
      resolution: 640x480
      horizontalFieldOfView: 60
      lens: {{model: pinhole}}
      mount: {{pitch: -90, height: 4}}
      methods: [CaptureImage, RetrieveImage]
"""
DRONE = f"""
apiVersion: fractus.dev/v1alpha1
kind: Drone
metadata: {{name: {NODE}}}
spec:
  services:
    camera:
      resolution: 640x480
      horizontalFieldOfView: 50
      lens: {{model: pinhole}}
      mount: {{pitch: -90, stabilised: true}}
      methods: [CaptureImage, RetrieveImage]
"""


def privacy(action: str, *box: float) -> dict[str, Any]:
    spec = {"type": "PrivacyControl", "kind": "camera", "action": action, "selector": {"zones": ["private"]}}
    return {"name": "privacy", "spec": spec, "zones": [{"name": "private", "area": area(*box)}]}


def stub(rig: Rig, address: str, identity: str = PASSENGER) -> camera_pb2_grpc.CameraServiceStub:
    return camera_pb2_grpc.CameraServiceStub(rig.channel(identity, address=address))


async def capture(camera: Any, **size: int) -> camera_pb2.CaptureImageResponse:
    return await camera.CaptureImage(camera_pb2.CaptureImageRequest(**size), wait_for_ready=True, timeout=60)


async def retrieve(camera: Any, name: str, action: Any = types_pb2.Decision.ACTION_ALLOW) -> bytes:
    chunks = [c async for c in camera.RetrieveImage(camera_pb2.RetrieveImageRequest(name=name), timeout=20)]
    assert chunks[0].decision.action == action
    assert all(len(c.data) <= 256 * 1024 for c in chunks)
    return b"".join(c.data for c in chunks)


async def test_edge_node_camera_captures_lists_and_deletes_pictures(rig: Rig) -> None:
    viewer = passenger_grant(services=CAMERA, operationArea=[], **{"class": None})
    rig.write_grant(viewer)
    other = grant(services=CAMERA, operationArea=[], **{"class": None})
    rig.write_grant(other)
    address = rig.start_camera("--keep", "2", description=EDGE)
    camera = stub(rig, address)
    taken = await capture(camera)
    assert (taken.image.width, taken.image.height) == (640, 480)
    data = await retrieve(camera, taken.image.name)
    assert len(data) == taken.image.size_bytes
    assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).shape == (480, 640, 3)
    assert taken.image.position.latitude_deg == pytest.approx(HOME[0])

    large = await capture(camera, width=3264, height=2448)
    assert large.image.size_bytes > 256 * 1024
    assert len(await retrieve(camera, large.image.name)) == large.image.size_bytes
    code, why = await denied(capture(camera))
    assert (code, why.code) == (grpc.StatusCode.RESOURCE_EXHAUSTED, "AlbumFull")
    listed = await camera.ListImages(camera_pb2.ListImagesRequest(), timeout=5)
    assert [i.name for i in listed.images] == [taken.image.name, large.image.name]

    code, why = await denied(retrieve(stub(rig, address, DRIVER), taken.image.name))
    assert (code, why.code) == (grpc.StatusCode.NOT_FOUND, "NoSuchImage"), (
        "the driver retrieved a picture of the passenger"
    )
    code, why = await denied(retrieve(camera, "../../../etc/passwd"))
    assert code == grpc.StatusCode.NOT_FOUND
    await camera.DeleteImage(camera_pb2.DeleteImageRequest(name=taken.image.name), timeout=5)
    await capture(camera, width=64, height=64)
    code, why = await denied(capture(camera, width=100_000, height=10))
    assert code == grpc.StatusCode.INVALID_ARGUMENT
    with (rig.directory / "camera.jsonl").open("rb") as log:
        assert not verify(log).problem


async def test_camera_uses_changed_node_description_at_once(rig: Rig) -> None:
    rig.write_grant(
        passenger_grant(privacy("refuse", 40, -20, 60, 20), services=CAMERA, operationArea=[], **{"class": None})
    )
    handed = rig.directory / "node.json"
    handover = NodeObjectFile(handed)
    camera = stub(rig, rig.start_camera("--node-object", str(handed)))
    assert (await denied(capture(camera)))[1].code == "PositionUnknown", (
        "the service took a picture before it knew its node"
    )
    await rig.until_logged("camera", "policies assume that the camera sees everything (missing=services.camera)")

    async def becomes(code: str) -> None:
        found: str | None = None
        async with asyncio.timeout(15):
            while found != code:
                try:
                    status, why = await denied(capture(camera, width=64, height=48))
                    found = why.code if status is grpc.StatusCode.PERMISSION_DENIED else None
                except AssertionError:
                    found = ""
                await asyncio.sleep(0.1)

    def hand_over(**mount: float) -> None:
        described = yaml.safe_load(EDGE)
        described["spec"]["services"]["camera"]["mount"] = mount
        handover.write(EdgeNode.from_body(described))

    hand_over(pitch=-90, height=4)
    await becomes("")
    hand_over(pitch=-90, height=80)
    await becomes("PrivacyZone")
    hand_over(pitch=-90, height=4)
    await becomes("")
    handed.write_text("{")
    await becomes("PositionUnknown")
    log = (rig.directory / "camera.jsonl").read_bytes().splitlines(keepends=True)
    assert not verify(log).problem
    assert sum(json.loads(line)["kind"] == "started" for line in log) == 5


async def until_refused(call: Any) -> tuple[grpc.StatusCode, types_pb2.Decision]:
    for _ in range(200):
        try:
            await call()
        except grpc.aio.AioRpcError:
            return await denied(call())
        await asyncio.sleep(0.05)
    raise AssertionError("the new policy had no effect on the stored picture")


async def test_later_policy_applies_to_stored_pictures(rig: Rig) -> None:
    def write(*policies: dict[str, Any]) -> None:
        bound = passenger_grant(*policies, services=CAMERA, operationArea=[], **{"class": None})
        rig.write_grant(bound)

    write()
    camera = stub(rig, rig.start_camera(description=EDGE))
    taken = await capture(camera)
    plain = await retrieve(camera, taken.image.name)
    exif = Image.open(io.BytesIO(plain)).getexif().get_ifd(0x8825)
    assert float(exif[2][0]) == int(HOME[0])
    write(privacy("blurFaces", -20, -20, 20, 20))
    request = camera_pb2.RetrieveImageRequest(name=taken.image.name)
    for _ in range(200):
        try:
            chunks = [chunk async for chunk in camera.RetrieveImage(request, timeout=20)]
        except grpc.aio.AioRpcError as error:
            # The policy arrived during this request.
            assert "request it again" in str(error.details()), error
            continue
        if chunks[0].decision.action == types_pb2.Decision.ACTION_CORRECT:
            break
        await asyncio.sleep(0.05)
    assert list(chunks[0].decision.policies) == ["privacy"]
    assert "blurAverage is applied" in chunks[0].decision.reason, (
        "faces cannot be detected at 640 pixels from 4 m, so the fallback blurAverage must be applied"
    )
    blurred = b"".join(c.data for c in chunks)
    assert len(blurred) == chunks[0].image.size_bytes < len(plain)
    assert not chunks[0].image.HasField("position")
    assert b"Exif" not in blurred
    # A stored picture of a fixed camera is judged by the policies that currently apply at the camera's position.
    logged = f"policy: filters required (action=correct caller={PASSENGER} method=RetrieveImage filters=blurAverage policies=privacy"
    await rig.until_logged("camera", logged)
    again = await capture(camera)
    assert again.decision.action == types_pb2.Decision.ACTION_CORRECT
    write(privacy("refuse", -20, -20, 20, 20))
    status, why = await until_refused(lambda: retrieve(camera, taken.image.name, types_pb2.Decision.ACTION_CORRECT))
    assert (status, why.code) == (grpc.StatusCode.PERMISSION_DENIED, "PrivacyZone")
    status, why = await denied(capture(camera))
    assert (status, why.code, list(why.policies)) == (grpc.StatusCode.PERMISSION_DENIED, "PrivacyZone", ["privacy"])
    counts = json.loads((rig.directory / "pictures" / "picture-counts.json").read_text())
    assert list(counts.values()) == [[2, 1]], "taken and refused pictures"


@pytest.fixture
def noise_url() -> Iterator[str]:
    """URL of a picture of random noise, which cannot be compressed."""
    picture = np.random.default_rng(1).integers(0, 256, (1800, 2400, 3), np.uint8)
    data = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 0])[1].tobytes()

    class Snapshots(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.end_headers()
            self.wfile.write(data)

        def log_message(self, *_: Any) -> None:
            """Log no requests."""

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Snapshots)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_address[1]}/"
    server.shutdown()
    server.server_close()


@pytest.mark.parametrize(
    ("change", "code"),
    [("removed", "NoGrant"), ("refuses", "PrivacyZone"), ("filters", "PrivacyZone"), ("permits", "")],
)
async def test_changed_grant_ends_capture_in_progress(rig: Rig, noise_url: str, change: str, code: str) -> None:
    def write(*policies: dict[str, Any]) -> Path:
        return rig.write_grant(passenger_grant(*policies, services=CAMERA, operationArea=[], **{"class": None}))

    path = write()
    address = rig.start_camera("--camera", noise_url, description=EDGE)
    # Disable bdp_probe. Otherwise the client's gRPC library reads megabytes ahead of the program on a fast link.
    camera = camera_pb2_grpc.CameraServiceStub(
        rig.channel(PASSENGER, address=address, options=(("grpc.http2.bdp_probe", 0),))
    )
    size = (await capture(camera, width=2400, height=1800)).image.size_bytes
    assert size > 3_000_000
    (name,) = (one.name for one in (await camera.ListImages(camera_pb2.ListImagesRequest(), timeout=5)).images)
    stream = camera.RetrieveImage(camera_pb2.RetrieveImageRequest(name=name), timeout=30)
    received = len((await stream.read()).data)
    if change == "removed":
        path.unlink()
    elif change == "permits":
        write(privacy("refuse", 500, 500, 510, 510))
    else:
        write(privacy({"refuses": "refuse", "filters": "black"}[change], -20, -20, 20, 20))
    await rig.until_logged("camera", f"grants: {'removed' if change == 'removed' else 'changed'}")

    async def rest() -> None:
        nonlocal received
        while (chunk := await stream.read()) is not grpc.aio.EOF:
            received += len(chunk.data)
        assert await stream.code() == grpc.StatusCode.OK

    if not code:
        await rest()
        assert received == size
        return
    status, why = await denied(rest())
    assert (status, why.code) == (grpc.StatusCode.PERMISSION_DENIED, code)
    assert received < 1_000_000, "the service sent more than its buffers contained when the Grant changed"


async def test_ip_camera_is_used_again_after_failure(rig: Rig) -> None:
    viewer = passenger_grant(services=CAMERA, operationArea=[], **{"class": None})
    rig.write_grant(viewer)
    requests: list[str] = []

    class Snapshots(http.server.BaseHTTPRequestHandler):
        broken = ""

        def do_GET(self) -> None:
            requests.append(self.path)
            if self.broken == "503":
                self.send_error(503, "no pose")
                return
            picture = np.full((90, 160, 3), 200, np.uint8)
            data = b"no picture" if self.broken else cv2.imencode(".png", picture)[1].tobytes()
            self.send_response(200)
            self.end_headers()
            self.wfile.write(data)

        def log_message(self, *_: Any) -> None:
            """Log no requests."""

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Snapshots)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        url = f"http://user:secret@127.0.0.1:{server.server_address[1]}/snapshot.jpg"
        camera = stub(rig, rig.start_camera("--camera", url, description=EDGE))
        taken = await capture(camera, width=320, height=320)
        assert requests == ["/snapshot.jpg?width=427&height=320"], (
            "the requested size does not have the proportions of the camera"
        )
        data = await retrieve(camera, taken.image.name)
        shown = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert shown.shape == (320, 320, 3)
        assert abs(float(shown.mean()) - 200) < 3
        for broken, sentence in (("503", "503"), ("text", "returned no image")):
            Snapshots.broken = broken
            code, why = await denied(capture(camera))
            assert (code, why.code) == (grpc.StatusCode.UNAVAILABLE, "CameraFailed")
            assert sentence in why.reason
            assert "secret" not in why.reason
        Snapshots.broken = ""
        await capture(camera)
    finally:
        server.shutdown()
        server.server_close()
    code, why = await denied(capture(camera))
    assert (code, why.code) == (grpc.StatusCode.UNAVAILABLE, "CameraFailed")
    listed = await camera.ListImages(camera_pb2.ListImagesRequest(), timeout=5)
    assert len(listed.images) == 2


BILLBOARD = (39.36009591, 22.95004318)
"""Position of a picture of a face that lies on the ground of the simulated landscape."""


async def test_face_in_simulated_world_is_blurred(rig: Rig) -> None:
    port = free_port()
    rig._start(
        "world", "-m", "fractus_world", "--listen", f"127.0.0.1:{port}", "--pose", f"{BILLBOARD[0]},{BILLBOARD[1]},4",
        "--origin", "39.36,22.95", "--resolution", "640x360",
    )  # fmt: skip
    node = {
        "apiVersion": "fractus.dev/v1alpha1", "kind": "EdgeNode", "metadata": {"name": NODE},
        "spec": {
            "location": {"lat": BILLBOARD[0], "lon": BILLBOARD[1], "alt": 0, "altitudeReference": "amsl"},
            "services": {"camera": {
                "connection": f"http://127.0.0.1:{port}/snapshot.jpg", "resolution": "640x360", "methods": ALL,
                "horizontalFieldOfView": 62.2, "lens": {"model": "pinhole"}, "mount": {"pitch": -90, "height": 4},
            }},
        },
    }  # fmt: skip
    faces = {"name": "faces", "spec": {"type": "PrivacyControl", "kind": "camera", "action": "blurFaces"}}
    rig.write_grant(grant(services=CAMERA, operationArea=[], **{"class": None}))
    rig.write_grant(passenger_grant(faces, services=CAMERA, operationArea=[], **{"class": None}))
    address = rig.start_camera("--face-px", "12", description=yaml.safe_dump(node))

    async def picture(identity: str) -> np.ndarray:
        camera = stub(rig, address, identity)
        for _ in range(100):
            try:
                taken = await capture(camera)
                break
            except grpc.aio.AioRpcError as error:
                assert error.code() == grpc.StatusCode.UNAVAILABLE, error
                await asyncio.sleep(0.2)
        data = await retrieve(camera, taken.image.name, taken.decision.action)
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE).astype(float)

    plain = await picture(DRIVER)
    hidden = await picture(PASSENGER)
    url = f"http://127.0.0.1:{port}/truth.json"
    truth = json.loads(await asyncio.to_thread(lambda: urllib.request.urlopen(url, timeout=10).read()))
    left, top, right, bottom = (int(v) for v in next(f for f in truth["faces"] if f["visible"] > 0.7)["box"])
    face = np.s_[max(top, 0) : bottom, max(left, 0) : right]
    fine = [np.abs(np.diff(p[face], axis=1)) for p in (plain, hidden)]
    assert (fine[1] > 4).mean() < 0.35 * (fine[0] > 4).mean()
    border = np.s_[:, :60]
    assert np.abs(plain[border] - hidden[border]).mean() < 12, "the filter changed pixels outside the face"
    assert np.abs(plain[face] - hidden[face]).mean() > 5


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--face-model", "/nowhere.onnx"), "file not found"),
        (("--camera", "gopher://x"), "names no supported camera"),
    ],
)
async def test_camera_service_refuses_invalid_arguments_at_start(
    rig: Rig, arguments: tuple[str, ...], sentence: str
) -> None:
    rig.start_camera(*arguments, description=EDGE)
    assert await asyncio.to_thread(rig._processes["camera"].wait, 30) == 1
    log = rig.log("camera")
    assert sentence in log
    assert "Traceback" not in log


async def test_drone_camera_is_refused_over_privacy_zone(rig: Rig) -> None:
    rig.write_grant(grant())
    stripe = privacy("refuse", -50, 30, 50, 60)
    rig.write_grant(passenger_grant(stripe, services=[*CAMERA, {"service": "mobility", "methods": ["GetPosition"]}]))
    rig.start_service()
    rig.start_vehicle()
    camera = stub(rig, rig.start_camera(description=DRONE))
    driver = Driver(rig)
    await driver.up()
    over = await capture(camera, width=64, height=64)
    assert FRAME.xy(over.image.position.latitude_deg, over.image.position.longitude_deg)[1] < 10
    await driver.goto(0, 45)
    code, why = await denied(capture(camera))
    assert (code, why.code) == (grpc.StatusCode.PERMISSION_DENIED, "PrivacyZone")
    await driver.goto(0, 80)
    await capture(camera, width=64, height=64)
    rig.kill("service")

    async def until_unknown() -> types_pb2.Decision:
        for _ in range(500):
            try:
                await capture(camera, width=64, height=64)
            except grpc.aio.AioRpcError as error:
                if error.code() == grpc.StatusCode.PERMISSION_DENIED:
                    return (await denied(capture(camera)))[1]
            for shot in (await camera.ListImages(camera_pb2.ListImagesRequest(), timeout=5)).images:
                await camera.DeleteImage(camera_pb2.DeleteImageRequest(name=shot.name), timeout=5)
            await asyncio.sleep(0.1)  # below the rate limit of the service
        raise AssertionError("the service takes pictures although the position is unknown")

    assert (await until_unknown()).code in {"PositionUnknown", "PrivacyZone"}
