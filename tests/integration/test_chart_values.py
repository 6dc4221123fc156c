"""Values of an older release, kept by `helm upgrade --reuse-values`: neither they nor their defaults have what a newer chart adds."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import yaml
from chart import CHARTS, render

VALUES: dict[str, Any] = yaml.safe_load((CHARTS / "fractus" / "values.yaml").read_text())
EVERYTHING = [
    f"--set={part}.enabled=true" for part in ("view", "metrics.podMonitor", "metrics.rules", "metrics.dashboard")
]


def keys(values: dict[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Values with their names, but for limits and labels, where one that is missing is meant to be."""
    for key, value in values.items():
        yield f"{above}{key}", value
        if isinstance(value, dict) and key not in {"resources", "labels"}:
            yield from keys(value, f"{above}{key}.")


def without(*names: str) -> list[str]:
    return [f"--set={name}=null" for name in names]


@pytest.mark.parametrize("name", [name for name, value in keys(VALUES) if isinstance(value, dict)])
def test_a_missing_part_has_its_defaults(name: str) -> None:
    assert render(*without(name)) == render()


def test_missing_values_have_their_defaults() -> None:
    missing = [name for name, value in keys(VALUES) if not isinstance(value, dict) and not name.endswith(".enabled")]
    assert len(missing) > 30
    assert render(*EVERYTHING, *without(*missing)) == render(*EVERYTHING)


def test_what_a_release_has_said_stays() -> None:
    said = ["--set=operator.replicas=1", "--set=rbac.aggregate=false", "--set=host.state=/data"]
    kept = render(*said, *without("metrics", "operator.resources", "host.config"))
    assert kept == render(*said)
    assert kept != render()


def test_a_limit_that_is_left_out_stays_out() -> None:
    agent = next(
        b
        for b in render("--set=agent.resources.limits=null")
        if b["metadata"]["name"] == "fractus-agent" and b["kind"] == "DaemonSet"
    )
    assert set(agent["spec"]["template"]["spec"]["containers"][0]["resources"]) == {"requests"}


def test_services_get_further_variables() -> None:
    said = [
        "--set=mobility.extraEnv[0].name=OTEL_EXPORTER_OTLP_ENDPOINT",
        "--set=mobility.extraEnv[0].value=http://c:4317",
    ]
    bodies = {b["metadata"]["name"]: b for b in render(*said) if b["kind"] == "DaemonSet"}
    variables = {
        name: bodies[name]["spec"]["template"]["spec"]["containers"][0]["env"]
        for name in ("fractus-mobility", "fractus-camera")
    }
    added = {"name": "OTEL_EXPORTER_OTLP_ENDPOINT", "value": "http://c:4317"}
    assert variables["fractus-mobility"][-1] == added
    assert added not in variables["fractus-camera"]
    assert "FRACTUS_NODE" in {one["name"] for one in variables["fractus-mobility"]}
