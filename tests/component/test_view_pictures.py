"""Thumbnails of pictures: their size, the program on a node, and the view that runs it with kubectl."""

from __future__ import annotations

import asyncio
import io
import json
import random
import subprocess
import sys
from base64 import b64decode
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest
from aiohttp import ClientSession, hdrs, web
from click.testing import CliRunner
from fractus_runtime import thumbnails
from fractus_runtime.kubernetes import Page
from fractus_runtime.thumbnails import HEIGHT_PX, MAX_BYTES, WIDTH_PX, thumbnail
from fractus_services.recording import messages
from fractus_services.recording.segment_writer import McapWriter
from fractus_services.recording.thumbnails import MAX_PER_SCAN, PictureScanner
from fractus_view import cluster_pictures
from fractus_view.cluster_pictures import MAX_STORED, ClusterPictures
from fractus_view.command import view
from fractus_view.events import Event, Picture, PictureSource
from fractus_view.server import ViewServer
from fractus_view.sources import Replay
from PIL import Image

T_MS = 1_780_000_000_000


def jpeg(width: int = 640, height: int = 480, *, noise: bool = False) -> bytes:
    if noise:
        picture = Image.frombytes("RGB", (width, height), random.Random(1).randbytes(width * height * 3))
    else:
        picture = Image.new("RGB", (width, height), (10, 120, 200))
    buffer = io.BytesIO()
    exif = Image.Exif()
    exif[0x010E] = "a description"
    picture.save(buffer, "JPEG", quality=95, exif=exif)
    return buffer.getvalue()


def record(path: Path, pictures: Iterable[tuple[int, bytes]]) -> None:
    """Write a recording of a camera service that is not closed yet."""
    with path.open("wb") as file:
        out = McapWriter(file)
        for second, data in pictures:
            item = messages.picture((T_MS + second * 1_000) * 1_000_000, "drone-1", data)
            out.write("/drone-1/picture", item.schema, item.time_ns, item.content)
        out.flush()


@pytest.mark.parametrize(("width", "height"), [(4000, 3000), (100, 2000), (64, 48)])
def test_thumbnail_is_small_and_contains_no_metadata(width: int, height: int) -> None:
    small = thumbnail(jpeg(width, height, noise=width < 1000))
    assert small is not None
    assert len(small) <= MAX_BYTES
    with Image.open(io.BytesIO(small)) as picture:
        assert picture.format == "JPEG"
        assert picture.width <= min(WIDTH_PX, width)
        assert picture.height <= min(HEIGHT_PX, height)
        assert not picture.getexif()


def test_damaged_or_huge_picture_has_no_thumbnail(monkeypatch: pytest.MonkeyPatch) -> None:
    assert thumbnail(b"") is None
    assert thumbnail(b"\xff\xd8 a picture \xff\xd9") is None
    assert thumbnail(jpeg()[:2_000]) is None
    monkeypatch.setattr(thumbnails, "MAX_PIXELS", 640 * 480 - 1)
    assert thumbnail(jpeg()) is None


def test_scanner_yields_only_the_latest_new_pictures(tmp_path: Path) -> None:
    path = tmp_path / "000001-20260528T202640Z.mcap"
    record(path, [(second, jpeg()) for second in range(10)])
    (tmp_path / "000002-20260528T202640Z.mcap").write_bytes(b"no recording")
    scanner = PictureScanner(tmp_path, T_MS + 5_000)
    assert [time_ms - T_MS for time_ms, _ in scanner.scan()] == [6_000, 7_000, 8_000, 9_000]
    assert list(scanner.scan()) == []
    assert len(list(PictureScanner(tmp_path, 0).scan())) == MAX_PER_SCAN


def test_program_prints_thumbnails_as_lines_and_ends(tmp_path: Path) -> None:
    record(tmp_path / "000001-20260528T202640Z.mcap", [(0, jpeg(2000, 1500))])
    command = [sys.executable, "-m", "fractus_services.recording.thumbnails", str(tmp_path), "--seconds", "0"]
    output = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout
    content = json.loads(output)
    assert content["time_ms"] == T_MS
    assert len(b64decode(content["jpeg"])) <= MAX_BYTES
    missing = subprocess.run(
        [*command[:-3], str(tmp_path / "no")], capture_output=True, text=True, timeout=60, check=False
    )
    assert missing.returncode == 1
    assert "set camera.recordings.enabled=true" in missing.stderr


