"""Configuration of the kubelet, network plug-in, DNS server and control groups of a cluster."""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta
from ipaddress import IPv4Network
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import yaml
from fractus_cluster.addressing import Addressing
from fractus_cluster.cgroups import TOP, Branch, Hierarchies, find_hierarchies
from fractus_cluster.controlplane import corefile
from fractus_cluster.errors import PrerequisiteError
from fractus_cluster.manifests import dns_objects, extended_resources_patch, is_ready, node_object, taints_patch
from fractus_cluster.network import host_link
from fractus_cluster.nodeconfig import Machine, cni_config, kubelet_config, node_units, shortfalls
from fractus_cluster.spec import NodeSpec
from fractus_cluster.startup import apply_volumes

ADDRESSING = Addressing(IPv4Network("10.200.0.0/16"))
MACHINE = Machine(cpus=4, memory_bytes=16 * 2**30)


def node(**resources: str) -> NodeSpec:
    """Return a node with the given resources. `gpu` stands for fractus.dev/gpu."""
    named = {"fractus.dev/gpu" if key == "gpu" else key: value for key, value in resources.items()}
    return NodeSpec.model_validate({"name": "n", "class": "edge", "resources": named, "labels": {"zone": "z"}})


def kubelet(spec: NodeSpec, version: int = 1) -> Any:
    """Return the parsed configuration of the node's kubelet."""
    return yaml.safe_load(kubelet_config(spec, cgroup_root="a/b", cgroup_version=version, machine=MACHINE))


def test_kubelet_reserves_resources_that_the_node_does_not_offer() -> None:
    assert kubelet(node(cpu="1500m", memory="4Gi"))["systemReserved"] == {"cpu": "2500m", "memory": str(12 * 2**30)}


def test_kubelet_reserves_nothing_when_node_offers_all_resources() -> None:
    assert kubelet(node())["systemReserved"] == {}
    assert kubelet(node(cpu="8", memory="64Gi"))["systemReserved"] == {}


def test_resources_beyond_the_machine_are_reported() -> None:
    assert shortfalls(node(cpu="4", memory="16Gi"), MACHINE) == []
    cpu, memory = shortfalls(node(cpu="8", memory="64Gi"), MACHINE)
    assert "4 CPUs instead of 8" in cpu
    assert "16384Mi of memory instead of 64Gi" in memory


def test_kubelet_accepts_cgroup_v1_only_on_machines_with_cgroup_v1() -> None:
    assert kubelet(node(), 1)["failCgroupV1"] is False
    assert "failCgroupV1" not in kubelet(node(), 2)


def test_kubelet_limits_number_of_pods() -> None:
    assert kubelet(node(pods="7"))["maxPods"] == 7
    assert kubelet(node())["maxPods"] == 110


def test_nodes_assign_pod_addresses_from_separate_networks() -> None:
    subnets = [json.loads(cni_config(i, ADDRESSING))["plugins"][0]["ipam"]["ranges"][0][0]["subnet"] for i in range(3)]
    assert subnets == [str(ADDRESSING.pods(i)) for i in range(3)]
    assert len(set(subnets)) == 3


def test_node_object_has_class_and_pod_network() -> None:
    path, body = node_object(node(), 2, ADDRESSING)
    assert path == "/api/v1/nodes/n"
    assert body["metadata"]["labels"]["fractus.dev/class"] == "edge"
    assert body["metadata"]["labels"]["zone"] == "z"
    assert body["spec"]["podCIDR"] == str(ADDRESSING.pods(2))


def test_drones_and_edge_nodes_are_tainted_and_keep_other_taints() -> None:
    class_taint = {"key": "fractus.dev/class", "value": "edge", "effect": "NoExecute"}
    other_taint = {"key": "node.kubernetes.io/unschedulable", "effect": "NoSchedule"}

    def patched_taints(spec: NodeSpec, *taints: dict[str, str]) -> Any:
        patch = taints_patch(spec, {"metadata": {"resourceVersion": "7"}, "spec": {"taints": list(taints)}})
        if patch is None:
            return None
        assert patch[0] == "/api/v1/nodes/n"
        assert patch[1]["metadata"] == {"resourceVersion": "7"}
        return patch[1]["spec"]["taints"]

    assert patched_taints(node()) == [class_taint]
    assert patched_taints(node(), other_taint) == [other_taint, class_taint]
    assert patched_taints(node(), {**class_taint, "value": "drone"}, other_taint) == [other_taint, class_taint]
    assert patched_taints(node(), class_taint, other_taint) is None
    cloud = NodeSpec.model_validate({"name": "n", "class": "cloud"})
    assert patched_taints(cloud, other_taint) is None
    assert patched_taints(cloud, class_taint, other_taint) == [other_taint]


def test_extended_resources_are_patched_only_when_missing() -> None:
    spec = node(gpu="1", cpu="1")
    amounts = {"fractus.dev/gpu": "1"}
    path, patch = extended_resources_patch(spec, {"status": {"capacity": {"cpu": "4"}}}) or pytest.fail("no patch")
    assert path == "/api/v1/nodes/n/status"
    assert patch == {"status": {"capacity": amounts, "allocatable": amounts}}
    partial = extended_resources_patch(spec, {"status": {"capacity": amounts}}) or pytest.fail("no patch")
    assert partial[1] == {"status": {"allocatable": amounts}}
    assert extended_resources_patch(spec, {"status": {"capacity": amounts, "allocatable": amounts}}) is None
    assert extended_resources_patch(node(), {}) is None


