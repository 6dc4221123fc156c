"""Grant files of a node's services: scanning, listeners, invalid files, and the rate limiter of callers."""

from __future__ import annotations

import asyncio
import json
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fractus_core.policy.compiled_grant import CompiledGrant, compile_grant
from fractus_services import grant_files as module
from fractus_services.errors import ResourceExhausted
from fractus_services.grant_files import ActiveGrant, GrantFiles
from fractus_services.grant_verifier import GrantVerifier
from fractus_services.grpc_server import RateLimiter
from grant_signing import CA_PEM, signed
from odd_files import odd_files
from policy_world import spec


def manifest(**changes: Any) -> dict[str, Any]:
    return {
        "apiVersion": "fractus.dev/v1alpha1",
        "kind": "Grant",
        "metadata": {"name": "g", "uid": changes.pop("uid", "u1")},
        "spec": {**spec().to_dict(), **changes},
    }


def body(**changes: Any) -> str:
    return json.dumps(signed(manifest(**changes)))


def grant_files(directory: Path, refused: Any = lambda _name, _why: None) -> GrantFiles:
    tls = directory.parent / f"{directory.name}-tls"
    tls.mkdir(exist_ok=True)
    (tls / "ca.crt").write_bytes(CA_PEM)
    return GrantFiles(directory, "drone-1", GrantVerifier(tls, tls / "seen.json"), refused=refused)


def test_grant_files_report_added_changed_and_removed_grants(tmp_path: Path) -> None:
    changes: list[tuple[str | None, str | None]] = []
    files = grant_files(tmp_path)
    files.listen(lambda old, new: changes.append((old and old.spec.mission, new and new.spec.mission)))
    path = tmp_path / "g.json"
    path.write_text(body())
    files.scan()
    files.scan()
    (grant,) = files.active.values()
    assert isinstance(grant, ActiveGrant)
    assert files.active.get(grant.identity) is grant
    path.write_text(body(uid="u2"))
    files.scan()
    path.write_text("{")
    files.scan()
    assert not files.active
    path.write_text(body(uid="u3"))
    files.scan()
    path.unlink()
    files.scan()
    assert changes == [(None, "u1"), ("u1", "u2"), ("u2", None), (None, "u3"), ("u3", None)]


async def active_within_1_s(files: GrantFiles, count: int) -> None:
    async with asyncio.timeout(1.0):
        while len(files.active) != count:  # noqa: ASYNC110
            await asyncio.sleep(0.01)


async def test_grant_files_revoke_a_removed_grant_within_one_second(tmp_path: Path) -> None:
    directory = tmp_path / "grants"
    files = grant_files(directory)
    watching = asyncio.ensure_future(files.run())
    try:
        path = directory / "g.json"
        while not directory.is_dir():  # noqa: ASYNC110
            await asyncio.sleep(0.01)
        path.write_text(body())
        await active_within_1_s(files, 1)
        path.unlink()
        await active_within_1_s(files, 0)
    finally:
        watching.cancel()
        await asyncio.gather(watching, return_exceptions=True)


async def test_grant_files_grant_nothing_while_their_directory_is_missing(tmp_path: Path) -> None:
    """When the directory is available again, for example after a disk was mounted, its Grants are active again."""
    directory = tmp_path / "grants"
    directory.mkdir()
    (directory / "g.json").write_text(body())
    files = grant_files(directory)
    watching = asyncio.ensure_future(files.run())
    try:
        await active_within_1_s(files, 1)
        directory.rename(tmp_path / "unmounted")
        await active_within_1_s(files, 0)
        (tmp_path / "unmounted").rename(directory)
        await active_within_1_s(files, 1)
    finally:
        watching.cancel()
        await asyncio.gather(watching, return_exceptions=True)


