"""The traffic monitoring example: a picture that comes again after a change of path counts once."""

from __future__ import annotations

import importlib
import json
import sys
from email.message import Message
from pathlib import Path
from typing import Any

import pytest
from fractus.exchange import Request, Requester, Responder

EXAMPLE = Path(__file__).parents[2] / "examples" / "traffic-monitoring"


@pytest.fixture
def programs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> dict[str, Any]:
    """The example's modules; results go from ImageCheckers to one DataStore without a network."""
    monkeypatch.setattr(sys, "path", [str(EXAMPLE), *sys.path])
    names = ("data_store", "image_checker", "pictures", "web")
    for name in names:
        monkeypatch.delitem(sys.modules, name, raising=False)
    found = {name: importlib.import_module(name) for name in names}
    for name in names:
        monkeypatch.setitem(sys.modules, name, found[name])
    monkeypatch.setattr(found["data_store"], "RESULTS", tmp_path / "results.jsonl")
    monkeypatch.setenv("FRACTUS_SERVICE_DATA_STORE", "data-store:8080")
    monkeypatch.setattr(
        found["image_checker"], "post", lambda _to, _path, body, _headers: found["data_store"].keep(body, Message())
    )
    return found


async def test_two_instances_and_one_picture(programs: dict[str, Any]) -> None:
    check, pictures = programs["image_checker"].check, programs["pictures"]
    body = pictures.pack("picture-1", "viewer-1", pictures.render(160, 120, 1))
    for _ in range(2):  # instances, each of which knows nothing of the other
        responder = Responder({"check": check}, 0)
        await responder.start()
        async with Requester(f"127.0.0.1:{responder.port}") as asking:
            answer = json.loads(await asking.ask("check", body, request_id="r1"))
        await responder.stop(0.0)
        assert (answer["picture"], answer["source"], answer["kind"]) == ("picture-1", "viewer-1", "PNG")
    (kept,) = programs["data_store"].results(b"", Message())
    assert kept["request"] == "r1"


async def test_what_is_no_picture_is_refused(programs: dict[str, Any]) -> None:
    for body in (b"", b"not json\nx", programs["pictures"].pack("p", "s", b"no picture")):
        with pytest.raises(ValueError, match=" "):
            await programs["image_checker"].check(Request("r", "check", body))