def test_node_is_ready_only_with_heartbeat_after_given_time() -> None:
    heartbeat_time = datetime(2026, 1, 1, tzinfo=UTC)
    condition = {"type": "Ready", "status": "True", "lastHeartbeatTime": "2026-01-01T00:00:00Z"}
    body = {"status": {"conditions": [condition]}}
    assert is_ready(body)
    assert is_ready(body, since=heartbeat_time)
    assert not is_ready(body, since=heartbeat_time + timedelta(seconds=1))
    assert not is_ready({"status": {"conditions": [{**condition, "status": "Unknown"}]}})
    assert not is_ready({})


def test_dns_service_has_well_known_address() -> None:
    objects = {body["kind"]: body for _, body in dns_objects(ADDRESSING.control_plane)}
    assert objects["Service"]["spec"]["clusterIP"] == "10.96.0.10"
    assert "selector" not in objects["Service"]["spec"]
    assert objects["EndpointSlice"]["endpoints"][0]["addresses"] == [str(ADDRESSING.control_plane)]
    assert f"bind {ADDRESSING.control_plane}" in corefile(ADDRESSING, Path("/kubeconfig"))


def test_node_units_have_programs_and_log_files() -> None:
    units = {unit["name"]: unit for unit in node_units(node(), address="10.200.0.10")}
    assert set(units) == {"containerd", "kubelet", "kube-proxy"}
    assert "--node-ip=10.200.0.10" in units["kubelet"]["argv"]
    assert all(unit["log"] == f"/run/fractus/logs/{name}.log" for name, unit in units.items())


@pytest.mark.parametrize("name", ["a", "demo", "a-very-long-name-of-a-cluster-x"])
def test_link_names_fit_the_kernel_limit(name: str) -> None:
    assert len(host_link(name)) <= 15
    assert host_link(name) != host_link(name + "2")


V1 = "".join(
    f"cgroup /sys/fs/cgroup/{name} cgroup rw,{name} 0 0\n"
    for name in ("cpu,cpuacct", "cpuset", "memory", "devices", "freezer", "pids")
)
UNIFIED = "cgroup2 /sys/fs/cgroup/unified cgroup2 rw,relatime 0 0\n"


def test_cgroup_hierarchies_of_version_1_and_hybrid_are_found() -> None:
    assert find_hierarchies(V1).version == 1
    hybrid = find_hierarchies(V1 + UNIFIED)
    assert hybrid.version == 1
    assert Path("/sys/fs/cgroup/unified") in hybrid.roots


def test_cgroup_hierarchy_of_version_2_is_found() -> None:
    hierarchies = find_hierarchies("cgroup2 /sys/fs/cgroup cgroup2 rw,nsdelegate 0 0\nproc /proc proc rw 0 0\n")
    assert (hierarchies.version, hierarchies.roots) == (2, (Path("/sys/fs/cgroup"),))


def test_cluster_cgroup_has_more_cpu_shares_than_a_process(tmp_path: Path) -> None:
    shares = tmp_path / TOP / "cpu.shares"
    shares.parent.mkdir()
    shares.write_text("1024")
    Branch(Hierarchies(1, (tmp_path,)), f"{TOP}/demo").create()
    assert int(shares.read_text()) >= 10 * 1024


def test_error_names_missing_cgroup_controller() -> None:
    with pytest.raises(PrerequisiteError, match="memory"):
        find_hierarchies(V1.replace("memory", "misc"))
    with pytest.raises(PrerequisiteError, match="no control groups"):
        find_hierarchies("proc /proc proc rw 0 0\n")


class FakeVolumes:
    """API server with PersistentVolumes, and claims that are bound to some of them."""

    def __init__(self) -> None:
        self.objects: dict[str, dict[str, Any]] = {}

    def apply(self, path: str, body: dict[str, Any]) -> dict[str, Any]:
        return self.objects.setdefault(path, {**body, "status": {"phase": "Available"}})

    def list(self, path: str) -> list[dict[str, Any]]:
        return [body for key, body in self.objects.items() if key.startswith(path)]

    def call(self, method: str, path: str) -> None:
        assert method == "DELETE"
        del self.objects[path]

    def merge(self, path: str, patch: dict[str, Any]) -> None:
        assert patch == {"spec": {"claimRef": None}}
        self.objects[path]["status"]["phase"] = "Available"


def test_volumes_are_kept_until_their_claim_or_node_is_removed(tmp_path: Path) -> None:
    api = FakeVolumes()

    def up(*names: str) -> dict[str, str]:
        nodes = [
            SimpleNamespace(name=name, volume=lambda number, name=name: tmp_path / name / str(number)) for name in names
        ]
        apply_volumes(cast(Any, api), cast(Any, nodes))
        return {body["metadata"]["name"]: body["status"]["phase"] for body in api.list("/api/v1/persistentvolumes")}

    api.objects["/api/v1/persistentvolumes/other"] = {"metadata": {"name": "other"}, "status": {"phase": "Released"}}
    assert len(up("cloud-1", "drone-1")) == 9
    (default,) = api.list("/apis/storage.k8s.io/v1/storageclasses")
    assert default["metadata"]["annotations"] == {"storageclass.kubernetes.io/is-default-class": "true"}
    for number, phase in ((1, "Bound"), (2, "Released")):
        (tmp_path / "cloud-1" / str(number) / "result").write_text("x")
        api.objects[f"/api/v1/persistentvolumes/cloud-1-{number}"]["status"]["phase"] = phase
    phases = up("cloud-1")
    assert (phases["cloud-1-1"], phases["cloud-1-2"], phases["other"]) == ("Bound", "Available", "Released")
    assert not any(name.startswith("drone-1") for name in phases)
    assert [str(p.relative_to(tmp_path)) for p in tmp_path.rglob("result")] == ["cloud-1/1/result"]
    assert (tmp_path / "cloud-1" / "2").is_dir()
