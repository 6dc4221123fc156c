"""Pod settings of each workload in the chart values are added to the required settings and never replace them."""

from __future__ import annotations

import json
import subprocess
from functools import cache
from typing import Any

import pytest
from chart import render

Body = dict[str, Any]

ON_NODES = ("agent", "mobility", "camera")
IN_THE_CLOUD = ("operator", "view", "management")
ENABLED = ("--set=view.enabled=true", "--set=management.enabled=true")
WORKLOADS = (*ON_NODES, *IN_THE_CLOUD)
DRONE = "--set=drone=d"
WHERE = "requiredDuringSchedulingIgnoredDuringExecution"
RATHER = "preferredDuringSchedulingIgnoredDuringExecution"

SSD = {"key": "disk", "operator": "In", "values": ["ssd"]}
BIG = {"key": "memory", "operator": "Exists"}
NAMED = {"key": "metadata.name", "operator": "In", "values": ["node-1"]}
APART = {"topologyKey": "rack", "labelSelector": {"matchLabels": {"team": "birds"}}}
FOR_ALL: Body = {
    "podLabels": {"team": "birds", "example.com/cost-centre": "7"},
    "podAnnotations": {"example.com/scrape": "no"},
    "extraEnv": [{"name": "HTTPS_PROXY", "value": "http://proxy:3128"}, {"name": "WHERE", "value": "$(FRACTUS_NODE)"}],
    "resources": {"requests": {"cpu": "1m"}},
}
FOR_PLACED = FOR_ALL | {
    "nodeSelector": {"region": "north"},
    "affinity": {
        "nodeAffinity": {
            WHERE: {"nodeSelectorTerms": [{"matchExpressions": [SSD], "matchFields": [NAMED]}, {"matchExpressions": [BIG]}]},
            RATHER: [{"weight": 1, "preference": {"matchExpressions": [BIG]}}],
        },
        "podAffinity": {RATHER: [{"weight": 2, "podAffinityTerm": APART}]},
        "podAntiAffinity": {WHERE: [APART]},
    },
}  # fmt: skip
FOR_THE_CLOUD = FOR_PLACED | {
    "tolerations": [{"key": "dedicated", "operator": "Exists"}],
    "topologySpreadConstraints": [{"maxSkew": 1, "topologyKey": "zone", "whenUnsatisfiable": "DoNotSchedule"}],
    "priorityClassName": "ground",
}


@cache
def templates(*arguments: str, chart: str = "fractus") -> dict[str, Body]:
    """Return the pod template of each workload, by its component label."""
    bodies = [body for body in render(*arguments, chart=chart) if body["kind"] in {"Deployment", "DaemonSet", "Job"}]
    return {body["metadata"]["labels"]["app.kubernetes.io/component"]: body["spec"]["template"] for body in bodies}


def everything() -> dict[str, Body]:
    settings = [f"--set-json={name}={json.dumps(FOR_THE_CLOUD)}" for name in IN_THE_CLOUD]
    settings += [f"--set-json={name}={json.dumps(FOR_PLACED)}" for name in ON_NODES]
    return templates(*settings, *ENABLED, "--set=uninstall.wipeNodes=true", "--is-upgrade")


def plain() -> dict[str, Body]:
    return templates(*ENABLED, "--set=uninstall.wipeNodes=true", "--is-upgrade")


def refusal(*arguments: str, chart: str = "fractus") -> str:
    with pytest.raises(subprocess.CalledProcessError) as error:
        render(*arguments, chart=chart)
    return str(error.value.stderr)


@pytest.mark.parametrize("part", [*WORKLOADS, "uninstall", "removal", "wipe"])
def test_workload_has_additional_labels_and_annotations(part: str) -> None:
    labels = plain()[part]["metadata"]["labels"]
    assert everything()[part]["metadata"] == {
        "labels": labels | FOR_ALL["podLabels"], "annotations": FOR_ALL["podAnnotations"],
    }  # fmt: skip
    assert labels["app.kubernetes.io/component"] == part


@pytest.mark.parametrize("part", WORKLOADS)
def test_workload_has_additional_variables_and_resources(part: str) -> None:
    (before,), (container,) = (found[part]["spec"]["containers"] for found in (plain(), everything()))
    assert container.get("env") == before.get("env", []) + FOR_ALL["extraEnv"]
    assert container["resources"]["requests"] == before["resources"]["requests"] | {"cpu": "1m"}


