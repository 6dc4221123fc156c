"""Chaos runs: repeatable fault schedules, detection of violated invariants, and repair at the end of each fault."""

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
from fractus_sim.chaos.chaos_cluster import ChaosTarget, with_disk
from fractus_sim.chaos.chaos_faults import FAULTS, inject
from fractus_sim.chaos.chaos_run import Missions, create_schedule
from fractus_sim.chaos.invariants import (
    TelemetrySample,
    flights_of_several_applications,
    flights_without_authority,
    forbidden_calls,
    landings_away_from_home,
    orphans,
    unfinished_missions,
    with_corrected_times,
)
from fractus_sim.errors import ExperimentError

ROOT = Path(__file__).parents[2]
HOME = Home(50.8637, 4.6785, 25.0)
DURATIONS = {name: (fault.shortest_s, fault.longest_s) for name, fault in FAULTS.items()}
BEGAN_S = 1_800_000_000.0


def grant(application: str = "one", **more: Any) -> GrantSpec:
    """Return the Grant of a Navigator. Its area has a radius of 200 m around home, and its maximum altitude is 50 m."""
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


def flight(*modes: tuple[float, str], end_s: float = 60) -> list[TelemetrySample]:
    """Return one sample per second of a drone in the air above home."""
    return [
        TelemetrySample(
            BEGAN_S + at, HOME.lat, HOME.lon, at < end_s, [mode for since, mode in modes if since <= at][-1]
        )
        for at in range(round(end_s) + 2)
    ]


def test_only_the_drone_has_a_separate_disk() -> None:
    spec = load_spec(ROOT / "examples" / "clusters" / "demo.yaml")
    sizes = {node.name: node.hardware.disk and node.hardware.disk.size_bytes for node in with_disk(spec).nodes}
    assert sizes == {node.name: 2**30 if node.name == "drone-1" else None for node in spec.nodes}
    assert with_disk(spec).nodes[0].hardware.vehicle == spec.nodes[0].hardware.vehicle


def test_fault_schedule_is_identical_for_the_same_seed() -> None:
    assert create_schedule(7, 1800, DURATIONS) == create_schedule(7, 1800, DURATIONS)
    assert create_schedule(7, 1800, DURATIONS) != create_schedule(8, 1800, DURATIONS)


@pytest.mark.parametrize("seed", range(20))
def test_long_fault_schedule_contains_every_fault_within_the_run(seed: int) -> None:
    planned = create_schedule(seed, 1800, DURATIONS)
    assert {fault.kind for fault in planned} == set(FAULTS) or len(planned) >= 8
    ends: dict[str, float] = {}
    for fault in planned:
        shortest, longest = DURATIONS[fault.kind]
        assert shortest <= fault.duration_s <= max(shortest, longest)
        assert fault.start_s + fault.duration_s <= 1800
        assert fault.start_s >= ends.get(fault.kind, 0)
        ends[fault.kind] = fault.start_s + fault.duration_s


def test_authority_invariant_is_violated_by_missing_entries_in_flight() -> None:
    log = [entry(at, "state", controller="system", in_air=True) for at in range(20)]
    (violation,) = flights_without_authority(flight((0, "GUIDED")), log)
    assert violation.time_s == BEGAN_S + 32
    assert not flights_without_authority(flight((0, "GUIDED"), (30, "RTL")), log)
    assert not flights_without_authority(flight((0, "GUIDED"), end_s=25), log)


def test_authority_invariant_is_independent_of_clock_steps() -> None:
    started_s = BEGAN_S - 5000
    state = {"controller": "system", "in_air": True}
    ahead = [entry(at + (7200 if at > 10 else 0), "state", boot_s=5000 + at, **state) for at in range(60)]
    assert not flights_without_authority(flight((0, "GUIDED")), with_corrected_times(ahead, started_s))
    hidden = [entry(at * 3, "state", boot_s=5000 + at, **state) for at in range(20)]
    (violation,) = flights_without_authority(flight((0, "GUIDED")), with_corrected_times(hidden, started_s))
    assert violation.time_s == BEGAN_S + 32


def test_authority_invariant_is_violated_by_an_entry_without_controller() -> None:
    log = [entry(at, "state", controller="" if at == 9 else "system", in_air=True) for at in range(60)]
    (violation,) = flights_without_authority(flight((0, "GUIDED")), log)
    assert violation.time_s == BEGAN_S + 9


