"""The complete camera service keeps its image store when the node description changes."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest
from fractus_cluster.ports import free_port
from fractus_services import node_description
from fractus_services.camera import server
from fractus_services.camera.settings import CameraSettings
from scraping import get, values


class CountedImageStore(server.ImageStore):
    """ImageStore that counts its instances."""

    instances = 0

    def __init__(self, *args: Any, **more: Any) -> None:
        super().__init__(*args, **more)
        type(self).instances += 1


async def logged(caplog: pytest.LogCaptureFixture, text: str) -> None:
    while text not in caplog.text:  # noqa: ASYNC110 (a log cannot be awaited)
        await asyncio.sleep(0.01)


async def test_image_store_is_kept_when_the_node_description_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A second image store must not exist, because it would delete a picture that the first store is still writing."""
    monkeypatch.setattr(server, "ImageStore", CountedImageStore)
    monkeypatch.setattr(node_description, "POLL_INTERVAL_S", 0.01)
    node = tmp_path / "node.json"
    port = free_port()
    options = CameraSettings(
        grants=tmp_path / "grants", tls=tmp_path / "tls", state=tmp_path / "state", audit=tmp_path / "audit", node="n",
        node_object=node, description=tmp_path / "none.yaml", listen="127.0.0.1:0", lock_timeout=0.0, mobility="unix:none", recordings=None, metrics=f"127.0.0.1:{port}",
        recordings_mb=0, keep=10, keep_mb=10, keep_total_mb=10, camera=None, face_model=None, face_px=20.0, relief=0.0,
    )  # fmt: skip
    stop = asyncio.Event()
    serving = asyncio.ensure_future(server.run(options, stop))
    manifest = '{"apiVersion": "fractus.dev/v1alpha1", "kind": "EdgeNode", "metadata": {"name": "n"}, "spec": {"location": %s}}'
    async with asyncio.timeout(30):
        for lat in (50.0, 51.0):
            await logged(caplog, "field of view unknown")
            caplog.clear()
            node.write_text(manifest % f'{{"lat": {lat}, "lon": 8.0}}')
        await logged(caplog, "described=True")
        first, body = await get(port)
        assert "200" in first
        assert values(body)["fractus_audit_failing",] == 0
        stop.set()
        await serving
    assert CountedImageStore.instances == 1
