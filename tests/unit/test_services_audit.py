"""The audit log: what it writes, what survives a crash, what cannot be hidden."""

from __future__ import annotations

import asyncio
import json
import math
import os
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner
from fractus_cli.audit import audit
from fractus_services.audit import AuditLog
from fractus_services.chain import digest, segments, verify


async def written(path: Path, count: int, begin: int = 0) -> list[bytes]:
    log = AuditLog(path, lambda: 1_780_000_000.0)
    for i in range(begin, begin + count):
        log.append("call", {"n": i, "value": math.nan, "deep": {"é": [1.5, None, math.inf]}}, now=i % 2 == 0)
    await log.close()
    assert not log.failure
    return read(path)


def read(path: Path) -> list[bytes]:
    return path.read_bytes().splitlines(keepends=True)


async def test_a_sound_chain_goes_on_after_a_restart(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    await written(path, 5)
    lines = await written(path, 5, 5)
    finding = verify(lines)
    assert (finding.entries, finding.problem, finding.torn) == (10, "", False)
    assert [json.loads(line)["n"] for line in lines] == list(range(10))
    assert json.loads(lines[0])["value"] == "nan"


@pytest.mark.parametrize("which", ["change", "remove", "insert", "swap", "reformat", "rehash", "cut head"])
async def test_no_entry_can_be_touched(tmp_path: Path, which: str) -> None:
    lines = await written(tmp_path / "audit.jsonl", 6)
    if which == "change":
        lines[2] = lines[2].replace(b'"n":2', b'"n":7')
    elif which == "remove":
        del lines[3]
    elif which == "insert":
        lines.insert(3, lines[2])
    elif which == "swap":
        lines[2], lines[3] = lines[3], lines[2]
    elif which == "reformat":
        lines[2] = json.dumps(json.loads(lines[2])).encode() + b"\n"
    elif which == "rehash":
        entry = json.loads(lines[2])
        entry["n"] = 99
        entry["hash"] = digest(entry)
        lines[2] = json.dumps(entry, sort_keys=True, separators=(",", ":"), ensure_ascii=False).encode() + b"\n"
    else:
        del lines[0]
    finding = verify(lines)
    assert finding.problem
    assert finding.line in {1, 3, 4}


async def test_a_torn_last_line_is_cut_off_and_noted(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    lines = await written(path, 4)
    path.write_bytes(b"".join(lines[:3]) + lines[3][:40])
    torn = verify(read(path))
    assert (torn.entries, torn.torn, torn.problem) == (3, True, "")
    lines = await written(path, 1, 4)
    assert not verify(lines).problem
    assert json.loads(lines[3])["torn_bytes"] == 40
    assert json.loads(lines[4])["n"] == 4


async def test_a_full_disk_is_told_and_nothing_is_lost_when_there_is_room_again(tmp_path: Path) -> None:
    folder = tmp_path / "log"
    path = folder / "audit.jsonl"
    log = AuditLog(path, lambda: 0.0)
    folder.rmdir()  # any write fails now
    log.append("call", {"n": 0})
    await until(lambda: log.failure)
    assert "cannot be written" in log.failure
    folder.mkdir()
    log.append("call", {"n": 1})
    await log.close()
    assert verify(read(path)).entries == 2
    assert not log.failure


async def until(condition: Callable[[], object]) -> None:
    for _ in range(1000):
        if condition():
            return
        await asyncio.sleep(0.005)
    raise AssertionError("it never happened")


async def test_a_sync_that_fails_leaves_nothing_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real, failing = os.fsync, [True]

    def fsync(file: int) -> None:
        if failing:
            failing.pop()
            raise OSError(5, "Input/output error")
        real(file)

    monkeypatch.setattr("fractus_services.audit.os.fsync", fsync)
    log = AuditLog(tmp_path / "audit.jsonl", lambda: 0.0)
    log.append("call", {"n": 0})
    await until(lambda: log.failure)
    log.append("call", {"n": 1})
    await until(lambda: not log.failure)
    await log.close()
    finding = verify(read(tmp_path / "audit.jsonl"))
    assert (finding.entries, finding.problem) == (2, "")


async def test_what_a_failed_write_left_is_cut_off_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = {"fsync": os.fsync, "ftruncate": os.ftruncate}
    failing = [True]

    def fails(which: str) -> Callable[..., None]:
        def call(*args: int) -> None:
            if failing:
                raise OSError(5, "Input/output error")
            real[which](*args)

        return call

    for which in real:
        monkeypatch.setattr(f"fractus_services.audit.os.{which}", fails(which))
    log = AuditLog(tmp_path / "audit.jsonl", lambda: 0.0)
    log.append("call", {"n": 0})
    await until(lambda: log.failure)
    failing.clear()
    await until(lambda: not log.failure)
    await log.close()
    finding = verify(read(tmp_path / "audit.jsonl"))
    assert (finding.entries, finding.problem) == (1, "")


async def test_a_disk_that_hangs_is_a_failure_and_the_queue_has_an_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fractus_services.audit.MAX_WAITING", 10)
    monkeypatch.setattr("fractus_services.audit.HANG_TIMEOUT_S", 0.02)
    real, answers, asked = os.fsync, threading.Event(), threading.Event()

    def fsync(file: int) -> None:
        asked.set()
        answers.wait(10)
        real(file)

    monkeypatch.setattr("fractus_services.audit.os.fsync", fsync)
    log = AuditLog(tmp_path / "audit.jsonl", lambda: 0.0)
    log.append("call", {"n": 0})
    await until(asked.is_set)
    await until(lambda: "has not answered" in log.failure)
    for n in range(1, 25):
        log.append("call", {"n": n})
    answers.set()
    await until(lambda: not log.failure)
    await until(lambda: not log._waiting)
    log.append("call", {"n": 25})
    await log.close()
    lines = read(tmp_path / "audit.jsonl")
    assert not verify(lines).problem
    entries = [json.loads(line) for line in lines]
    assert [e["n"] for e in entries if e["kind"] == "call"] == [*range(10), 25]
    assert [(e["seq"], e["entries"]) for e in entries if e["kind"] == "lost"] == [(11, 15)]


async def test_what_is_no_json_is_the_callers_error(tmp_path: Path) -> None:
    log = AuditLog(tmp_path / "audit.jsonl", lambda: 0.0)
    with pytest.raises(TypeError):
        log.append("call", {"n": object()})
    log.append("call", {"n": 1})
    await log.close()
    assert verify(read(tmp_path / "audit.jsonl")).entries == 1


async def filled(path: Path, count: int, **bounds: int) -> None:
    """A log written entry by entry, so that it is closed as often as it can be."""
    log = AuditLog(path, lambda: 0.0, **bounds)
    for n in range(count):
        log.append("call", {"n": n})
        await until(lambda: not log._waiting)
    await log.close()
    assert not log.failure


def verified(*paths: Path) -> tuple[int, str]:
    done = CliRunner().invoke(audit, ["verify", *map(str, paths)])
    return done.exit_code, done.output.strip()


async def test_the_chain_goes_on_through_segments_and_restarts(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    await filled(path, 7, segment_bytes=600)
    assert len(segments(path)) >= 2
    await filled(path, 4, segment_bytes=600)
    files = [*segments(path), path]
    every = [line for file in files if file.exists() for line in read(file)]
    assert [json.loads(line)["seq"] for line in every] == list(range(1, 12))
    assert all(file.stat().st_size < 900 for file in files if file.exists())
    code, said = verified(tmp_path)
    assert code == 0
    assert "11 entries, chain sound" in said
    assert verified(files[0])[1].endswith("what came before and after is not judged")


async def test_a_log_that_was_just_closed_is_continued(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    await filled(path, 3, segment_bytes=1)
    assert not path.exists()
    await filled(path, 1)
    assert [json.loads(line)["seq"] for line in read(path)] == [4]
    assert verified(path)[0] == 0


async def test_the_oldest_segments_go_and_the_log_says_so(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    await filled(path, 30, segment_bytes=500, keep=2)
    await until(lambda: len(segments(path)) <= 3)
    code, said = verified(path)
    assert code == 0, said
    assert "before were removed to make room" in said
    segments(path)[0].unlink()
    code, said = verified(path)
    assert code == 1
    assert "the entries before it were removed, and no entry records that" in said


@pytest.mark.parametrize("which", ["middle", "change", "torn"])
async def test_segments_cannot_be_touched(tmp_path: Path, which: str) -> None:
    path = tmp_path / "audit.jsonl"
    await filled(path, 12, segment_bytes=500)
    second = segments(path)[1]
    if which == "middle":
        second.unlink()
        second = segments(path)[1]
    elif which == "change":
        second.write_bytes(second.read_bytes().replace(b'"kind":"call"', b'"kind":"cool"', 1))
    else:
        second.write_bytes(second.read_bytes()[:-5])
    code, said = verified(tmp_path)
    assert code == 1
    assert f"{second}: line" in said


async def test_several_logs_at_once(tmp_path: Path) -> None:
    for name in ("mobility", "camera"):
        await filled(tmp_path / f"{name}.jsonl", 2)
    code, said = verified(tmp_path)
    assert (code, said.count("2 entries, chain sound")) == (0, 2)
    code, said = verified(tmp_path / "mobility.jsonl", tmp_path / "camera.jsonl")
    assert (code, said.count("2 entries, chain sound")) == (0, 2)
    assert verified(tmp_path.parent / tmp_path.name)[0] == 0


async def test_a_segment_that_cannot_be_closed_costs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr("fractus_services.audit.Path.rename", refuse)
    await filled(tmp_path / "audit.jsonl", 4, segment_bytes=1)
    assert "cannot close a segment" in caplog.text
    assert verify(read(tmp_path / "audit.jsonl")).entries == 4


async def test_the_command(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    lines = await written(path, 3)
    good = CliRunner().invoke(audit, ["verify", str(path)])
    assert good.exit_code == 0
    assert "3 entries, chain sound" in good.output
    path.write_bytes(b"".join((lines[0], lines[2])))
    bad = CliRunner().invoke(audit, ["verify", str(path)])
    assert bad.exit_code == 1
    assert "line 2 does not continue" in bad.output
