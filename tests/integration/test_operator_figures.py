"""The operator's metrics, as Prometheus finds them."""

from __future__ import annotations

import urllib.request
from pathlib import Path

from chart import render
from control_plane import ControlPlane, wait_for
from fractus_cluster.ports import free_port
from operator_world import OperatorProcess, World, traffic
from prometheus_client.parser import text_string_to_metric_families


def test_the_operator_tells_prometheus_what_it_does(
    control_plane: ControlPlane, world: World, namespace: str, tmp_path: Path
) -> None:
    port = free_port()
    operator = OperatorProcess(
        control_plane.kubeconfig, tmp_path / "operator.log", FRACTUS_METRICS_PORT=str(port), FRACTUS_LEASE="2"
    )

    def told() -> dict[tuple[str, ...], float]:
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=5) as answer:
                text = answer.read().decode()
        except OSError:
            return {}
        families = text_string_to_metric_families(text)
        return {(s.name, *s.labels.values()): s.value for family in families for s in family.samples}

    operator.start()
    try:
        world.put(traffic(namespace))
        world.phase(namespace, "Deploying")
        seen = wait_for(lambda: (found := told()).get(("fractus_applications", "Deploying")) and found, operator.log)
        assert seen["fractus_operator_lease_left_seconds",] > 0
        assert seen["fractus_operator_watch_open", "drones"] == 1
        assert 0 <= seen["fractus_operator_watch_age_seconds", "pods"] < 300
        assert seen["fractus_operator_reconcile_seconds_count", "application"] > 0
        assert seen["fractus_operator_plan_phase_seconds_count", "plan"] > 0
        assert seen["fractus_drones", "inactive"] == 1
    finally:
        operator.stop()


def test_the_chart_makes_a_pod_monitor_where_it_is_asked_to() -> None:
    assert not [body for body in render() if body["kind"] == "PodMonitor"]
    arguments = ("--set", "metrics.podMonitor.enabled=true", "--set", "metrics.podMonitor.labels.release=kube")
    rendered = render(*arguments)
    (monitor,) = [body for body in rendered if body["kind"] == "PodMonitor"]
    (operator,) = [body for body in rendered if body["kind"] == "Deployment"]
    pods = operator["spec"]["template"]
    assert monitor["metadata"]["labels"]["release"] == "kube"
    assert monitor["spec"]["selector"]["matchLabels"].items() <= pods["metadata"]["labels"].items()
    (endpoint,) = monitor["spec"]["podMetricsEndpoints"]
    assert endpoint["port"] in {p["name"] for p in pods["spec"]["containers"][0]["ports"]}