async def test_server_serves_thumbnails_of_recorded_pictures(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    record(path, [(0, jpeg(2000, 1500, noise=True))])
    replay = Replay([path])
    (picture,) = [event for event in replay.events() if isinstance(event, Picture)]
    server = ViewServer(replay, frozenset())
    runner = web.AppRunner(server.application(), shutdown_timeout=0.1)
    await runner.setup()
    await web.TCPSite(runner, "127.0.0.1", 0).start()
    address = f"http://127.0.0.1:{runner.addresses[0][1]}/thumbnails"
    headers = {hdrs.AUTHORIZATION: f"Bearer {server.token}"}
    try:
        async with asyncio.timeout(20), ClientSession(headers=headers) as session:
            async with session.get(f"{address}/{picture.id}") as response:
                assert response.status == 200
                assert len(await response.read()) <= MAX_BYTES
            async with session.get(f"{address}/0-0-0") as response:
                assert response.status == 404
    finally:
        await runner.cleanup()


class Cluster:
    """Fake API server with the camera service of drone-1."""

    async def list_whole(self, *_: Any, **__: Any) -> Page:
        pod = {
            "metadata": {"namespace": "fractus-system", "name": "fractus-camera-x"},
            "spec": {"nodeName": "drone-1"}, "status": {"phase": "Running"},
        }  # fmt: skip
        return Page({"metadata": {}, "items": [pod]})


def kubectl(path: Path, script: str) -> str:
    """Write a fake kubectl, which logs its arguments."""
    path.write_text(f'#!/bin/bash\necho "$*" >> {path}.calls\n{script}\n')
    path.chmod(0o755)
    return str(path)


async def received(command: str, condition: Callable[[list[Event], ClusterPictures], bool]) -> list[Event]:
    """Receive pictures until a condition is true, and return the published events."""
    events: list[Event] = []
    changed = asyncio.Event()

    def publish(batch: Iterable[Event]) -> None:
        events.extend(batch)
        changed.set()

    pictures = ClusterPictures(
        Cluster(),  # type: ignore[arg-type]
        [command, "--context=town"],
        "fractus-system",
        drones=lambda: frozenset({"drone-1"}),
        publish=publish,
        now_ms=lambda: T_MS + 60_000,
    )
    task = asyncio.create_task(pictures.run())
    try:
        async with asyncio.timeout(30):
            while not condition(events, pictures):
                changed.clear()
                await changed.wait()
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
    return events


async def test_view_receives_thumbnails_and_continues_after_the_last_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster_pictures, "RETRY_S", 0.01)
    valid = f"""echo '{{"time_ms": {T_MS}, "jpeg": "AAEC"}}'"""
    too_long = "head -c 200000 /dev/zero | tr '\\\\0' x"
    command = kubectl(tmp_path / "kubectl", f"""{valid}; echo '{{"time_ms": 1}}'; echo nonsense; {too_long}""")
    calls = tmp_path / "kubectl.calls"
    bodies: list[bytes | None] = []

    def complete(events: list[Event], pictures: ClusterPictures) -> bool:
        found = [event for event in events if isinstance(event, Picture)]
        bodies[:] = [pictures.picture(event.id) for event in found]
        return len(found) >= 2

    events = await received(command, complete)
    first = next(event for event in events if isinstance(event, Picture))
    assert (first.drone, first.time_ms, bodies[0]) == ("drone-1", T_MS, b"\x00\x01\x02")
    program = "python3 -m fractus_services.recording.thumbnails /var/lib/fractus/recordings/camera --after"
    expected = f"--context=town exec -n fractus-system fractus-camera-x -c camera -- {program}"
    assert calls.read_text().splitlines()[:2] == [f"{expected} 0", f"{expected} {T_MS}"]


async def test_view_keeps_a_limited_number_of_thumbnails(tmp_path: Path) -> None:
    number = MAX_STORED + 5
    script = f"""for i in {{1..{number}}}; do echo '{{"time_ms": {T_MS}, "jpeg": "AAEC"}}'; done"""
    stored: list[bool] = []

    def complete(events: list[Event], pictures: ClusterPictures) -> bool:
        ids = [event.id for event in events if isinstance(event, Picture)]
        stored[:] = [pictures.picture(id_) is not None for id_ in ids]
        return len(ids) == number

    await received(kubectl(tmp_path / "kubectl", script), complete)
    assert stored == [False] * 5 + [True] * MAX_STORED


async def test_missing_permission_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster_pictures, "PODS_INTERVAL_S", 0.05)
    command = kubectl(tmp_path / "kubectl", 'echo "Error: pods is forbidden" >&2; exit 1')

    def problems(events: list[Event]) -> list[str]:
        return [event.problem for event in events if isinstance(event, PictureSource) and event.problem]

    events = await received(command, lambda events, _: bool(problems(events)))
    assert problems(events) == ["drone-1: Error: pods is forbidden"]


def test_pictures_of_a_cluster_need_kubectl(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    result = CliRunner().invoke(view, ["--pictures"])
    assert result.exit_code == 1
    assert "--pictures needs kubectl" in result.output
    result = CliRunner().invoke(view, ["--pictures", "--recordings", str(tmp_path)])
    assert "specify only one source" in result.output
