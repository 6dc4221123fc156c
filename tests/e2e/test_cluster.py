"""The embedded cluster: nodes, loss of power and of links, repair and removal.

These tests start separate clusters, also with FRACTUS_E2E_CLUSTER=current. They need root on Linux.
"""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from docs_pages import shell_lines
from fractus_cluster.cluster import Cluster
from fractus_cluster.errors import ClusterError
from fractus_cluster.images.build import build_images
from fractus_cluster.network import host_link
from fractus_cluster.processes import kill, read_record
from fractus_cluster.spec import ClusterSpec, load_spec, parse_spec
from fractus_cluster.state import state_of

pytestmark = [
    pytest.mark.slow,
    pytest.mark.root,
    pytest.mark.skipif(os.geteuid() != 0, reason="needs root"),
    pytest.mark.xdist_group("cluster"),
]

ROOT = Path(__file__).parents[2]
NAME = f"ct{os.getpid()}"
IMAGE = "localhost/fractus/component:dev"
FETCH = (
    "python3",
    "-c",
    "import sys, urllib.request; print(urllib.request.urlopen(sys.argv[1], timeout=20).read().decode())",
)

WORKLOAD = f"""
apiVersion: apps/v1
kind: DaemonSet
metadata: {{name: web}}
spec:
  selector: {{matchLabels: {{app: web}}}}
  template:
    metadata: {{labels: {{app: web}}}}
    spec:
      terminationGracePeriodSeconds: 0
      tolerations: [{{operator: Exists}}]
      securityContext: {{runAsNonRoot: true, seccompProfile: {{type: RuntimeDefault}}}}
      containers:
        - name: web
          image: {IMAGE}
          args: [-m, http.server, "8080", --directory, /etc]
          securityContext:
            allowPrivilegeEscalation: false
            readOnlyRootFilesystem: true
            capabilities: {{drop: [ALL]}}
          readinessProbe: {{httpGet: {{port: 8080, path: /hostname}}, periodSeconds: 1}}
---
apiVersion: v1
kind: Service
metadata: {{name: web}}
spec: {{selector: {{app: web}}, ports: [{{port: 80, targetPort: 8080}}]}}
"""


def spec_of(name: str, nodes: int = 2) -> ClusterSpec:
    """Return a cluster with a drone that has a separate disk, and with edge nodes."""
    drone = load_spec(ROOT / "examples" / "clusters" / "demo.yaml").nodes[0].model_dump(by_alias=True)
    drone["hardware"]["disk"] = {"size": "32Mi"}
    edge = load_spec(ROOT / "examples" / "clusters" / "demo.yaml").nodes[1].model_dump(by_alias=True)
    edge["resources"] = {"cpu": 1, "memory": "1Gi", "fractus.dev/gpu": 3}
    edges = [{**edge, "name": f"edge-{n}"} for n in range(1, nodes)]
    return parse_spec({"name": name, "nodes": [drone, *edges]}, source="test")


def until(condition: Callable[[], Any], description: str, timeout_s: float = 40.0) -> Any:
    """Poll a condition until it returns a true value, and return this value."""
    deadline = time.monotonic() + timeout_s
    while not (result := condition()):
        assert time.monotonic() < deadline, f"waited {timeout_s:.0f} s for {description}"
        threading.Event().wait(0.1)
    return result


def leftovers(name: str) -> list[str]:
    """Return everything that a cluster has left on this machine, such as mounts, namespaces, files and processes."""
    remains = [f"mount {line}" for line in Path("/proc/self/mountinfo").read_text().splitlines() if f"/{name}/" in line]
    remains += [f"netns {p}" for p in Path("/run/netns").glob(f"fractus.{name}*")]
    # os.walk ignores control groups of other clusters that are removed during the walk.
    groups = ((Path(parent), below) for parent, below, _ in os.walk("/sys/fs/cgroup"))
    remains += [f"cgroup {parent / name}" for parent, below in groups if parent.name == "fractus-sim" and name in below]
    remains += [
        f"state {p}" for p in (state_of(name).path, Path(f"/run/fractus-sim/cluster.{name}.lock")) if p.exists()
    ]
    ledger = Path("/run/fractus-sim/machine.json")
    remains += ["claim"] if ledger.exists() and name in json.loads(ledger.read_text())["claims"] else []
    remains += ["link"] if Path(f"/sys/class/net/{host_link(name)}").exists() else []
    for process in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = process.read_bytes().decode(errors="replace").split("\0")
        except (FileNotFoundError, ProcessLookupError):
            continue
        remains += [f"process {words[:4]}"] if any(f"/{name}/" in w or f"fractus.{name}" in w for w in words) else []
    return remains


