"""Direct links on real nodes when 4G is lost in flight: the drone's calls go on over WiFi, and all comes together afterwards."""

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
"""Longer than a connection gets old (30 s) and than an agent may be silent (45 s); five minutes where FRACTUS_DEEP is set."""
QUIET_S = 60.0
"""So long the pictures, one a second, may stay away on a machine under load."""
NEAR_EDGE = ((50.864239, 4.679068), (50.865228, 4.679352))


def slow_flight() -> Object:
    """The example's application, to and fro beside edge-1 for about seven minutes."""
    (app,) = yaml.safe_load_all((LINKS / "application.yaml").read_text())
    navigator = next(c for c in app["spec"]["components"] if c["name"] == "Navigator")
    turns = [NEAR_EDGE[number % 2] for number in range(5)]
    navigator["controlPoints"][0]["path"] = [{"lat": lat, "lon": lon, "alt": 15} for lat, lon in turns]
    navigator["container"]["env"] = [{"name": "SPEED_MPS", "value": "1"}]
    return app


def received(kube: Kube, pod: str) -> list[float]:
    """When an ImageChecker received pictures, Unix seconds."""
    lines = kube.must("logs", pod, "--tail=-1").splitlines()
    return [json.loads(line)["at"] for line in lines if line.startswith("{")]


def pods_of(kube: Kube) -> dict[str, tuple[str, int]]:
    """The pods on the drone and of the application: their identities, and how often they restarted."""
    found = {}
    for namespace in ("default", SYSTEM):
        for pod in kube.all("pods", namespace):
            if namespace == "default" or pod["spec"].get("nodeName") == DRONE:
                found[pod["metadata"]["name"]] = (pod["metadata"]["uid"], restarts(pod))
    return found


def linked(kube: Kube) -> bool:
    return any(
        body["spec"]["node"] == PEER and (body.get("status") or {}).get("traffic") == "direct"
        for body in kube.all("directlinks.fractus.dev")
    )


def test_4g_is_lost_in_flight(grounded: Kube, cluster: Cluster | None) -> None:
    if cluster is None:
        pytest.skip("cuts the drone's uplink, which only the embedded cluster lets a test do")
    kube = grounded
    kube.apply(slow_flight())
    kube.wait("traffic takes the direct link", lambda: linked(kube), timeout_s=150)
    checker = kube.pod("fractus.dev/component=ImageChecker", "default", PEER)["metadata"]["name"]
    kube.wait("pictures over the link", lambda: received(kube, checker), timeout_s=30)
    before, node = pods_of(kube), cluster.node(DRONE)
    node.cut_link()
    cut_s = time.time()
    try:
        ready = lambda: condition(kube.get("drone", DRONE), "Ready")  # noqa: E731 - asked three times
        kube.wait("the drone's status says that it is silent", lambda: ready().get("status") != "True", timeout_s=CUT_S)
        assert condition(kube.get("node", DRONE), "Ready")["status"] == "Unknown"
        while (left_s := cut_s + CUT_S - time.time()) > 0:
            last_s = max(received(kube, checker))
            assert time.time() - last_s < QUIET_S, f"no picture since {last_s - cut_s:.0f} s after the cut"
            time.sleep(min(left_s, 5.0))
        arrived = [at for at in received(kube, checker) if cut_s < at]
    finally:
        node.heal_link()
    assert len(arrived) > CUT_S / 3
    kube.wait("the drone is Ready again", lambda: ready().get("status") == "True", timeout_s=90)
    kube.wait("its node is Ready again", lambda: condition(kube.get("node", DRONE), "Ready")["status"] == "True")
    kube.wait("traffic is direct by the status", lambda: linked(kube), timeout_s=30)
    assert pods_of(kube) == before
    assert phase(kube, "links") == "Flying"
