"""Missions on a cluster: one manifest flies a drone under policies and leaves no objects behind."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest
from conftest import DRONE, NODES, SYSTEM, example, flight_state, short_flight
from disclosure import readable, secrets
from fractus_runtime.audit_chain import verify
from kubectl import Kube, Object, condition
from leaks import leaks

MOBILITY = "app.kubernetes.io/component=mobility"


def phase(kube: Kube, name: str, namespace: str = "default") -> str | None:
    app = kube.get("application.fractus.dev", name, namespace)
    return ((app or {}).get("status") or {}).get("phase")


def ready(kube: Kube, name: str) -> bool:
    return condition(kube.get("application.fractus.dev", name), "Ready").get("status") == "True"


STILL_AT_WORK = ",!fractus.dev/finished"


def all_stopped(pods: list[Object]) -> list[Object]:
    """Return the pods if all have finished, otherwise an empty list."""
    return pods if pods and all(pod["status"]["phase"] in {"Succeeded", "Failed"} for pod in pods) else []


def audit_text(kube: Kube) -> str:
    pod = kube.pod(MOBILITY, SYSTEM, node=DRONE)["metadata"]["name"]
    return kube.must("exec", "-n", SYSTEM, pod, "--", "cat", "/var/lib/fractus/audit/mobility.jsonl")


def audit_log(kube: Kube) -> list[Object]:
    return [json.loads(line) for line in audit_text(kube).splitlines()]


def children(kube: Kube, namespace: str = "default", pods: str = "") -> list[str]:
    kinds = "deployments,replicasets,services,secrets,endpointslices,poddisruptionbudgets"
    objects = kube.all(kinds, namespace, "fractus.dev/application")
    objects += kube.all("pods", namespace, f"fractus.dev/application{pods}")
    grants = kube.all("grants.fractus.dev")
    return [f"{o['kind']}/{o['metadata']['name']}" for o in (*objects, *grants)]


def test_traffic_monitoring_flies_under_policies(grounded: Kube, tmp_path: Path) -> None:
    kube = grounded
    app = example("application.yaml")[0]
    app["spec"]["afterFlight"] = 5  # with the default of 30 s, the test would only wait longer
    started = time.monotonic()
    kube.apply(app)
    kube.wait("all pods of the example are Ready", lambda: ready(kube, "traffic-monitoring"), timeout_s=60)
    print(f"time from apply until all pods were Ready: {time.monotonic() - started:.1f} s")
    secret_values = secrets(kube)
    texts = {f"{name} in flight": text for name, text in readable(kube).items()}

    plan = kube.get("deploymentplan", "traffic-monitoring")
    placed = {(p["component"], p.get("node")) for p in plan["spec"]["placements"]}
    assert {
        ("Navigator", DRONE),
        ("AerialViewer", DRONE),
        ("GroundViewer", NODES["edge-1"]),
        ("GroundViewer", NODES["edge-2"]),
    } <= placed
    assert ("ImageChecker", None) in placed
    assert {n for c, n in placed if c == "ImageChecker"} >= {NODES["edge-1"], NODES["edge-2"]}
    dropped = {(r["component"], r["node"]): r["reason"] for r in plan["spec"]["rejected"]}
    assert dropped["ImageChecker", NODES["edge-3"]] == "NoCoverage"
    for pod in kube.all("pods", "default", "fractus.dev/application=traffic-monitoring"):
        labels = pod["metadata"]["labels"]
        assert {"fractus.dev/component", "fractus.dev/instance", "fractus.dev/placement"} <= labels.keys()
        node = pod["spec"]["nodeName"]
        assert node == NODES["cloud-1"] if labels["fractus.dev/placement"] == "cloud" else node

    kube.wait("the drone flies", lambda: flight_state(kube) == "flying", timeout_s=90)
    kube.wait(
        "the mission is over", lambda: phase(kube, "traffic-monitoring") in {"Completed", "Failed"}, timeout_s=240
    )
    finished = kube.get("application.fractus.dev", "traffic-monitoring")
    assert finished["status"]["phase"] == "Completed", finished["status"]
    kube.wait("the drone is home", lambda: flight_state(kube) == "inactive", timeout_s=120)

    log = audit_log(kube)
    calls = [e for e in log if e.get("kind") == "call"]
    assert any(e["action"] == "correct" and "town-altitude" in e["policies"] for e in calls)
    assert any(e["action"] == "deny" and "no-fly-hospital" in e["policies"] for e in calls)
    heights = [e["alt"] for e in log if e.get("kind") == "state"]
    assert 45 < max(heights) < 52
    kube.wait(
        "all child objects except the plan, stopped pods, and those of the component in the cloud are deleted",
        lambda: not [name for name in children(kube, pods=STILL_AT_WORK) if "data-store" not in name],
        timeout_s=90,
    )
    store = kube.all("pods", "default", "fractus.dev/component=DataStore")
    assert [pod["status"]["phase"] for pod in store] == ["Running"] * 3
    application = "fractus.dev/application=traffic-monitoring,fractus.dev/component!=DataStore"
    stopped = kube.wait("all pods stopped", lambda: all_stopped(kube.all("pods", "default", application)), timeout_s=60)
    assert len(stopped) >= 4
    logs = kube.must("logs", "-l", application, "--all-containers", "--prefix", "--tail=-1", "--max-log-requests=20")
    assert "run: mission complete" in logs
    events = {e["reason"] for e in kube.all("events", "default")}
    assert {"Planned", "MissionComplete"} <= events

    options = ["--kubeconfig", str(kube.kubeconfig), "--out", str(tmp_path / "report")]
    path = f"{kube.kubectl.parent}:{os.environ['PATH']}"
    subprocess.run(
        [sys.executable, "-m", "fractus_cli", "report", "traffic-monitoring", *options],
        check=True, timeout=120, env={**os.environ, "PATH": path},
    )  # fmt: skip
    assert f"**Completed.** {DRONE} flew" in (tmp_path / "report" / "summary.md").read_text()
    assert (tmp_path / "report" / "map.png").stat().st_size > 10_000

    assert {f"{SYSTEM}/fractus-ca/tls.key", f"key of {DRONE}"} <= secret_values.keys()
    assert any(re.fullmatch(r"default/traffic-monitoring-navigator\b.*-tls/tls\.key", name) for name in secret_values)
    texts |= readable(kube) | {"audit log": audit_text(kube)}
    assert leaks(texts, secret_values) == []


# `make test` shows this with test_deleted_application_leaves_no_objects and test_return_respects_zones_of_removed_grant.
@pytest.mark.slow
def test_deleted_application_flies_the_drone_home(grounded: Kube) -> None:
    kube = grounded
    kube.apply(short_flight("deleted"))
    kube.wait("the drone flies", lambda: flight_state(kube) == "flying", timeout_s=120)
    kube.must("delete", "application.fractus.dev", "deleted", "--wait=true", "--timeout=60s", timeout_s=90)
    kube.wait("nothing is left", lambda: not children(kube), timeout_s=60)
    assert kube.get("deploymentplan", "deleted") is None
    kube.wait("the drone is home", lambda: flight_state(kube) == "inactive", timeout_s=150)
    takeovers = [e for e in audit_log(kube) if e.get("kind") == "takeover"]
    assert any(e.get("code") == "GrantRevoked" for e in takeovers)


def test_status_has_the_last_output_of_a_failed_component(grounded: Kube) -> None:
    kube = grounded
    app = short_flight("failing")
    container = app["spec"]["components"][0]["container"]
    container["command"] = ["python3", "-c", "raise SystemExit('no route to the river')"]
    kube.apply(app)

    def failed() -> Object | None:
        ready_condition = condition(kube.get("application.fractus.dev", "failing"), "Ready")
        return ready_condition if ready_condition.get("reason") == "ComponentFailed" else None

    failure = kube.wait("the failure is reported", failed, timeout_s=120)
    last_output = "failed with exit code 1: no route to the river"
    assert last_output in failure["message"]
    kube.wait(
        "the failure has an Event",
        lambda: any(
            last_output in event["message"]
            for event in kube.all("events", "default")
            if event["reason"] == "ComponentFailed"
        ),
    )


# `make test` shows this with test_deletion_while_operator_is_down_leaves_no_objects.
@pytest.mark.slow
def test_application_deleted_without_operator_leaves_no_objects(grounded: Kube) -> None:
    kube = grounded
    kube.apply(short_flight("orphan"))
    kube.wait("the Grant exists", lambda: kube.all("grants.fractus.dev"), timeout_s=120)
    kube.must("scale", "deployment/fractus-operator", "-n", SYSTEM, "--replicas=0")
    try:
        kube.wait(
            "the pods of the operator are deleted",
            lambda: not kube.all("pods", SYSTEM, "app.kubernetes.io/component=operator"),
        )
        kube.must("delete", "application.fractus.dev", "orphan", "--wait=false")
    finally:
        kube.must("scale", "deployment/fractus-operator", "-n", SYSTEM, "--replicas=2")
    kube.wait("the Application is deleted", lambda: kube.get("application.fractus.dev", "orphan") is None, timeout_s=90)
    kube.wait("nothing is left", lambda: not children(kube), timeout_s=60)


def test_audit_log_is_an_unbroken_chain(kube: Kube) -> None:
    log = audit_text(kube)
    finding = verify(line.encode() for line in log.splitlines(keepends=True))
    assert finding.problem == ""
    assert finding.entries > 10
    forged = re.sub(r'"alt":-?[0-9.]+', '"alt":999', log, count=1)
    assert forged != log
    assert verify(line.encode() for line in forged.splitlines(keepends=True)).problem


READ_METRICS = "import os, urllib.request as u; print(u.urlopen(f'http://{os.environ[\"FRACTUS_METRICS\"]}/metrics').read().decode())"


def test_every_workload_serves_metrics(kube: Kube) -> None:
    checked = set()
    for pod in kube.all("pods", SYSTEM):
        name = pod["metadata"]["name"]
        (container,) = pod["spec"]["containers"]
        ports = {port["name"]: port["containerPort"] for port in container.get("ports", ())}
        if pod["status"]["phase"] != "Running":
            continue
        if any(variable["name"] == "FRACTUS_METRICS" for variable in container.get("env", ())):
            # By default, workloads on nodes serve metrics on the loopback interface only.
            metrics = kube.must("exec", "-n", SYSTEM, name, "--", "python3", "-c", READ_METRICS)
        elif "metrics" in ports:
            metrics = kube.must(
                "get", "--raw", f"/api/v1/namespaces/{SYSTEM}/pods/{name}:{ports['metrics']}/proxy/metrics"
            )
        else:
            continue
        assert "\nfractus_" in metrics, name
        checked.add(container["name"])
    assert checked == {"operator", "agent", "mobility", "camera"}
