"""Traffic monitoring example: a picture that is sent again after a path change counts once."""

from __future__ import annotations

import importlib
import json
import os
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import fractus
import pytest
import yaml
from fractus.exchange import Request, Requester, Responder

EXAMPLES = Path(__file__).parents[2] / "examples"
EXAMPLE = EXAMPLES / "traffic-monitoring"


@pytest.fixture
def programs(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Return the modules of the example."""
    monkeypatch.setattr(sys, "path", [str(EXAMPLE), *sys.path])
    names = ("data_store", "image_checker", "pictures")
    for name in names:
        monkeypatch.delitem(sys.modules, name, raising=False)
    modules = {name: importlib.import_module(name) for name in names}
    for name in names:
        monkeypatch.setitem(sys.modules, name, modules[name])
    return modules


@asynccontextmanager
async def serving(**handlers: Any) -> AsyncIterator[Requester]:
    """Yield a client of a server with these handlers."""
    responder = Responder(handlers, 0)
    await responder.start()
    async with Requester(f"127.0.0.1:{responder.port}") as client:
        yield client
    await responder.stop(0.0)


async def test_repeated_picture_counts_once_across_instances(programs: dict[str, Any], tmp_path: Path) -> None:
    pictures = programs["pictures"]
    body = pictures.pack("picture-1", "viewer-1", pictures.render(160, 120, 1))
    path = tmp_path / "results.jsonl"
    store = programs["data_store"].DataStore(path)
    async with serving(store=store.store) as data_store:
        for _ in range(2):  # two instances without shared state
            checker = programs["image_checker"].ImageChecker(data_store)
            async with serving(check=checker.check) as asking:
                response = json.loads(await asking.request("check", body, request_id="r1"))
            assert (response["picture"], response["source"], response["kind"]) == ("picture-1", "viewer-1", "PNG")
    (stored,) = path.read_text().splitlines()
    assert json.loads(stored) == response
    restarted = programs["data_store"].DataStore(path)
    await restarted.store(Request("r2", "store", json.dumps(response | {"by": "another"}).encode()))
    assert len(path.read_text().splitlines()) == 1, "a restarted DataStore knows the results in its file"


async def test_picture_is_checked_again_until_result_is_stored(
    programs: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    attempts = 0

    async def store(_: Request) -> bytes:
        nonlocal attempts
        attempts += 1
        if attempts == 1:
            raise OSError("the store is full")
        return b""

    monkeypatch.setattr(programs["image_checker"], "STORE_TIMEOUT_S", 0.05)
    pictures = programs["pictures"]
    async with serving(store=store) as data_store:
        checker = programs["image_checker"].ImageChecker(data_store)
        async with serving(check=checker.check) as asking:
            await asking.request("check", pictures.pack("picture-1", "viewer-1", pictures.render(160, 120, 1)))
            assert asking.repeated >= 1


async def test_example_refuses_invalid_picture(programs: dict[str, Any]) -> None:
    checker = programs["image_checker"].ImageChecker(Requester("127.0.0.1:1"))
    for body in (b"", b"not json\nx", programs["pictures"].pack("p", "s", b"no picture")):
        with pytest.raises(ValueError, match=" "):
            await checker.check(Request("r", "check", body))


class FullCamera:
    """Fake camera that can store only one picture. Retrieval of every second picture fails."""

    def __init__(self) -> None:
        self.stored: list[str] = []
        self.taken = 0

    take = fractus.Camera.take

    async def capture(self, *_: int, timeout_s: float) -> SimpleNamespace:
        assert timeout_s > 0
        assert not self.stored, "the camera has no space for a second picture"
        self.taken += 1
        self.stored.append(f"picture-{self.taken}")
        return SimpleNamespace(name=self.stored[-1])

    async def retrieve(self, name: str) -> bytes:
        if self.taken % 2:
            raise fractus.PolicyDenied(fractus.Decision(fractus.Action.DENY, reason="not this one"))
        return name.encode()

    async def delete(self, name: str) -> None:
        self.stored.remove(name)


async def test_traffic_example_leaves_no_pictures_on_the_node(programs: dict[str, Any]) -> None:
    camera = FullCamera()
    for number in range(4):
        try:
            assert (await programs["pictures"].take_picture(camera, number))[1] == f"picture-{camera.taken}".encode()
        except fractus.PolicyDenied:
            assert camera.taken % 2
    assert (camera.stored, camera.taken) == ([], 4)


async def test_links_example_leaves_no_pictures_on_the_node(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", [str(EXAMPLES / "links"), *sys.path])
    monkeypatch.delitem(sys.modules, "aerial_viewer", raising=False)
    monkeypatch.delitem(os.environ, "PICTURE_BYTES", raising=False)
    look = importlib.import_module("aerial_viewer").take_picture
    camera = FullCamera()
    with pytest.raises(fractus.PolicyDenied):
        await look(camera)
    assert await look(camera) == b"picture-2"
    assert not camera.stored


def test_components_that_take_pictures_have_delete_method() -> None:
    taking = 0
    for path in sorted(EXAMPLES.rglob("*.yaml")):
        for body in filter(None, yaml.safe_load_all(path.read_text())):
            if body.get("kind") != "Application":
                continue
            for component in body["spec"]["components"]:
                for service in component.get("services", ()):
                    if "CaptureImage" in service.get("methods", ()):
                        taking += 1
                        assert "DeleteImage" in service["methods"], f"{path}: {component['name']}"
    assert taking > 3
