"""Journal of missions: damaged files, other format versions, failed and slow disks."""

from __future__ import annotations

import asyncio
import json
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from fractus_core.control import Mission, Outcome, OutcomeKind
from fractus_services.mobility.authority.journal import Journal, JournalContent


def record(**changes: Any) -> JournalContent:
    """Return journal content with one mission. It is the active mission."""
    return JournalContent({"k": replace(Mission("k", "id", home=(39.0, 22.0, 10.0)), **changes)}, "k")


async def saved_journal(directory: Path) -> Journal:
    journal = Journal(directory)
    await journal.save(record(points_done=1))
    await journal.save(record(points_done=2))
    return journal


@pytest.mark.parametrize("torn", [b"", b"{", b'{"missions": 3}', b'{"missions": [3]}', b"[]", b"[" * 90_000])
async def test_journal_restores_previous_copy_when_file_is_damaged(tmp_path: Path, torn: bytes) -> None:
    await saved_journal(tmp_path)
    (tmp_path / "journal.json").write_bytes(torn)
    journal = Journal(tmp_path)
    assert journal.record.active == "k"
    assert journal.record.missions["k"].points_done == 1
    assert journal.record.missions["k"].home == (39.0, 22.0, 10.0)
    await journal.save(journal.record)
    assert json.loads((tmp_path / "journal.last.json").read_bytes())["active"] == "k", (
        "a damaged file must not replace a valid one"
    )


@pytest.mark.parametrize(
    ("stored", "outcome"),
    [
        ("", None),
        ("complete", Outcome(OutcomeKind.COMPLETE)),
        ("failed: driver lost: it left", Outcome(OutcomeKind.FAILED, "driver lost: it left")),
        ("revoked: the grant was removed", Outcome(OutcomeKind.REVOKED, "the grant was removed")),
    ],
)
async def test_journal_reads_format_version_1(tmp_path: Path, stored: str, outcome: Outcome | None) -> None:
    mission = {"key": "k", "identity": "id", "outcome": stored, "points_done": 2, "waypoints": 3, "flown": True}
    body = {"version": 1, "active": "k", "missions": [{**mission, "home": [39, 22, 10]}]}
    (tmp_path / "journal.json").write_text(json.dumps(body))
    stored = Journal(tmp_path).record
    assert stored == JournalContent({"k": Mission("k", "id", outcome, 2, 3, True, (39.0, 22.0, 10.0), True)}, "k")


@pytest.mark.parametrize("odd", ["lost in space", {"kind": "lost", "reason": ""}, {"kind": "failed"}, 7, ["failed"]])
async def test_journal_reads_unknown_mission_outcome_as_failed(tmp_path: Path, odd: object) -> None:
    body = {"version": 3, "active": None, "missions": [{"key": "k", "identity": "id", "outcome": odd}]}
    (tmp_path / "journal.json").write_text(json.dumps(body))
    outcome = Journal(tmp_path).record.missions["k"].outcome
    assert outcome is not None
    assert outcome.kind is OutcomeKind.FAILED


async def test_journal_logs_loss_of_both_copies(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    await saved_journal(tmp_path)
    for name in ("journal.json", "journal.last.json"):
        (tmp_path / name).write_bytes(b"{")
    assert Journal(tmp_path).record == JournalContent()
    assert "remove Grants that must not fly again" in caplog.text


async def test_journal_ignores_fields_of_newer_release(tmp_path: Path) -> None:
    await saved_journal(tmp_path)
    path = tmp_path / "journal.json"
    stored = json.loads(path.read_bytes())
    stored["missions"][0]["novelty"] = 1
    path.write_text(json.dumps(stored))
    assert Journal(tmp_path).record.missions["k"].points_done == 2


async def test_journal_keeps_armed_by_others(tmp_path: Path) -> None:
    journal = Journal(tmp_path)
    await journal.save(replace(record(), armed_by_others=True))
    assert Journal(tmp_path).record.armed_by_others
    await journal.save(record())
    assert not Journal(tmp_path).record.armed_by_others


async def test_journal_reports_failed_disk_until_next_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    journal = await saved_journal(tmp_path)
    with monkeypatch.context() as broken:

        def fail(*_: object) -> None:
            raise OSError(28, "No space left on device")

        broken.setattr("fractus_runtime.files.os.fsync", fail)
        await journal.save(journal.record)
        assert "No space left" in journal.failure
    assert not list(tmp_path.glob(".*.tmp"))  # noqa: ASYNC240 - a temporary directory
    await journal.save(journal.record)
    assert journal.failure == ""


async def test_journal_writes_one_record_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    journal = Journal(tmp_path)
    free = threading.Event()
    inside = [0]
    most = [0]
    write = journal._write

    def slow(data: bytes) -> None:
        inside[0] += 1
        most[0] = max(most[0], inside[0])
        free.wait(5)
        write(data)
        inside[0] -= 1

    monkeypatch.setattr(journal, "_write", slow)
    await journal.save(record(), timeout_s=0.05)
    assert "not written" in journal.failure
    caller = asyncio.create_task(journal.save(record()))
    await asyncio.sleep(0)
    caller.cancel()
    last = journal.save_soon(record(outcome=Outcome(OutcomeKind.FAILED, "driver lost: it left")))
    free.set()
    await last
    assert most == [1]
    assert Journal(tmp_path).record.missions["k"].outcome == Outcome(OutcomeKind.FAILED, "driver lost: it left")
    assert journal.failure == ""


async def test_journal_restores_landing_place(tmp_path: Path) -> None:
    await Journal(tmp_path).save(record(land_at=(39.25, 22.5)))
    assert Journal(tmp_path).record.missions["k"].land_at == (39.25, 22.5)
