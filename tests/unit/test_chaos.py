"""Fault schedules, invariants and faults of chaos runs."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from random import Random
from types import SimpleNamespace
from typing import Any, cast

import pytest
from fractus_cluster.spec import load_spec
from fractus_core.api import Grant
from fractus_core.api.grants import GrantSpec, pack
from fractus_core.policy.decision_types import Home
from fractus_sim.chaos.__main__ import with_disk
from fractus_sim.chaos.chaos_cluster import Stage
from fractus_sim.chaos.chaos_faults import FAULTS, broken
from fractus_sim.chaos.chaos_run import Missions, schedule
from fractus_sim.chaos.invariants import (
    Seen,
    forbidden_calls,
    in_two_applications,
    landed_elsewhere,
    left_over,
    not_ended,
    steadily_timed,
    without_authority,
)
from fractus_sim.errors import ExperimentError

ROOT = Path(__file__).parents[2]
HOME = Home(50.8637, 4.6785, 25.0)
DURATIONS = {name: (fault.shortest_s, fault.longest_s) for name, fault in FAULTS.items()}
BEGAN_S = 1_800_000_000.0


def grant(application: str = "one", **more: Any) -> GrantSpec:
    """Return a Grant of a Navigator, limited to 200 m around home and 50 m above home."""
    area = [{"circle": {"center": {"lat": HOME.lat, "lon": HOME.lon}, "radius": 200}}]
    return GrantSpec.model_validate(
        {
            "node": "drone-1",
            "application": {"namespace": "default", "name": application, "uid": f"uid-{application}"},
            "component": "Navigator",
            "instance": f"{application}-navigator",
            "class": "driver",
            "control": "full",
            "services": [{"service": "mobility", "methods": ["Goto", "GetPosition"]}],
            "operationArea": area,
            "home": {"lat": HOME.lat, "lon": HOME.lon, "alt": 0},
            "limits": {"maxAltitude": 50, "maxSpeed": 15},
            "mission": "uid",
        }
        | more
    )


def entry(at_s: float, kind: str, **more: Any) -> dict[str, Any]:
    time = datetime.fromtimestamp(BEGAN_S + at_s, UTC).isoformat()
    return {"time": time, "kind": kind, **more}


def grant_entry(at_s: float, spec: GrantSpec, change: str = "added") -> dict[str, Any]:
    return entry(at_s, "grant", change=change, identity=spec.identity, key=spec.mission_key)


def goto(at_s: float, spec: GrantSpec, north_m: float = 50, alt: float = 12, **more: Any) -> dict[str, Any]:
    target = {"lat": HOME.lat + north_m / 111_195, "lon": HOME.lon, "alt": alt, "reference": "home"}
    place = {"lat": HOME.lat, "lon": HOME.lon, "alt": 12.0}
    return entry(at_s, "call", caller=spec.identity, method="Goto", action="allow", result=target, **place) | more


def flight(*modes: tuple[float, str], end_s: float = 60) -> list[Seen]:
    """Return observations, one each second, of a drone in the air above home. Modes are (start, mode)."""
    return [
        Seen(BEGAN_S + at, HOME.lat, HOME.lon, at < end_s, [mode for since, mode in modes if since <= at][-1])
        for at in range(round(end_s) + 2)
    ]


def test_only_the_drone_has_a_separate_disk() -> None:
    spec = load_spec(ROOT / "examples" / "clusters" / "demo.yaml")
    sizes = {node.name: node.hardware.disk and node.hardware.disk.size_bytes for node in with_disk(spec).nodes}
    assert sizes == {node.name: 2**30 if node.name == "drone-1" else None for node in spec.nodes}
    assert with_disk(spec).nodes[0].hardware.vehicle == spec.nodes[0].hardware.vehicle


def test_fault_schedule_is_identical_for_the_same_seed() -> None:
    assert schedule(7, 1800, DURATIONS) == schedule(7, 1800, DURATIONS)
    assert schedule(7, 1800, DURATIONS) != schedule(8, 1800, DURATIONS)


@pytest.mark.parametrize("seed", range(20))
def test_long_fault_schedule_contains_every_fault_within_the_run(seed: int) -> None:
    planned = schedule(seed, 1800, DURATIONS)
    assert {item.fault for item in planned} == set(FAULTS) or len(planned) >= 8
    ends: dict[str, float] = {}
    for item in planned:
        shortest, longest = DURATIONS[item.fault]
        assert shortest <= item.duration_s <= max(shortest, longest)
        assert item.at_s + item.duration_s <= 1800
        assert item.at_s >= ends.get(item.fault, 0)
        ends[item.fault] = item.at_s + item.duration_s


def test_authority_invariant_is_violated_by_missing_entries_in_flight() -> None:
    log = [entry(at, "state", controller="system", in_air=True) for at in range(20)]
    (violation,) = without_authority(flight((0, "GUIDED")), log)
    assert violation.time_s == BEGAN_S + 32
    assert not without_authority(flight((0, "GUIDED"), (30, "RTL")), log)
    assert not without_authority(flight((0, "GUIDED"), end_s=25), log)


def test_authority_invariant_is_independent_of_clock_steps() -> None:
    started_s = BEGAN_S - 5000
    state = {"controller": "system", "in_air": True}
    ahead = [entry(at + (7200 if at > 10 else 0), "state", boot_s=5000 + at, **state) for at in range(60)]
    assert not without_authority(flight((0, "GUIDED")), steadily_timed(ahead, started_s))
    hidden = [entry(at * 3, "state", boot_s=5000 + at, **state) for at in range(20)]
    (violation,) = without_authority(flight((0, "GUIDED")), steadily_timed(hidden, started_s))
    assert violation.time_s == BEGAN_S + 32


def test_authority_invariant_is_violated_by_an_entry_without_controller() -> None:
    log = [entry(at, "state", controller="" if at == 9 else "system", in_air=True) for at in range(60)]
    (violation,) = without_authority(flight((0, "GUIDED")), log)
    assert violation.time_s == BEGAN_S + 9


def test_one_application_invariant_is_violated_by_two_drivers() -> None:
    first = grant("one")
    second = grant("other")
    grants = {spec.mission_key: spec for spec in (first, second)}
    state = {"controller": "system", "in_air": True}
    both = [grant_entry(0, first), grant_entry(1, second), entry(2, "state", **state)]
    (violation,) = in_two_applications(both, grants)
    assert "one, other" in violation.found
    in_turn = [
        grant_entry(0, first),
        grant_entry(1, first, "removed"),
        grant_entry(2, second),
        entry(3, "state", **state),
    ]
    assert not in_two_applications(in_turn, grants)
    restarted = [grant_entry(0, first), entry(1, "started"), grant_entry(2, second), entry(3, "state", **state)]
    assert not in_two_applications(restarted, grants)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (goto(1, grant()), ""),
        (goto(1, grant(), action="deny", north_m=500), ""),
        (goto(1, grant(), north_m=500), "outside"),
        (goto(1, grant(), alt=90), "50"),
        (goto(1, grant(), method="Land"), "does not include Land"),
        (goto(1, grant("stranger")), "it had no Grant"),
    ],
)
def test_grant_invariant_evaluates_permitted_calls_again(call: dict[str, Any], words: str) -> None:
    spec = grant()
    violations = forbidden_calls([grant_entry(0, spec), call], {spec.mission_key: spec}, HOME)
    assert [words in item.found for item in violations] == ([True] if words else [])


def test_grant_invariant_is_violated_by_a_call_after_revocation() -> None:
    spec = grant()
    log = [grant_entry(0, spec), grant_entry(1, spec, "removed"), goto(2, spec)]
    (violation,) = forbidden_calls(log, {spec.mission_key: spec}, HOME)
    assert "it had no Grant" in violation.found
    (violation,) = forbidden_calls([grant_entry(0, spec), goto(2, spec)], {}, HOME)
    assert "never on the node" in violation.found


def test_mission_invariant_is_violated_by_unfinished_missions() -> None:
    ends = {
        "a": ("Completed", ""),
        "b": ("Failed", "the driver was lost"),
        "c": ("Failed", ""),
        "d": ("Flying", "leg 2"),
    }
    assert [item.found.split()[0] for item in not_ended(ends)] == ["c", "d"]


def test_landing_invariant_is_violated_away_from_home() -> None:
    assert not landed_elsewhere(flight((0, "RTL")), HOME)
    (violation,) = landed_elsewhere(flight((0, "RTL")), Home(HOME.lat + 0.001, HOME.lon, 25.0))
    assert "111 m from home" in violation.found
    (violation,) = landed_elsewhere(flight((0, "RTL"))[:30], HOME)
    assert "in the air" in violation.found


def test_orphan_invariant_describes_remaining_objects() -> None:
    assert not left_over([])
    (violation,) = left_over([{"kind": "Secret", "metadata": {"name": "one-navigator"}}])
    assert "Secret/one-navigator (exists)" in violation.found
    ends = {
        "name": "one",
        "deletionTimestamp": "12:00",
        "finalizers": ["orphan"],
        "ownerReferences": [{"kind": "D", "name": "d"}],
    }
    (violation,) = left_over([{"kind": "ReplicaSet", "metadata": ends}])
    assert "ReplicaSet/one (exists; deleted at 12:00; owned by D/d; finalizers orphan)" in violation.found


def test_orphan_invariant_includes_grants_stored_on_nodes(tmp_path: Path) -> None:
    def body(application: str) -> dict[str, Any]:
        metadata = {"name": f"default.{application}-navigator", "uid": f"uid-{application}", "generation": 1}
        return Grant.model_validate({"metadata": metadata, "spec": grant(application)}).to_dict()

    objects = {
        "applications.fractus.dev": [{"kind": "Application", "metadata": {"name": "flies"}}],
        "nodegrants.fractus.dev": [{"spec": {"count": 2, "packed": pack([body("flies"), body("carried")])}}],
    }
    stored = tmp_path / "grants"
    stored.mkdir()
    for application in ("flies", "stored"):
        (stored / f"{application}.json").write_text(json.dumps(body(application)))
    cluster = SimpleNamespace(nodes=[SimpleNamespace(own_state=tmp_path)])
    stage = cast("Stage", SimpleNamespace(objects=lambda kinds, *_: objects.get(kinds, []), cluster=cluster))
    left = Missions(stage, "chaos", print).left_over()
    assert [item["metadata"]["name"] for item in left] == ["default.carried-navigator", "default.stored-navigator"]


def test_drained_node_is_uncordoned_after_a_rejected_request(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fractus_sim.chaos.chaos_faults._RETRY_S", 0.0)
    cordoned = False
    refusals = 1

    def kubectl(command: str, *arguments: str, **_: object) -> str:
        """Imitate kubectl. Among these commands only `patch` fails when the API server rejects the request."""
        nonlocal cordoned, refusals
        if command == "drain":
            cordoned = True
        elif refusals:
            refusals -= 1
            if command != "uncordon":
                raise ExperimentError("the server was unable to return a response in the time allotted")
        elif command == "uncordon" or '{"spec": {"unschedulable": null}}' in arguments:
            cordoned = False
        return ""

    spec = SimpleNamespace(nodes=[SimpleNamespace(name="edge-1")])
    stage = SimpleNamespace(
        kubectl=kubectl, kube=SimpleNamespace(run=kubectl), drone="drone-1", cluster=SimpleNamespace(spec=spec)
    )
    with broken(FAULTS["drain"], cast("Stage", stage), Random(1)):
        assert cordoned
    assert not cordoned


def test_label_fault_waits_for_the_drone_but_not_for_an_edge_node(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fractus_sim.chaos.chaos_faults._RETRY_S", 0.0)
    labels: dict[str, str] = {}
    refusals = 0

    def kubectl(_command: str, _kind: str, node: str, label: str, *_: object, **__: object) -> str:
        nonlocal refusals
        if label.endswith("-"):
            if node == "drone-1" and refusals < 3:
                refusals += 1
                raise ExperimentError("drone-1 is in the air")
            del labels[node]
        else:
            labels[node] = label.partition("=")[2]
        return ""

    nodes = [SimpleNamespace(name=name, node_class=name.split("-")[0]) for name in ("drone-1", "edge-1", "cloud-1")]
    cluster = SimpleNamespace(spec=SimpleNamespace(nodes=nodes))
    stage = cast("Stage", SimpleNamespace(kubectl=kubectl, drone="drone-1", cluster=cluster))
    complete = {"drone-1": "drone", "edge-1": "edge"}
    removed = set()
    for seed in range(8):
        labels.update(complete)
        with broken(FAULTS["label-removal"], stage, Random(seed)):
            removed |= complete.keys() - labels.keys()
        assert labels == complete
    assert removed == {"drone-1", "edge-1"}
    assert refusals == 3
