"""A pod with an unmodified pymavlink program flies a drone of the cluster through its sidecar and the gateway."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import DRONE, SYSTEM, flight_state, short_flight
from kubectl import Kube, Object, condition
from test_mission import audit_log, phase
from test_upgrade import services, upgrade

pytestmark = pytest.mark.slow

PROGRAM = Path(__file__).with_name("mavlink_program.py")


@pytest.fixture
def gateway(grounded: Kube) -> Iterator[Kube]:
    """The cluster with the MAVLink gateway, which runs beside the mobility service of the drone."""
    installed = upgrade(grounded, "gateway.enabled=true")
    assert installed.returncode == 0, installed.stderr

    grounded.wait("the gateway runs on the drone", lambda: gateway_is_ready(grounded) is True, timeout_s=180)
    yield grounded
    assert upgrade(grounded, "gateway.enabled=false").returncode == 0
    grounded.wait("the gateway is removed", lambda: gateway_is_ready(grounded) is False, timeout_s=180)


def gateway_is_ready(kube: Kube) -> bool | None:
    """Return True if the gateway is ready, False if the mobility service runs without it, None in between."""
    names = [name for name in services(kube) if "mobility" in name]
    pod = kube.get("pod", names[0], SYSTEM) if len(names) == 1 else None
    if condition(pod, "Ready").get("status") != "True":
        return None
    return "gateway" in {container["name"] for container in pod["spec"]["containers"]}


def application() -> Object:
    """Return an Application whose pod contains only Python, pymavlink and the program."""
    app = short_flight("mavlink")
    (component,) = app["spec"]["components"]
    methods = ["Arm", "Disarm", "Takeoff", "Land", "Goto", "Hover", "GetPosition", "ReturnToLaunch"]
    component["services"] = [{"service": "mobility", "interfaces": ["mavlink"], "methods": methods}]
    image = "localhost/fractus/mobility:dev"  # it contains pymavlink, and the drone already has it
    component["container"] |= {"image": image, "command": ["python3", "-c", PROGRAM.read_text()]}
    return app


def test_pymavlink_program_in_a_pod_flies_and_obeys_a_policy(gateway: Kube) -> None:
    kube = gateway
    before = len(audit_log(kube))
    kube.apply(application())
    pod = kube.wait("the pod of the program", lambda: kube.all("pods", "default", "fractus.dev/application=mavlink"))[0]
    assert "fractus-mavlink" in {container["name"] for container in pod["spec"]["initContainers"]}
    kube.wait("the drone flies", lambda: flight_state(kube) == "flying", timeout_s=120)
    assert kube.get("pod", pod["metadata"]["name"])["spec"]["nodeName"] == DRONE
    kube.wait("the mission is over", lambda: phase(kube, "mavlink") in {"Completed", "Failed"}, timeout_s=240)
    status = (kube.get("application.fractus.dev", "mavlink") or {})["status"]
    assert status["phase"] == "Completed", kube.must("logs", pod["metadata"]["name"], "--all-containers")
    first, *others = [entry for entry in audit_log(kube)[before:] if entry.get("method") == "Goto"]
    assert first["action"] == "deny"
    assert "no-fly-hospital" in first["policies"]
    assert "allow" in {entry["action"] for entry in others}
