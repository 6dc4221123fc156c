"""Scraping of the operator, and the PodMonitors and addresses that the chart configures."""

from __future__ import annotations

import json
import urllib.request
from pathlib import Path

from chart import render
from control_plane import ControlPlane, wait_for
from fractus_cluster.ports import free_port
from operator_world import OperatorProcess, World, traffic
from scraping import scraped


def test_operator_serves_metrics_of_a_running_rollout(
    control_plane: ControlPlane, world: World, namespace: str, tmp_path: Path
) -> None:
    port = free_port()
    operator = OperatorProcess(
        control_plane.kubeconfig,
        tmp_path / "operator.log",
        FRACTUS_METRICS_PORT=str(port),
        FRACTUS_LEASE="2",
        FRACTUS_LOG_FORMAT="json",
    )

    operator.start()
    try:
        world.put(traffic(namespace))
        world.phase(namespace, "Deploying")
        metrics_text = wait_for(
            lambda: (samples := scraped(port)).get(("fractus_applications", "Deploying")) and samples, operator.log
        )
        assert metrics_text["fractus_operator_lease_left_seconds",] > 0
        assert metrics_text["fractus_operator_watch_open", "drones"] == 1
        assert 0 <= metrics_text["fractus_operator_watch_age_seconds", "pods"] < 300
        assert metrics_text["fractus_operator_reconcile_seconds_count", "application"] > 0
        assert metrics_text["fractus_operator_plan_phase_seconds_count", "plan"] > 0
        assert metrics_text["fractus_drones", "inactive"] == 1
        with urllib.request.urlopen(operator.health, timeout=20) as response:
            assert response.status == 200
        assert json.loads(operator.log().splitlines()[-1])["level"]
        assert "healthz" not in operator.log()
    finally:
        operator.stop()


def test_chart_creates_pod_monitors_only_if_enabled() -> None:
    assert not [body for body in render() if body["kind"] == "PodMonitor"]
    arguments = ("--set", "metrics.podMonitor.enabled=true", "--set", "metrics.podMonitor.labels.release=kube")
    rendered = render(*arguments)
    workloads = [body["spec"]["template"] for body in rendered if body["kind"] in {"Deployment", "DaemonSet"}]
    monitors = [body for body in rendered if body["kind"] == "PodMonitor"]
    assert len(monitors) == len(workloads) == 4
    for monitor in monitors:
        assert monitor["metadata"]["labels"]["release"] == "kube"
        selected = monitor["spec"]["selector"]["matchLabels"].items()
        (pods,) = [pods for pods in workloads if selected <= pods["metadata"]["labels"].items()]
        (container,) = pods["spec"]["containers"]
        (port,) = [p["containerPort"] for p in container["ports"] if p["name"] == "metrics"]
        environment = {each["name"]: each.get("value") for each in container["env"]}
        assert environment.get("FRACTUS_METRICS", environment.get("FRACTUS_METRICS_PORT")).endswith(str(port))
        (endpoint,) = monitor["spec"]["podMetricsEndpoints"]
        assert endpoint["port"] == "metrics"


def node_addresses(*arguments: str) -> set[tuple[str, bool]]:
    """Return, for each DaemonSet, its metrics address, and True if its pods declare a port for metrics."""
    bodies = [body for body in render(*arguments) if body["kind"] == "DaemonSet"]
    assert len(bodies) == 3
    containers = [body["spec"]["template"]["spec"]["containers"][0] for body in bodies]
    return {
        (
            next(each["value"] for each in container["env"] if each["name"] == "FRACTUS_METRICS").rsplit(":", 1)[0],
            "metrics" in {port["name"] for port in container.get("ports", ())},
        )
        for container in containers
    }


def test_node_metrics_listen_on_the_network_only_if_configured() -> None:
    assert node_addresses() == {("127.0.0.1", False)}
    node_address = {("$(FRACTUS_HOST)", True)}
    assert node_addresses("--set=metrics.podMonitor.enabled=true") == node_address
    assert node_addresses("--set=metrics.nodes.address=node") == node_address
    local = ("--set=metrics.podMonitor.enabled=true", "--set=metrics.nodes.address=localhost")
    assert node_addresses(*local) == {("127.0.0.1", False)}
    assert [body["metadata"]["name"] for body in render(*local) if body["kind"] == "PodMonitor"] == ["fractus-operator"]


def test_node_metrics_are_absent_if_disabled() -> None:
    rendered = render("--set", "metrics.podMonitor.enabled=true", "--set", "metrics.nodes.enabled=false")
    assert [body["metadata"]["name"] for body in rendered if body["kind"] == "PodMonitor"] == ["fractus-operator"]
    for body in rendered:
        if body["kind"] == "DaemonSet":
            (container,) = body["spec"]["template"]["spec"]["containers"]
            assert "FRACTUS_METRICS" not in {each["name"] for each in container["env"]}
            assert "metrics" not in {port["name"] for port in container.get("ports", ())}
