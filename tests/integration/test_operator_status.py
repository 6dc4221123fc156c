"""Status of Applications: the operator derives it from its observations, and never believes an edited status."""

from __future__ import annotations

import signal
from typing import Any

import pytest
from control_plane import wait_for
from operator_world import FRACTUS, SYSTEM, OperatorProcess, World, fractus_object, traffic
from test_operator import deployed, end_mission, running

Body = dict[str, Any]
COMPLETED = {
    "phase": "Completed",
    "drone": "nope",
    "message": "done",
    "controller": "nobody",
    "conditions": [
        {
            "type": kind,
            "status": "True",
            "reason": "MissionComplete",
            "message": "done",
            "lastTransitionTime": "2026-01-01T00:00:00Z",
        }
        for kind in ("MissionComplete", "Invented")
    ],
}


RUNNING_OR_RESTARTED = pytest.mark.parametrize(
    "restarted",
    # `make test` restarts the operator in test_edited_status_in_flight_is_corrected_and_flight_continues and
    # test_returning_drone_stays_claimed_after_restart_with_edited_status.
    [False, pytest.param(True, marks=pytest.mark.slow)],
    ids=["running", "restarted"],
)


def edit_status(world: World, namespace: str, status: Body, name: str = "traffic") -> None:
    """Write the status of an Application, as an administrator can."""
    present = world.application(namespace, name) or {}
    generation = present["metadata"]["generation"]
    path = f"{FRACTUS}/namespaces/{namespace}/applications/{name}/status"
    world.api.merge(path, {"status": {**status, "observedGeneration": generation}})


def essence(status: Body) -> Body:
    """Return a status without times, which differ after a correction."""
    conditions = [{k: v for k, v in c.items() if k != "lastTransitionTime"} for c in status.get("conditions") or ()]
    return {**status, "conditions": conditions}


def grant_uids(world: World, namespace: str) -> dict[str, str]:
    return {grant["metadata"]["name"]: grant["metadata"]["uid"] for grant in world.grants(namespace)}


def flying(world: World, namespace: str) -> None:
    running(world, namespace)
    world.drone_status("drone-1", "flying")
    world.phase(namespace, "Flying")


def awaits(world: World, namespace: str) -> list[str]:
    """Return the components for which the driver's mission waits."""
    grant = world.api.get(f"{FRACTUS}/grants/{namespace}.traffic-navigator") or {}
    return list(grant["spec"].get("awaits") or ())


def set_ready(world: World, namespace: str, component: str, ready: str) -> None:
    (pod,) = (pod for pod in world.pods(namespace) if pod["metadata"]["labels"]["fractus.dev/component"] == component)
    path = f"/api/v1/namespaces/{namespace}/pods/{pod['metadata']['name']}/status"
    conditions = [{**c, "status": ready} if c["type"] == "Ready" else c for c in pod["status"]["conditions"]]
    world.api.merge(path, {"status": {"conditions": conditions}})


def test_application_that_starts_when_ready_waits_for_its_components_until_takeoff(
    world: World, operator: OperatorProcess, namespace: str
) -> None:
    manifest = traffic(namespace)
    manifest["spec"]["start"] = "whenReady"
    world.put(manifest)
    wait_for(lambda: world.api.get(f"{FRACTUS}/grants/{namespace}.traffic-navigator"), "the Grant of the driver")
    assert awaits(world, namespace) == ["Navigator", "AerialViewer", "GroundViewer", "ImageChecker", "DataStore"]
    deployed(world, namespace)
    wait_for(lambda: awaits(world, namespace) == [], lambda: f"no awaited component: {world.status(namespace)}")
    set_ready(world, namespace, "DataStore", "False")
    wait_for(lambda: awaits(world, namespace) == ["DataStore"], "the drone to wait for the DataStore")
    expected = (
        "waiting for traffic-data-store; drone-1 is on the ground and its mission has not begun;"
        " the mission begins when all components are ready"
    )
    wait_for(lambda: world.status(namespace)["message"] == expected, lambda: f"{expected}: {world.status(namespace)}")
    set_ready(world, namespace, "DataStore", "True")
    wait_for(lambda: awaits(world, namespace) == [], "no awaited component again")
    world.drone_status("drone-1", "flying")
    world.phase(namespace, "Flying")
    set_ready(world, namespace, "DataStore", "False")
    wait_for(lambda: "waiting for traffic-data-store" in world.status(namespace)["message"], "the message in flight")
    assert awaits(world, namespace) == [], "a mission that has begun waits for no component"


