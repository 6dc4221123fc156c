"""What becomes of grants: phases, and which news changes the disk."""

import json
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
from fractus_agent.cluster.store import Backoff, Changed, Deleted, Event, KubeError, Listed
from fractus_agent.grants.keeper import (
    UNVERIFIED_TIMEOUT_S,
    GrantDirectory,
    GrantKeeper,
    outcome_of,
    status_of,
    stored_form,
)
from fractus_core.api.plans import Grant
from fractus_core.control import Outcome, OutcomeKind
from fractus_core.policy.trust import BadSignature, UnknownAuthority

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


class FakeStore:
    def __init__(self) -> None:
        self.statuses: list[tuple[str, dict[str, Any]]] = []
        self.down = False

    async def apply_status(self, kind: str, name: str, status: dict[str, Any]) -> dict[str, Any] | None:
        if self.down:
            raise KubeError(0, "Unreachable", "down")
        self.statuses.append((name, status))
        return {}

    async def grants(self) -> AsyncIterator[Event]:
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


def test_only_a_list_or_a_deletion_removes(keeper: GrantKeeper, tmp_path: Path) -> None:
    keeper.take(Listed((manifest("g1"), manifest("g2"))))
    assert on_disk(tmp_path) == {"g1.json", "g2.json"}
    keeper.take(Changed(manifest("g3")))
    assert on_disk(tmp_path) == {"g1.json", "g2.json", "g3.json"}
    keeper.take(Deleted("g1"))
    assert on_disk(tmp_path) == {"g2.json", "g3.json"}
    keeper.take(Listed((manifest("g3"),)))
    assert on_disk(tmp_path) == {"g3.json"}


def test_a_new_agent_removes_what_a_full_list_lacks(store: FakeStore, tmp_path: Path) -> None:
    (tmp_path / "old.json").write_text("{}")
    (tmp_path / ".half.json.tmp").write_text("{")
    directory = GrantDirectory(tmp_path)
    directory.open()
    assert on_disk(tmp_path) == {"old.json"}
    GrantKeeper(store, directory, "drone-1", believe).take(Listed(()))
    assert on_disk(tmp_path) == set()


def test_a_file_is_the_grant_and_only_its_content_rewrites_it(keeper: GrantKeeper, tmp_path: Path) -> None:
    keeper.take(Changed(manifest()))
    file = tmp_path / "g1.json"
    assert Grant.from_body(json.loads(file.read_text())).spec.identity.endswith("/instance/app-navigator")
    assert file.stat().st_mode & 0o777 == 0o600
    first = file.stat().st_ino
    keeper.take(Changed(manifest(version="2", status={"phase": "Active"})))
    assert file.stat().st_ino == first
    keeper.take(Changed(manifest(version="3", spec={"control": "full"})))
    assert file.stat().st_ino != first
    assert json.loads(file.read_text())["spec"]["control"] == "full"


def test_a_grant_being_deleted_or_of_another_node_is_gone(keeper: GrantKeeper, tmp_path: Path) -> None:
    keeper.take(Listed((manifest("g1"), manifest("g2"))))
    keeper.take(Changed(manifest("g1", metadata={"deletionTimestamp": "2026-01-01T00:00:00Z"})))
    keeper.take(Changed(manifest("g2", spec={"node": "drone-2"})))
    assert on_disk(tmp_path) == set()


async def test_an_unreadable_grant_grants_nothing_and_says_so(
    keeper: GrantKeeper, store: FakeStore, tmp_path: Path
) -> None:
    keeper.take(Listed((manifest(),)))
    keeper.take(Changed(manifest(spec={"newRestriction": True})))
    assert on_disk(tmp_path) == set()
    await keeper.report_once()
    (name, status) = store.statuses[-1]
    assert (name, status["phase"]) == ("g1", "Failed")
    assert "spec.newRestriction" in status["message"]


async def test_phases_are_reported_once_and_survive_outages(keeper: GrantKeeper, store: FakeStore) -> None:
    keeper.take(Listed((manifest(),)))
    store.down = True
    with pytest.raises(KubeError):
        await keeper.report_once()
    store.down = False
    await keeper.report_once()
    await keeper.report_once()
    assert [s["phase"] for _, s in store.statuses] == ["Active"]
    keeper.missions_changed({KEY: FAILED})
    await keeper.report_once()
    assert store.statuses[-1] == ("g1", {"phase": "Failed", "message": "driver lost", "observedGeneration": 1})


async def test_a_new_agent_does_not_repeat_what_is_reported(keeper: GrantKeeper, store: FakeStore) -> None:
    status = {"phase": "Active", "message": "", "observedGeneration": 1}
    keeper.take(Listed((manifest(status=status),)))
    await keeper.report_once()
    assert store.statuses == []