def test_one_application_invariant_is_violated_by_two_drivers() -> None:
    one = grant("one")
    other = grant("other")
    grants = {spec.mission_key: spec for spec in (one, other)}
    state = {"controller": "system", "in_air": True}
    both = [grant_entry(0, one), grant_entry(1, other), entry(2, "state", **state)]
    (violation,) = flights_of_several_applications(both, grants)
    assert "one, other" in violation.description
    in_turn = [grant_entry(0, one), grant_entry(1, one, "removed"), grant_entry(2, other), entry(3, "state", **state)]
    assert not flights_of_several_applications(in_turn, grants)
    restarted = [grant_entry(0, one), entry(1, "started"), grant_entry(2, other), entry(3, "state", **state)]
    assert not flights_of_several_applications(restarted, grants)


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
    assert [words in violation.description for violation in violations] == ([True] if words else [])


def test_grant_invariant_is_violated_by_a_call_after_revocation() -> None:
    spec = grant()
    log = [grant_entry(0, spec), grant_entry(1, spec, "removed"), goto(2, spec)]
    (violation,) = forbidden_calls(log, {spec.mission_key: spec}, HOME)
    assert "it had no Grant" in violation.description
    (violation,) = forbidden_calls([grant_entry(0, spec), goto(2, spec)], {}, HOME)
    assert "never on the node" in violation.description


def test_mission_invariant_is_violated_by_unfinished_missions() -> None:
    ends = {
        "a": ("Completed", ""),
        "b": ("Failed", "the driver was lost"),
        "c": ("Failed", ""),
        "d": ("Flying", "leg 2"),
    }
    assert [violation.description.split()[0] for violation in unfinished_missions(ends)] == ["c", "d"]


def test_landing_invariant_is_violated_away_from_home() -> None:
    assert not landings_away_from_home(flight((0, "RTL")), HOME)
    (violation,) = landings_away_from_home(flight((0, "RTL")), Home(HOME.lat + 0.001, HOME.lon, 25.0))
    assert "111 m from home" in violation.description
    (violation,) = landings_away_from_home(flight((0, "RTL"))[:30], HOME)
    assert "in the air" in violation.description


def test_orphan_invariant_describes_remaining_objects() -> None:
    assert not orphans([])
    (violation,) = orphans([{"kind": "Secret", "metadata": {"name": "one-navigator"}}])
    assert "Secret/one-navigator (exists)" in violation.description
    ends = {
        "name": "one",
        "deletionTimestamp": "12:00",
        "finalizers": ["orphan"],
        "ownerReferences": [{"kind": "D", "name": "d"}],
    }
    (violation,) = orphans([{"kind": "ReplicaSet", "metadata": ends}])
    assert "ReplicaSet/one (exists; deleted at 12:00; owned by D/d; finalizers orphan)" in violation.description


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
    cluster = SimpleNamespace(nodes=[SimpleNamespace(fractus_state=tmp_path)])
    target = cast("ChaosTarget", SimpleNamespace(objects=lambda kinds, *_: objects.get(kinds, []), cluster=cluster))
    left = Missions(target, "chaos", print).orphans()
    assert [each["metadata"]["name"] for each in left] == ["default.carried-navigator", "default.stored-navigator"]


def test_drained_node_is_uncordoned_after_a_rejected_request(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fractus_sim.chaos.chaos_faults._RETRY_S", 0.0)
    cordoned = False
    refusals = 1

    def kubectl(command: str, *arguments: str, **_: object) -> str:
        """Fake kubectl.

        Like the real one, it exits with 0 after a rejected uncordon, but not after a rejected patch.
        """
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
    target = SimpleNamespace(
        kubectl=kubectl, kube=SimpleNamespace(run=kubectl), drone="drone-1", cluster=SimpleNamespace(spec=spec)
    )
    with inject(FAULTS["drain"], cast("ChaosTarget", target), Random(1)):
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
    target = cast("ChaosTarget", SimpleNamespace(kubectl=kubectl, drone="drone-1", cluster=cluster))
    complete = {"drone-1": "drone", "edge-1": "edge"}
    removed = set()
    for seed in range(8):
        labels.update(complete)
        with inject(FAULTS["label-removal"], target, Random(seed)):
            removed |= complete.keys() - labels.keys()
        assert labels == complete
    assert removed == {"drone-1", "edge-1"}
    assert refusals == 3
