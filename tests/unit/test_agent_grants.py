"""Grant synchronization: stored files and reported phases."""

import json
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self, cast

import pytest
from fractus_agent.grant_synchronizer import (
    UNVERIFIED_TIMEOUT_S,
    GrantDirectory,
    GrantSynchronizer,
    grant_report,
    keep_final_phase,
    mission_outcome,
    serialize_grant,
)
from fractus_agent.store import GrantList, KubeError, Store
from fractus_core.api.grants import Grant, ReportedGrant, ReportedPictures, ReportedWaypoints, pack
from fractus_core.control import Outcome, OutcomeKind, WaypointCounts
from fractus_core.policy.grant_signatures import BadSignature, UnknownAuthority
from fractus_runtime.backoff import Backoff

COMPLETE = Outcome(OutcomeKind.COMPLETE)
FAILED = Outcome(OutcomeKind.FAILED, "driver lost")
KEY = "spiffe://fractus.dev/ns/default/app/app/component/Navigator/instance/app-navigator#u1"


def manifest(name: str = "g1", uid: str = "u1", version: str = "1", **more: Any) -> dict[str, Any]:
    return {
        "apiVersion": "fractus.dev/v1alpha1",
        "kind": "Grant",
        "metadata": {"name": name, "uid": uid, "generation": 1, "resourceVersion": version} | more.pop("metadata", {}),
        "spec": {
            "node": "drone-1",
            "application": {"namespace": "default", "name": "app", "uid": "a"},
            "component": "Navigator",
            "instance": "app-navigator",
            "mission": uid,
        }
        | more.pop("spec", {}),
        **more,
    }


def grant_list(
    *manifests: dict[str, Any],
    generation: int = 1,
    reported: Sequence[ReportedGrant] = (),
    reported_generation: int = 1,
) -> GrantList:
    return GrantList(generation, manifests, {report.uid: report for report in reported}, reported_generation)


def report(phase: str, message: str = "", name: str = "g1", uid: str = "u1") -> ReportedGrant:
    return ReportedGrant.model_validate(
        {"uid": uid, "name": name, "phase": phase, "message": message, "observedGeneration": 1}
    )


class FakeStore:
    """Fake store that records the reports of all Grants."""

    def __init__(self) -> None:
        self.reports: list[dict[str, ReportedGrant]] = []
        self.generation = 0
        self.down = False
        self.absent = False

    async def report_grants(self, generation: int, reports: Sequence[ReportedGrant]) -> bool:
        if self.down:
            raise KubeError(0, "Unreachable", "down")
        if not self.absent:
            self.generation = generation
            self.reports.append({report.name: report for report in reports})
        return not self.absent

    def phases(self, name: str = "g1") -> list[str]:
        return [reports[name].phase for reports in self.reports]

    async def grants(self) -> AsyncIterator[GrantList]:
        raise NotImplementedError
        yield


def accept(_grant: Grant) -> None:
    """Accept every signature."""


@pytest.fixture
def store() -> FakeStore:
    return FakeStore()


@pytest.fixture
def synchronizer(store: FakeStore, tmp_path: Path) -> GrantSynchronizer:
    directory = GrantDirectory(tmp_path)
    directory.open()
    return GrantSynchronizer(store, directory, "drone-1", accept)


def on_disk(path: Path) -> set[str]:
    return {p.name for p in path.iterdir()}


def test_grants_missing_from_the_list_are_removed(synchronizer: GrantSynchronizer, tmp_path: Path) -> None:
    synchronizer.apply(grant_list(manifest("g1"), manifest("g2")))
    assert on_disk(tmp_path) == {"g1.json", "g2.json"}
    synchronizer.apply(GrantList(1, None, {}, 0))
    assert on_disk(tmp_path) == {"g1.json", "g2.json"}, "a list with changed reports only does not remove files"
    synchronizer.apply(grant_list(manifest("g2"), manifest("g3")))
    assert on_disk(tmp_path) == {"g2.json", "g3.json"}


def test_new_agent_removes_stored_grants_missing_from_the_list(store: FakeStore, tmp_path: Path) -> None:
    (tmp_path / "old.json").write_text("{}")
    (tmp_path / ".half.json.tmp").write_text("{")
    directory = GrantDirectory(tmp_path)
    directory.open()
    assert on_disk(tmp_path) == {"old.json"}
    GrantSynchronizer(store, directory, "drone-1", accept).apply(grant_list())
    assert on_disk(tmp_path) == set()


