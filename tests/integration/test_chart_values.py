"""Values of an older release, kept by `helm upgrade --reuse-values`: they lack the values that a newer chart adds."""

from __future__ import annotations

from functools import cache
from typing import Any

import pytest
from chart import render, values_of

VALUES = tuple(values_of("fractus"))
EVERYTHING = [
    f"--set={part}.enabled=true" for part in ("view", "metrics.podMonitor", "metrics.rules", "metrics.dashboard")
]


@cache
def plain() -> list[dict[str, Any]]:
    return render()


def without(*names: str) -> list[str]:
    return [f"--set={name}=null" for name in names]


@pytest.mark.parametrize("name", [name for name, value in VALUES if value and isinstance(value, dict)])
def test_chart_uses_defaults_for_missing_section(name: str) -> None:
    assert render(*without(name)) == plain()


def test_chart_uses_defaults_for_missing_values() -> None:
    missing = [
        name for name, value in VALUES if not (value and isinstance(value, dict)) and not name.endswith(".enabled")
    ]
    assert len(missing) > 30
    assert render(*EVERYTHING, *without(*missing)) == render(*EVERYTHING)


def test_chart_keeps_values_of_older_release() -> None:
    values = ["--set=operator.replicas=1", "--set=rbac.aggregate=false", "--set=host.state=/data"]
    kept = render(*values, *without("metrics", "operator.resources", "host.config"))
    assert kept == render(*values)
    assert kept != render()


def test_chart_omits_limit_set_to_null() -> None:
    agent = next(
        b
        for b in render("--set=agent.resources.limits=null")
        if b["metadata"]["name"] == "fractus-agent" and b["kind"] == "DaemonSet"
    )
    assert set(agent["spec"]["template"]["spec"]["containers"][0]["resources"]) == {"requests"}


def test_chart_adds_environment_variables_to_service() -> None:
    values = [
        "--set=mobility.extraEnv[0].name=OTEL_EXPORTER_OTLP_ENDPOINT",
        "--set=mobility.extraEnv[0].value=http://c:4317",
    ]
    bodies = {b["metadata"]["name"]: b for b in render(*values) if b["kind"] == "DaemonSet"}
    variables = {
        name: bodies[name]["spec"]["template"]["spec"]["containers"][0]["env"]
        for name in ("fractus-mobility", "fractus-camera")
    }
    added = {"name": "OTEL_EXPORTER_OTLP_ENDPOINT", "value": "http://c:4317"}
    assert variables["fractus-mobility"][-1] == added
    assert added not in variables["fractus-camera"]
    assert "FRACTUS_NODE" in {one["name"] for one in variables["fractus-mobility"]}


def test_chart_quotes_names_and_paths() -> None:
    values = ["--set-string=priorityClass.name=123", "--set=host.config=/etc/a: b}", "--set=logLevel=INFO"]
    bodies = {(body["kind"], body["metadata"]["name"]): body for body in render(*values)}
    assert ("PriorityClass", "123") in bodies
    agent = bodies["DaemonSet", "fractus-agent"]["spec"]["template"]["spec"]
    assert agent["priorityClassName"] == "123"
    paths = {volume["name"]: volume["hostPath"]["path"] for volume in agent["volumes"] if "hostPath" in volume}
    assert paths["config"] == "/etc/a: b}"
