"""What becomes of grants: phases, and which news changes the disk."""

import json
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self, cast

import pytest
from fractus_agent.cluster.store import Backoff, Granted, KubeError, Store
from fractus_agent.grants.keeper import (
    UNVERIFIED_TIMEOUT_S,
    GrantDirectory,
    GrantKeeper,
    outcome_of,
    report_of,
    stored_form,
    unless_ended,
)
from fractus_core.api.grants import Grant, ReportedGrant, pack
from fractus_core.control import Outcome, OutcomeKind
from fractus_core.policy.grant_signatures import BadSignature, UnknownAuthority

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


def granted(
    *manifests: dict[str, Any], generation: int = 1, reported: Sequence[ReportedGrant] = (), reported_of: int = 1
) -> Granted:
    return Granted(generation, manifests, {report.uid: report for report in reported}, reported_of)


def report(phase: str, message: str = "", name: str = "g1", uid: str = "u1") -> ReportedGrant:
    return ReportedGrant.model_validate(
        {"uid": uid, "name": name, "phase": phase, "message": message, "observedGeneration": 1}
    )


class FakeStore:
    """What was reported, each time of all Grants."""

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

    async def grants(self) -> AsyncIterator[Granted]:
        raise NotImplementedError
        yield


def believe(_grant: Grant) -> None:
    """Every grant is as good as signed."""


@pytest.fixture
def store() -> FakeStore:
    return FakeStore()


@pytest.fixture
def keeper(store: FakeStore, tmp_path: Path) -> GrantKeeper:
    directory = GrantDirectory(tmp_path)
    directory.open()
    return GrantKeeper(store, directory, "drone-1", believe)


def on_disk(path: Path) -> set[str]:
    return {p.name for p in path.iterdir()}


def test_what_the_operator_does_not_name_any_more_is_removed(keeper: GrantKeeper, tmp_path: Path) -> None:
    keeper.take(granted(manifest("g1"), manifest("g2")))
    assert on_disk(tmp_path) == {"g1.json", "g2.json"}
    keeper.take(Granted(1, None, {}, 0))
    assert on_disk(tmp_path) == {"g1.json", "g2.json"}, "only what was reported has changed"
    keeper.take(granted(manifest("g2"), manifest("g3")))
    assert on_disk(tmp_path) == {"g2.json", "g3.json"}


def test_a_new_agent_removes_what_a_full_list_lacks(store: FakeStore, tmp_path: Path) -> None:
    (tmp_path / "old.json").write_text("{}")
    (tmp_path / ".half.json.tmp").write_text("{")
    directory = GrantDirectory(tmp_path)
    directory.open()
    assert on_disk(tmp_path) == {"old.json"}
    GrantKeeper(store, directory, "drone-1", believe).take(granted())
    assert on_disk(tmp_path) == set()


def test_a_file_is_the_grant_and_only_its_content_rewrites_it(keeper: GrantKeeper, tmp_path: Path) -> None:
    keeper.take(granted(manifest()))
    file = tmp_path / "g1.json"
    assert Grant.from_body(json.loads(file.read_text())).spec.identity.endswith("/instance/app-navigator")
    assert file.stat().st_mode & 0o777 == 0o600
    first = file.stat().st_ino
    keeper.take(granted(manifest(version="2", status={"phase": "Active"})))
    assert file.stat().st_ino == first
    keeper.take(granted(manifest(version="3", spec={"control": "full"})))
    assert file.stat().st_ino != first
    assert json.loads(file.read_text())["spec"]["control"] == "full"


def test_a_grant_of_another_node_is_not_stored(keeper: GrantKeeper, tmp_path: Path) -> None:
    keeper.take(granted(manifest("g1"), manifest("g2")))
    keeper.take(granted(manifest("g1"), manifest("g2", spec={"node": "drone-2"})))
    assert on_disk(tmp_path) == {"g1.json"}


