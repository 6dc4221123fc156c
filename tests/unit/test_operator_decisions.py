"""Decisions of the operator that need no cluster: conditions, differences, missions, labels, quantities, settings."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any, cast

import pytest
from fractus_core.api import Application, Drone, EdgeNode, Grant
from fractus_core.api.conditions import ConditionUpdate, merge_conditions
from fractus_core.api.plans import DeploymentPlanSpec, PlannedInstance
from fractus_core.control import Outcome, OutcomeKind, WaypointCounts
from fractus_core.planning.inventory import Host, Inventory, amount_of
from fractus_operator import status
from fractus_operator.cache import ClusterCache
from fractus_operator.comparison import contains, is_current, stamped
from fractus_operator.node_controller import geohash, location_labels
from fractus_operator.node_liveness import displayed_flight_state
from fractus_operator.pods import PodView, parse_host, parse_pod, refusal_of
from fractus_operator.replanning import (
    _with_names_of,
    of_generation,
    replan_reason,
    stuck_nodes,
    waits_for_landing,
)
from fractus_operator.settings import BadSetting, Settings
from fractus_operator.status import Blocked, flight, mission_outcome
from fractus_operator.status_reporter import transition_events
from fractus_operator.store import Store

NOW = datetime(2026, 6, 1, 12, 0, tzinfo=UTC)
V1 = "fractus.dev/v1alpha1"


# -- conditions --


def test_condition_transition_is_reported_and_sets_time() -> None:
    first, transitions = merge_conditions([], [ConditionUpdate("Ready", "False", "PodsNotReady")], 1, NOW)
    assert [n.reason for n in transitions] == ["PodsNotReady"]
    later = NOW + timedelta(minutes=1)
    same, transitions = merge_conditions(
        first, [ConditionUpdate("Ready", "False", "PodsNotReady", "two to go")], 2, later
    )
    assert transitions == ()
    assert (same[0].last_transition_time, same[0].message, same[0].observed_generation) == (NOW, "two to go", 2)
    other, transitions = merge_conditions(same, [ConditionUpdate("Ready", "False", "NodeGone")], 2, later)
    assert [n.reason for n in transitions] == ["NodeGone"]
    assert other[0].last_transition_time == NOW
    true, _ = merge_conditions(other, [ConditionUpdate("Ready", "True", "PodsReady")], 2, later)
    assert true[0].last_transition_time == later


def test_stages_reached_together_have_one_event() -> None:
    stages = [ConditionUpdate(stage, "True", stage, f"{stage} it is") for stage in ("Planned", "Granted", "Deployed")]
    ready = ConditionUpdate("Ready", "True", "PodsReady", "all pods are ready")
    waiting = ConditionUpdate("Ready", "False", "PodsNotReady", "one to go", progress=True)
    (only,) = transition_events([*stages, waiting])
    assert (only.reason, only.message) == ("Planned", "Planned it is; Granted it is; Deployed it is")
    assert [update.reason for update in transition_events([*stages, ready])] == ["Planned", "PodsReady"]
    assert list(transition_events([stages[2], ready])) == [stages[2], ready], "a single transition is not merged"
    refused = ConditionUpdate("Deployed", "False", "NameTaken", "a Secret has the same name")
    not_ready = ConditionUpdate("Ready", "False", "NameTaken", "a Secret has the same name")
    merged = list(transition_events([*stages[:2], refused, not_ready]))
    assert [(update.reason, update.warning) for update in merged] == [("Planned", False), ("NameTaken", True)]


def test_condition_is_warning_only_for_problem() -> None:
    assert ConditionUpdate("Ready", "False", "X").warning
    assert not ConditionUpdate("Ready", "False", "X", progress=True).warning
    assert not ConditionUpdate("Ready", "True", "X").warning


# -- differences --


def test_applied_object_is_current_until_changed() -> None:
    desired = stamped(
        {"metadata": {"name": "a"}, "spec": {"replicas": 1, "ports": [{"port": 1}], "empty": {}, "none": []}}
    )
    observed = {
        "metadata": {**desired["metadata"], "uid": "u"},
        "spec": {"replicas": 1, "ports": [{"port": 1, "protocol": "TCP"}], "more": 2},
    }
    assert is_current(desired, observed)
    assert not is_current(desired, None)
    for spoil in ({"replicas": 2}, {"ports": []}, {"ports": [{"port": 1}, {"port": 2}]}, {"ports": None}):
        assert not is_current(desired, {**observed, "spec": {**observed["spec"], **spoil}}), spoil


def test_removed_field_is_a_difference() -> None:
    before = stamped({"metadata": {"name": "a"}, "spec": {"x": 1, "y": 2}})
    assert not is_current(stamped({"metadata": {"name": "a"}, "spec": {"x": 1}}), before)


@pytest.mark.parametrize(
    ("observed", "desired"), [(1, 1.0), (None, ""), (None, False), (None, {}), (None, []), ({"a": 1}, {})]
)
def test_missing_and_empty_values_are_equal(observed: object, desired: object) -> None:
    assert contains(observed, desired)


# -- missions --


def application(generation: int = 1) -> Application:
    parts = [{"name": "A", "placement": "cloud", "container": {"image": "a"}}]
    metadata = {"name": "app", "namespace": "ns", "uid": "u1", "generation": generation}
    return Application.from_body(
        {"apiVersion": V1, "kind": "Application", "metadata": metadata, "spec": {"components": parts}}
    )


def placed(instance: str, node: str | None, **more: object) -> PlannedInstance:
    values = {"component": "A", "placement": "edge" if node else "cloud", "role": "static" if node else "cloud"} | more
    return PlannedInstance.model_validate({"instance": instance, "node": node, **values})


def edge(name: str) -> EdgeNode:
    spec = {"location": {"lat": 1, "lon": 2}}
    return EdgeNode.from_body({"apiVersion": V1, "kind": "EdgeNode", "metadata": {"name": name}, "spec": spec})


PLAN = DeploymentPlanSpec(
    application="app", application_generation=1, placements=(placed("a-1", "edge-1"), placed("a-c", None, replicas=2))
)
INVENTORY = Inventory(hosts={"edge-1": Host("edge-1")}, edge_nodes={"edge-1": edge("edge-1")})


def test_plan_is_kept_while_its_nodes_exist() -> None:
    assert replan_reason(application(), PLAN, INVENTORY, {}) is None
    unreachable = replace(INVENTORY, hosts={"edge-1": Host("edge-1", ready=False)})
    assert replan_reason(application(), PLAN, unreachable, {}) is None


def test_replan_reason_names_the_cause() -> None:
    assert replan_reason(application(), None, INVENTORY, {}) == "NoPlanYet"
    assert replan_reason(application(2), PLAN, INVENTORY, {}) == "SpecChanged"
    same = PLAN.model_copy(update={"application_digest": application().spec.mission_digest})
    assert replan_reason(application(2), same, INVENTORY, {}) is None
    assert replan_reason(application(), PLAN, replace(INVENTORY, hosts={}), {}) == "NodeGone"
    assert replan_reason(application(), PLAN, replace(INVENTORY, edge_nodes={}), {}) == "NodeGone"
    assert replan_reason(application(), PLAN, INVENTORY, {"edge-1": "full"}) == "NodeUnusable"
    cordoned = replace(INVENTORY, hosts={"edge-1": Host("edge-1", schedulable=False)})
    assert replan_reason(application(), PLAN, cordoned, {}) == "NodeCordoned"
    assert replan_reason(application(), PLAN, cordoned, {}, in_flight="edge-1") is None


def test_plan_is_kept_while_drone_is_in_flight() -> None:
    without = replace(INVENTORY, hosts={}, edge_nodes={})
    assert replan_reason(application(), PLAN, without, {}) == "NodeGone"
    assert replan_reason(application(), PLAN, without, {"edge-1": "full"}, in_flight="edge-1") is None
    assert replan_reason(application(2), PLAN, without, {}, in_flight="edge-1") == "SpecChanged"


def test_changed_manifest_waits_for_landing() -> None:
    assert waits_for_landing(application(2), PLAN, "d")
    assert not waits_for_landing(application(1), PLAN, "d")
    assert not waits_for_landing(application(2), PLAN, None)
    now = application(2)
    now = now.model_copy(update={"spec": now.spec.model_copy(update={"update_policy": "Immediate"})})
    assert not waits_for_landing(now, PLAN, "d")


def test_instances_in_flight_keep_names_of_another_release() -> None:
    named = PLAN.model_copy(update={"placements": (placed("old-1", "edge-1"), placed("old-c", None, replicas=2))})
    fresh = (placed("new-1", "edge-1"), placed("new-c", None, replicas=2), placed("new-2", "edge-2"))
    renamed = _with_names_of(named, PLAN.model_copy(update={"placements": fresh}))
    assert [p.instance for p in renamed.placements] == ["old-1", "old-c", "new-2"]
    clash = (*fresh[:2], placed("old-1", "edge-2"))
    assert [p.instance for p in _with_names_of(named, PLAN.model_copy(update={"placements": clash})).placements] == [
        "new-1", "new-c", "old-1",
    ]  # fmt: skip


def view(instance: str, **more: object) -> PodView:
    values: dict[str, object] = {"ready": True, "finished": False, "terminating": False, "ip": None}
    values |= {"deployment": instance, **more}
    return PodView("ns", f"{instance}-x", None, {"fractus.dev/instance": instance}, {}, **values)  # type: ignore[arg-type]


def test_node_is_stuck_after_grace_period() -> None:
    waiting = view("a-1", ready=False, unschedulable_since=NOW - timedelta(seconds=2), unschedulable_message="no cpu")
    assert stuck_nodes(PLAN, [waiting], NOW) == ({}, 3.0)
    stuck, again_s = stuck_nodes(PLAN, [waiting], NOW + timedelta(seconds=10))
    assert (set(stuck), again_s) == ({"edge-1"}, None)
    assert stuck["edge-1"] == "the scheduler cannot place a-1: no cpu"  # shown after the name of the node
    in_the_cloud = view("a-c", ready=False, unschedulable_since=NOW - timedelta(minutes=1))
    leaving = view("a-1", terminating=True, unschedulable_since=NOW - timedelta(minutes=1))
    forged = view("a-1", deployment=None, unschedulable_since=NOW - timedelta(minutes=1))
    assert stuck_nodes(PLAN, [in_the_cloud, leaving, forged], NOW) == ({}, None)


def test_node_is_not_stuck_while_previous_pod_terminates() -> None:
    waiting = view("a-1", unschedulable_since=NOW - timedelta(seconds=60), unschedulable_message="full")
    leaving = replace(view("a-0", terminating=True), node="edge-1")
    assert stuck_nodes(PLAN, [waiting, leaving], NOW) == ({}, 1.0)
    assert set(stuck_nodes(PLAN, [waiting], NOW)[0]) == {"edge-1"}


def test_status_counts_ready_pods_up_to_replicas() -> None:
    pods = [view("a-c"), view("a-c"), view("a-c"), view("a-1", ready=False)]
    update = status.deployed(PLAN, pods, 0)
    assert (update.phase, update.pods) == ("Deploying", "2/3")
    assert "a-1" in update.message
    done = status.deployed(PLAN, [view("a-1"), view("a-c"), view("a-c"), view("a-c", terminating=True)], 0)
    assert (done.phase, done.pods) == ("Running", "3/3")
    old = status.deployed(PLAN, [view("a-1", terminating=True), view("a-c"), view("a-c")], 0)
    assert old.pods == "2/3"


def test_status_reports_why_pods_cannot_be_created() -> None:
    why = 'pods "a-1-5d8f-" is forbidden: exceeded quota: compute'
    pods = [view("a-c"), view("a-c")]
    update = status.deployed(PLAN, pods, 0, refused={"a-1": why, "a-c": "of its last rollout"})
    ready = next(c for c in update.conditions if c.type == "Ready")
    assert (ready.reason, ready.warning) == ("PodsRefused", True)
    assert update.message == ready.message == f"waiting for a-1; pods of a-1 cannot be created: {why}"
    assert status.deployed(PLAN, [*pods, view("a-1")], 0, refused={"a-1": why}).phase == "Running"
    failure = {"type": "ReplicaFailure", "status": "True", "reason": "FailedCreate", "message": why}
    scaled = {"type": "Available", "status": "False", "message": "no"}
    conditions = {"a": [scaled, failure], "b": [scaled, failure | {"status": "False"}], "c": []}
    conditions["e"] = [failure | {"reason": "FailedDelete"}]
    bodies = [{"metadata": {"name": name}, "status": {"conditions": reported}} for name, reported in conditions.items()]
    bodies.append({"metadata": {"name": "d"}})
    refused = {body["metadata"]["name"]: refusal_of(body) for body in bodies}
    assert refused == {"a": why, "b": "", "c": "", "d": "", "e": ""}


@pytest.mark.parametrize(
    ("output", "text"),
    [
        ("flies\nno route to the river\n", "no route to the river (before: flies)"),
        ("stops", "stops"),
        (
            'Traceback (most recent call last):\n  File "a.py", line 3\n    x = 1 / 0\nZeroDivisionError: division by zero\ngrpc: shutting down\n',
            "ZeroDivisionError: division by zero (before: Traceback",
        ),
        ("a" * 5000 + "\nValueError: " + "b" * 5000, "ValueError: bbb"),
    ],
)
def test_status_names_the_error_before_the_other_log_lines(output: str, text: str) -> None:
    container = {"state": {"terminated": {"exitCode": 1, "message": output}}}
    body = {"metadata": {"name": "p", "namespace": "ns"}, "spec": {}, "status": {"containerStatuses": [container]}}
    failure = parse_pod(body).failure
    assert failure.startswith(f"exit code 1: {text}")
    assert len(failure) < 900


def test_status_reports_exit_code_and_last_log_lines() -> None:
    ended = {"exitCode": 1, "message": "Traceback\nValueError: no route\n"}
    restarting = {"state": {"running": {}}, "lastState": {"terminated": ended}}
    never = {"state": {"waiting": {"reason": "ImagePullBackOff", "message": "no such image"}}}
    well = {"state": {"running": {}}, "lastState": {"terminated": {"exitCode": 0}}}
    body = {"metadata": {"name": "p", "namespace": "ns"}, "spec": {}}
    failures = [parse_pod(body | {"status": {"containerStatuses": [c]}}).failure for c in (restarting, never, well)]
    assert failures[::2] == ["exit code 1: ValueError: no route (before: Traceback)", ""]
    assert failures[1].startswith("ImagePullBackOff: no such image; push the image to a registry")
    pods = [view("a-c"), view("a-c"), view("a-1", ready=False, failure=failures[0])]
    update = status.deployed(PLAN, pods, 0)
    ready = next(c for c in update.conditions if c.type == "Ready")
    assert (ready.reason, ready.warning) == ("ComponentFailed", True)
    assert update.message == "waiting for a-1; a-1 failed with exit code 1: ValueError: no route (before: Traceback)"
    failed = status.mission_record(Outcome(OutcomeKind.FAILED, "driver lost"), pods)
    assert failed.message == "driver lost; a-1 failed with exit code 1: ValueError: no route (before: Traceback)"
    assert status.mission_record(Outcome(OutcomeKind.COMPLETE, "done"), pods).message == "done"


def test_status_names_pods_that_are_evicted_or_cannot_be_scheduled() -> None:
    body = {
        "metadata": {"name": "p", "namespace": "ns", "labels": {"fractus.dev/instance": "a-1"}},
        "spec": {"nodeName": "d"},
    }
    drained = {
        "type": "DisruptionTarget",
        "status": "True",
        "reason": "EvictionByEvictionAPI",
        "message": "Eviction API: evicting",
    }
    tainted = drained | {
        "reason": "DeletionByTaintManager",
        "message": "Taint manager: deleting due to NoExecute taint",
    }
    unplaced = {"type": "PodScheduled", "status": "False", "reason": "Unschedulable", "lastTransitionTime": NOW.isoformat(),
                "message": "0/6 nodes are available: 1 node(s) had untolerated taint"}  # fmt: skip
    problems = [parse_pod(body | {"status": {"conditions": [c]}}).problem for c in (drained, tainted, unplaced)]
    assert problems == [
        "a-1 was evicted from d: eviction requested, for example by kubectl drain",
        "a-1 was evicted from d: Taint manager: deleting due to NoExecute taint",
        "a-1 cannot be scheduled: 0/6 nodes are available: 1 node(s) had untolerated taint",
    ]
    leaving = replace(view("a-1", ready=False, terminating=True, eviction="by kubectl drain"), node="d")
    waiting = view("a-1", ready=False, unschedulable_since=NOW, unschedulable_message="no node")
    update = status.deployed(PLAN, [view("a-c"), view("a-c"), leaving, waiting], 0)
    assert update.message == (
        "waiting for a-1; a-1 cannot be scheduled: no node; a-1 was evicted from d: by kubectl drain"
    )
    ready = next(c for c in update.conditions if c.type == "Ready")
    assert (ready.reason, ready.warning) == ("PodsNotReady", False)
    lost = status.mission_record(Outcome(OutcomeKind.FAILED, "driver lost"), [leaving])
    assert lost.message == "driver lost; a-1 was evicted from d: by kubectl drain"


def grant(phase: str | None, uid: str = "u1", class_: str = "driver") -> Grant:
    owner = {"namespace": "ns", "name": "app", "uid": uid}
    spec = {"node": "d", "application": owner, "component": "N", "instance": "n", "class": class_}
    status = {"status": {"phase": phase, "message": "because"}} if phase else {}
    return Grant.from_body({"apiVersion": V1, "kind": "Grant", "metadata": {"name": "ns.n"}, "spec": spec, **status})


def test_mission_outcome_is_that_of_the_driver() -> None:
    assert mission_outcome("u1", [grant(None), grant("Active"), grant("Pending")]) is None
    assert mission_outcome("u1", [grant("Complete", uid="u0"), grant("Failed", class_="passenger")]) is None
    assert mission_outcome("u1", [grant("Complete")]) == Outcome(OutcomeKind.COMPLETE, "because")
    assert mission_outcome("u1", [grant("Failed")]) == Outcome(OutcomeKind.FAILED, "because")
    assert mission_outcome("u1", [grant("Revoked")]) == Outcome(OutcomeKind.REVOKED, "because")


def test_completed_status_contains_waypoint_counts_of_the_grant() -> None:
    body = grant("Complete").to_dict()
    body["status"]["waypoints"] = {"reached": 4, "skipped": 0, "corrected": 1}
    outcome = mission_outcome("u1", [Grant.from_body(body)])
    assert outcome is not None
    update = status.over(status.mission_record(outcome), "d", None)
    assert update.phase == "Completed"
    assert update.message == "because; 4 of 4 waypoints reached (1 with corrections by policies)"
    assert [c.type for c in update.conditions] == ["Ready", "MissionComplete"]


def test_completed_status_contains_counts_of_pictures() -> None:
    body = grant("Complete").to_dict()
    body["status"]["pictures"] = {"taken": 12, "refused": 3}
    granted = [Grant.from_body(body)]
    outcome = mission_outcome("u1", granted)
    assert outcome is not None
    record = status.mission_record(outcome, pictures=status.reported_pictures("u1", granted))
    assert status.over(record, "d", None).message == "because; 12 pictures taken, 3 refused"
    assert status.reported_pictures("other", granted) is None


def test_completed_mission_with_skipped_waypoints_is_partial() -> None:
    outcome = Outcome(OutcomeKind.COMPLETE, "done", WaypointCounts(reached=3, skipped=1))
    update = status.over(status.mission_record(outcome), "d", None)
    assert (update.phase, update.message) == ("Completed", "done; 3 of 4 waypoints reached, 1 skipped")
    partial = next(c for c in update.conditions if c.type == "Partial")
    assert (partial.status, partial.reason, partial.warning) == ("True", "WaypointsSkipped", True)
    assert "3 of 4" in partial.message


@pytest.mark.parametrize("kind", OutcomeKind)
def test_status_reports_every_mission_outcome(kind: OutcomeKind) -> None:
    update = status.over(status.mission_record(Outcome(kind, "because")), "d", None)
    complete = kind is OutcomeKind.COMPLETE
    assert (update.phase, update.message) == ("Completed" if complete else "Failed", "because")
    assert [c.status for c in update.conditions] == ["False", "True" if complete else "False"]
    assert update.conditions[0].warning is not complete


def flown(state: str, last: str | None = None, controller: str | None = None) -> Drone:
    fields = {"flightState": state, "lastFlightState": last or state, "controller": controller}
    body = {"apiVersion": V1, "kind": "Drone", "metadata": {"name": "d"}, "spec": {}}
    return Drone.from_body({**body, "status": {name: value for name, value in fields.items() if value}})


def test_phase_is_returning_until_drone_has_landed() -> None:
    record = status.mission_record(Outcome(OutcomeKind.FAILED, "driver lost"))
    update = status.over(record, "d", flown("flying", controller="system"))
    assert (update.phase, update.controller) == ("Returning", "system")
    silent = status.over(record, "d", flown("unknown", "flying"))
    assert (silent.phase, "at its last report" in silent.message) == ("Returning", True)
    for landed in (flown("inactive"), None):
        update = status.over(record, "d", landed)
        assert (update.phase, update.message, update.controller) == ("Failed", "driver lost", None)


def test_later_flight_does_not_change_status_of_landed_mission() -> None:
    record = status.mission_record(Outcome(OutcomeKind.COMPLETE, "done")).model_copy(update={"landed": True})
    assert status.over(record, "d", flown("flying", controller="system")).phase == "Completed"


@pytest.mark.parametrize(
    ("phase", "reason", "outcome"),
    [
        ("Completed", "MissionComplete", "Complete"),
        ("Returning", "MissionComplete", "Complete"),
        ("Returning", "MissionRevoked", "Revoked"),
        ("Failed", "MissionFailed", "Failed"),
        ("Flying", "MissionBegun", None),
    ],
)
def test_outcome_is_read_from_status_of_earlier_release(phase: str, reason: str, outcome: str | None) -> None:
    complete = "True" if reason == "MissionComplete" else "False"
    mission = {"type": "MissionComplete", "status": complete, "reason": reason, "message": "because"}
    reported = {"phase": phase, "observedGeneration": 2, "conditions": [mission]}
    record = status.reported_record(reported, 2)
    assert (record.outcome if record is not None else None) == outcome
    assert status.reported_record(reported, 3) is None, "the plan is of a later mission"


@pytest.mark.parametrize(
    ("drone", "begun", "phase"),
    [
        (flown("inactive"), False, "Waiting"),
        (flown("inactive"), True, "Landed"),
        (flown("takingOff"), False, "TakingOff"),
        (flown("landing"), False, "Flying"),
        (flown("unknown", "flying"), True, "Unknown"),
        (None, True, "Unknown"),
    ],
)
def test_flight_phase_follows_drone_state(drone: Drone | None, begun: bool, phase: str) -> None:
    flight_phase = flight("d", drone, took_off=begun)
    assert flight_phase.phase == phase
    update = status.deployed(PLAN, [view("a-1")], 0, flight_phase)
    assert update.phase == ("Deploying" if phase in {"Waiting", "Landed"} else phase), (
        "the phase is Deploying, because a pod is missing"
    )


def test_status_reports_blocked_stage() -> None:
    update = status.blocked(Blocked("Pending", "Granted", "PolicyInvalid", "no zone"), None)
    assert [(c.type, c.status) for c in update.conditions] == [
        ("Planned", "True"),
        ("Granted", "False"),
        ("Ready", "False"),
    ]
    queued = status.blocked(Blocked("Queued", "Planned", "DroneBusy", "busy"), None)
    assert not any(condition.warning for condition in queued.conditions)


# -- locations --


@pytest.mark.parametrize(
    ("lat", "lon", "cell"),
    [(57.64911, 10.40744, "u4pruydqqvj"), (-25.382708, -49.265506, "6gkzwgjzn82"), (42.605, -5.603, "ezs42")],
)
def test_geohash_of_known_positions(lat: float, lon: float, cell: str) -> None:
    assert geohash(lat, lon, len(cell)) == cell


def test_location_labels_of_drone() -> None:
    spec = {"depot": "base", "home": {"lat": 1, "lon": 2}, "interfaces": [{"technology": "WiFi"}, {"technology": "4G"}]}
    body = {"apiVersion": V1, "kind": "Drone", "metadata": {"name": "d"}, "spec": spec}
    assert location_labels(Drone.from_body(body)) == {
        "fractus.dev/depot": "base",
        "fractus.dev/geohash": geohash(1, 2),
        "fractus.dev/interface-wifi": "true",
        "fractus.dev/interface-4g": "true",
    }
    flown = Drone.from_body({**body, "status": {"position": {"lat": 40, "lon": 20}}})
    assert location_labels(flown)["fractus.dev/geohash"] == geohash(40, 20)


# -- pods and nodes --


@pytest.mark.parametrize(
    ("text", "value"), [("250m", 0.25), ("1Ki", 1024), ("1e3", 1000), ("500n", 5e-7), ("2E", 2e18), (3, 3)]
)
def test_quantities_are_parsed(text: str | int, value: float) -> None:
    assert amount_of(text) == pytest.approx(value)


def test_pod_requests_are_maximum_of_init_and_main_containers() -> None:
    def container(cpu: str) -> dict:
        return {"resources": {"requests": {"cpu": cpu}}}

    body = {
        "metadata": {"name": "p", "namespace": "ns", "labels": {"x": "y", "fractus.dev/instance": "i"}},
        "spec": {
            "containers": [container("100m"), container("200m")],
            "initContainers": [container("1")],
            "overhead": {"cpu": "50m"},
        },
    }
    pod = parse_pod(body)
    assert pod.requests["cpu"] == pytest.approx(1.05)
    assert (pod.instance, pod.ready, pod.labels) == ("i", False, {"fractus.dev/instance": "i"})


def test_pod_requests_include_sidecars_and_overhead() -> None:
    """The proxy of a service mesh is an init container that keeps running. The scheduler counts its requests."""

    def container(cpu: str, **more: str) -> dict:
        return {"resources": {"requests": {"cpu": cpu}}, **more}

    def cpu_requests(**spec: Any) -> float:
        return parse_pod({"metadata": {"name": "p", "namespace": "ns"}, "spec": spec}).requests["cpu"]

    proxy = container("200m", restartPolicy="Always")
    main = container("300m")
    assert cpu_requests(containers=[main], initContainers=[proxy]) == pytest.approx(0.5)
    assert cpu_requests(containers=[main], initContainers=[proxy, container("400m")]) == pytest.approx(0.6)
    assert cpu_requests(containers=[main], initContainers=[container("400m"), proxy]) == pytest.approx(0.5)
    assert cpu_requests(containers=[main], initContainers=[proxy], **container("1")) == pytest.approx(1)


@pytest.mark.parametrize(
    ("spec", "phase", "finished"),
    [({}, "Running", False), ({}, "Failed", True), ({"activeDeadlineSeconds": 1}, "Running", True),
     ({"activeDeadlineSeconds": 2**31}, "Running", False)],
)  # fmt: skip
def test_finished_label_does_not_hide_running_pod(spec: dict, phase: str, finished: bool) -> None:
    metadata = {"name": "p", "namespace": "ns", "labels": {"fractus.dev/finished": "20260601T120000Z"}}
    pod = parse_pod({"metadata": metadata, "spec": spec, "status": {"phase": phase}})
    assert (pod.finished_at is not None) == finished


@pytest.mark.parametrize(
    ("state", "last", "mission", "shown"),
    [
        ("inactive", None, None, "inactive"),
        ("unknown", "inactive", None, "offline"),
        ("unknown", "charging", "False", "offline"),
        ("unknown", "inactive", "True", "unknown"),
        ("unknown", "inactive", "Unknown", "unknown"),
        ("unknown", "flying", None, "unknown"),
        ("unknown", None, None, "unknown"),
    ],
)
def test_displayed_state_is_unknown_only_if_drone_may_be_in_the_air(
    state: str, last: str, mission: str, shown: str
) -> None:
    drone_status: dict[str, Any] = {"flightState": state, "lastSeen": "2026-06-01T12:00:00Z"}
    if last is not None:
        drone_status["lastFlightState"] = last
    if mission is not None:
        drone_status["conditions"] = [
            {
                "type": "OnMission",
                "status": mission,
                "reason": "R",
                "message": "m",
                "lastTransitionTime": "2026-06-01T12:00:00Z",
            }
        ]
    body = {"apiVersion": V1, "kind": "Drone", "metadata": {"name": "d"}, "spec": {}}
    assert displayed_flight_state(Drone.from_body({**body, "status": drone_status})) == shown
    assert displayed_flight_state(Drone.from_body(body)) == "offline"


def test_node_heartbeat_does_not_change_host() -> None:
    def node(beat: str) -> dict:
        condition = {"type": "Ready", "status": "True", "lastHeartbeatTime": beat}
        return {
            "metadata": {"name": "n", "resourceVersion": beat},
            "status": {"conditions": [condition], "allocatable": {"cpu": "2"}},
        }

    assert parse_host(node("1")) == parse_host(node("2"))
    assert not parse_host({"metadata": {"name": "n"}, "spec": {"unschedulable": True}}).schedulable


@pytest.mark.parametrize(
    ("key", "effect", "guarded"),
    [
        ("fractus.dev/class", "NoExecute", True),
        ("fractus.dev/class", "NoSchedule", False),
        ("node.kubernetes.io/unreachable", "NoExecute", False),
    ],
)
def test_only_no_execute_taint_guards_node(key: str, effect: str, guarded: bool) -> None:
    node = {"metadata": {"name": "n"}, "spec": {"taints": [{"key": key, "effect": effect}]}}
    assert parse_host(node).guarded is guarded
    assert not parse_host({"metadata": {"name": "n"}}).guarded


# -- settings --


def test_settings_come_from_the_environment() -> None:
    settings = Settings.from_environment({"FRACTUS_PLANNING_SAFETY_RADIUS": "9.5", "FRACTUS_LOG_LEVEL": "debug"})
    assert (settings.planning.safety_radius_m, settings.log_level) == (9.5, 10)
    assert (settings.gateway_image, settings.planning.gateway) == ("", False)
    settings = Settings.from_environment({"FRACTUS_GATEWAY_IMAGE": "registry.test/mobility:1"})
    assert (settings.gateway_image, settings.planning.gateway) == ("registry.test/mobility:1", True)
    assert settings.agent_users == {f"system:serviceaccount:fractus-system:fractus-{n}" for n in ("agent", "node")}


@pytest.mark.parametrize(
    "environment",
    [
        {"FRACTUS_LOG_LEVEL": "LOUD"},
        {"FRACTUS_LOG_FORMAT": "xml"},
        {"FRACTUS_PLANNING_CRUISE_SPEED": "fast"},
        {"FRACTUS_PLANNING_CRUISE_SPEED": "-1"},
        {"FRACTUS_PLANNING_CRUISE_SPEED": "0"},
        {"FRACTUS_PLANNING_BATTERY_RESERVE": "20"},
        {"FRACTUS_PLANNING_RANKING": "best"},
        {"FRACTUS_PLANNING_POLICY_CONFLICTS": "ignore"},
        {"FRACTUS_LEASE": "0.5"},
    ],
)
def test_invalid_setting_is_named(environment: dict[str, str]) -> None:
    with pytest.raises(BadSetting, match=next(iter(environment))):
        Settings.from_environment(environment)


# -- waking --


def edge_body(version: int, ready: str) -> dict[str, Any]:
    condition = {"type": "Ready", "status": ready, "reason": "R", "lastTransitionTime": "2026-01-01T00:00:00Z"}
    status = {"conditions": [condition], "lastSeen": f"2026-01-01T00:00:{version:02d}Z"}
    metadata = {"name": "e", "resourceVersion": str(version)}
    spec = {"location": {"lat": 0, "lon": 0}}
    return {"apiVersion": V1, "kind": "EdgeNode", "metadata": metadata, "spec": spec, "status": status}


async def test_applications_wake_when_edge_node_becomes_ready() -> None:
    cache = ClusterCache(cast(Store, None))
    cache.edge_nodes.record_write(("", "e"), edge_body(1, "False"))
    with cache.subscriptions.subscribe(("default", "app")) as inputs:
        cache.edge_nodes.record_write(("", "e"), edge_body(2, "False"))
        assert not await inputs.changed(0)
        cache.edge_nodes.record_write(("", "e"), edge_body(3, "True"))
        assert await inputs.changed(1)


def test_update_policy_and_ends_of_pods_do_not_change_the_mission() -> None:
    spec = application().spec
    same_mission = spec.model_copy(update={"ttl_after_finished": 5, "after_flight": 0, "update_policy": "Immediate"})
    assert same_mission.mission_digest == spec.mission_digest
    lasting = tuple(c.model_copy(update={"ends_with": "flight"}) for c in spec.components)
    assert spec.model_copy(update={"components": lasting}).mission_digest == spec.mission_digest
    same_mission = tuple(c.model_copy(update={"name": f"{c.name}2"}) for c in spec.components)
    assert spec.model_copy(update={"components": same_mission}).mission_digest != spec.mission_digest
    # A field with its default value has the same digest as an omitted field.
    assert type(spec).model_validate(spec.model_dump(by_alias=True)).mission_digest == spec.mission_digest


def test_plan_gets_new_generation_of_unchanged_mission() -> None:
    stamped = of_generation(application(), PLAN)
    assert stamped.application_digest == application().spec.mission_digest
    assert of_generation(application(), stamped) is stamped
    assert of_generation(application(2), stamped).application_generation == 2