def ready(cluster: Cluster) -> dict[str, bool]:
    """Return, for each node, True if the API server reports the node as ready."""
    return {node.name: bool(node.ready) for node in cluster.status()}


def pods(cluster: Cluster) -> dict[str, dict[str, Any]]:
    """Return the workload's pods by node."""
    items = json.loads(cluster.kubectl("get", "pods", "-l", "app=web", "-o", "json").stdout)["items"]
    return {item["spec"]["nodeName"]: item for item in items if "nodeName" in item["spec"]}


def running(cluster: Cluster, node: str) -> bool:
    """Return True if the workload's pod on a node is ready."""
    conditions = pods(cluster).get(node, {}).get("status", {}).get("conditions", [])
    return any(entry["type"] == "Ready" and entry["status"] == "True" for entry in conditions)


@pytest.fixture(scope="module")
def small() -> Iterator[Cluster]:
    """A cluster of a drone and an edge node. Each node runs a web server."""
    build_images(ROOT, targets=("component",), report=print)
    cluster = Cluster.load(spec_of(NAME), report=print)
    try:
        cluster.up(images=[IMAGE])
        cluster.kubectl("apply", "-f", "-", input_text=WORKLOAD)
        for node in ("drone-1", "edge-1"):
            until(lambda node=node: running(cluster, node), f"the pod on {node}")
        yield cluster
    finally:
        cluster.down()
        assert leftovers(NAME) == []


@pytest.fixture
def healthy(small: Cluster) -> Iterator[Cluster]:
    """The small cluster. It is repaired after the test."""
    yield small
    small.up()
    for node in ("drone-1", "edge-1"):
        until(lambda node=node: running(small, node), f"the pod on {node}")


def test_cluster_nodes_match_their_description(small: Cluster) -> None:
    items = json.loads(small.kubectl("get", "nodes", "-o", "json").stdout)["items"]
    nodes = {item["metadata"]["name"]: item for item in items}
    assert set(nodes) == {"drone-1", "edge-1"}
    assert nodes["drone-1"]["metadata"]["labels"]["fractus.dev/class"] == "drone"
    for name, node_class in (("drone-1", "drone"), ("edge-1", "edge")):
        taint = {"key": "fractus.dev/class", "value": node_class, "effect": "NoExecute"}
        assert nodes[name]["spec"]["taints"] == [taint]
    offered = nodes["edge-1"]["status"]["allocatable"]
    assert (offered["cpu"], offered["memory"], offered["fractus.dev/gpu"]) == ("1", "1Gi", "3")
    written = yaml.safe_load(small.node("drone-1").exec(["cat", "/etc/fractus/node.yaml"]).stdout)
    assert written == small.spec.nodes[0].manifest
    assert small.node("drone-1").exec(["hostname"]).stdout.strip() == "drone-1"
    assert not Path("/etc/fractus/node.yaml").exists()


def test_cluster_services_and_names_work_across_nodes(small: Cluster) -> None:
    pods_by_node = pods(small)
    for node, other in (("drone-1", "edge-1"), ("edge-1", "drone-1")):
        name = pods_by_node[node]["metadata"]["name"]
        address = pods_by_node[other]["status"]["podIP"]
        fetched = small.kubectl("exec", name, "--", *FETCH, f"http://{address}:8080/hostname")
        assert fetched.stdout.strip() == pods_by_node[other]["metadata"]["name"]
        small.kubectl("exec", name, "--", *FETCH, "http://web.default.svc.cluster.local/hostname")
    assert "GET /hostname" in small.kubectl("logs", pods_by_node["edge-1"]["metadata"]["name"]).stdout


