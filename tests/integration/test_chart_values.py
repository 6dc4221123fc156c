"""Values of an older release, kept by `helm upgrade --reuse-values`: they lack the values that a newer chart adds."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator
from functools import cache
from typing import Any

import pytest
from chart import CHARTS, render, values_of

VALUES = tuple(values_of("fractus"))
SCHEMA = json.loads((CHARTS / "fractus" / "values.schema.json").read_text())
WIPE = ("--set=uninstall.wipeNodes=true", "--is-upgrade")
EVERYTHING = [
    f"--set={part}.enabled=true"
    for part in ("view", "management", "metrics.podMonitor", "metrics.rules", "metrics.dashboard")
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


FRACTIONS = {
    "operator.planning.safetyRadius": ("7.5", ("0.0", "-7.5", "7.5m", "0", "-1")),
    "operator.planning.depotRadius": ("0.5", ("0.00", "1e-3")),
    "operator.planning.coverageShare": ("0.85", ("1.5", "-0.1", "2")),
    "operator.planning.cruiseSpeed": ("5.25", ("fast", ".")),
    "operator.planning.climbSpeed": ("2.5", ("0.0", "two")),
    "operator.planning.batteryReserve": (".25", ("1.01", "20%")),
    "mobility.driverGrace": ("2.5", ("-2.5", "-1", "2.5s")),
    "directLinks.drainSeconds": ("2.5", ("600.5", "601", "-1.5", "1.5s")),
}
"""Values that may be fractions: a valid one, and invalid ones. `helm --set` passes fractions as strings."""


@pytest.mark.parametrize("name", FRACTIONS)
def test_chart_accepts_fraction_of_set_and_refuses_value_out_of_range(name: str) -> None:
    enabled = ("--set=directLinks.enabled=true",)
    valid, invalid = FRACTIONS[name]
    rendered = render(*enabled, f"--set={name}={valid}")
    assert rendered == render(*enabled, f"--set-json={name}={float(valid)}") or valid.startswith(".")
    assert rendered != render(*enabled)
    for value in invalid:
        with pytest.raises(subprocess.CalledProcessError) as refused:
            render(*enabled, f"--set={name}={value}")
        assert f"/{name.replace('.', '/')}" in refused.value.stderr


def test_every_fraction_of_values_schema_is_tested() -> None:
    def fractions(schema: Any, name: str) -> Iterator[str]:
        target = schema.get("$ref", "").rpartition("/")[2]
        found = SCHEMA["definitions"][target] if target else schema
        if "number" in found.get("type", ()):
            yield name.removeprefix(".")
        for key, inner in found.get("properties", {}).items():
            yield from fractions(inner, f"{name}.{key}")

    assert set(fractions(SCHEMA, "")) == set(FRACTIONS)


IMAGES = {
    "fractus": ("operator", "agent", "mobility", "camera", "view", "management"),
    "fractus-demo": ("sim", "example-traffic-monitoring", "operator"),
}


@pytest.mark.parametrize(("chart", "name"), [(chart, name) for chart, names in IMAGES.items() for name in names])
def test_image_is_selected_by_digest(chart: str, name: str) -> None:
    digest = "sha256:" + "0123456789abcdef" * 4
    options = (
        ("--set=view.enabled=true", "--set=management.enabled=true", *WIPE)
        if chart == "fractus"
        else ("--set=drone=drone-1",)
    )
    rendered = str(render(*options, f"--set=image.digests.{name}={digest}", chart=chart))
    assert f"localhost/fractus/{name}@{digest}" in rendered
    assert f"localhost/fractus/{name}:" not in rendered, "a workload ignores the digest"
    for bad in ("sha256:0", "latest"):
        with pytest.raises(subprocess.CalledProcessError) as refused:
            render(*options, f"--set=image.digests.{name}={bad}", chart=chart)
        assert "/image/digests" in refused.value.stderr


def test_digest_of_unknown_image_is_refused() -> None:
    with pytest.raises(subprocess.CalledProcessError) as refused:
        render(f"--set=image.digests.navigator=sha256:{'0' * 64}")
    assert "navigator" in refused.value.stderr


DRONE = "drone=drone-1"
WRONG_VALUES = [
    ("fractus", "operator.replica=3", "at '/operator': additional properties 'replica' not allowed"),
    ("fractus", "operator.replicas=two", "at '/operator/replicas': got string, want integer"),
    ("fractus", "image.repository=x", "at '/image': additional properties 'repository' not allowed"),
    ("fractus", "image.tag=a:b", "at '/image/tag': 'a:b' does not match"),
    ("fractus", "image.pullPolicy=Allways", "one of 'Always', 'IfNotPresent', 'Never'"),
    ("fractus", "logLevel=info", "one of 'DEBUG', 'INFO', 'WARNING', 'ERROR'"),
    ("fractus", "mobility.autopilot=127.0.0.1:5760", "at '/mobility/autopilot': '127.0.0.1:5760' does not match"),
    ("fractus", "mobility.autopilot=tcp:127.0.0.1", "at '/mobility/autopilot': 'tcp:127.0.0.1' does not match"),
    ("fractus", "mobility.autopilot=tcp:a:99999", "at '/mobility/autopilot': 'tcp:a:99999' does not match"),
    ("fractus", "mobility.extraArgs=--verbose", "at '/mobility/extraArgs': got string, want array"),
    ("fractus", "mobility.extraEnv[0].name=1A", "at '/mobility/extraEnv/0/name': '1A' does not match"),
    ("fractus", "agent.resources.limits.memory=128", "at '/agent/resources/limits/memory': minimum: got 128"),
    ("fractus", "agent.resources.limits.memory=128MB", "at '/agent/resources/limits/memory': '128MB' does not match"),
    ("fractus", "mobility.resources.requests.cpu=fast", "at '/mobility/resources/requests/cpu': 'fast' does not match"),
    ("fractus", "agent.resources.limit.cpu=1", "at '/agent/resources': additional properties 'limit' not allowed"),
    ("fractus", "camera.recordings.megabytes=1GB", "at '/camera/recordings/megabytes': got string, want integer"),
    ("fractus", "host.state=/", "at '/host/state': '/' does not match"),
    ("fractus", "admission.exemptNamespaces=kube-system", "at '/admission/exemptNamespaces': got string, want array"),
    ("fractus", "imagePullSecrets[0].name=regcred", "at '/imagePullSecrets/0': got object, want string"),
    ("fractus-crds", "kep=true", "additional properties 'kep' not allowed"),
    ("fractus-crds", "keep=yes", "at '/keep': got string, want boolean"),
    ("fractus-demo", "dron=drone-1", "additional properties 'dron' not allowed"),
    ("fractus-demo", "drone=Drone_1", "at '/drone': 'Drone_1' does not match"),
    ("fractus-demo", f"{DRONE},edgeNodes=edge-1", "at '/edgeNodes': got string, want array"),
    ("fractus-demo", f"{DRONE},edgeNodes={{edge-1,Edge_2}}", "at '/edgeNodes/1': 'Edge_2' does not match"),
    ("fractus-demo", f"{DRONE},edgeNodes={{drone-1}}", "edgeNodes: drone-1 is the drone of this release; specify other"),
    ("fractus-demo", f"{DRONE},vehicle.home=50.8\\,4.6", "at '/vehicle/home': '50.8,4.6' does not match"),
    ("fractus-demo", f"{DRONE},vehicle.home=95\\,4.6\\,10", "at '/vehicle/home': '95,4.6,10' does not match"),
]  # fmt: skip
"""A chart, wrong values, and a part of the answer of helm, which names the value."""


@pytest.mark.parametrize(("chart", "values", "answer"), WRONG_VALUES, ids=[values for _, values, _ in WRONG_VALUES])
def test_wrong_value_of_chart_is_refused_with_its_name(chart: str, values: str, answer: str) -> None:
    with pytest.raises(subprocess.CalledProcessError) as refused:
        render(f"--set={values}", chart=chart)
    assert answer in refused.value.stderr


@pytest.mark.parametrize("memory", ["128Mi", "1.5Gi", "134217728", "1e9", "1e+9", "+128Mi", "500M"])
def test_chart_accepts_quantities_of_memory(memory: str) -> None:
    assert render(f"--set-string=agent.resources.limits.memory={memory}")
    assert render(f"--set=agent.resources.limits.memory={memory}")
