"""Output and exit codes of `fractus status`, `explain`, `doctor` and `completion`."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from fake_cluster_reader import condition, show
from fractus_cli import doctor, explain, main, status
from fractus_core.api import KINDS
from fractus_core.api.crd import crd

V1 = "/apis/fractus.dev/v1alpha1"
DOCS = Path(__file__).parents[2] / "docs" / "cli.md"

Run = Callable[..., tuple[int, str]]
Body = dict[str, Any]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    def call(*arguments: str) -> tuple[int, str]:
        code = main.run(arguments)
        output = capsys.readouterr()
        return code, output.out + output.err

    return call


def named(name: str, namespace: str = "", **more: Any) -> Body:
    return {"metadata": {"name": name} | ({"namespace": namespace} if namespace else {}), **more}


DRONE = named(
    "drone-1",
    spec={},
    status={
        "flightState": "flying",
        "battery": {"remaining": 0.625},
        "lastSeen": "2026-01-01T00:00:00Z",
        "conditions": [
            condition("Ready", "True"),
            condition("ServicesCurrent", "False", "InTheAir"),
            condition("OnMission", "True"),
        ],
    },
)
APPLICATION = named(
    "traffic",
    "default",
    spec={
        "contactLost": {"after": 20, "action": "hover"},
        "components": [
            {"name": "Navigator", "placement": "drone"},
            {"name": "Viewer", "placement": "edge", "endsWith": "application"},
            {"name": "Store", "placement": "cloud"},
        ],
    },
    status={"phase": "Flying", "drone": "drone-1", "pods": "3/3", "message": "drone-1 flies"},
)


def test_status_shows_drones_edge_nodes_and_applications(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    edge = named("edge-1", spec={}, status={"conditions": [condition("Ready", "Unknown", "AgentSilent", "gone")]})
    objects = {
        f"{V1}/drones": [DRONE],
        f"{V1}/edgenodes": [edge],
        f"{V1}/applications": [APPLICATION, named("new", "default")],
        f"{V1}/namespaces/other/applications": [],
    }
    show(monkeypatch, status, objects)
    code, output = run("status")
    assert code == 0
    assert re.search(r"drone-1 +flying +- +62% +True +InTheAir +2026-01-01T00:00:00Z", output)
    assert re.search(r"edge-1 +Unknown +Current +- +gone", output)
    assert re.search(r"default/traffic +Flying +drone-1 +3/3 +drone-1 flies", output)
    assert re.search(r"default/new +Pending .*not processed by the operator yet", output)
    code, output = run("status", "-n", "other", "-o", "json")
    parsed = json.loads(output)
    assert (parsed["drones"][0]["onMission"], parsed["applications"]) == ("True", [])


def test_status_watch_repeats_until_interrupted(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    show(monkeypatch, status, {})
    pauses: list[float] = []

    def pause(seconds: float) -> None:
        pauses.append(seconds)
        if len(pauses) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(status.time, "sleep", pause)
    code, output = run("status", "--watch")
    assert code == 130
    assert output.count("APPLICATION") == 3


PLAN: Body = {
    "application": "traffic",
    "drone": {
        "node": "drone-1",
        "score": 12.5,
        "alternatives": [{"node": "drone-2", "score": 3.25}],
        "mission": {"distance": 420.4, "duration": 6.25, "available": 18.0},
        "legality": [
            {
                "end": {"lat": 39.5, "lon": 22.5},
                "outcome": "Detour",
                "message": "the system flies a detour of 80 m",
                "policies": ["school"],
            }
        ],
    },
    "placements": [
        {"component": "Navigator", "node": "drone-1", "role": "drone"},
        {"component": "Viewer", "node": "edge-1", "role": "static", "location": 1},
        {"component": "Store", "role": "cloud"},
    ],
    "rejected": [
        {"component": "Navigator", "node": f"drone-{i}", "reason": "FlightTooLong", "message": "needs 9 min"}
        for i in range(3, 10)
    ],
    "rejectedOmitted": 40,
}


def distant(name: str, selector: Body) -> Body:
    """Return a Policy whose zone is far from every depot."""
    spec = {"type": "GeofenceControl", "kind": "exclusion", "selector": {"zones": ["yard"], **selector}}
    far = {**condition("FarFromDepots", "True", "ZonesFar", "far: yard"), "lastTransitionTime": "2026-01-01T00:00:00Z"}
    return named(name, spec=spec, status={"conditions": [far]})


@pytest.fixture
def explained(monkeypatch: pytest.MonkeyPatch) -> Body:
    owner = {"namespace": "default", "name": "traffic"}
    place = {"lat": 39.4, "lon": 22.4}
    spec = {"type": "GeofenceControl", "action": "abort", "landAt": place}
    policy = {"name": "school", "spec": spec, "selected": True, "zones": [{"name": "yard"}]}
    grant = {"spec": {"instance": "navigator-x", "application": owner, "policies": [policy]}}
    event = {"lastTimestamp": "2026-01-01T00:00:00Z", "type": "Normal", "reason": "Planned", "message": "drone-1 flies"}
    objects: Body = {
        f"{V1}/namespaces/default/applications/traffic": APPLICATION,
        f"{V1}/namespaces/default/deploymentplans": [named("traffic", "default", spec=PLAN)],
        f"{V1}/grants": [grant],
        f"{V1}/policies": [
            distant("school", {}),
            distant("other", {"applications": {"names": ["other"]}}),
            named("near", spec=distant("near", {})["spec"]),
        ],
        "/api/v1/namespaces/default/events": [event],
    }
    show(monkeypatch, explain, objects)
    return objects


def test_explain_prints_placements_rejected_nodes_and_policies(run: Run, explained: Body) -> None:
    code, output = run("explain", "traffic")
    assert code == 0
    for sentence in (
        "default/traffic: Flying: drone-1 flies",
        "Drone: drone-1 (score 12.5); next best: drone-2 (3.25)",
        "420 m in 6.2 min; available without the reserve: 18.0 min",
        "leg to 39.500000, 22.500000: Detour by school: the system flies a detour of 80 m",
        "Viewer: edge-1 (for location 1)",
        "Store: cloud (any cloud node)",
        "Until 30 s after the landing (spec.afterFlight): Navigator\n",
        "Until the Application is deleted (endsWith: application): Viewer, Store\n",
        "Rejected for Navigator:",
        "drone-3: FlightTooLong: needs 9 min",
        "and 2 more (--all)",
        "40 more rejected nodes",
        "Policies for navigator-x: school (GeofenceControl in yard:"
        " abort and land at 39.400000, 22.400000, selected by the application)",
        "Without contact with the API server for 20 s: hover",
        "Normal Planned: drone-1 flies",
    ):
        assert sentence in output
    assert re.findall("Policy .*", output) == ["Policy school: far: yard"]
    assert "drone-9" not in output
    assert "drone-9" in run("explain", "traffic", "--all")[1]
    assert json.loads(run("explain", "traffic", "-o", "json")[1])["rejected"] == PLAN["rejected"]


def test_explain_exits_with_2_without_plan_or_with_policy_conflict(run: Run, explained: Body) -> None:
    assert run("explain", "other")[0] == 1
    plans = explained[f"{V1}/namespaces/default/deploymentplans"]
    conflict = {**PLAN, "drone": {**PLAN["drone"], "policyConflict": "the leg is denied"}}
    plans[:] = [named("traffic", "default", spec=conflict)]
    code, output = run("explain", "traffic")
    assert code == 2
    assert "Conflict: the leg is denied" in output
    plans.clear()
    code, output = run("explain", "traffic")
    assert code == 2
    assert "There is no plan." in output


def test_explain_suggests_closest_application_for_unknown_name(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    show(monkeypatch, explain, {f"{V1}/namespaces/default/applications": [APPLICATION]})
    assert run("explain", "trafic") == (
        1,
        "fractus: Application default/trafic not found; did you mean traffic?\n",
    )


# -- doctor --


def authority(days: float) -> Body:
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "ca")])
    now = datetime.now(UTC)
    builder = x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number())
    builder = builder.not_valid_before(now - timedelta(days=900)).not_valid_after(now + timedelta(days=days))
    pem = builder.sign(key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)
    return {"data": {"ca.crt": pem.decode()}}


def node(name: str, node_class: str, *, tainted: bool = True, ready: str = "True", cloud: bool = False) -> Body:
    taints = [{"key": "fractus.dev/class", "effect": "NoExecute"}] if tainted else []
    body = named(name, spec={"taints": taints}, status={"conditions": [condition("Ready", ready)]})
    body["metadata"]["labels"] = {"fractus.dev/class": node_class} | ({"fractus.dev/cloud": "true"} if cloud else {})
    return body


@pytest.fixture
def healthy(monkeypatch: pytest.MonkeyPatch) -> Body:
    """Cluster without problems."""
    system = "/apis/apps/v1/namespaces/fractus-system"
    kinds = [crd(kind) | {"status": {"conditions": [condition("Established", "True")]}} for kind in KINDS]
    policies = [named(name) for name in doctor.POLICIES]
    bindings = [named(name, spec={"policyName": name, "validationActions": ["Deny"]}) for name in doctor.POLICIES]
    objects: Body = {
        "/version": {"major": "1", "minor": "35+", "gitVersion": "v1.35.4"},
        "/apis/apiextensions.k8s.io/v1/customresourcedefinitions": kinds,
        f"{system}/deployments/fractus-operator": {"spec": {"replicas": 2}, "status": {"readyReplicas": 2}},
        "/apis/coordination.k8s.io/v1/namespaces/fractus-system/leases/fractus-operator": {
            "spec": {"holderIdentity": "operator-a"}
        },
        "/apis/admissionregistration.k8s.io/v1/validatingadmissionpolicies": policies,
        "/apis/admissionregistration.k8s.io/v1/validatingadmissionpolicybindings": bindings,
        "/api/v1/namespaces/fractus-system/pods": [],
        "/api/v1/namespaces/fractus-system/configmaps/fractus-ca": authority(400),
        "/api/v1/nodes": [node("drone-1", "drone"), node("edge-1", "edge"), node("cloud-1", "cloud")],
        f"{V1}/drones": [DRONE],
        f"{V1}/edgenodes": [named("edge-1", status={"conditions": [condition("Ready", "True")]})],
        f"{V1}/zones": [],
        f"{V1}/policies": [],
        f"{V1}/depots": [named("base")],
    }
    for name in doctor.SERVICES:
        counts = {"numberReady": 2, "desiredNumberScheduled": 2, "currentNumberScheduled": 2}
        objects[f"{system}/daemonsets/{name}"] = {"status": counts}
    show(monkeypatch, doctor, objects)
    return objects


def test_doctor_reports_only_ok_for_healthy_cluster(run: Run, healthy: Body) -> None:
    code, output = run("doctor")
    assert code == 0, output
    assert {line.split()[0] for line in output.splitlines()} == {"ok"}


def test_doctor_warns_about_single_node_that_is_drone_and_cloud(run: Run, healthy: Body) -> None:
    healthy["/api/v1/nodes"] = [node("drone-1", "drone", tainted=False, cloud=True)]
    healthy[f"{V1}/edgenodes"] = []
    code, output = run("doctor", "-o", "json")
    assert code == 0, output
    (warned,) = [value["message"] for value in json.loads(output) if value["level"] != "ok"]
    assert warned == "drone-1 is also a cloud node: any pod on it can reach the autopilot"


SYSTEM_APPS = "/apis/apps/v1/namespaces/fractus-system"
WAITING = {
    "metadata": {"name": "fractus-camera-x"},
    "spec": {"nodeName": "drone-1"},
    "status": {"containerStatuses": [{"state": {"waiting": {"reason": "ImagePullBackOff", "message": "no such tag"}}}]},
}
SILENT = {**DRONE, "status": {"conditions": [condition("Ready", "Unknown", "AgentSilent", "last heard of")]}}
UNREGISTERED = [node("drone-1", "drone"), node("drone-9", "drone"), node("cloud-1", "cloud")]
MISTYPED = [*UNREGISTERED[::2], node("b", "boat")]
AUTHORITY = "/api/v1/namespaces/fractus-system/configmaps/fractus-ca"
ADMISSION = "/apis/admissionregistration.k8s.io/v1"
LIMIT = {"type": "LimitControl", "kind": "speed", "upperLimit": 5, "action": "enforce"}
PROBLEMS: list[tuple[str, Any, str, str]] = [
    ("/version", {"major": "1", "minor": "31"}, "error", "upgrade Kubernetes to 1.32"),
    ("/apis/apiextensions.k8s.io/v1/customresourcedefinitions", [], "error", "--install fractus-crds"),
    (f"{SYSTEM_APPS}/deployments/fractus-operator", None, "error", "--install fractus "),
    (f"{SYSTEM_APPS}/deployments/fractus-operator", {"spec": {"replicas": 2}}, "error", "logs deployment/fractus-oper"),
    (f"{SYSTEM_APPS}/daemonsets/fractus-camera", None, "warning", "fractus-camera is not installed"),
    (
        f"{SYSTEM_APPS}/daemonsets/fractus-camera",
        {"status": {"numberReady": 1, "desiredNumberScheduled": 2, "currentNumberScheduled": 2}},
        "warning",
        "component=camera",
    ),
    (f"{ADMISSION}/validatingadmissionpolicies", [], "error", "fractus-flight-pods"),
    (f"{ADMISSION}/validatingadmissionpolicybindings", [], "error", "fractus-flight-pods"),
    ("/api/v1/namespaces/fractus-system/pods", [WAITING], "error", "imagePullSecrets"),
    (AUTHORITY, None, "error", "the certificate of the authority, does not exist"),
    (AUTHORITY, authority(10), "warning", "the certificate authority expires"),
    (AUTHORITY, authority(-1), "error", "the certificate authority expires"),
    (AUTHORITY, {"data": {"ca.crt": base64.b64encode(b"x").decode()}}, "error", "invalid certificate authority"),
    ("/api/v1/nodes", UNREGISTERED, "error", "drone-9 has no Drone"),
    ("/api/v1/nodes", MISTYPED, "error", "kubectl label node b fractus.dev/class=drone --overwrite"),
    ("/api/v1/nodes", [node("cloud-1", "cloud")], "error", "kubectl label node NODE fractus.dev/class=drone"),
    ("/api/v1/nodes", [node("drone-1", "drone")], "warning", "kubectl label node NODE fractus.dev/class=cloud"),
    (
        "/api/v1/nodes",
        [node("drone-1", "drone", cloud=True)],
        "warning",
        "kubectl taint node drone-1 fractus.dev/class-",
    ),
    (
        "/api/v1/nodes",
        [node("drone-1", "drone", tainted=False), node("c", "cloud")],
        "warning",
        "kubectl taint node drone-1 fractus.dev/class=drone:NoExecute",
    ),
    (
        "/api/v1/nodes",
        [node("drone-1", "drone", ready="Unknown"), node("c", "cloud")],
        "warning",
        "drone-1 is not ready",
    ),
    (f"{V1}/edgenodes", [named("drone-1")], "error", "drone-1 is the name of a Drone and of an EdgeNode"),
    (f"{V1}/drones", [SILENT], "error", "drone-1: Ready: AgentSilent: last heard of"),
    (
        f"{V1}/policies",
        [named("p", status={"conditions": [condition("Ready", "False", "ZoneMissing", "no zone z")]})],
        "error",
        "policies/p: no zone z",
    ),
    (
        f"{V1}/policies",
        [named("slow", spec=LIMIT | {"selector": {"applications": {"names": ["nobody"]}}})],
        "warning",
        "Policy slow: spec.selector.applications: no Application is selected",
    ),
    (f"{V1}/depots", [], "warning", "apply a Depot"),
]


@pytest.mark.parametrize(
    ("path", "value", "level", "words"), PROBLEMS, ids=[f"{n}-{x[3]}" for n, x in enumerate(PROBLEMS)]
)
def test_doctor_reports_problem_with_remedy(
    run: Run, healthy: Body, path: str, value: Any, level: str, words: str
) -> None:
    healthy[path] = value
    code, output = run("doctor", "-o", "json")
    assert code == (2 if level == "error" else 0)
    assert any(f["level"] == level and words in f["message"] + f["remedy"] for f in json.loads(output)), output
    assert all(f["remedy"] for f in json.loads(output) if f["level"] != "ok"), "every problem has a remedy"


def test_doctor_checks_all_admission_policies_of_the_chart() -> None:
    charts = DOCS.parents[1] / "charts" / "fractus" / "templates"
    text = "".join(file.read_text() for file in charts.glob("*.yaml"))
    assert set(re.findall(r"kind: ValidatingAdmissionPolicy\nmetadata:\n  name: ([\w-]+)", text)) == set(
        doctor.POLICIES
    )


# -- the command line --


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_prints_script_for_shell(run: Run, shell: str) -> None:
    code, output = run("completion", shell)
    assert code == 0
    assert "_FRACTUS_COMPLETE" in output


def test_cli_page_lists_every_command_with_its_summary() -> None:
    text = DOCS.read_text()
    rows = dict(re.findall(r"^\| `fractus ([\w-]+)` \| (.*?) \|", text, re.MULTILINE))
    assert rows == {name: entry.summary for name, entry in main.COMMANDS.items()}


@pytest.mark.parametrize("name", ["status", "explain", "doctor", "completion"])
def test_cli_page_quotes_help_of_commands_that_read_clusters(run: Run, name: str) -> None:
    assert run(name, "--help")[1].strip() in DOCS.read_text()
