"""Audit log: written entries, recovery after crashes, and detection of changes."""

from __future__ import annotations

import asyncio
import json
import math
import os
import shutil
import threading
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import pytest
from click.testing import CliRunner
from fractus_cli.audit import audit
from fractus_core.identity.authority import Authority
from fractus_runtime.audit import AuditLog
from fractus_runtime.audit_chain import digest, last_entry, verify

EPOCH = datetime.fromtimestamp(0, UTC)
AUTHORITY = Authority.generate(EPOCH)


async def written(path: Path, count: int, begin: int = 0) -> list[bytes]:
    log = AuditLog(path, lambda: 1_780_000_000.0)
    for i in range(begin, begin + count):
        log.append("call", {"n": i, "value": math.nan, "deep": {"é": [1.5, None, math.inf]}}, now=i % 2 == 0)
    await log.close()
    assert not log.failure
    return read(path)


def read(path: Path) -> list[bytes]:
    return path.read_bytes().splitlines(keepends=True)


async def test_audit_chain_continues_after_a_restart(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    await written(path, 5)
    lines = await written(path, 5, 5)
    finding = verify(lines)
    assert (finding.entries, finding.problem, finding.torn) == (10, "", False)
    assert [json.loads(line)["n"] for line in lines] == list(range(10))
    assert json.loads(lines[0])["value"] == "nan"


async def test_audit_entries_have_the_time_since_boot_despite_clock_steps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steady = iter([50.0, 53.2504, 60.0])
    clock = iter([1_780_000_000.0, 1_779_906_400.0, 1_780_000_010.0])
    monkeypatch.setattr("fractus_runtime.audit.time.clock_gettime", lambda _clock: next(steady))
    log = AuditLog(tmp_path / "audit.jsonl", lambda: next(clock))
    for number in range(3):
        log.append("call", {"n": number})
    await log.close()
    entries = [json.loads(line) for line in read(tmp_path / "audit.jsonl")]
    assert [entry["boot_s"] for entry in entries] == [50.0, 53.25, 60.0]
    assert entries[1]["time"] < entries[0]["time"]
    assert not verify(read(tmp_path / "audit.jsonl")).problem


async def test_audit_log_of_two_writers_has_one_chain(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    first, second = (AuditLog(path, lambda: 0.0) for _ in range(2))
    for number in range(3):
        first.append("call", {"by": "first", "n": number})
    await until(lambda: path.stat().st_size > 0)
    for number in range(3):
        second.append("call", {"by": "second", "n": number})
    await until(lambda: bool(second.failure))
    assert "another process" in second.failure
    await first.close()
    second.append("call", {"by": "second", "n": 3})
    await second.close()
    assert not second.failure
    lines = read(path)
    assert not verify(lines).problem
    written = [(entry["by"], entry["n"]) for entry in map(json.loads, lines)]
    assert written == [("first", n) for n in range(3)] + [("second", n) for n in range(4)]


@pytest.mark.parametrize("which", ["change", "remove", "insert", "swap", "reformat", "rehash", "cut head"])
async def test_audit_verification_detects_a_changed_entry(tmp_path: Path, which: str) -> None:
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


async def test_audit_verification_rejects_deeply_nested_json(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    lines = await written(path, 2)
    path.write_bytes(b"".join(lines) + b"[" * 200_000 + b"\n")
    finding = verify(read(path))
    assert (finding.line, finding.problem) == (3, "is not an audit entry")
    with pytest.raises(ValueError, match="not an audit entry"):
        last_entry(path)


async def test_audit_log_removes_an_incomplete_last_line_and_records_it(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    lines = await written(path, 4)
    path.write_bytes(b"".join(lines[:3]) + lines[3][:40])
    torn = verify(read(path))
    assert (torn.entries, torn.torn, torn.problem) == (3, True, "")
    lines = await written(path, 1, 4)
    assert not verify(lines).problem
    assert json.loads(lines[3])["torn_bytes"] == 40
    assert json.loads(lines[4])["n"] == 4


@pytest.mark.parametrize("length", [65_535, 65_536, 1_000_001, 5_000_000])
@pytest.mark.parametrize("byte", [b"\0", b"x"], ids=["zeros", "text"])
async def test_audit_chain_continues_after_an_incomplete_last_line_of_any_length(
    tmp_path: Path, byte: bytes, length: int
) -> None:
    torn = byte * length
    path = tmp_path / "audit.jsonl"
    lines = await written(path, 2)
    path.write_bytes(b"".join(lines) + torn)
    lines = await written(path, 1, 2)
    assert (verify(lines).entries, verify(lines).problem) == (4, "")
    assert json.loads(lines[2])["torn_bytes"] == len(torn)


async def test_audit_chain_continues_after_an_entry_of_any_length(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    log = AuditLog(path, lambda: 0.0)
    log.append("call", {"reason": "x" * 3_000_000})
    await log.close()
    lines = await written(path, 1)
    assert (verify(lines).entries, verify(lines).problem) == (2, "")


async def test_audit_log_keeps_entries_until_a_full_disk_has_space(tmp_path: Path) -> None:
    folder = tmp_path / "log"
    path = folder / "audit.jsonl"
    log = AuditLog(path, lambda: 0.0)
    shutil.rmtree(folder)  # all writes fail after the removal of the directory
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


async def test_audit_log_has_no_duplicates_after_a_failed_sync(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = os.fsync
    failing = [True]

    def fsync(file: int) -> None:
        if failing:
            failing.pop()
            raise OSError(5, "Input/output error")
        real(file)

    monkeypatch.setattr("fractus_runtime.audit.os.fsync", fsync)
    log = AuditLog(tmp_path / "audit.jsonl", lambda: 0.0)
    log.append("call", {"n": 0})
    await until(lambda: log.failure)
    log.append("call", {"n": 1})
    await until(lambda: not log.failure)
    await log.close()
    finding = verify(read(tmp_path / "audit.jsonl"))
    assert (finding.entries, finding.problem) == (2, "")


async def test_audit_log_removes_the_written_part_of_a_failed_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = {"fsync": os.fsync, "ftruncate": os.ftruncate}
    failing = [True]

    def fails(which: str) -> Callable[..., None]:
        def call(*args: int) -> None:
            if failing:
                raise OSError(5, "Input/output error")
            real[which](*args)

        return call

    for which in real:
        monkeypatch.setattr(f"fractus_runtime.audit.os.{which}", fails(which))
    log = AuditLog(tmp_path / "audit.jsonl", lambda: 0.0)
    log.append("call", {"n": 0})
    await until(lambda: log.failure)
    failing.clear()
    await until(lambda: not log.failure)
    await log.close()
    finding = verify(read(tmp_path / "audit.jsonl"))
    assert (finding.entries, finding.problem) == (1, "")


async def test_audit_log_reports_a_hanging_disk_and_bounds_its_queue(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fractus_runtime.audit.MAX_WAITING", 10)
    monkeypatch.setattr("fractus_runtime.audit.HANG_TIMEOUT_S", 0.02)
    real = os.fsync
    answers = threading.Event()
    sync_requested = threading.Event()

    def fsync(file: int) -> None:
        sync_requested.set()
        answers.wait(10)
        real(file)

    monkeypatch.setattr("fractus_runtime.audit.os.fsync", fsync)
    log = AuditLog(tmp_path / "audit.jsonl", lambda: 0.0)
    log.append("call", {"n": 0})
    await until(sync_requested.is_set)
    await until(lambda: "no response of the disk" in log.failure)
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


async def test_audit_log_rejects_content_that_is_not_json(tmp_path: Path) -> None:
    log = AuditLog(tmp_path / "audit.jsonl", lambda: 0.0)
    with pytest.raises(TypeError):
        log.append("call", {"n": object()})
    log.append("call", {"n": 1})
    await log.close()
    assert verify(read(tmp_path / "audit.jsonl")).entries == 1


async def test_audit_log_records_text_that_is_not_unicode(tmp_path: Path) -> None:
    """A file name may contain any bytes."""
    log = AuditLog(tmp_path / "audit.jsonl", lambda: 0.0)
    log.refused_grant(os.fsdecode(b"\xe9.json"), "é")
    log.append("call", {"n": 1})
    await log.close()
    assert not log.failure
    lines = read(tmp_path / "audit.jsonl")
    assert (verify(lines).entries, verify(lines).problem) == (2, "")
    assert json.loads(lines[0])["name"] == os.fsdecode(b"\xe9.json")


async def test_audit_log_reports_a_path_that_is_no_regular_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "audit.jsonl")
    log = AuditLog(tmp_path / "audit.jsonl", lambda: 0.0)
    log.append("call", {"n": 1})
    await log.close()
    assert "is not a regular file" in log.failure


async def test_audit_verify_command_reports_a_broken_chain(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    lines = await written(path, 3)
    good = CliRunner().invoke(audit, ["verify", str(path)])
    assert good.exit_code == 0
    assert "3 entries, chain sound" in good.output
    path.write_bytes(b"".join((lines[0], lines[2])))
    bad = CliRunner().invoke(audit, ["verify", str(path)])
    assert bad.exit_code == 1
    assert "line 2 does not continue" in bad.output
