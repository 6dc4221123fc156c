"""`fractus flights` on a real API server with the operator: order, choices, start, watch and end."""

from __future__ import annotations

import json
import threading

import pytest
from control_plane import ControlPlane, wait_for
from fractus_cli import main
from operator_world import FRACTUS, OperatorProcess, World, approved_template, fractus_object
from test_operator_flight_plans import started, status

TEMPLATE = f"{FRACTUS}/applicationtemplates/survey"
PLACE = "39.361,22.9313,20"


def test_ordered_flight_is_chosen_started_watched_and_ended(
    control_plane: ControlPlane,
    world: World,
    operator: OperatorProcess,
    namespace: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def run(*arguments: str) -> tuple[int, str]:
        capsys.readouterr()
        code = main.run(["flights", *arguments, "-n", namespace, "--kubeconfig", str(control_plane.kubeconfig)])
        captured = capsys.readouterr()
        return code, captured.out + captured.err

    def order(name: str, *more: str) -> tuple[int, str]:
        place = ("--waypoint", PLACE, "--start", "now", "--duration", "15")
        return run("order", "survey", "--name", name, *place, *more)

    approved_template(world)
    square = [{"lat": 39.4 + north, "lon": 22.97 + east} for north, east in ((0, 0), (0, 0.001), (0.001, 0.001))]
    world.put(fractus_object("Zone", "yard", {"area": {"polygon": {"exterior": square}}}))
    spec = {"type": "GeofenceControl", "kind": "exclusion", "selector": {"zones": ["yard"]}}
    world.put(fractus_object("Policy", "school", spec | {"action": "hover", "choices": ["land"]}))

    code, output = order("probe", "--check", "--action", "school=hover")
    assert code == 0, output
    assert f"{namespace}/probe: Accepted: drone-1 is reserved (a check that reserves nothing)" in output

    code, output = order("flight")
    assert code == 2, output
    assert "school: not selected; choose one of: hover, land" in output
    code, output = run("choose", "flight", "school=land")
    assert code == 0, output
    assert "school: land, selected among: hover, land" in output

    code, output = order("second", "--action", "school=hover")
    assert code == 2
    assert "drone-1: Reserved: " in output
    listed = json.loads(run("list", "--drone", "drone-1", "-o", "json")[1])["flightPlans"]
    assert {(each["name"], each["status"]["state"]) for each in listed} >= {("flight", "Accepted")}

    code, output = run("start", "flight")
    assert code == 0, output
    wait_for(lambda: started(world, namespace), "the Application of the flight")
    name = status(world, namespace)["application"]
    grants = wait_for(lambda: world.grants(namespace, name), "the Grant of the flight")
    path = f"{FRACTUS}/grants/{grants[0]['metadata']['name']}/status"
    complete = {"status": {"phase": "Complete", "message": "all waypoints reached"}}
    threading.Timer(1.5, lambda: world.api.merge(path, complete)).start()
    code, output = run("watch", "flight")
    assert code == 0, output
    assert f"{namespace}/flight: Activated: " in output
    assert f"{namespace}/flight: Ended: all waypoints reached" in output

    code, output = order("third", "--action", "school=hover")
    assert code == 0, output
    run("end", "third")
    assert status(world, namespace, "third")["state"] == "Ended"
    assert run("watch", "third")[0] == 2


def test_authority_approves_present_generation_of_a_template(
    control_plane: ControlPlane, world: World, operator: OperatorProcess, capsys: pytest.CaptureFixture[str]
) -> None:
    def approve(template: str) -> int:
        capsys.readouterr()
        return main.run(["flights", "approve", template, "--yes", "--kubeconfig", str(control_plane.kubeconfig)])

    approved_template(world)
    world.api.merge(f"{TEMPLATE}/status", {"status": {"approval": None}})
    world.api.merge(TEMPLATE, {"spec": {"altitudes": {"upper": 55}}})
    assert approve("survey") == 0
    output = capsys.readouterr().out
    assert "altitudes: 0 to 55 m" in output
    assert "registry.test/component@sha256:" in output
    template = world.api.get(TEMPLATE)
    assert template is not None
    assert template["status"]["approval"]["generation"] == template["metadata"]["generation"]
    assert template["status"]["approval"]["by"] in output
    assert approve("unknown") != 0
    assert "there is no ApplicationTemplate unknown" in capsys.readouterr().err