async def test_an_unreadable_grant_grants_nothing_and_says_so(
    keeper: GrantKeeper, store: FakeStore, tmp_path: Path
) -> None:
    keeper.take(granted(manifest()))
    keeper.take(granted(manifest(spec={"newRestriction": True})))
    assert on_disk(tmp_path) == set()
    await keeper.report_once()
    (found,) = store.reports[-1].values()
    assert (found.name, found.uid, found.phase) == ("g1", "u1", "Failed")
    assert "spec.newRestriction" in found.message


async def test_phases_are_reported_once_and_survive_outages(keeper: GrantKeeper, store: FakeStore) -> None:
    keeper.take(granted(manifest()))
    store.down = True
    with pytest.raises(KubeError):
        await keeper.report_once()
    store.down = False
    await keeper.report_once()
    await keeper.report_once()
    assert store.phases() == ["Active"]
    keeper.missions_changed({KEY: FAILED})
    await keeper.report_once()
    assert store.reports[-1] == {"g1": report("Failed", "driver lost")}


async def test_a_new_agent_does_not_repeat_what_is_reported(keeper: GrantKeeper, store: FakeStore) -> None:
    keeper.take(granted(manifest(), reported=[report("Active")]))
    await keeper.report_once()
    assert store.reports == []


async def test_what_the_api_server_lost_is_reported_again(keeper: GrantKeeper, store: FakeStore) -> None:
    keeper.take(granted(manifest(), generation=4))
    await keeper.report_once()
    keeper.take(Granted(5, None, {}, 0))
    await keeper.report_once()
    assert store.phases() == ["Active", "Active"]
    assert store.generation == 5


async def test_what_is_reported_names_all_grants_and_no_other(keeper: GrantKeeper, store: FakeStore) -> None:
    keeper.take(granted(manifest(), manifest("g2", "u2"), reported=[report("Active")]))
    await keeper.report_once()
    assert store.reports == [{"g1": report("Active"), "g2": report("Active", name="g2", uid="u2")}]
    keeper.take(granted(manifest("g2", "u2"), reported=list(store.reports[-1].values())))
    await keeper.report_once()
    assert store.reports[-1] == {"g2": report("Active", name="g2", uid="u2")}


async def test_reports_wait_for_an_object_that_takes_them(keeper: GrantKeeper, store: FakeStore) -> None:
    store.absent = True
    keeper.take(granted(manifest()))
    await keeper.report_once()
    store.absent = False
    await keeper.report_once()
    assert store.phases() == ["Active"]


async def test_a_grant_made_again_under_its_name_is_reported_again(keeper: GrantKeeper, store: FakeStore) -> None:
    keeper.missions_changed({KEY: COMPLETE})
    for uid in ("u1", "u2"):
        keeper.take(granted(manifest(uid=uid)))
        await keeper.report_once()
    keeper.take(granted(manifest(uid="u3")))
    await keeper.report_once()
    assert store.phases() == ["Complete", "Active", "Active"]


