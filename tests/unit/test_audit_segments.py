"""Segments and checkpoints of audit logs: rotation, pruning, and detection of changes."""

from __future__ import annotations

import asyncio
import base64
import errno
import json
import os
import re
import time
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from fractus_agent.registration.diagnostics import read_audit_heads
from fractus_cli.audit import audit
from fractus_core.identity.authority import Authority
from fractus_runtime.audit import AuditLog
from fractus_runtime.audit_chain import last_entry, segments, verify
from test_audit_log import AUTHORITY, EPOCH, read, until, written


async def filled(path: Path, count: int, **bounds: Any) -> None:
    """Write entries one by one. The log can then close its segment after each entry."""
    log = AuditLog(path, lambda: 0.0, **bounds)
    for n in range(count):
        log.append("call", {"n": n})
        await until(lambda: not log._waiting)
    await log.close()
    assert not log.failure


def verified(*paths: Path | str) -> tuple[int, str]:
    done = CliRunner().invoke(audit, ["verify", *map(str, paths)])
    return done.exit_code, done.output.strip()


async def test_audit_chain_continues_through_segments_and_restarts(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    await filled(path, 7, segment_bytes=600)
    assert len(segments(path)) >= 2
    await filled(path, 4, segment_bytes=600)
    files = [*segments(path), path]
    every = [line for file in files if file.exists() for line in read(file)]
    assert [json.loads(line)["seq"] for line in every] == list(range(1, 12))
    assert all(file.stat().st_size < 900 for file in files if file.exists())
    code, output = verified(tmp_path)
    assert code == 0
    assert "11 entries, chain sound" in output
    assert verified(files[0])[1].endswith("earlier and later entries were not verified")


async def test_audit_chain_continues_after_a_segment_was_just_closed(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    await filled(path, 3, segment_bytes=1)
    assert path.read_bytes() == b"", "the new segment is created at once, so that its loss is detected"
    await filled(path, 1)
    assert [json.loads(line)["seq"] for line in read(path)] == [4]
    assert verified(path)[0] == 0


@pytest.fixture
def tls(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return node_files(tmp_path_factory.mktemp("tls"), AUTHORITY)


def node_files(directory: Path, authority: Authority) -> Path:
    for name, content in authority.issue_node("drone-1", EPOCH).items():
        (directory / name).write_bytes(base64.b64decode(content))
    return directory


async def checkpoint(path: Path, count: int, tls: Path, **bounds: int) -> Path:
    """Write entries to a log. Return a copy of the last checkpoint."""
    await filled(path, count, tls=tls, **bounds)
    checkpoint_file = path.parent.parent / f"kept-{len(list(path.parent.parent.iterdir()))}"
    checkpoint_file.write_bytes(path.with_suffix(".checkpoint").read_bytes())
    return checkpoint_file


async def test_pruned_segments_are_accepted_only_with_a_checkpoint(tmp_path: Path, tls: Path) -> None:
    path = tmp_path / "audit" / "audit.jsonl"
    old = await checkpoint(path, 5, tls, segment_bytes=500, keep=2)
    await filled(path, 30, segment_bytes=500, keep=2)
    recent = await checkpoint(path, 1, tls, segment_bytes=500, keep=2)
    code, output = verified(path)
    assert code == 1
    assert "to free space, which only an earlier checkpoint can prove; specify it with --since" in output
    code, output = verified(path, "--since", recent)
    assert code == 0, output
    assert "entries were removed to free space" in output
    assert re.search(
        r"complete since entry \d+ \(checkpoint signed by spiffe://fractus.dev/node/drone-1; its cert", output
    )
    assert "--ca" not in verified(path, "--since", recent, "--ca", tls / "ca.crt")[1]
    code, output = verified(path, "--since", old)
    assert code == 1
    assert "entries since the checkpoint, number 5, are missing" in output
    segments(path)[0].unlink()
    code, output = verified(path, "--since", recent)
    assert code == 1
    assert "earlier entries were removed, and no entry records the removal" in output


async def test_checkpoint_detects_a_forged_record_of_pruning(tmp_path: Path, tls: Path) -> None:
    path = tmp_path / "audit" / "audit.jsonl"
    checkpoint_file = await checkpoint(path, 12, tls, segment_bytes=500)
    await filled(path, 6)
    pruned = segments(path)[:2]
    end = last_entry(pruned[-1])
    assert end is not None
    log = AuditLog(path, lambda: 0.0)
    log.append("pruned", {"first": 1, "last": end.sequence, "last_hash": end.hash})
    await log.close()
    for segment in pruned:
        segment.unlink()
    assert verified(path)[0] == 1
    assert verified(path, "--since", checkpoint_file)[0] == 0, "all entries since the checkpoint still exist"
    for segment in segments(path):
        segment.unlink()
    code, output = verified(path.parent, "--since", checkpoint_file)
    assert (code, "and those since the checkpoint" in output or "no entry records" in output) == (1, True)


@pytest.mark.parametrize("which", ["end", "rewritten", "emptied", "missing", "log"])
async def test_checkpoint_detects_changes_that_the_hash_chain_misses(tmp_path: Path, tls: Path, which: str) -> None:
    path = tmp_path / "audit" / "audit.jsonl"
    checkpoint_file = await checkpoint(path, 4, tls)
    if which == "end":
        path.write_bytes(b"".join(read(path)[:3]))
        message = "is the last entry, number 3, but the checkpoint is number 4: entries are missing"
    elif which == "rewritten":
        path.unlink()
        await filled(path, 3)
        await filled(path, 3)
        message = "differs from the checkpoint: this entry and all entries before it were rewritten"
    elif which == "emptied":
        path.write_bytes(b"")
        message = "is the last entry, number 0"
    elif which == "missing":
        path.rename(path.with_name("audit.000000000001.jsonl"))
        message = "audit.jsonl: segment is missing; the log is incomplete without it"
    else:
        path.rename(path.with_name("other.jsonl"))
        path.with_suffix(".checkpoint").unlink()
        message = "--since: the checkpoint belongs to audit.jsonl; add that log or its directory to PATHS"
    if which not in {"missing", "log"}:
        assert verified(path.parent)[0] == 0
    code, output = verified(path.parent, "--since", checkpoint_file)
    assert (code, message in output) == (1, True), output


async def test_checkpoint_of_a_node_status_is_accepted(tmp_path: Path, tls: Path) -> None:
    path = tmp_path / "audit" / "audit.jsonl"
    assert read_audit_heads(path.parent) == []
    await filled(path, 4, tls=tls)
    (head,) = read_audit_heads(path.parent)
    assert head == f"audit:4:{json.loads(read(path)[-1])['hash']}"
    (path.parent / "odd.checkpoint").write_bytes(b"{")
    (path.parent / "other.checkpoint").write_text(json.dumps({"log": "a b", "seq": 1, "hash": "0" * 64}))
    assert read_audit_heads(path.parent) == [head]
    await filled(tmp_path / "gateway" / "gateway.jsonl", 2, tls=tls)
    assert [h.split(":")[:2] for h in read_audit_heads(path.parent, tmp_path / "gateway")] == [
        ["audit", "4"],
        ["gateway", "2"],
    ]
    code, output = verified(path, "--since", head)
    assert (code, "complete since entry 4" in output, "signed" in output) == (0, True, False)
    path.write_bytes(b"".join(read(path)[:3]))
    code, output = verified(path, "--since", head)
    assert code == 1
    assert "entries are missing" in output
    code, output = verified(path, "--since", "audit:4:nonsense")
    assert (code, "No such file" in output) == (1, True)


async def test_removed_log_is_detected_by_its_checkpoint(tmp_path: Path, tls: Path) -> None:
    for name in ("camera", "mobility"):
        await filled(tmp_path / "audit" / f"{name}.jsonl", 2, tls=tls)
    assert verified(tmp_path / "audit")[0] == 0
    (tmp_path / "audit" / "camera.jsonl").unlink()
    code, output = verified(tmp_path / "audit")
    assert code == 1
    assert "camera.jsonl: segment is missing" in output


@pytest.mark.parametrize("which", ["changed", "other", "component", "nonsense", "twice"])
async def test_invalid_checkpoint_is_rejected(tmp_path: Path, tls: Path, which: str) -> None:
    path = tmp_path / "audit" / "audit.jsonl"
    checkpoint_file = await checkpoint(path, 4, tls)
    more = list[Path]()
    if which == "changed":
        checkpoint_file.write_bytes(checkpoint_file.read_bytes().replace(b'"seq":4', b'"seq":3'))
        message = "was changed after it was signed"
    elif which == "other":
        checkpoint_file = await checkpoint(path, 1, node_files(tls, Authority.generate(EPOCH)))
        (tls / "ca.crt").write_bytes(AUTHORITY.certificate_pem)
        message = "is signed with a certificate of another authority"
    elif which == "component":
        issued = AUTHORITY.issue_component("spiffe://fractus.dev/ns/a/app/b/component/c/instance/d", EPOCH)
        for name, content in issued.items():
            (tls / name).write_bytes(base64.b64decode(content))
        checkpoint_file = await checkpoint(path, 1, tls)
        message = "is not signed by a node"
    elif which == "nonsense":
        checkpoint_file.write_bytes(b"[" * 9_000)
        message = "is not a checkpoint"
    else:
        more = [await checkpoint(path, 1, tls)]
        message = "second checkpoint of audit.jsonl"
    options = [word for file in (checkpoint_file, *more) for word in ("--since", file)]
    code, output = verified(path, *options, "--ca", tls / "ca.crt")
    assert (code, message in output) == (1, True), output


async def test_checkpoint_is_not_written_without_a_certificate(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, tls: Path
) -> None:
    path = tmp_path / "audit.jsonl"
    await filled(path, 2, tls=tmp_path)
    assert not path.with_suffix(".checkpoint").exists()
    assert not caplog.text
    (tls / "tls.key").write_bytes(b"nonsense")
    await filled(path, 2, tls=tls)
    assert "cannot write a checkpoint" in caplog.text
    assert verified(path)[0] == 0


async def test_checkpoint_covers_the_last_entries_if_no_entry_follows(
    tmp_path: Path, tls: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fractus_runtime.audit.CHECKPOINT_INTERVAL_S", 0.2)
    path = tmp_path / "audit.jsonl"
    checkpoint_path = path.with_suffix(".checkpoint")
    log = AuditLog(path, lambda: 0.0, tls=tls)
    log.append("call", {"n": 0})
    await until(checkpoint_path.exists)
    log.append("call", {"n": 1})
    await until(lambda: json.loads(checkpoint_path.read_bytes())["seq"] == 2)
    before = checkpoint_path.read_bytes()
    await asyncio.sleep(0.5)
    await log.close()
    assert checkpoint_path.read_bytes() == before, "no checkpoint is signed without a new entry"


async def test_checkpoint_retries_until_a_certificate_exists(
    tmp_path: Path, tls: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried: list[float] = []

    def missing(*_: object) -> bytes:
        tried.append(time.monotonic())
        raise FileNotFoundError

    with monkeypatch.context() as patched:
        patched.setattr("fractus_runtime.audit.CHECKPOINT_INTERVAL_S", 0.1)
        patched.setattr("fractus_runtime.audit.sign_checkpoint", missing)
        path = tmp_path / "audit.jsonl"
        log = AuditLog(path, lambda: 0.0, tls=tls)
        log.append("call", {"n": 0})
        await until(lambda: len(tried) >= 3)
        assert tried[2] - tried[0] > 0.15, "the log pauses between attempts"
    await log.close()
    assert json.loads(path.with_suffix(".checkpoint").read_bytes())["seq"] == 1


@pytest.mark.parametrize("torn", [b"", b'{"half an en'])
async def test_audit_log_reports_a_read_only_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, torn: bytes) -> None:
    path = tmp_path / "audit.jsonl"
    await written(path, 2)
    path.write_bytes(path.read_bytes() + torn)
    real = os.open

    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    def opened(name: Any, flags: int, *args: Any, **named: Any) -> int:
        if flags & (os.O_WRONLY | os.O_RDWR) and str(name) == str(path):
            refuse()
        return real(name, flags, *args, **named)

    looked = Path.open

    def looked_at(file: Path, mode: str = "r", *args: Any, **named: Any) -> Any:
        return looked(file, mode, *args, **named) if mode in {"r", "rb"} else refuse()

    with monkeypatch.context() as patched:
        patched.setattr("fractus_runtime.audit.Path.touch", refuse)
        patched.setattr("fractus_runtime.audit.Path.open", looked_at)
        patched.setattr("fractus_runtime.audit.os.open", opened)
        log = AuditLog(path, lambda: 0.0)
        log.append("call", {"n": 2})
        await until(lambda: "Read-only file system" in log.failure)
    await log.close()
    finding = verify(read(path))
    assert (finding.entries, finding.problem, finding.torn) == (4 if torn else 3, "", False)
    assert [entry.get("torn_bytes") for entry in map(json.loads, read(path))][2:] == ([12, None] if torn else [None])


@pytest.mark.parametrize("which", ["middle", "change", "torn"])
async def test_audit_verification_detects_changed_segments(tmp_path: Path, which: str) -> None:
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
    code, output = verified(tmp_path)
    assert code == 1
    assert f"{second}: line" in output


async def test_audit_verify_command_checks_several_logs(tmp_path: Path) -> None:
    for name in ("mobility", "camera"):
        await filled(tmp_path / f"{name}.jsonl", 2)
    code, output = verified(tmp_path)
    assert (code, output.count("2 entries, chain sound")) == (0, 2)
    code, output = verified(tmp_path / "mobility.jsonl", tmp_path / "camera.jsonl")
    assert (code, output.count("2 entries, chain sound")) == (0, 2)
    assert verified(tmp_path.parent / tmp_path.name)[0] == 0


async def test_checkpoint_of_another_log_with_the_same_name_is_rejected(tmp_path: Path, tls: Path) -> None:
    checkpoint_file = await checkpoint(tmp_path / "one" / "audit.jsonl", 3, tls)
    await filled(tmp_path / "two" / "audit.jsonl", 3)
    code, output = verified(tmp_path / "one", tmp_path / "two", "--since", checkpoint_file)
    assert code == 1
    assert "--since: several logs match the checkpoint of audit.jsonl" in output
    assert str(tmp_path / "two" / "audit.jsonl") in output
    assert verified(tmp_path / "one", tmp_path / "two")[0] == 0
    assert verified(tmp_path / "one", "--since", checkpoint_file)[0] == 0


async def test_audit_log_continues_if_a_segment_cannot_be_closed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr("fractus_runtime.audit.Path.rename", refuse)
    await filled(tmp_path / "audit.jsonl", 4, segment_bytes=1)
    assert "cannot close a segment" in caplog.text
    assert verify(read(tmp_path / "audit.jsonl")).entries == 4