def test_cluster_pods_are_reachable_from_machine_without_changed_settings(small: Cluster) -> None:
    address = pods(small)["edge-1"]["status"]["podIP"]
    result = subprocess.run(
        ["curl", "-sf", "-m", "5", f"http://{address}:8080/hostname"], capture_output=True, check=True
    )
    assert result.stdout
    overcommit = small.node("edge-1").exec(["cat", "/proc/sys/vm/overcommit_memory"]).stdout.strip()
    assert overcommit == "1"  # the value that kubelet expects
    # The setting of the machine itself is unchanged.
    records = json.loads(Path("/run/fractus-sim/machine.json").read_text())["sysctls"]
    assert set(records) <= {"fs.inotify.max_user_instances", "fs.inotify.max_user_watches"}


def test_cluster_up_changes_nothing_if_all_parts_run(small: Cluster) -> None:
    state = state_of(NAME)
    before = {path.name: path.read_text() for path in (state.path / "processes").iterdir()}
    started = time.monotonic()
    small.up(images=[IMAGE])
    elapsed_s = time.monotonic() - started
    assert {path.name: path.read_text() for path in (state.path / "processes").iterdir()} == before
    assert elapsed_s < 30, f"took {elapsed_s:.1f} s"


def test_cluster_power_off_ends_node_but_not_its_vehicle(healthy: Cluster) -> None:
    drone = healthy.node("drone-1")
    vehicle = read_record(state_of(NAME).process("vehicle.drone-1"))
    assert vehicle is not None
    uid = pods(healthy)["drone-1"]["metadata"]["uid"]
    drone.exec(["sh", "-c", "echo kept > /var/lib/fractus/file"])
    assert drone.fractus_state.is_mount()
    drone.power_off()
    assert not drone.powered
    assert vehicle.alive
    with pytest.raises(ClusterError, match="drone-1 is off"):
        drone.exec(["true"])
    until(lambda: not ready(healthy)["drone-1"], "the node to be reported as not ready")
    assert vehicle.alive
    drone.power_on()
    until(lambda: ready(healthy)["drone-1"], "the node to be ready again")
    until(lambda: running(healthy, "drone-1"), "the pod to be ready again")
    assert pods(healthy)["drone-1"]["metadata"]["uid"] == uid
    assert vehicle.alive
    assert (drone.fractus_state / "file").read_text() == "kept\n"
    assert (
        drone.exec(["stat", "-f", "-c", "%b", "/var/lib/fractus"]).stdout
        == f"{os.statvfs(drone.fractus_state).f_blocks}\n"
    )


def test_cluster_cut_link_disconnects_node_without_restarts(healthy: Cluster) -> None:
    edge = healthy.node("edge-1")
    pod = pods(healthy)["edge-1"]
    edge.cut_link()
    assert [node.linked for node in healthy.status() if node.name == "edge-1"] == [False]
    until(lambda: not ready(healthy)["edge-1"], "the node to be reported as not ready")
    assert edge.exec(["curl", "-sf", "-m", "5", f"http://{pod['status']['podIP']}:8080/hostname"]).stdout
    edge.heal_link()
    until(lambda: ready(healthy)["edge-1"] and running(healthy, "edge-1"), "the node to be ready again")
    pod_after = pods(healthy)["edge-1"]
    assert pod_after["metadata"]["uid"] == pod["metadata"]["uid"]
    assert pod_after["status"]["containerStatuses"][0]["restartCount"] == 0


def test_cluster_commands_of_the_documentation_work(healthy: Cluster) -> None:
    drone = healthy.node("drone-1")
    edge = healthy.node("edge-1")
    typed_words = [shlex.split(line, comments=True) for line in shell_lines("docs/embedded-cluster.md")]
    lines = {words[2]: words for words in typed_words if len(words) > 3}

    def typed(verb: str, *replacements: str) -> str:
        """Run the documented command for this test's cluster. Replacements replace the last arguments."""
        words = lines[verb]
        argv = [str(Path(sys.executable).with_name("fractus")), "cluster", verb, "--name", NAME, *words[3:]]
        argv = [*argv[: len(argv) - len(replacements)], *replacements] if replacements else argv
        result = subprocess.run(argv, capture_output=True, text=True, timeout=120, check=False)
        assert result.returncode == 0, f"{argv}: {result.stderr}"
        return result.stdout

    assert str(drone.address) in typed("exec")
    assert (lines["power"][3:], lines["link"][3:]) == (["off", "drone-1"], ["cut", "edge-1"])
    typed("power")
    assert not drone.powered
    typed("power", "on", "drone-1")
    assert drone.powered
    typed("link")
    assert [node.linked for node in healthy.status() if node.name == "edge-1"] == [False]
    typed("link", "heal", "edge-1")
    assert [node.linked for node in healthy.status() if node.name == "edge-1"] == [True]
    assert edge.exec(["cat", "/sys/class/net/wlan0/operstate"]).stdout
    typed("radio")
    typed("radio", "on")
    assert "kubelet" in typed("logs")


