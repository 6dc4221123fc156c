"""The audit log: what it writes, what survives a crash, what cannot be hidden."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from click.testing import CliRunner
from fractus_services.audit import AuditLog, audit, verify


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
        from fractus_services.audit import digest

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
    for _ in range(1000):
        if log.failure:
            break
        import asyncio

        await asyncio.sleep(0.005)
    assert "cannot be written" in log.failure
    folder.mkdir()
    log.append("call", {"n": 1})
    await log.close()
    assert verify(read(path)).entries == 2
    assert not log.failure


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
