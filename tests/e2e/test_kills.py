"""Kill each part in flight with SIGKILL. The mission continues, or the system flies the drone home."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from conftest import DRONE, SYSTEM, flight_state, short_flight
from kubectl import Kube, Object
from test_mission import audit_log, phase

PARTS: dict[str, tuple[str, str, str | None]] = {
    "operator": ("app.kubernetes.io/component=operator", SYSTEM, None),
    "agent": ("app.kubernetes.io/component=agent", SYSTEM, DRONE),
    "mobility": ("app.kubernetes.io/component=mobility", SYSTEM, DRONE),
    "navigator": ("fractus.dev/component=Navigator", "default", DRONE),
}

# `make test` kills the other programs without a cluster, for example in
# test_killed_navigator_continues_mission_and_keeps_running_after_it and test_killed_operator_completes_rollout_after_restart.
IN_GATE = "mobility"


@pytest.mark.parametrize(
    "part", [part if part == IN_GATE else pytest.param(part, marks=pytest.mark.slow) for part in PARTS]
)
def test_killed_part_does_not_leave_the_drone_unsupervised_in_flight(grounded: Kube, part: str) -> None:
    kube = grounded
    application = f"kill-{part}"
    entries = len(audit_log(kube))
    kube.apply(short_flight(application))
    kube.wait("the drone flies", lambda: flight_state(kube) == "flying", timeout_s=120)
    kube.wait("the first waypoint is near", in_midleg(kube, entries), timeout_s=60)
    selector, namespace, node = PARTS[part]
    pod = leader(kube) if part == "operator" else kube.pod(selector, namespace, node)
    name = pod["metadata"]["name"]
    before = restarts(pod)
    kube.kill_pod(pod)
    kube.wait(f"{part} runs again", lambda: restarts(kube.get("pod", name, namespace)) > before, timeout_s=60)
    kube.wait("the mission is over", lambda: phase(kube, application) in {"Completed", "Failed"}, timeout_s=240)
    kube.wait("the drone is home", lambda: flight_state(kube) == "inactive", timeout_s=150)
    kube.wait("the landing is in the audit log", landed(kube, entries), timeout_s=30)
    log = audit_log(kube)[entries:]
    assert_supervised(log)
    if part in {"operator", "agent"}:
        assert phase(kube, application) == "Completed"
        assert not [e for e in log if e["kind"] == "takeover"]


def in_midleg(kube: Kube, entries: int) -> Callable[[], bool]:
    """Return a function that returns True if the new entries of the audit log contain an allowed Goto."""

    def goto_logged() -> bool:
        return any(
            e["kind"] == "call" and e["method"] == "Goto" and e["action"] != "deny" for e in audit_log(kube)[entries:]
        )

    return goto_logged


def landed(kube: Kube, entries: int) -> Callable[[], bool]:
    """Return a function that returns True if the new entries of the audit log contain the landing."""

    def landing_logged() -> bool:
        return any(e["kind"] == "control" and e["action"] == "landed" for e in audit_log(kube)[entries:])

    return landing_logged


def leader(kube: Kube) -> Object:
    """Return the pod of the active operator."""
    lease = kube.get("lease", "fractus-operator", SYSTEM)
    return kube.get("pod", lease["spec"]["holderIdentity"], SYSTEM)


def restarts(pod: Object) -> int:
    return sum(c["restartCount"] for c in pod["status"].get("containerStatuses", ()))


def assert_supervised(log: list[Object]) -> None:
    """Check that the audit log contains states of the flight, and that each of them names a control authority."""
    states = [e for e in log if e["kind"] == "state"]
    assert states, "no flight was recorded"
    assert all(s["controller"] for s in states)