def test_grant_file_is_rewritten_only_if_its_content_changes(synchronizer: GrantSynchronizer, tmp_path: Path) -> None:
    synchronizer.apply(grant_list(manifest()))
    file = tmp_path / "g1.json"
    assert Grant.from_body(json.loads(file.read_text())).spec.identity.endswith("/instance/app-navigator")
    assert file.stat().st_mode & 0o777 == 0o600
    first = file.stat().st_ino
    synchronizer.apply(grant_list(manifest(version="2", status={"phase": "Active"})))
    assert file.stat().st_ino == first
    synchronizer.apply(grant_list(manifest(version="3", spec={"control": "full"})))
    assert file.stat().st_ino != first
    assert json.loads(file.read_text())["spec"]["control"] == "full"


def test_grant_of_another_node_is_not_stored(synchronizer: GrantSynchronizer, tmp_path: Path) -> None:
    synchronizer.apply(grant_list(manifest("g1"), manifest("g2")))
    synchronizer.apply(grant_list(manifest("g1"), manifest("g2", spec={"node": "drone-2"})))
    assert on_disk(tmp_path) == {"g1.json"}


async def test_invalid_grant_is_removed_and_reported_as_failed(
    synchronizer: GrantSynchronizer, store: FakeStore, tmp_path: Path
) -> None:
    synchronizer.apply(grant_list(manifest()))
    synchronizer.apply(grant_list(manifest(spec={"newRestriction": True})))
    assert on_disk(tmp_path) == set()
    await synchronizer.report_once()
    (reported,) = store.reports[-1].values()
    assert (reported.name, reported.uid, reported.phase) == ("g1", "u1", "Failed")
    assert "spec.newRestriction" in reported.message


async def test_phases_are_reported_once_and_after_outages(synchronizer: GrantSynchronizer, store: FakeStore) -> None:
    synchronizer.apply(grant_list(manifest()))
    store.down = True
    with pytest.raises(KubeError):
        await synchronizer.report_once()
    store.down = False
    await synchronizer.report_once()
    await synchronizer.report_once()
    assert store.phases() == ["Active"]
    synchronizer.set_missions({KEY: FAILED})
    await synchronizer.report_once()
    assert store.reports[-1] == {"g1": report("Failed", "driver lost")}


async def test_new_agent_does_not_repeat_reports(synchronizer: GrantSynchronizer, store: FakeStore) -> None:
    synchronizer.apply(grant_list(manifest(), reported=[report("Active")]))
    await synchronizer.report_once()
    assert store.reports == []


async def test_reports_lost_by_the_api_server_are_repeated(synchronizer: GrantSynchronizer, store: FakeStore) -> None:
    synchronizer.apply(grant_list(manifest(), generation=4))
    await synchronizer.report_once()
    synchronizer.apply(GrantList(5, None, {}, 0))
    await synchronizer.report_once()
    assert store.phases() == ["Active", "Active"]
    assert store.generation == 5


async def test_report_contains_all_grants_of_the_list(synchronizer: GrantSynchronizer, store: FakeStore) -> None:
    synchronizer.apply(grant_list(manifest(), manifest("g2", "u2"), reported=[report("Active")]))
    await synchronizer.report_once()
    assert store.reports == [{"g1": report("Active"), "g2": report("Active", name="g2", uid="u2")}]
    synchronizer.apply(grant_list(manifest("g2", "u2"), reported=list(store.reports[-1].values())))
    await synchronizer.report_once()
    assert store.reports[-1] == {"g2": report("Active", name="g2", uid="u2")}


async def test_reports_wait_for_the_node_grants_object(synchronizer: GrantSynchronizer, store: FakeStore) -> None:
    store.absent = True
    synchronizer.apply(grant_list(manifest()))
    await synchronizer.report_once()
    store.absent = False
    await synchronizer.report_once()
    assert store.phases() == ["Active"]