async def test_a_grant_that_cannot_be_stored_is_pending_until_it_can(
    keeper: GrantKeeper, store: FakeStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("os.fsync", full)
        keeper.take(granted(manifest()))
    await keeper.report_once()
    assert store.phases()[-1] == "Pending"
    assert "No space left" in store.reports[-1]["g1"].message
    keeper.retry_disk()
    await keeper.report_once()
    assert store.phases()[-1] == "Active"


async def test_what_the_disk_did_not_take_is_tried_again_within_seconds(
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
    keeper = GrantKeeper(store, directory, "drone-1", believe, monotonic=lambda: now_s[0])
    monkeypatch.setattr("fractus_agent.grants.keeper.repeat", repeated)
    with monkeypatch.context() as patch:
        patch.setattr("fractus_agent.grants.keeper.write_file", full)
        keeper.take(granted(manifest()))
        await keeper.report()
    assert max(waits_s) <= 5
    assert caplog.text.count("cannot be written to disk") == 1, "it is told once"
    waits_s.clear()
    await keeper.report()
    assert on_disk(tmp_path) == {"g1.json"}
    assert waits_s == [60.0] * 4


def test_services_do_not_go_on_by_a_grant_whose_change_cannot_be_stored(
    keeper: GrantKeeper, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    keeper.take(granted(manifest()))
    stored = (tmp_path / "g1.json").read_bytes()
    narrower = manifest()
    narrower["spec"]["limits"] = {"maxAltitude": 10, "maxSpeed": 5}
    annotated = manifest()
    annotated["metadata"]["annotations"] = {"note": "new"}
    with monkeypatch.context() as patch:
        patch.setattr("fractus_agent.grants.keeper.write_file", full)
        keeper.take(granted(annotated))
        assert (tmp_path / "g1.json").read_bytes() == stored, "it grants the same"
        keeper.take(granted(narrower))
        assert on_disk(tmp_path) == set()
        assert keeper.counts()["unstored"] == 1
    keeper.retry_disk()
    assert json.loads((tmp_path / "g1.json").read_bytes())["spec"]["limits"]["maxAltitude"] == 10


def test_a_grant_that_cannot_be_read_for_a_while_is_kept_if_it_is_the_same(
    keeper: GrantKeeper, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An agent without a free descriptor may still remove files, and must not take what a drone flies by."""

    def unreadable(_path: Path) -> bytes:
        raise OSError(24, "Too many open files")

    keeper.take(granted(manifest()))
    narrower = manifest()
    narrower["spec"]["limits"] = {"maxAltitude": 10, "maxSpeed": 5}
    with monkeypatch.context() as patch:
        patch.setattr(Path, "read_bytes", unreadable)
        keeper.take(granted(manifest(), generation=2))
        assert on_disk(tmp_path) == {"g1.json"}
        keeper.take(granted(narrower, generation=3))
        assert on_disk(tmp_path) == set()
    keeper.retry_disk()
    assert json.loads((tmp_path / "g1.json").read_bytes())["spec"]["limits"]["maxAltitude"] == 10


def test_the_older_grant_makes_room_for_the_newer(
    keeper: GrantKeeper, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def tight(path: Path, content: bytes) -> None:
        if path.exists():
            raise OSError(28, "No space left on device")
        path.write_bytes(content)

    keeper.take(granted(manifest()))
    monkeypatch.setattr("fractus_agent.grants.keeper.write_file", tight)
    narrower = manifest()
    narrower["spec"]["limits"] = {"maxAltitude": 10, "maxSpeed": 5}
    keeper.take(granted(narrower))
    assert json.loads((tmp_path / "g1.json").read_bytes())["spec"]["limits"]["maxAltitude"] == 10
    assert keeper.counts()["unstored"] == 0


class Doubter:
    """The operator's word on grants, which a test changes."""

    def __init__(self) -> None:
        self.error: Exception | None = None
        self.asked = 0
        self.now_s = 0.0

    def check(self, _grant: Grant) -> None:
        if self.error is not None:
            raise self.error

    def ask(self) -> None:
        self.asked += 1


@pytest.fixture
def doubter() -> Doubter:
    return Doubter()


@pytest.fixture
def doubting(store: FakeStore, doubter: Doubter, tmp_path: Path) -> GrantKeeper:
    directory = GrantDirectory(tmp_path)
    directory.open()
    return GrantKeeper(
        store, directory, "drone-1", doubter.check, refresh_authority=doubter.ask, monotonic=lambda: doubter.now_s
    )


async def test_a_grant_that_is_not_signed_is_not_stored_and_takes_away_the_one_before(
    doubting: GrantKeeper, doubter: Doubter, store: FakeStore, tmp_path: Path
) -> None:
    doubting.take(granted(manifest()))
    doubter.error = BadSignature("the Grant was changed after signing")
    doubting.take(granted(manifest(spec={"control": "full"})))
    assert on_disk(tmp_path) == set()
    await doubting.report_once()
    found = store.reports[-1]["g1"]
    assert found.phase == "Pending", "the operator signs it again; nothing has failed"
    assert "changed after" in found.message
    doubter.error = None
    doubting.take(granted(manifest()))
    await doubting.report_once()
    assert on_disk(tmp_path) == {"g1.json"}
    assert store.phases()[-1] == "Active"


async def test_a_change_of_authorities_takes_no_grant_away(
    doubting: GrantKeeper, doubter: Doubter, store: FakeStore, tmp_path: Path
) -> None:
    doubting.take(granted(manifest()))
    await doubting.report_once()
    doubter.error = UnknownAuthority("it is of an authority that is not in ca.crt")
    doubting.take(granted(manifest(spec={"control": "full"}), reported=[report("Active")]))
    await doubting.report_once()
    assert "control" not in json.loads((tmp_path / "g1.json").read_text())["spec"]
    assert doubter.asked == 1
    assert store.phases() == ["Active"]
    doubter.error = None
    doubting.authority_changed()
    assert json.loads((tmp_path / "g1.json").read_text())["spec"]["control"] == "full"


def test_an_authority_that_stays_unknown_ends_the_grant(
    doubting: GrantKeeper, doubter: Doubter, tmp_path: Path
) -> None:
    doubting.take(granted(manifest()))
    doubter.error = UnknownAuthority("it is of an authority that is not in ca.crt")
    doubting.take(granted(manifest(spec={"control": "full"})))
    doubter.now_s = UNVERIFIED_TIMEOUT_S
    doubting.give_up_unverified()
    assert on_disk(tmp_path) == {"g1.json"}
    doubter.now_s = UNVERIFIED_TIMEOUT_S + 1
    doubting.give_up_unverified()
    assert on_disk(tmp_path) == set()
    doubting.take(granted())
    doubter.error = None
    doubting.authority_changed()
    assert on_disk(tmp_path) == set(), "what the API server has no more does not come back"


async def test_a_stored_grant_outlives_its_authority_and_the_agent(
    doubting: GrantKeeper, doubter: Doubter, store: FakeStore, tmp_path: Path
) -> None:
    doubting.take(granted(manifest()))
    doubter.error = UnknownAuthority("it is of an authority that is not in ca.crt")
    again = GrantKeeper(store, GrantDirectory(tmp_path), "drone-1", doubter.check, monotonic=lambda: doubter.now_s)
    again.take(granted(manifest()))
    doubter.now_s = UNVERIFIED_TIMEOUT_S * 2
    again.give_up_unverified()
    await again.report_once()
    assert on_disk(tmp_path) == {"g1.json"}
    assert store.phases()[-1] == "Active"


async def test_an_api_server_that_is_gone_for_a_month_takes_no_grant_away(
    doubting: GrantKeeper, doubter: Doubter, store: FakeStore, tmp_path: Path
) -> None:
    doubting.take(granted(manifest("g1"), manifest("g2")))
    store.down = True
    doubter.error = UnknownAuthority("there is no ca.crt any more")
    for _ in range(30):
        doubter.now_s += 86_400
        doubting.missions_changed({KEY: Outcome(OutcomeKind.FAILED, f"{doubter.now_s}")})
        doubting.give_up_unverified()
        doubting.retry_disk()
        doubting.authority_changed()
        with pytest.raises(KubeError):
            await doubting.report_once()
    assert on_disk(tmp_path) == {"g1.json", "g2.json"}


def test_outcomes() -> None:
    grant = Grant.from_body(manifest())
    assert outcome_of(grant, {}) is None
    assert outcome_of(grant, {KEY: COMPLETE}) == ("Complete", "")
    assert outcome_of(grant, {KEY: Outcome(OutcomeKind.REVOKED, "zone closed: now")}) == (
        "Revoked",
        "zone closed: now",
    )
    assert outcome_of(grant, {KEY: FAILED}) == ("Failed", "driver lost")
    assert outcome_of(grant, {KEY.replace("#u1", "#u2"): COMPLETE, "u1": COMPLETE}) is None


def test_a_reported_end_is_final() -> None:
    grant, ended = Grant.from_body(manifest(metadata={"generation": 2})), report("Complete", "done")
    now = report_of(grant, {KEY: FAILED}, None)
    assert unless_ended(now, ended) == ended.model_copy(update={"observed_generation": 2})
    assert unless_ended(report_of(grant, {}, "disk full"), ended).phase == "Complete"
    assert unless_ended(now, report("Active")) == unless_ended(now, None) == now


@pytest.mark.parametrize("problem", [BadSignature("changed"), UnknownAuthority("unknown"), None])
async def test_nor_is_an_end_taken_back_by_a_grant_that_is_unusable(
    doubting: GrantKeeper, doubter: Doubter, store: FakeStore, problem: Exception | None
) -> None:
    doubter.error = problem
    spec = {} if problem is not None else {"newRestriction": True}
    doubting.take(granted(manifest(spec=spec), reported=[report("Complete", "done")]))
    await doubting.report_once()
    assert store.reports == []


async def test_what_is_reported_is_of_the_present_generation(keeper: GrantKeeper, store: FakeStore) -> None:
    """Signed again, a Grant has other annotations and the same generation."""
    keeper.take(granted(manifest(), reported=[report("Active")]))
    again = manifest(metadata={"annotations": {"fractus.dev/signature": "again"}})
    keeper.take(granted(again, generation=2, reported=[report("Active")]))
    await keeper.report_once()
    assert (store.generation, store.phases()) == (2, ["Active"])


def test_what_is_unchanged_is_not_verified_again(doubting: GrantKeeper, doubter: Doubter, tmp_path: Path) -> None:
    doubting.take(granted(manifest("g1"), manifest("g2")))
    doubter.error = BadSignature("it is asked again")
    doubting.take(granted(manifest("g1"), manifest("g2", spec={"control": "full"})))
    assert on_disk(tmp_path) == {"g1.json"}
    doubter.error = None
    doubting.take(granted(manifest("g1"), manifest("g2")))
    stored = {name: (tmp_path / name).read_bytes() for name in ("g1.json", "g2.json")}
    (tmp_path / "g1.json").unlink()
    (tmp_path / "g2.json").write_bytes(stored["g2.json"][:20])
    doubting.take(granted(manifest("g1"), manifest("g2")))
    assert {name: (tmp_path / name).read_bytes() for name in on_disk(tmp_path)} == stored, "as it was written"


async def test_a_new_agent_takes_no_reported_end_back(keeper: GrantKeeper, store: FakeStore) -> None:
    keeper.take(granted(manifest(), reported=[report("Complete", "done")]))
    await keeper.report_once()
    assert store.reports == []


def test_the_stored_form_is_stable() -> None:
    one = Grant.from_body(manifest(version="1"))
    two = Grant.from_body(manifest(version="2", status={"phase": "Active"}))
    assert stored_form(one) == stored_form(two)
    stored = json.loads(stored_form(one))
    assert stored["metadata"]["uid"] == "u1"
    assert Grant.from_body(stored).spec == one.spec
    assert "policies" not in stored["spec"], "services of an earlier release meet no field that is not used"


def test_backoff_doubles_to_its_cap_and_starts_again() -> None:
    backoff = Backoff(0.5, 15.0)
    delays = [backoff.delay_s() for _ in range(50)]
    for attempt, delay in enumerate(delays):
        full = min(15.0, 0.5 * 2**attempt)
        assert full / 2 <= delay <= full
    backoff.succeeded()
    assert backoff.delay_s() <= 0.5


class OneObject:
    """A client that finds the object of the node, and then hears nothing."""

    def __init__(self, body: dict[str, Any]) -> None:
        self._body = body

    def account(self, *_: str) -> Self:
        return self

    async def list_whole(self, *_: object, **__: object) -> SimpleNamespace:
        return SimpleNamespace(items=[self._body], resource_version="1")


async def test_what_was_reported_keeps_no_grant_from_the_node() -> None:
    """By a release that knew of other phases."""
    reports = [{"uid": "u1", "name": "g1", "phase": "Paused", "observedGeneration": 1}]
    body = {
        "apiVersion": "fractus.dev/v1alpha1",
        "kind": "NodeGrants",
        "metadata": {"name": "drone-1", "namespace": "fractus-nodes", "generation": 3},
        "spec": {"count": 1, "packed": pack([manifest()])},
        "status": {"observedGeneration": 2, "grants": reports},
    }
    found = await anext(Store(cast(Any, OneObject(body)), "drone-1").grants())
    assert found.grants is not None
    assert [grant["metadata"]["name"] for grant in found.grants] == ["g1"]
    assert (found.generation, found.reported, found.reported_of) == (3, {}, 0), "and it is reported again"
