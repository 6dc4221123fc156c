"""Management API as a workload of the chart: objects, command and permissions."""

from __future__ import annotations

import subprocess
from typing import Any

import chart as fractus_chart
import pytest
from click.testing import CliRunner
from fractus_management import command

Body = dict[str, Any]

ENABLED = "--set=management.enabled=true"


def management_objects(*arguments: str) -> dict[str, Body]:
    """Return the objects of the management API that the chart renders, by kind."""
    label = "app.kubernetes.io/component"
    bodies = fractus_chart.render(*arguments)
    return {body["kind"]: body for body in bodies if body["metadata"].get("labels", {}).get(label) == "management"}


def pod() -> Body:
    spec: Body = management_objects(ENABLED)["Deployment"]["spec"]["template"]["spec"]
    return spec


def test_management_is_rendered_only_if_enabled() -> None:
    assert management_objects() == {}
    assert set(management_objects(ENABLED)) == {
        "ServiceAccount", "Deployment", "Service", "PodDisruptionBudget", "NetworkPolicy",
    }  # fmt: skip


def test_management_has_no_permissions_and_no_token() -> None:
    account = management_objects(ENABLED)["ServiceAccount"]
    assert account["automountServiceAccountToken"] is False
    bindings = [body for body in fractus_chart.render(ENABLED) if body["kind"].endswith("RoleBinding")]
    subjects = [subject["name"] for binding in bindings for subject in binding["subjects"]]
    assert account["metadata"]["name"] not in subjects
    assert pod()["automountServiceAccountToken"] is False
    assert [volume["configMap"]["name"] for volume in pod()["volumes"]] == ["kube-root-ca.crt", "fractus-ca"]


def test_management_runs_without_privileges() -> None:
    (container,) = pod()["containers"]
    assert pod()["securityContext"]["runAsNonRoot"] is True
    assert container["securityContext"] == {
        "allowPrivilegeEscalation": False, "readOnlyRootFilesystem": True, "capabilities": {"drop": ["ALL"]},
    }  # fmt: skip


def test_management_arguments_are_options_of_the_command(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    (container,) = pod()["containers"]
    arguments = container["args"]
    for mount in container["volumeMounts"]:
        arguments = [each.replace(mount["mountPath"], str(tmp_path / mount["name"])) for each in arguments]
        (tmp_path / mount["name"]).mkdir()
        (tmp_path / mount["name"] / "ca.crt").write_text("")
    served: list[Any] = []

    async def serve(*received: Any) -> None:
        received[2].close()
        served.extend(received)

    monkeypatch.setattr(command, "_serve", serve)
    result = CliRunner().invoke(command.api, arguments)
    assert result.exit_code == 0, result.output
    listen, settings, _access, metrics = served
    ports = {port["name"]: port["containerPort"] for port in container["ports"]}
    assert (listen, metrics) == (("0.0.0.0", ports["http"]), f":{ports['metrics']}")
    assert (settings.namespace, settings.requests_per_s) == ("default", 20)
    assert settings.node_ca == tmp_path / "nodes" / "ca.crt"


def agent_environment(*arguments: str) -> dict[str, str]:
    """Return the variables of the agent that the chart renders."""
    (agent,) = [
        body
        for body in fractus_chart.render(*arguments)
        if (body["kind"], body["metadata"]["name"]) == ("DaemonSet", "fractus-agent")
    ]
    (container,) = agent["spec"]["template"]["spec"]["containers"]
    return {variable["name"]: variable.get("value", "") for variable in container["env"]}


def test_agents_serve_records_for_the_management_api_only() -> None:
    assert "FRACTUS_RECORDS" not in agent_environment()
    assert agent_environment(ENABLED)["FRACTUS_RECORDS"] == "$(FRACTUS_NODE_ADDRESS):46816"
    assert "FRACTUS_RECORDS" not in agent_environment(ENABLED, "--set=management.records.enabled=false")
    (container,) = management_objects(ENABLED, "--set=management.records.enabled=false")["Deployment"]["spec"][
        "template"
    ]["spec"]["containers"]
    assert not any(argument.startswith("--node-ca") for argument in container["args"])


def test_network_policy_limits_senders_of_requests_and_not_of_metrics() -> None:
    requests, metrics = management_objects(ENABLED)["NetworkPolicy"]["spec"]["ingress"]
    assert "from" not in requests
    sender = "--set=management.from[0].podSelector.matchLabels.app=proxy"
    requests, metrics = management_objects(ENABLED, sender)["NetworkPolicy"]["spec"]["ingress"]
    assert requests["from"] == [{"podSelector": {"matchLabels": {"app": "proxy"}}}]
    assert metrics == {"ports": [{"port": "metrics", "protocol": "TCP"}]}
    (served,) = management_objects(ENABLED)["Service"]["spec"]["ports"]
    assert served["targetPort"] == "http", "the Service exposes the metrics port, which needs no token"


INGRESS = (ENABLED, "--set=management.ingress.enabled=true")


def test_ingress_serves_the_api_with_tls() -> None:
    settings = ("--set=management.ingress.host=fly.example.org", "--set=management.ingress.tlsSecret=fly")
    ingress = management_objects(*INGRESS, *settings)["Ingress"]["spec"]
    assert ingress["tls"] == [{"hosts": ["fly.example.org"], "secretName": "fly"}]
    (rule,) = ingress["rules"]
    (path,) = rule["http"]["paths"]
    assert (rule["host"], path["path"]) == ("fly.example.org", "/")
    (port,) = management_objects(ENABLED)["Service"]["spec"]["ports"]
    assert path["backend"]["service"] == {"name": "fractus-management", "port": {"name": port["name"]}}


@pytest.mark.parametrize("given", ["host", "tlsSecret"])
def test_ingress_needs_host_and_certificate(given: str) -> None:
    with pytest.raises(subprocess.CalledProcessError) as refused:
        management_objects(*INGRESS, f"--set=management.ingress.{given}=x")
    missing = "tlsSecret" if given == "host" else "host"
    assert f"management.ingress.{missing}: give the name" in refused.value.stderr


def test_management_has_pod_monitor_if_enabled() -> None:
    (endpoint,) = management_objects(ENABLED, "--set=metrics.podMonitor.enabled=true")["PodMonitor"]["spec"][
        "podMetricsEndpoints"
    ]
    assert endpoint["port"] == "metrics"