@pytest.mark.parametrize("part", WORKLOADS)
def test_workload_placement_combines_required_and_configured_rules(part: str) -> None:
    pod = everything()[part]["spec"]
    before = plain()[part]["spec"]
    assert pod["nodeSelector"] == FOR_PLACED["nodeSelector"]
    needed = before["affinity"]["nodeAffinity"][WHERE]["nodeSelectorTerms"]
    assert [term["matchExpressions"][0]["key"].partition("/")[0] for term in needed] == ["fractus.dev"] * len(needed)
    assert pod["affinity"]["nodeAffinity"][WHERE]["nodeSelectorTerms"] == [
        {"matchExpressions": [*term["matchExpressions"], configured], **fields}
        for term in needed
        for configured, fields in ((SSD, {"matchFields": [NAMED]}), (BIG, {}))
    ]
    configured = FOR_PLACED["affinity"]
    assert pod["affinity"]["nodeAffinity"][RATHER] == configured["nodeAffinity"][RATHER]
    assert pod["affinity"]["podAffinity"] == configured["podAffinity"]
    required = before["affinity"].get("podAntiAffinity", {})
    assert pod["affinity"]["podAntiAffinity"] == required | configured["podAntiAffinity"]


@pytest.mark.parametrize("part", [*IN_THE_CLOUD, "uninstall", "removal"])
def test_cloud_workload_has_configured_spread_and_tolerations(part: str) -> None:
    pod = everything()[part]["spec"]
    assert pod["tolerations"] == FOR_THE_CLOUD["tolerations"]
    assert pod["priorityClassName"] == "ground"
    (spread,) = pod["topologySpreadConstraints"]
    counted = spread.pop("labelSelector")["matchLabels"]
    assert spread == FOR_THE_CLOUD["topologySpreadConstraints"][0]
    labels = everything()[part if part in IN_THE_CLOUD else "operator"]["metadata"]["labels"]
    assert counted.items() <= labels.items()
    assert "app.kubernetes.io/component" in counted


def test_topology_spread_constraint_keeps_its_label_selector() -> None:
    constraint = FOR_THE_CLOUD["topologySpreadConstraints"][0] | {"labelSelector": {"matchLabels": {"team": "birds"}}}
    pods = templates(f"--set-json=operator.topologySpreadConstraints={json.dumps([constraint])}")
    assert pods["operator"]["spec"]["topologySpreadConstraints"] == [constraint]


@pytest.mark.parametrize("part", ON_NODES)
def test_node_workload_has_node_priority_and_tolerates_all_taints(part: str) -> None:
    pod = everything()[part]["spec"]
    assert pod["priorityClassName"] == "fractus-node"
    assert pod["tolerations"] == [{"operator": "Exists"}]
    for name, value in (("priorityClassName", '"low"'), ("tolerations", "[]"), ("topologySpreadConstraints", "[]")):
        assert name in refusal(f"--set-json={part}.{name}={value}")


def test_operator_replicas_prefer_different_nodes() -> None:
    anti_affinity = plain()["operator"]["spec"]["affinity"]["podAntiAffinity"]
    assert set(anti_affinity) == {RATHER}, "a required rule would prevent two replicas on one node"
    assert {term["podAffinityTerm"]["topologyKey"]: term["weight"] for term in anti_affinity[RATHER]} == {
        "kubernetes.io/hostname": 100,
        "topology.kubernetes.io/zone": 50,
    }


def test_view_inherits_placement_of_operator_unless_configured() -> None:
    settings = [
        "--set=view.enabled=true",
        "--set=operator.nodeSelector.pool=a",
        "--set=operator.tolerations[0].operator=Exists",
    ]
    pod = templates(*settings)["view"]["spec"]
    assert (pod["nodeSelector"], pod["tolerations"]) == ({"pool": "a"}, [{"operator": "Exists"}])
    assert templates(*settings, "--set=view.nodeSelector.pool=b")["view"]["spec"]["nodeSelector"]["pool"] == "b"


RESERVED = (
    "app.kubernetes.io/name",
    "app.kubernetes.io/component",
    "app.kubernetes.io/version",
    "fractus.dev/application",
    "operator.fractus.dev/anything",
    "helm.sh/chart",
    "controller-revision-hash",
    "pod-template-hash",
)


@pytest.mark.parametrize("name", RESERVED)
def test_reserved_pod_label_is_refused(name: str) -> None:
    for part in ("operator", "mobility"):
        message = refusal(f"--set-json={part}.podLabels={json.dumps({name: 'x'})}", "--skip-schema-validation")
        assert f"{part}.podLabels: the label {name} is reserved" in message
    assert name in refusal(DRONE, f"--set-json=vehicle.podLabels={json.dumps({name: 'x'})}", chart="fractus-demo")