async def test_a_grant_made_again_under_its_name_is_reported_again(keeper: GrantKeeper, store: FakeStore) -> None:
    keeper.missions_changed({KEY: COMPLETE})
    for uid in ("u1", "u2"):
        keeper.take(Changed(manifest(uid=uid)))
        await keeper.report_once()
    keeper.take(Changed(manifest(uid="u3")))
    await keeper.report_once()
    assert [s["phase"] for _, s in store.statuses] == ["Complete", "Active", "Active"]


async def test_a_grant_that_cannot_be_stored_is_pending_until_it_can(
    keeper: GrantKeeper, store: FakeStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("os.fsync", full)
        keeper.take(Listed((manifest(),)))
    await keeper.report_once()
    assert store.statuses[-1][1]["phase"] == "Pending"
    assert "No space left" in store.statuses[-1][1]["message"]
    keeper.retry_disk()
    await keeper.report_once()
    assert store.statuses[-1][1]["phase"] == "Active"


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
    doubting.take(Listed((manifest(),)))
    doubter.error = BadSignature("it was changed after it was signed")
    doubting.take(Changed(manifest(spec={"control": "full"})))
    assert on_disk(tmp_path) == set()
    await doubting.report_once()
    name, status = store.statuses[-1]
    assert (name, status["phase"]) == ("g1", "Pending"), "the operator signs it again; nothing has failed"
    assert "changed after" in status["message"]
    doubter.error = None
    doubting.take(Changed(manifest()))
    await doubting.report_once()
    assert on_disk(tmp_path) == {"g1.json"}
    assert store.statuses[-1][1]["phase"] == "Active"


async def test_a_change_of_authorities_takes_no_grant_away(
    doubting: GrantKeeper, doubter: Doubter, store: FakeStore, tmp_path: Path
) -> None:
    doubting.take(Listed((manifest(),)))
    await doubting.report_once()
    doubter.error = UnknownAuthority("it is of an authority that is not in ca.crt")
    doubting.take(Changed(manifest(spec={"control": "full"})))
    await doubting.report_once()
    assert "control" not in json.loads((tmp_path / "g1.json").read_text())["spec"]
    assert doubter.asked == 1
    assert [s["phase"] for _, s in store.statuses] == ["Active"]
    doubter.error = None
    doubting.authority_changed()
    assert json.loads((tmp_path / "g1.json").read_text())["spec"]["control"] == "full"


def test_an_authority_that_stays_unknown_ends_the_grant(
    doubting: GrantKeeper, doubter: Doubter, tmp_path: Path
) -> None:
    doubting.take(Listed((manifest(),)))
    doubter.error = UnknownAuthority("it is of an authority that is not in ca.crt")
    doubting.take(Changed(manifest(spec={"control": "full"})))
    doubter.now_s = UNVERIFIED_TIMEOUT_S
    doubting.give_up_unverified()
    assert on_disk(tmp_path) == {"g1.json"}
    doubter.now_s = UNVERIFIED_TIMEOUT_S + 1
    doubting.give_up_unverified()
    assert on_disk(tmp_path) == set()
    doubting.take(Listed(()))
    doubter.error = None
    doubting.authority_changed()
    assert on_disk(tmp_path) == set(), "what the API server has no more does not come back"


async def test_a_stored_grant_outlives_its_authority_and_the_agent(
    doubting: GrantKeeper, doubter: Doubter, store: FakeStore, tmp_path: Path
) -> None:
    doubting.take(Listed((manifest(),)))
    doubter.error = UnknownAuthority("it is of an authority that is not in ca.crt")
    again = GrantKeeper(store, GrantDirectory(tmp_path), "drone-1", doubter.check, monotonic=lambda: doubter.now_s)
    again.take(Listed((manifest(),)))
    doubter.now_s = UNVERIFIED_TIMEOUT_S * 2
    again.give_up_unverified()
    await again.report_once()
    assert on_disk(tmp_path) == {"g1.json"}
    assert store.statuses[-1][1]["phase"] == "Active"


async def test_an_api_server_that_is_gone_for_a_month_takes_no_grant_away(
    doubting: GrantKeeper, doubter: Doubter, store: FakeStore, tmp_path: Path
) -> None:
    doubting.take(Listed((manifest("g1"), manifest("g2"))))
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
    grant = Grant.from_body(manifest(status={"phase": "Complete", "message": "done"}))
    assert status_of(grant, {}, None)["phase"] == "Complete"
    assert status_of(grant, {KEY: "failed: x"}, "disk full")["phase"] == "Complete"


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
