"""The segments and checkpoints of audit logs: what they prove, and what cannot be hidden in them."""

from __future__ import annotations

import asyncio
import base64
import errno
import json
import os
import re
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from fractus_agent.registration.diagnostics import read_audit_heads
from fractus_cli.audit import audit
from fractus_core.identity.authority import Authority
from fractus_runtime.audit import AuditLog
from fractus_runtime.audit_chain import last_link, segments, verify
from test_storage_audit import AUTHORITY, EPOCH, read, until, written


async def filled(path: Path, count: int, **bounds: Any) -> None:
    """A log written entry by entry, so that it is closed as often as it can be."""
    log = AuditLog(path, lambda: 0.0, **bounds)
    for n in range(count):
        log.append("call", {"n": n})
        await until(lambda: not log._waiting)
    await log.close()
    assert not log.failure


def verified(*paths: Path | str) -> tuple[int, str]:
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
    assert path.read_bytes() == b"", "it begins at once, so that it is known when it is missing"
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
    """A copy of the checkpoint that a log ends with, after more entries."""
    await filled(path, count, tls=tls, **bounds)
    kept = path.parent.parent / f"kept-{len(list(path.parent.parent.iterdir()))}"
    kept.write_bytes(path.with_suffix(".checkpoint").read_bytes())
    return kept


async def test_only_a_checkpoint_proves_that_the_oldest_segments_went_to_make_room(tmp_path: Path, tls: Path) -> None:
    path = tmp_path / "audit" / "audit.jsonl"
    old = await checkpoint(path, 5, tls, segment_bytes=500, keep=2)
    await filled(path, 30, segment_bytes=500, keep=2)
    recent = await checkpoint(path, 1, tls, segment_bytes=500, keep=2)
    code, said = verified(path)
    assert code == 1
    assert "to make room, which only a checkpoint from before can prove: give it with --since" in said
    code, said = verified(path, "--since", recent)
    assert code == 0, said
    assert "before were removed to make room" in said
    assert re.search(
        r"all since number \d+ are there, as signed by spiffe://fractus.dev/node/drone-1, whose cert", said
    )
    assert "--ca" not in verified(path, "--since", recent, "--ca", tls / "ca.crt")[1]
    code, said = verified(path, "--since", old)
    assert code == 1
    assert "and those since the checkpoint, number 5, are missing" in said
    segments(path)[0].unlink()
    code, said = verified(path, "--since", recent)
    assert code == 1
    assert "the entries before it were removed, and no entry records that" in said


async def test_what_was_removed_and_recorded_by_another_is_found(tmp_path: Path, tls: Path) -> None:
    path = tmp_path / "audit" / "audit.jsonl"
    kept = await checkpoint(path, 12, tls, segment_bytes=500)
    await filled(path, 6)
    gone = segments(path)[:2]
    end = last_link(gone[-1])
    assert end is not None
    log = AuditLog(path, lambda: 0.0)
    log.append("pruned", {"first": 1, "last": end.sequence, "last_hash": end.hash})
    await log.close()
    for segment in gone:
        segment.unlink()
    assert verified(path)[0] == 1
    assert verified(path, "--since", kept)[0] == 0, "what the checkpoint stands for is there"
    for segment in segments(path):
        segment.unlink()
    code, said = verified(path.parent, "--since", kept)
    assert (code, "and those since the checkpoint" in said or "no entry records" in said) == (1, True)


@pytest.mark.parametrize("which", ["end", "rewritten", "emptied", "missing", "log"])
async def test_a_checkpoint_finds_what_the_chain_alone_does_not(tmp_path: Path, tls: Path, which: str) -> None:
    path = tmp_path / "audit" / "audit.jsonl"
    kept = await checkpoint(path, 4, tls)
    if which == "end":
        path.write_bytes(b"".join(read(path)[:3]))
        why = "is number 3, the last one, and the checkpoint is number 4: entries are missing"
    elif which == "rewritten":
        path.unlink()
        await filled(path, 3)
        await filled(path, 3)
        why = "is another entry than the checkpoint's: it and all before it were written again"
    elif which == "emptied":
        path.write_bytes(b"")
        why = "is number 0, the last one"
    elif which == "missing":
        path.rename(path.with_name("audit.000000000001.jsonl"))
        why = "audit.jsonl: is missing; the log is not complete without it"
    else:
        path.rename(path.with_name("other.jsonl"))
        path.with_suffix(".checkpoint").unlink()
        why = "--since: the checkpoint is of audit.jsonl; give that log, or its directory"
    if which not in {"missing", "log"}:
        assert verified(path.parent)[0] == 0
    code, said = verified(path.parent, "--since", kept)
    assert (code, why in said) == (1, True), said


async def test_what_the_status_of_the_node_tells_is_a_checkpoint_too(tmp_path: Path, tls: Path) -> None:
    path = tmp_path / "audit" / "audit.jsonl"
    assert read_audit_heads(path.parent) == []
    await filled(path, 4, tls=tls)
    (head,) = read_audit_heads(path.parent)
    assert head == f"audit:4:{json.loads(read(path)[-1])['hash']}"
    (path.parent / "odd.checkpoint").write_bytes(b"{")
    (path.parent / "other.checkpoint").write_text(json.dumps({"log": "a b", "seq": 1, "hash": "0" * 64}))
    assert read_audit_heads(path.parent) == [head]
    code, said = verified(path, "--since", head)
    assert (code, "all since number 4 are there" in said, "signed" in said) == (0, True, False)
    path.write_bytes(b"".join(read(path)[:3]))
    code, said = verified(path, "--since", head)
    assert code == 1
    assert "entries are missing" in said
    code, said = verified(path, "--since", "audit:4:nonsense")
    assert (code, "No such file" in said) == (1, True)