@pytest.mark.parametrize(("chart", "more"), [("fractus", ()), ("fractus-demo", (DRONE,))])
def test_invalid_image_tag_is_refused(chart: str, more: tuple[str, ...]) -> None:
    """A kubelet refuses a digest in the place of a tag, so no service would start."""
    for tag in (f"sha256:{64 * '0'}", f"1.0@sha256:{64 * '0'}", "-x", 129 * "x"):
        assert "image/tag" in refusal(f"--set-string=image.tag={tag}", *more, chart=chart)
    for tag in ("", "1.2.3_amd64-rc.1"):
        assert render(f"--set-string=image.tag={tag}", *more, chart=chart)


@pytest.mark.parametrize("part", WORKLOADS)
def test_reserved_environment_variable_is_refused(part: str) -> None:
    message = refusal(f"--set={part}.extraEnv[0].name=FRACTUS_NODE", *ENABLED)
    assert f"{part}.extraEnv: FRACTUS_NODE is reserved" in message


def test_demo_vehicle_has_additional_pod_settings() -> None:
    before = templates(DRONE, chart="fractus-demo")["vehicle"]
    settings = FOR_ALL | {"priorityClassName": "fractus-node"}
    after = templates(DRONE, f"--set-json=vehicle={json.dumps(settings)}", chart="fractus-demo")["vehicle"]
    assert after["metadata"] == {
        "labels": before["metadata"]["labels"] | FOR_ALL["podLabels"], "annotations": FOR_ALL["podAnnotations"],
    }  # fmt: skip
    assert after["spec"]["priorityClassName"] == "fractus-node"
    (container,) = after["spec"]["containers"]
    assert container["env"] == FOR_ALL["extraEnv"]
    assert container["resources"]["requests"]["cpu"] == "1m"


@pytest.mark.parametrize(("settings", "host"), [((), "127.0.0.1"), (("--set=metrics.nodes.address=node",), None)])
def test_agent_readiness_probe_requests_metrics(settings: tuple[str, ...], host: str | None) -> None:
    (container,) = templates(*settings)["agent"]["spec"]["containers"]
    probe = container["readinessProbe"]["httpGet"]
    assert (probe["path"], probe.get("host")) == ("/metrics", host)
    (listens,) = (variable["value"] for variable in container["env"] if variable["name"] == "FRACTUS_METRICS")
    assert listens == f"{host or '$(FRACTUS_HOST)'}:{probe['port']}"


def test_agent_has_no_readiness_probe_without_metrics() -> None:
    (container,) = templates("--set=metrics.nodes.enabled=false")["agent"]["spec"]["containers"]
    assert "readinessProbe" not in container


@pytest.mark.parametrize("part", ON_NODES)
def test_node_services_have_no_liveness_probe(part: str) -> None:
    (container,) = plain()[part]["spec"]["containers"]
    assert "readinessProbe" in container
    assert not {"livenessProbe", "startupProbe"} & set(container)


def test_operator_network_policy_opens_exactly_its_ports() -> None:
    (policy,) = (b for b in render() if (b["kind"], b["metadata"]["name"]) == ("NetworkPolicy", "fractus-operator"))
    assert policy["spec"]["policyTypes"] == ["Ingress"], "the policy restricts egress"
    pod = templates()["operator"]
    assert policy["spec"]["podSelector"]["matchLabels"].items() <= pod["metadata"]["labels"].items()
    (rule,) = policy["spec"]["ingress"]
    (container,) = pod["spec"]["containers"]
    assert {port["port"] for port in rule["ports"]} == {port["name"] for port in container["ports"]}


def test_gateway_has_neither_root_nor_the_files_and_devices_of_the_mobility_service() -> None:
    assert "initContainers" not in templates()["mobility"]["spec"]
    template = templates("--set=gateway.enabled=true,mobility.privileged=true")["mobility"]["spec"]
    mobility, gateway = template["containers"]
    assert (mobility["name"], gateway["name"]) == ("mobility", "gateway")
    security = gateway["securityContext"]
    assert security["runAsNonRoot"]
    assert security["readOnlyRootFilesystem"]
    assert security["capabilities"] == {"drop": ["ALL"]}
    paths = {mount["mountPath"]: mount.get("readOnly", False) for mount in gateway["volumeMounts"]}
    state = "/var/lib/fractus"
    assert paths == {"/run/fractus": False, "/tmp": False, f"{state}/tls": True, f"{state}/gateway": False}
    options = dict(zip(mobility["args"], mobility["args"][1:], strict=False))
    assert options["--gateway-socket"] == "/run/fractus/gateway.sock"
    assert options["--gateway-user"] == str(security["runAsUser"])
    assert template["securityContext"]["fsGroup"] == security["runAsGroup"]
