"""Loss of the mobile uplink in flight: calls continue over a direct link, and the cluster recovers afterwards."""

from __future__ import annotations

import json
import time

import pytest
import yaml
from conftest import DRONE, EXAMPLE, SYSTEM
from depth import DEEP
from fractus_cluster.cluster import Cluster
from kubectl import Kube, Object, condition
from test_kills import restarts
from test_mission import phase

pytestmark = pytest.mark.slow

LINKS = EXAMPLE.parent / "links"
PEER = "edge-1"
CUT_S = 300.0 if DEEP else 75.0
"""Duration of the loss, in seconds: above the maximum connection age (30 s) and the silence limit of agents (45 s)."""
QUIET_S = 60.0
"""Maximum time between two received pictures on a machine under load. The component takes one picture per second."""
NEAR_EDGE = ((50.864239, 4.679068), (50.865228, 4.679352))


def slow_flight() -> Object:
    """Return the example's application, with a path of about seven minutes near edge-1."""
    (app,) = yaml.safe_load_all((LINKS / "application.yaml").read_text())
    navigator = next(c for c in app["spec"]["components"] if c["name"] == "Navigator")
    turns = [NEAR_EDGE[number % 2] for number in range(5)]
    navigator["controlPoints"][0]["path"] = [{"lat": lat, "lon": lon, "alt": 15} for lat, lon in turns]
    navigator["container"]["env"] = [{"name": "SPEED_MPS", "value": "1"}]
    return app


def received(kube: Kube, pod: str) -> list[float]:
    """Return the Unix times, in seconds, at which a pod of the ImageChecker received pictures."""
    lines = kube.must("logs", pod, "--tail=-1").splitlines()
    return [json.loads(line)["at"] for line in lines if line.startswith("{")]


def pods_of(kube: Kube) -> dict[str, tuple[str, int]]:
    """Return uid and restart count of the pods on the drone and of the application, by name."""
    pods = {}
    for namespace in ("default", SYSTEM):
        for pod in kube.all("pods", namespace):
            if namespace == "default" or pod["spec"].get("nodeName") == DRONE:
                pods[pod["metadata"]["name"]] = (pod["metadata"]["uid"], restarts(pod))
    return pods


def drone_ready(kube: Kube) -> bool:
    return condition(kube.get("drone", DRONE), "Ready").get("status") == "True"


def linked(kube: Kube) -> bool:
    return any(
        body["spec"]["node"] == PEER and (body.get("status") or {}).get("traffic") == "direct"
        for body in kube.all("directlinks.fractus.dev")
    )


def test_calls_continue_over_wifi_when_the_uplink_is_lost(grounded: Kube, cluster: Cluster | None) -> None:
    if cluster is None:
        pytest.skip("the test cuts the drone's uplink, which only the embedded cluster supports")
    kube = grounded
    kube.apply(slow_flight())
    kube.wait("traffic uses the direct link", lambda: linked(kube), timeout_s=150)
    checker = kube.pod("fractus.dev/component=ImageChecker", "default", PEER)["metadata"]["name"]
    kube.wait("pictures over the link", lambda: received(kube, checker), timeout_s=30)
    before = pods_of(kube)
    node = cluster.node(DRONE)
    node.cut_link()
    cut_s = time.time()
    try:
        kube.wait("the drone is no longer Ready", lambda: not drone_ready(kube), timeout_s=CUT_S)
        assert condition(kube.get("node", DRONE), "Ready")["status"] == "Unknown"
        while (remaining_s := cut_s + CUT_S - time.time()) > 0:
            last_s = max(received(kube, checker))
            assert time.time() - last_s < QUIET_S, f"the last picture arrived {last_s - cut_s:.0f} s after the cut"
            time.sleep(min(remaining_s, 5.0))
        arrived = [at for at in received(kube, checker) if cut_s < at]
    finally:
        node.heal_link()
    assert len(arrived) > CUT_S / 3
    kube.wait("the drone is Ready again", lambda: drone_ready(kube), timeout_s=90)
    kube.wait(
        "the node of the drone is Ready again", lambda: condition(kube.get("node", DRONE), "Ready")["status"] == "True"
    )
    kube.wait("the status reports direct traffic", lambda: linked(kube), timeout_s=30)
    assert pods_of(kube) == before
    assert phase(kube, "links") == "Flying"