async def test_a_log_that_is_gone_is_missed_in_its_directory(tmp_path: Path, tls: Path) -> None:
    for name in ("camera", "mobility"):
        await filled(tmp_path / "audit" / f"{name}.jsonl", 2, tls=tls)
    assert verified(tmp_path / "audit")[0] == 0
    (tmp_path / "audit" / "camera.jsonl").unlink()
    code, said = verified(tmp_path / "audit")
    assert code == 1
    assert "camera.jsonl: is missing" in said


@pytest.mark.parametrize("which", ["changed", "other", "component", "nonsense", "twice"])
async def test_a_checkpoint_that_proves_nothing(tmp_path: Path, tls: Path, which: str) -> None:
    path = tmp_path / "audit" / "audit.jsonl"
    kept, more = await checkpoint(path, 4, tls), list[Path]()
    if which == "changed":
        kept.write_bytes(kept.read_bytes().replace(b'"seq":4', b'"seq":3'))
        why = "was changed after it was signed"
    elif which == "other":
        kept = await checkpoint(path, 1, node_files(tls, Authority.generate(EPOCH)))
        (tls / "ca.crt").write_bytes(AUTHORITY.certificate_pem)
        why = "is signed with a certificate of another authority"
    elif which == "component":
        issued = AUTHORITY.issue_component("spiffe://fractus.dev/ns/a/app/b/component/c/instance/d", EPOCH)
        for name, content in issued.items():
            (tls / name).write_bytes(base64.b64decode(content))
        kept, why = await checkpoint(path, 1, tls), "is not signed by a node"
    elif which == "nonsense":
        kept.write_bytes(b"[" * 9_000)
        why = "is no checkpoint"
    else:
        more, why = [await checkpoint(path, 1, tls)], "is the second of audit.jsonl"
    options = [word for file in (kept, *more) for word in ("--since", file)]
    code, said = verified(path, *options, "--ca", tls / "ca.crt")
    assert (code, why in said) == (1, True), said


async def test_a_node_without_a_certificate_has_no_checkpoint_yet(
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


async def test_the_last_entries_are_signed_though_no_other_follows(
    tmp_path: Path, tls: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fractus_runtime.audit.CHECKPOINT_INTERVAL_S", 0.2)
    path = tmp_path / "audit.jsonl"
    found = path.with_suffix(".checkpoint")
    log = AuditLog(path, lambda: 0.0, tls=tls)
    log.append("call", {"n": 0})
    await until(found.exists)
    log.append("call", {"n": 1})
    await until(lambda: json.loads(found.read_bytes())["seq"] == 2)
    before = found.read_bytes()
    await asyncio.sleep(0.5)
    await log.close()
    assert found.read_bytes() == before, "nothing new, nothing signed"


async def test_a_certificate_that_is_missing_is_looked_for_now_and_then(
    tmp_path: Path, tls: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried = []

    def missing(*_: object) -> bytes:
        tried.append(1)
        raise FileNotFoundError

    with monkeypatch.context() as patched:
        patched.setattr("fractus_runtime.audit.CHECKPOINT_INTERVAL_S", 0.1)
        patched.setattr("fractus_runtime.audit.signed", missing)
        path = tmp_path / "audit.jsonl"
        log = AuditLog(path, lambda: 0.0, tls=tls)
        log.append("call", {"n": 0})
        await until(lambda: tried)
        await asyncio.sleep(0.5)
        assert 2 <= len(tried) <= 7
    await log.close()
    assert json.loads(path.with_suffix(".checkpoint").read_bytes())["seq"] == 1


@pytest.mark.parametrize("torn", [b"", b'{"half an en'])
async def test_a_disk_that_became_read_only_is_a_failure_and_no_crash(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, torn: bytes
) -> None:
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


async def test_a_checkpoint_is_not_taken_for_that_of_a_log_of_the_same_name(tmp_path: Path, tls: Path) -> None:
    kept = await checkpoint(tmp_path / "one" / "audit.jsonl", 3, tls)
    await filled(tmp_path / "two" / "audit.jsonl", 3)
    code, said = verified(tmp_path / "one", tmp_path / "two", "--since", kept)
    assert code == 1
    assert "--since: the checkpoint is of audit.jsonl, and there are several" in said
    assert str(tmp_path / "two" / "audit.jsonl") in said
    assert verified(tmp_path / "one", tmp_path / "two")[0] == 0
    assert verified(tmp_path / "one", "--since", kept)[0] == 0


async def test_a_segment_that_cannot_be_closed_costs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr("fractus_runtime.audit.Path.rename", refuse)
    await filled(tmp_path / "audit.jsonl", 4, segment_bytes=1)
    assert "cannot close a segment" in caplog.text
    assert verify(read(tmp_path / "audit.jsonl")).entries == 4
