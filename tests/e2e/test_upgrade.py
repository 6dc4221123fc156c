"""helm upgrade during a flight: services and operator keep running, and are replaced after the landing."""

from __future__ import annotations

import subprocess

import pytest
from conftest import DRONE, ROOT, SYSTEM, flight_state, short_flight
from kubectl import Kube, condition
from test_mission import audit_log, phase
from test_uninstall import helm

pytestmark = pytest.mark.slow

CHART = str(ROOT / "charts" / "fractus")


def services(kube: Kube) -> dict[str, str]:
    """Return uid and restart count of the drone's service pods, by name."""
    pods = {}
    for pod in kube.all("pods", SYSTEM, "app.kubernetes.io/component in (agent,mobility,camera)"):
        if pod["spec"].get("nodeName") == DRONE and "deletionTimestamp" not in pod["metadata"]:
            restarts = sum(c["restartCount"] for c in pod["status"].get("containerStatuses", ()))
            pods[pod["metadata"]["name"]] = f"{pod['metadata']['uid']} {restarts}"
    return pods


def upgrade(kube: Kube, *values: str) -> subprocess.CompletedProcess[str]:
    return helm(kube, "upgrade", "fractus", CHART, *(f"--set={value}" for value in values))


def check_refused(kube: Kube, *command: str) -> None:
    result = kube.run(*command)
    assert result.returncode, command
    assert f"{DRONE} is in the air: wait until it has landed" in result.stderr, result.stderr


def test_upgrade_during_a_flight_does_not_disturb_it(grounded: Kube) -> None:
    kube = grounded
    entries = len(audit_log(kube))
    kube.apply(short_flight("upgraded"))
    kube.wait("the drone flies", lambda: flight_state(kube) == "flying", timeout_s=120)
    assert phase(kube, "upgraded") == "Flying"
    before = services(kube)
    assert len(before) == 3

    # Changes that would remove the services are refused.
    result = upgrade(kube, "mobility.enabled=false")
    assert result.returncode
    assert f"mobility.enabled: {DRONE} is in the air and keeps its services" in result.stderr
    check_refused(kube, "label", "node", DRONE, "fractus.dev/class-")
    check_refused(kube, "delete", "node", DRONE)
    check_refused(kube, "delete", "daemonset", "fractus-mobility", "-n", SYSTEM)
    mobility = next(name for name in before if "mobility" in name)
    check_refused(kube, "delete", "pod", mobility, "-n", SYSTEM, "--force", "--grace-period=0")
    # An upgrade with other values and a missing image succeeds, but takes no effect during the flight.
    operators = {p["metadata"]["name"] for p in kube.all("pods", SYSTEM, "app.kubernetes.io/component=operator")}
    assert upgrade(kube, "image.tag=missing", "camera.resources.requests.cpu=21m").returncode == 0
    waits = kube.wait(
        "the drone has the condition ServicesCurrent",
        lambda: condition(kube.get("drone", DRONE), "ServicesCurrent") or None,
        timeout_s=60,
    )
    assert waits["status"] == "False", waits
    assert waits["reason"] in {"InTheAir", "OnMission"}, waits
    running = {
        p["metadata"]["name"]
        for p in kube.all("pods", SYSTEM, "app.kubernetes.io/component=operator")
        if condition(p, "Ready").get("status") == "True"
    }
    assert operators <= running, "the upgrade stopped running operators, although the new image cannot start"
    assert services(kube) == before
    assert upgrade(kube, "camera.resources.requests.cpu=21m", "image.tag=dev").returncode == 0

    kube.wait("the mission is over", lambda: phase(kube, "upgraded") in {"Completed", "Failed"}, timeout_s=240)
    assert phase(kube, "upgraded") == "Completed"
    assert not [e for e in audit_log(kube)[entries:] if e["kind"] == "takeover"]
    # After the landing the operator replaces outdated services, and the drone becomes ready again.
    camera = next(name for name in before if "camera" in name)
    kube.wait("the camera service is replaced", lambda: camera not in services(kube), timeout_s=120)
    kube.wait(
        "all services are current",
        lambda: condition(kube.get("drone", DRONE), "ServicesCurrent").get("status") == "True",
        timeout_s=180,
    )
    kube.wait("the drone is Ready", lambda: condition(kube.get("drone", DRONE), "Ready").get("status") == "True")
