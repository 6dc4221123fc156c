"""The journal: what survives a torn file, a newer release and a hung disk."""

from __future__ import annotations

import asyncio
import json
import threading
from pathlib import Path

import pytest
from fractus_services.mobility.authority.journal import Journal, Mission


async def kept(directory: Path) -> Journal:
    journal = Journal(directory)
    journal.missions["k"] = Mission("k", "id", points_done=1, home=(39.0, 22.0, 10.0))
    journal.active = "k"
    await journal.save()
    journal.missions["k"].points_done = 2
    await journal.save()
    return journal


@pytest.mark.parametrize("torn", [b"", b"{", b'{"missions": 3}'])
async def test_a_torn_journal_leaves_the_copy_before_it(tmp_path: Path, torn: bytes) -> None:
    await kept(tmp_path)
    (tmp_path / "journal.json").write_bytes(torn)
    found = Journal(tmp_path)
    assert found.active == "k"
    assert found.missions["k"].points_done == 1
    assert found.missions["k"].home == (39.0, 22.0, 10.0)
    await found.save()
    assert json.loads((tmp_path / "journal.last.json").read_bytes())["active"] == "k", (
        "a torn file replaces no sound one"
    )


async def test_what_a_newer_release_wrote_is_left_out(tmp_path: Path) -> None:
    await kept(tmp_path)
    path = tmp_path / "journal.json"
    stored = json.loads(path.read_bytes())
    stored["missions"][0]["novelty"] = 1
    path.write_text(json.dumps(stored))
    assert Journal(tmp_path).missions["k"].points_done == 2


async def test_a_disk_that_fails_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    journal = await kept(tmp_path)
    with monkeypatch.context() as broken:

        def fail(*_: object) -> None:
            raise OSError(28, "No space left on device")

        broken.setattr("fractus_storage.files.os.fsync", fail)
        await journal.save()
        assert "No space left" in journal.failure
    assert not list(tmp_path.glob(".*.tmp"))  # noqa: ASYNC240 - a temporary directory
    await journal.save()
    assert journal.failure == ""


async def test_writings_follow_each_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    journal = Journal(tmp_path)
    free, inside, most = threading.Event(), [0], [0]
    write = journal._write

    def slow(data: bytes) -> None:
        inside[0] += 1
        most[0] = max(most[0], inside[0])
        free.wait(5)
        write(data)
        inside[0] -= 1

    monkeypatch.setattr(journal, "_write", slow)
    journal.missions["k"] = Mission("k", "id")
    await journal.save(timeout_s=0.05)
    assert "not written" in journal.failure
    caller = asyncio.create_task(journal.save())
    await asyncio.sleep(0)
    caller.cancel()
    journal.missions["k"].outcome = "complete"
    last = journal.save_soon()
    free.set()
    await last
    assert most == [1]
    assert Journal(tmp_path).outcomes() == {"k": "complete"}
    assert journal.failure == ""