async def test_grant_files_do_not_block_event_loop_while_compiling(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The motion monitor and the heartbeats run on the event loop."""
    begun = threading.Event()
    may_continue = threading.Event()

    def slowly(*args: Any, **options: Any) -> CompiledGrant:
        begun.set()
        assert may_continue.wait(10.0), "the event loop must not wait for the compilation in this thread"
        return compile_grant(*args, **options)

    monkeypatch.setattr(module, "compile_grant", slowly)
    files = grant_files(tmp_path)
    changed = asyncio.Event()
    files.listen(lambda _old, _new: changed.set())
    watching = asyncio.ensure_future(files.run())
    try:
        (tmp_path / "g.json").write_text(body())
        async with asyncio.timeout(20.0):
            await asyncio.to_thread(begun.wait, 10.0)
            assert not files.active
            may_continue.set()
            await changed.wait()
        assert len(files.active) == 1
    finally:
        may_continue.set()
        watching.cancel()
        await asyncio.gather(watching, return_exceptions=True)


@pytest.mark.parametrize(
    "text",
    [
        "", "[]", '{"kind": "Policy"}', body(node="drone-2"), json.dumps(manifest()),
        body(operationArea=[{"polygon": {"exterior": [{"lat": 0, "lon": 0}, {"lat": 1, "lon": 1}, {"lat": 0, "lon": 1}, {"lat": 1, "lon": 0}]}}]),
        json.dumps(manifest(policies=[{"name": "p", "spec": {"type": "GeofenceControl", "kind": "wall"}}])),
        json.dumps(manifest(surprise=1)),
    ],
    ids=["empty", "list", "policy", "other-node", "unsigned", "crossing-area", "unknown-policy", "unknown-field"],
)  # fmt: skip
def test_grant_files_ignore_invalid_file(tmp_path: Path, text: str) -> None:
    (tmp_path / "g.json").write_text(text)
    files = grant_files(tmp_path)
    files.scan()
    assert not files.active


def test_grant_files_use_later_of_two_files_for_one_instance(tmp_path: Path) -> None:
    (tmp_path / "b.json").write_text(body(uid="first"))
    (tmp_path / "a.json").write_text(body(uid="second"))
    files = grant_files(tmp_path)
    files.scan()
    assert [grant.spec.mission for grant in files.active.values()] == ["second"], "the later Grant is active"
    (tmp_path / "a.json").unlink()
    files.scan()
    assert not files.active, "the removal of the later Grant does not activate the earlier Grant"


def test_grant_files_grant_nothing_when_directory_is_missing(tmp_path: Path) -> None:
    files = grant_files(tmp_path / "none")
    files.scan()
    assert not files.active


NESTED = b"[" * 100_000


@pytest.mark.parametrize("odd", [NESTED, b'{"a":' * 5000 + b"1" + b"}" * 5000, b"1" * 5000, b"\0" * 50, b"\xff\xfe{"])
def test_grant_files_read_other_files_when_one_file_is_malformed(tmp_path: Path, odd: bytes) -> None:
    (tmp_path / "a.json").write_bytes(odd)
    (tmp_path / "b.json").write_text(body(uid="sound"))
    (tmp_path / "loop.json").symlink_to("loop.json")
    files = grant_files(tmp_path)
    files.scan()
    assert [grant.spec.mission for grant in files.active.values()] == ["sound"]


def test_grant_files_revoke_grant_when_compilation_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_args: object, **_more: object) -> None:
        raise ZeroDivisionError

    (tmp_path / "a.json").write_text(body())
    files = grant_files(tmp_path)
    files.scan()
    assert files.active
    monkeypatch.setattr("fractus_services.grant_files.compile_grant", broken)
    (tmp_path / "a.json").write_text(body(uid="changed"))
    files.scan()
    assert not files.active, "the previous grant must be revoked too"


def test_grant_files_call_other_listeners_when_one_fails(tmp_path: Path) -> None:
    def broken(_old: ActiveGrant | None, _new: ActiveGrant | None) -> None:
        raise ZeroDivisionError

    missions: list[str] = []
    files = grant_files(tmp_path)
    files.listen(broken)
    files.listen(lambda _old, new: missions.append((new.spec.mission if new else None) or ""))
    (tmp_path / "a.json").write_text(body())
    files.scan()
    assert missions == ["u1"]


def retry_after_s(limiter: RateLimiter, identity: str, time_s: float) -> float:
    """Take a token. Return 0 on success, or the seconds until the next token if none is available."""
    try:
        limiter.take(identity, time_s)
    except ResourceExhausted as refusal:
        return refusal.retry_after_s
    return 0.0


def test_rate_limiter_delays_burst_and_refills() -> None:
    limiter = RateLimiter(rate=10, burst=5)
    assert [retry_after_s(limiter, "a", 0.0) for _ in range(7)] == [0.0] * 5 + [0.1] * 2
    assert retry_after_s(limiter, "b", 0.0) == 0.0, "other callers are not limited"
    assert [retry_after_s(limiter, "a", 0.25) for _ in range(3)] == [0.0, 0.0, pytest.approx(0.05)]
    assert [retry_after_s(limiter, "a", 100.0) for _ in range(6)] == [0.0] * 5 + [0.1]


def test_rate_limiter_forgets_inactive_callers() -> None:
    limiter = RateLimiter(rate=10, burst=5)
    for n in range(2500):
        limiter.take(f"caller-{n}", n * 0.01)
    assert len(limiter._buckets) < 1100


def test_directory_error_during_scan_keeps_service_running_and_grants_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = grant_files(tmp_path)
    monkeypatch.setattr("pathlib.Path.is_dir", lambda _path: (_ for _ in ()).throw(OSError(5, "Input/output error")))
    files.scan()
    assert not files.active


@odd_files
def test_grant_files_refuse_odd_file_and_read_others(tmp_path: Path, make_odd: Callable[[Path], None]) -> None:
    directory = tmp_path / "grants"
    directory.mkdir()
    refusals: list[str] = []
    files = grant_files(directory, lambda name, _reason: refusals.append(name))
    (directory / "sound.json").write_text(body())
    make_odd(directory / "odd.json")
    files.scan()
    assert [grant.spec.mission for grant in files.active.values()] == ["u1"]
    assert refusals == ["odd.json"]
    (directory / "sound.json").unlink()
    files.scan()
    assert not files.active, "a removed Grant is revoked despite the odd file"
    assert refusals == ["odd.json"], "reported once"


@odd_files
def test_grant_that_becomes_an_odd_file_is_revoked_for_good(tmp_path: Path, make_odd: Callable[[Path], None]) -> None:
    directory = tmp_path / "grants"
    directory.mkdir()
    refusals: list[str] = []
    files = grant_files(directory, lambda name, _reason: refusals.append(name))
    path = directory / "g.json"
    path.write_text(granted := body())
    files.scan()
    assert files.active
    path.unlink()
    make_odd(path)
    files.scan()
    assert not files.active
    assert refusals == ["g.json"]
    path.unlink()
    path.write_text(granted)
    files.scan()
    assert not files.active, "only a later Grant replaces a revoked one"


def test_grant_in_a_file_whose_name_is_not_utf8_is_read_and_can_be_reported(tmp_path: Path) -> None:
    directory = tmp_path / "grants"
    directory.mkdir()
    refusals: list[str] = []
    files = grant_files(directory, lambda name, reason: refusals.append(f"{name}: {reason}"))
    (directory / os.fsdecode(b"sound-\xe9.json")).write_text(body())
    (directory / os.fsdecode(b"odd-\xe9.json")).write_text("{")
    files.scan()
    assert len(files.active) == 1
    assert [text.split(":")[0] for text in refusals] == ["odd-\\xe9.json"]
    refusals[0].encode()


def test_grant_files_return_a_grant_when_a_disk_error_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    refusals: list[str] = []
    files = grant_files(tmp_path, lambda name, _reason: refusals.append(name))
    (tmp_path / "g.json").write_text(body())
    with monkeypatch.context() as patch:

        def fail(*_: object) -> bytes:
            raise OSError(5, "Input/output error")

        patch.setattr(module, "read_json", fail)
        for _ in range(3):
            files.scan()
        assert not files.active
        assert refusals == ["g.json"], "reported once"
    files.scan()
    assert files.active


def test_grant_removed_during_a_disk_error_is_revoked_for_good(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = grant_files(tmp_path)
    path = tmp_path / "g.json"
    path.write_text(granted := body())
    files.scan()
    assert files.active
    with monkeypatch.context() as patch:

        def fail(*_: object) -> bytes:
            raise OSError(5, "Input/output error")

        patch.setattr(module, "read_json", fail)
        path.touch()
        files.scan()
        files.scan()
        assert not files.active
        path.unlink()
        files.scan()
    path.write_text(granted)
    files.scan()
    assert not files.active


def test_removed_grant_is_revoked_for_good_beside_a_file_that_cannot_be_read(tmp_path: Path) -> None:
    files = grant_files(tmp_path)
    (tmp_path / "loop.json").symlink_to("loop.json")
    (tmp_path / "g.json").write_text(granted := body())
    files.scan()
    (tmp_path / "g.json").unlink()
    files.scan()
    (tmp_path / "g.json").write_text(granted)
    files.scan()
    assert not files.active


def test_missing_directory_is_reported_once_and_only_after_it_existed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    directory = tmp_path / "grants"
    files = grant_files(directory)
    files.scan()
    assert not caplog.messages
    directory.mkdir()
    files.scan()
    directory.rmdir()
    for _ in range(3):
        files.scan()
    assert [message.split(" (")[0] for message in caplog.messages] == [
        "grants: cannot read directory, nothing is granted"
    ]


def test_grants_in_a_directory_that_cannot_be_listed_are_not_taken_for_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "g.json").write_text(body())
    files = grant_files(tmp_path)
    files.scan()

    def fail(_path: Path) -> None:
        raise PermissionError(13, "Permission denied")

    with monkeypatch.context() as patch:
        patch.setattr("os.scandir", fail)
        files.scan()
        assert not files.active
    files.scan()
    assert files.active, "the Grant was not revoked for good"


def test_grant_removed_while_the_directory_cannot_be_listed_is_revoked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "g.json").write_text(granted := body())
    files = grant_files(tmp_path)
    files.scan()

    def fail(_path: Path) -> None:
        raise OSError(24, "Too many open files")

    with monkeypatch.context() as patch:
        patch.setattr("os.scandir", fail)
        files.scan()
    (tmp_path / "g.json").unlink()
    files.scan()
    (tmp_path / "g.json").write_text(granted)
    files.scan()
    assert not files.active, "the removed Grant was accepted again"