@pytest.mark.parametrize("victim", ["control-plane", "node.edge-1", "vehicle.drone-1"])
def test_cluster_up_repairs_killed_part(healthy: Cluster, victim: str) -> None:
    record = read_record(state_of(NAME).process(victim))
    assert record is not None
    kill(record)
    healthy.up()
    replacement = read_record(state_of(NAME).process(victim))
    assert replacement is not None
    assert replacement.alive
    assert replacement != record
    assert all(ready(healthy).values())


def test_cluster_restarts_killed_daemons_without_restarting_pods(healthy: Cluster) -> None:
    edge = healthy.node("edge-1")
    before = pods(healthy)["edge-1"]["status"]["containerStatuses"][0]["containerID"]

    def pid(program: str) -> str:
        return edge.exec(["sh", "-c", f"grep -lx {program} /proc/[0-9]*/comm; true"]).stdout.strip()

    for program in ("kubelet", "containerd"):
        old = pid(program)
        edge.exec(["kill", "-9", old.split("/")[2]])
        until(lambda program=program, old=old: pid(program) not in ("", old), f"{program} to run again")
    until(
        lambda: edge.exec(["ctr", "-n", "k8s.io", "tasks", "ls"], check=False).returncode == 0, "containerd to respond"
    )
    until(lambda: running(healthy, "edge-1"), "the pod to be ready")
    assert pods(healthy)["edge-1"]["status"]["containerStatuses"][0]["containerID"] == before


def test_cluster_up_adds_and_removes_nodes_of_changed_file(healthy: Cluster) -> None:
    address = healthy.node("edge-1").address
    three = Cluster(spec_of(NAME, 3), report=print)
    three.up()
    assert set(ready(three)) == {"drone-1", "edge-1", "edge-2"}
    assert all(ready(three).values())
    Cluster(spec_of(NAME, 2), report=print).up()
    names = healthy.kubectl("get", "nodes", "-o", "name").stdout.split()
    assert sorted(names) == ["node/drone-1", "node/edge-1"]
    assert healthy.node("edge-1").address == address
    assert not list(Path("/run/netns").glob(f"fractus.{NAME}.edge-2"))


def test_cluster_load_image_transfers_only_missing_layers(small: Cluster) -> None:
    assert small.load_images([IMAGE]) == {"drone-1": 0, "edge-1": 0}
    with pytest.raises(ClusterError, match="no image localhost/fractus/nothing:1"):
        small.load_images(["localhost/fractus/nothing:1"])


def test_cluster_is_not_affected_by_second_cluster(small: Cluster) -> None:
    name = f"{NAME}b"
    second = Cluster(spec_of(name, 1), report=print)
    try:
        second.up()
        assert ready(second) == {"drone-1": True}
        assert second.node("drone-1").address != small.node("drone-1").address
        assert sorted(ready(small)) == ["drone-1", "edge-1"]
        second.node("drone-1").power_off()
        assert small.node("drone-1").powered
    finally:
        second.down()
    assert leftovers(name) == []
    assert all(ready(small).values())


@pytest.mark.parametrize("after_s", [0.8, 2.0, 3.5])
@pytest.mark.parametrize("then", ["up", "down"])
def test_cluster_recovers_from_interrupted_up(then: str, after_s: float) -> None:
    name = f"{NAME}i"
    file = state_of(name).path.parent / f".{name}.yaml"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(spec_of(name).to_yaml())
    cluster = Cluster.load(file)
    try:
        argv = [sys.executable, "-m", "fractus_cli", "cluster", "up", str(file)]
        with subprocess.Popen(argv, stderr=subprocess.DEVNULL) as process:
            try:
                process.wait(timeout=after_s)
            except subprocess.TimeoutExpired:
                process.send_signal(signal.SIGKILL)
        if then == "up":
            cluster.up()
            assert all(ready(cluster).values())
    finally:
        file.unlink()
        cluster.down()
    assert leftovers(name) == []
    cluster.down()  # a repeated call has no effect