@pytest.mark.parametrize("restarted", [False, True], ids=["running", "restarted"])
def test_edited_status_in_flight_is_corrected_and_flight_continues(
    world: World, operator: OperatorProcess, namespace: str, *, restarted: bool
) -> None:
    flying(world, namespace)
    before = world.status(namespace)
    uids = grant_uids(world, namespace)
    children = set(world.children(namespace))
    if restarted:
        operator.stop(signal.SIGKILL)
    edit_status(world, namespace, COMPLETED)
    if restarted:
        operator.start()
    wait_for(
        lambda: essence(world.status(namespace)) == essence(before),
        lambda: f"the observed status: {world.status(namespace)} {operator.log()[-3000:]}",
    )
    assert grant_uids(world, namespace) == uids
    assert set(world.children(namespace)) == children
    assert operator.log().count("application controller: planned") == 1, "the edited status led to a new plan"


@RUNNING_OR_RESTARTED
def test_edited_status_of_landed_drone_does_not_end_its_mission(
    world: World, operator: OperatorProcess, namespace: str, *, restarted: bool
) -> None:
    """The mission continues after the drone has landed, for example at a control point."""
    flying(world, namespace)
    world.drone_status("drone-1", "inactive")
    world.phase(namespace, "Landed")
    if restarted:
        operator.stop(signal.SIGKILL)
    edit_status(world, namespace, COMPLETED)
    if restarted:
        operator.start()
    assert world.phase(namespace, "Landed")["drone"] == "drone-1"


@RUNNING_OR_RESTARTED
def test_edited_status_of_finished_mission_is_corrected(
    world: World, operator: OperatorProcess, namespace: str, *, restarted: bool
) -> None:
    flying(world, namespace)
    end_mission(world, namespace, "Complete", "all points visited")
    assert world.phase(namespace, "Returning")["drone"] == "drone-1"
    wait_for(lambda: not world.grants(namespace), "the Grants to be deleted")
    if restarted:
        operator.stop(signal.SIGKILL)
    edit_status(world, namespace, {"phase": "Flying", "drone": "nope", "conditions": []})
    if restarted:
        operator.start()
    status = world.phase(namespace, "Returning")
    assert (status["drone"], "all points visited" in status["message"]) == ("drone-1", True)
    world.drone_status("drone-1", "inactive")
    world.phase(namespace, "Completed")
    if restarted:
        operator.stop(signal.SIGKILL)
    edit_status(world, namespace, {"phase": "Failed", "drone": "nope", "message": "crashed", "conditions": []})
    if restarted:
        operator.start()
    status = world.phase(namespace, "Completed")
    assert (status["drone"], status["message"]) == ("drone-1", "all points visited")
    assert {c["type"]: c["status"] for c in status["conditions"]} == {"Ready": "False", "MissionComplete": "True"}
    assert not world.grants(namespace), "the mission was flown again"


def test_returning_drone_stays_claimed_after_restart_with_edited_status(
    world: World, operator: OperatorProcess, namespace: str
) -> None:
    flying(world, namespace)
    end_mission(world, namespace, "Complete", "done")
    world.phase(namespace, "Returning")
    wait_for(lambda: not world.grants(namespace), "the Grants to be deleted")
    operator.stop(signal.SIGKILL)
    edit_status(world, namespace, {"phase": "Completed", "drone": "nope"})
    operator.start()
    world.put(traffic(namespace, "second"))
    assert f"{namespace}/traffic (returning)" in world.phase(namespace, "Queued", "second")["message"]
    assert world.phase(namespace, "Returning")["drone"] == "drone-1"
    world.drone_status("drone-1", "inactive")
    world.phase(namespace, "Deploying", "second")
    assert world.phase(namespace, "Completed")["drone"] == "drone-1"


