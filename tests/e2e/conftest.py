"""Fixtures of end-to-end tests: a cluster with Fractus, shared by all tests of a worker.

By default, each worker starts an embedded cluster, and stops it at the end (FRACTUS_E2E_KEEP=1 keeps it for the next
run). FRACTUS_E2E_CLUSTER=current uses the cluster of KUBECONFIG (k3s, kind), with one worker. This cluster must have
loaded the images, and its nodes must have the label fractus.dev/class.
"""

from __future__ import annotations

import json
import os
import pathlib
import shutil
import subprocess
from collections.abc import Iterator, Mapping

import pytest
import yaml
from fractus_cluster.binaries import ensure_binaries
from fractus_cluster.cluster import Cluster
from fractus_cluster.images.build import build_images
from fractus_sim.chaos.chaos_run import short_mission
from fractus_sim.demo.demo_clusters import EXAMPLE_NODES, assign_nodes
from kubectl import Kube, Object, condition

ROOT = pathlib.Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "traffic-monitoring"
TARGETS = ("operator", "agent", "mobility", "camera", "example-traffic-monitoring", "example-links")
SYSTEM = "fractus-system"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of this folder as end-to-end tests, with a longer timeout."""
    for item in items:
        if pathlib.Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.e2e)
            item.add_marker(pytest.mark.timeout(600))


def _current() -> bool:
    return os.environ.get("FRACTUS_E2E_CLUSTER", "embedded") == "current"


def _nodes() -> Mapping[str, str]:
    """Map the node names of the example to the node names of the cluster."""
    if not _current():
        return {name: name for name in EXAMPLE_NODES}
    result = subprocess.run(["kubectl", "get", "nodes", "-o", "json"], capture_output=True, timeout=60, check=True)
    return assign_nodes(json.loads(result.stdout)["items"], {})


NODES = _nodes()
DRONE = NODES["drone-1"]


def report(line: str) -> None:
    """Print the progress of a long step at once, although pytest captures the output of tests."""
    os.write(2, f"e2e: {line}\n".encode())


@pytest.fixture(scope="session")
def cluster() -> Iterator[Cluster | None]:
    """The embedded cluster, or None if the tests run on the user's cluster."""
    if _current():
        yield None
        return
    images = build_images(ROOT, targets=TARGETS, report=report)
    name = "-".join(filter(None, ("e2e", os.environ.get("PYTEST_XDIST_WORKER"))))
    cluster = Cluster.load(ROOT / "examples" / "clusters" / "demo.yaml", name=name, report=report)
    keep = bool(os.environ.get("FRACTUS_E2E_KEEP"))
    if not keep:
        cluster.down()
    try:
        cluster.up(images=images)
        yield cluster
    finally:
        if not keep:
            cluster.down()


@pytest.fixture(scope="session")
def kube(cluster: Cluster | None) -> Kube:
    """The cluster with Fractus installed by its charts, and its drone ready to fly."""
    if cluster is not None:
        programs = ensure_binaries(("kubectl", "helm"), report=report)
        kubectl = programs["kubectl"]
        helm = programs["helm"]
        kubeconfig = cluster.kubeconfig
    else:
        kubectl, helm = (pathlib.Path(shutil.which(name) or name) for name in ("kubectl", "helm"))
        kubeconfig = pathlib.Path(os.environ.get("KUBECONFIG", "~/.kube/config")).expanduser()
    kube = Kube(kubectl, kubeconfig)
    for release in ("fractus-crds", "fractus") if cluster is not None else ("fractus-crds", "fractus", "fractus-demo"):
        chart = ROOT / "charts" / release
        result = subprocess.run(
            [helm, "upgrade", "--install", release, chart, "-n", SYSTEM, "--create-namespace"],
            env={**os.environ, "KUBECONFIG": str(kubeconfig)},
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        assert result.returncode == 0, result.stderr
    for name in ("depot.yaml", "zones.yaml", "policies.yaml") if cluster is not None else ():
        kube.must("apply", "-f", str(EXAMPLE / name))
    kube.wait(
        "the drone is Ready",
        lambda: condition(kube.get("drone", DRONE), "Ready").get("status") == "True",
        timeout_s=120,
    )
    return kube


@pytest.fixture
def grounded(kube: Kube) -> Iterator[Kube]:
    """The cluster with its drone on the ground. All Applications are deleted after the test."""
    kube.wait("the drone is on the ground", lambda: flight_state(kube) in {"inactive", "charging"}, timeout_s=120)
    yield kube
    kube.run("delete", "applications.fractus.dev", "--all", "-A", "--wait=true", "--timeout=60s", timeout_s=90)
    kube.wait("the drone is home", lambda: flight_state(kube) in {"inactive", "charging"}, timeout_s=180)


def flight_state(kube: Kube) -> str | None:
    """Return the flight state that the drone's agent last reported."""
    drone = kube.get("drone", DRONE)
    return ((drone or {}).get("status") or {}).get("flightState")


def example(name: str) -> list[Object]:
    """Return the objects of a manifest of the example."""
    return list(yaml.safe_load_all((EXAMPLE / name).read_text()))


def short_flight(name: str, namespace: str = "default") -> Object:
    """Return an Application with only the example's Navigator, on a path of about a minute near the depot."""
    return short_mission(name, namespace)