async def test_recreated_grant_is_reported_again(synchronizer: GrantSynchronizer, store: FakeStore) -> None:
    synchronizer.set_missions({KEY: COMPLETE})
    for uid in ("u1", "u2"):
        synchronizer.apply(grant_list(manifest(uid=uid)))
        await synchronizer.report_once()
    synchronizer.apply(grant_list(manifest(uid="u3")))
    await synchronizer.report_once()
    assert store.phases() == ["Complete", "Active", "Active"]


async def test_grant_is_pending_until_it_can_be_stored(
    synchronizer: GrantSynchronizer, store: FakeStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("os.fsync", full)
        synchronizer.apply(grant_list(manifest()))
    await synchronizer.report_once()
    assert store.phases()[-1] == "Pending"
    assert "No space left" in store.reports[-1]["g1"].message
    synchronizer.retry_disk()
    await synchronizer.report_once()
    assert store.phases()[-1] == "Active"


async def test_failed_disk_write_is_retried_within_seconds(
    store: FakeStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    now_s = [0.0]
    waits_s: list[float] = []

    async def repeated(_name: str, step: Callable[[], Awaitable[float]], _changed: object) -> None:
        for _ in range(4):
            waits_s.append(await step())
            now_s[0] += waits_s[-1]

    directory = GrantDirectory(tmp_path)
    synchronizer = GrantSynchronizer(store, directory, "drone-1", accept, monotonic=lambda: now_s[0])
    monkeypatch.setattr("fractus_agent.grant_synchronizer.repeat", repeated)
    with monkeypatch.context() as patch:
        patch.setattr("fractus_agent.grant_synchronizer.write_file", full)
        synchronizer.apply(grant_list(manifest()))
        await synchronizer.report()
    assert max(waits_s) <= 5
    assert caplog.text.count("cannot write to disk") == 1, "the failure is logged once"
    waits_s.clear()
    await synchronizer.report()
    assert on_disk(tmp_path) == {"g1.json"}
    assert waits_s == [60.0] * 4


def test_outdated_grant_is_removed_if_its_change_cannot_be_stored(
    synchronizer: GrantSynchronizer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    synchronizer.apply(grant_list(manifest()))
    stored = (tmp_path / "g1.json").read_bytes()
    narrower = manifest()
    narrower["spec"]["limits"] = {"maxAltitude": 10, "maxSpeed": 5}
    annotated = manifest()
    annotated["metadata"]["annotations"] = {"note": "new"}
    with monkeypatch.context() as patch:
        patch.setattr("fractus_agent.grant_synchronizer.write_file", full)
        synchronizer.apply(grant_list(annotated))
        assert (tmp_path / "g1.json").read_bytes() == stored, (
            "the stored file stays, because only annotations have changed"
        )
        synchronizer.apply(grant_list(narrower))
        assert on_disk(tmp_path) == set()
        assert synchronizer.counts()["unstored"] == 1
    synchronizer.retry_disk()
    assert json.loads((tmp_path / "g1.json").read_bytes())["spec"]["limits"]["maxAltitude"] == 10


def test_unreadable_grant_file_is_kept_if_the_grant_is_unchanged(
    synchronizer: GrantSynchronizer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The agent has no file descriptors left, so it cannot read files.

    It could still remove files, but must not remove a valid Grant.
    """

    def unreadable(_path: Path) -> bytes:
        raise OSError(24, "Too many open files")

    synchronizer.apply(grant_list(manifest()))
    narrower = manifest()
    narrower["spec"]["limits"] = {"maxAltitude": 10, "maxSpeed": 5}
    with monkeypatch.context() as patch:
        patch.setattr("fractus_agent.grant_synchronizer.read_file", unreadable)
        synchronizer.apply(grant_list(manifest(), generation=2))
        assert on_disk(tmp_path) == {"g1.json"}
        synchronizer.apply(grant_list(narrower, generation=3))
        assert on_disk(tmp_path) == set()
    synchronizer.retry_disk()
    assert json.loads((tmp_path / "g1.json").read_bytes())["spec"]["limits"]["maxAltitude"] == 10


def test_outdated_grant_is_removed_to_free_disk_space(
    synchronizer: GrantSynchronizer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def tight(path: Path, content: bytes) -> None:
        if path.exists():
            raise OSError(28, "No space left on device")
        path.write_bytes(content)

    synchronizer.apply(grant_list(manifest()))
    monkeypatch.setattr("fractus_agent.grant_synchronizer.write_file", tight)
    narrower = manifest()
    narrower["spec"]["limits"] = {"maxAltitude": 10, "maxSpeed": 5}
    synchronizer.apply(grant_list(narrower))
    assert json.loads((tmp_path / "g1.json").read_bytes())["spec"]["limits"]["maxAltitude"] == 10
    assert synchronizer.counts()["unstored"] == 0


class FakeVerifier:
    """Fake signature check. A test sets its result."""

    def __init__(self) -> None:
        self.error: Exception | None = None
        self.refreshes = 0
        self.now_s = 0.0

    def check(self, _grant: Grant) -> None:
        if self.error is not None:
            raise self.error

    def refresh(self) -> None:
        self.refreshes += 1


@pytest.fixture
def verifier() -> FakeVerifier:
    return FakeVerifier()


@pytest.fixture
def verifying(store: FakeStore, verifier: FakeVerifier, tmp_path: Path) -> GrantSynchronizer:
    directory = GrantDirectory(tmp_path)
    directory.open()
    return GrantSynchronizer(
        store,
        directory,
        "drone-1",
        verifier.check,
        refresh_authority=verifier.refresh,
        monotonic=lambda: verifier.now_s,
    )


async def test_grant_with_bad_signature_is_not_stored_and_removes_the_previous_grant(
    verifying: GrantSynchronizer, verifier: FakeVerifier, store: FakeStore, tmp_path: Path
) -> None:
    verifying.apply(grant_list(manifest()))
    verifier.error = BadSignature("the Grant was changed after signing")
    verifying.apply(grant_list(manifest(spec={"control": "full"})))
    assert on_disk(tmp_path) == set()
    await verifying.report_once()
    reported = store.reports[-1]["g1"]
    assert reported.phase == "Pending", "the Grant is pending until the operator signs it again"
    assert "changed after" in reported.message
    verifier.error = None
    verifying.apply(grant_list(manifest()))
    await verifying.report_once()
    assert on_disk(tmp_path) == {"g1.json"}
    assert store.phases()[-1] == "Active"


async def test_change_of_authorities_keeps_stored_grants(
    verifying: GrantSynchronizer, verifier: FakeVerifier, store: FakeStore, tmp_path: Path
) -> None:
    verifying.apply(grant_list(manifest()))
    await verifying.report_once()
    verifier.error = UnknownAuthority("the authority is not in ca.crt")
    verifying.apply(grant_list(manifest(spec={"control": "full"}), reported=[report("Active")]))
    await verifying.report_once()
    assert "control" not in json.loads((tmp_path / "g1.json").read_text())["spec"]
    assert verifier.refreshes == 1
    assert store.phases() == ["Active"]
    verifier.error = None
    verifying.on_authority_changed()
    assert json.loads((tmp_path / "g1.json").read_text())["spec"]["control"] == "full"


def test_stored_grant_is_removed_if_the_authority_of_its_replacement_stays_unknown(
    verifying: GrantSynchronizer, verifier: FakeVerifier, tmp_path: Path
) -> None:
    verifying.apply(grant_list(manifest()))
    verifier.error = UnknownAuthority("the authority is not in ca.crt")
    verifying.apply(grant_list(manifest(spec={"control": "full"})))
    verifier.now_s = UNVERIFIED_TIMEOUT_S
    verifying.expire_unverified()
    assert on_disk(tmp_path) == {"g1.json"}
    verifier.now_s = UNVERIFIED_TIMEOUT_S + 1
    verifying.expire_unverified()
    assert on_disk(tmp_path) == set()
    verifying.apply(grant_list())
    verifier.error = None
    verifying.on_authority_changed()
    assert on_disk(tmp_path) == set(), "a removed Grant is not stored again when its authority becomes known"


async def test_stored_grant_survives_unknown_authority_and_agent_restart(
    verifying: GrantSynchronizer, verifier: FakeVerifier, store: FakeStore, tmp_path: Path
) -> None:
    verifying.apply(grant_list(manifest()))
    verifier.error = UnknownAuthority("the authority is not in ca.crt")
    resigned = GrantSynchronizer(
        store, GrantDirectory(tmp_path), "drone-1", verifier.check, monotonic=lambda: verifier.now_s
    )
    resigned.apply(grant_list(manifest()))
    verifier.now_s = UNVERIFIED_TIMEOUT_S * 2
    resigned.expire_unverified()
    await resigned.report_once()
    assert on_disk(tmp_path) == {"g1.json"}
    assert store.phases()[-1] == "Active"


async def test_report_of_an_ended_mission_contains_pictures_of_all_instances_of_the_application(
    store: FakeStore, tmp_path: Path
) -> None:
    viewer = manifest("g2", uid="u2", spec={"component": "Viewer", "instance": "app-viewer"})
    other = manifest("g3", uid="u3", spec={"application": {"namespace": "default", "name": "other", "uid": "b"}})
    key = Grant.from_body(viewer).spec.mission_key
    foreign = Grant.from_body(other).spec.mission_key
    counts = {KEY: (2, 0), key: (5, 1), foreign: (7, 7), "removed": (9, 9)}
    synchronizer = GrantSynchronizer(store, GrantDirectory(tmp_path), "drone-1", accept, pictures=lambda: counts)
    synchronizer.apply(grant_list(manifest("g1"), viewer, other))
    await synchronizer.report_once()
    synchronizer.set_missions({KEY: COMPLETE})
    await synchronizer.report_once()
    reported = [{name: report.pictures for name, report in reports.items()} for reports in store.reports]
    assert reported[0] == {"g1": None, "g2": None, "g3": None}
    assert reported[1] == {"g1": ReportedPictures(taken=7, refused=1), "g2": None, "g3": None}


async def test_grants_stay_stored_while_the_api_server_is_unreachable_for_a_month(
    verifying: GrantSynchronizer, verifier: FakeVerifier, store: FakeStore, tmp_path: Path
) -> None:
    verifying.apply(grant_list(manifest("g1"), manifest("g2")))
    store.down = True
    verifier.error = UnknownAuthority("ca.crt is missing")
    for _ in range(30):
        verifier.now_s += 86_400
        verifying.set_missions({KEY: Outcome(OutcomeKind.FAILED, f"{verifier.now_s}")})
        verifying.expire_unverified()
        verifying.retry_disk()
        verifying.on_authority_changed()
        with pytest.raises(KubeError):
            await verifying.report_once()
    assert on_disk(tmp_path) == {"g1.json", "g2.json"}


def test_report_of_an_ended_mission_contains_its_waypoints() -> None:
    grant = Grant.from_body(manifest())
    counted = replace(COMPLETE, waypoints=WaypointCounts(3, 1, 2))
    reported = grant_report(grant, {KEY: counted}, None)
    assert (reported.phase, reported.waypoints) == ("Complete", ReportedWaypoints(reached=3, skipped=1, corrected=2))
    assert grant_report(grant, {KEY: COMPLETE}, None).waypoints is None
    assert grant_report(grant, {}, None).waypoints is None


def test_mission_outcome_gives_phase_and_reason() -> None:
    grant = Grant.from_body(manifest())
    assert mission_outcome(grant, {}) is None
    assert mission_outcome(grant, {KEY: COMPLETE}) == ("Complete", "")
    assert mission_outcome(grant, {KEY: Outcome(OutcomeKind.REVOKED, "zone closed: now")}) == (
        "Revoked",
        "zone closed: now",
    )
    assert mission_outcome(grant, {KEY: FAILED}) == ("Failed", "driver lost")
    assert mission_outcome(grant, {KEY.replace("#u1", "#u2"): COMPLETE, "u1": COMPLETE}) is None


def test_reported_final_phase_is_kept() -> None:
    grant = Grant.from_body(manifest(metadata={"generation": 2}))
    ended = report("Complete", "done")
    now = grant_report(grant, {KEY: FAILED}, None)
    assert keep_final_phase(now, ended) == ended.model_copy(update={"observed_generation": 2})
    assert keep_final_phase(grant_report(grant, {}, "disk full"), ended).phase == "Complete"
    assert keep_final_phase(now, report("Active")) == keep_final_phase(now, None) == now


@pytest.mark.parametrize("problem", [BadSignature("changed"), UnknownAuthority("unknown"), None])
async def test_reported_final_phase_is_kept_for_unusable_grant(
    verifying: GrantSynchronizer, verifier: FakeVerifier, store: FakeStore, problem: Exception | None
) -> None:
    verifier.error = problem
    spec = {} if problem is not None else {"newRestriction": True}
    verifying.apply(grant_list(manifest(spec=spec), reported=[report("Complete", "done")]))
    await verifying.report_once()
    assert store.reports == []


async def test_report_has_the_current_generation(synchronizer: GrantSynchronizer, store: FakeStore) -> None:
    """A new signature changes the annotations of a Grant, but not its generation."""
    synchronizer.apply(grant_list(manifest(), reported=[report("Active")]))
    resigned = manifest(metadata={"annotations": {"fractus.dev/signature": "again"}})
    synchronizer.apply(grant_list(resigned, generation=2, reported=[report("Active")]))
    await synchronizer.report_once()
    assert (store.generation, store.phases()) == (2, ["Active"])


def test_unchanged_grants_are_not_verified_again(
    verifying: GrantSynchronizer, verifier: FakeVerifier, tmp_path: Path
) -> None:
    verifying.apply(grant_list(manifest("g1"), manifest("g2")))
    verifier.error = BadSignature("an unchanged Grant is verified again")
    verifying.apply(grant_list(manifest("g1"), manifest("g2", spec={"control": "full"})))
    assert on_disk(tmp_path) == {"g1.json"}
    verifier.error = None
    verifying.apply(grant_list(manifest("g1"), manifest("g2")))
    stored = {name: (tmp_path / name).read_bytes() for name in ("g1.json", "g2.json")}
    (tmp_path / "g1.json").unlink()
    (tmp_path / "g2.json").write_bytes(stored["g2.json"][:20])
    verifying.apply(grant_list(manifest("g1"), manifest("g2")))
    assert {name: (tmp_path / name).read_bytes() for name in on_disk(tmp_path)} == stored, "changed files are restored"


async def test_new_agent_keeps_reported_final_phase(synchronizer: GrantSynchronizer, store: FakeStore) -> None:
    synchronizer.apply(grant_list(manifest(), reported=[report("Complete", "done")]))
    await synchronizer.report_once()
    assert store.reports == []


def test_serialized_grant_does_not_depend_on_status() -> None:
    first = Grant.from_body(manifest(version="1"))
    second = Grant.from_body(manifest(version="2", status={"phase": "Active"}))
    assert serialize_grant(first) == serialize_grant(second)
    stored = json.loads(serialize_grant(first))
    assert stored["metadata"]["uid"] == "u1"
    assert Grant.from_body(stored).spec == first.spec
    assert "policies" not in stored["spec"], (
        "unused fields are omitted, because services of an earlier release may not know them"
    )


def test_backoff_doubles_to_its_cap_and_restarts_after_success() -> None:
    backoff = Backoff(0.5, 15.0)
    delays = [backoff.delay_s() for _ in range(50)]
    for attempt, delay in enumerate(delays):
        full = min(15.0, 0.5 * 2**attempt)
        assert full / 2 <= delay <= full
    backoff.succeeded()
    assert backoff.delay_s() <= 0.5


class FakeClient:
    """Fake client that lists one object."""

    def __init__(self, body: dict[str, Any]) -> None:
        self._body = body

    def without_credentials(self) -> Self:
        return self

    def account(self, *_: str) -> Self:
        return self

    async def list_whole(self, *_: object, **__: object) -> SimpleNamespace:
        return SimpleNamespace(items=[self._body], resource_version="1")


async def test_invalid_status_of_node_grants_does_not_block_grants() -> None:
    """The status comes from a release with other phases."""
    reports = [{"uid": "u1", "name": "g1", "phase": "Paused", "observedGeneration": 1}]
    body = {
        "apiVersion": "fractus.dev/v1alpha1",
        "kind": "NodeGrants",
        "metadata": {"name": "drone-1", "namespace": "fractus-nodes", "generation": 3},
        "spec": {"count": 1, "packed": pack([manifest()])},
        "status": {"observedGeneration": 2, "grants": reports},
    }
    reported = await anext(Store(cast(Any, FakeClient(body)), "drone-1").grants())
    assert reported.grants is not None
    assert [grant["metadata"]["name"] for grant in reported.grants] == ["g1"]
    assert (reported.generation, reported.reported, reported.reported_generation) == (3, {}, 0), (
        "all phases are reported again"
    )