def test_waiting_application_with_edited_status_is_planned(
    world: World, operator: OperatorProcess, namespace: str
) -> None:
    world.drone_status("drone-1", "inactive", ready="False")
    world.put(traffic(namespace))
    world.phase(namespace, "Pending")
    edit_status(world, namespace, COMPLETED)
    wait_for(
        lambda: world.status(namespace).get("phase") == "Pending" and "drone" not in world.status(namespace),
        "the edited status to be replaced",
    )
    world.drone_status("drone-1", "inactive")
    world.phase(namespace, "Deploying")


def test_mission_without_record_is_not_flown_again(world: World, operator: OperatorProcess, namespace: str) -> None:
    """If plan and status contradict each other, the drone stays on the ground."""
    running(world, namespace)
    end_mission(world, namespace, "Complete", "done")
    world.phase(namespace, "Completed")
    wait_for(lambda: not world.grants(namespace), "the Grants to be deleted")
    operator.stop()
    world.api.delete(f"{FRACTUS}/namespaces/{namespace}/deploymentplans/traffic")
    operator.start()
    status = world.phase(namespace, "Failed")
    assert "deploymentplan" in status["message"].lower()
    assert not world.grants(namespace)
    changed = traffic(namespace)
    changed["spec"]["components"][4]["replicas"] = 2
    world.put(changed)
    world.phase(namespace, "Deploying")


def test_outcome_of_older_release_is_kept(world: World, operator: OperatorProcess, namespace: str) -> None:
    """Older releases recorded the outcome only in the status."""
    running(world, namespace)
    end_mission(world, namespace, "Failed", "driver lost")
    world.phase(namespace, "Failed")
    operator.stop()
    plan = f"{FRACTUS}/namespaces/{namespace}/deploymentplans/traffic"
    world.api.merge(plan, {"spec": {"flown": None}})
    operator.start()
    wait_for(lambda: ((world.api.get(plan) or {})["spec"].get("flown") or {}).get("outcome") == "Failed", operator.log)
    status = world.phase(namespace, "Failed")
    assert (status["drone"], status["message"]) == ("drone-1", "driver lost")
    wait_for(lambda: not world.grants(namespace), "the Grants to be deleted")


# -- the certificate of the authority --


def test_deleted_or_edited_authority_certificate_is_restored(world: World, operator: OperatorProcess) -> None:
    path = f"/api/v1/namespaces/{SYSTEM}/configmaps/fractus-ca"

    def certificate() -> str:
        return str(((world.api.get(path) or {}).get("data") or {}).get("ca.crt", ""))

    published = wait_for(certificate, "the certificate of the authority")
    world.api.delete(path)
    wait_for(lambda: certificate() == published, lambda: f"the ConfigMap to be restored: {operator.log()[-3000:]}")
    world.api.merge(path, {"data": {"ca.crt": "other"}})
    wait_for(lambda: certificate() == published, "the certificate to be restored")


def test_new_zone_does_not_change_corrected_status(world: World, operator: OperatorProcess, namespace: str) -> None:
    """A corrected status is written once, not in every step."""
    flying(world, namespace)
    edit_status(world, namespace, COMPLETED)
    wait_for(lambda: "controller" not in world.status(namespace), "the edited status to be replaced")
    written = (world.application(namespace) or {})["metadata"]["resourceVersion"]
    world.put(fractus_object("Policy", "low", {"type": "LimitControl", "kind": "altitude", "upperLimit": 15}))
    wait_for(
        lambda: all(grant["spec"].get("policies") for grant in world.grants(namespace) if grant["spec"].get("class")),
        "the policy in the Grants",
    )
    assert (world.application(namespace) or {})["metadata"]["resourceVersion"] == written
