"""Alert rules, evaluated by promtool: each alert fires in its case, and no alert fires during normal operation."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml
from chart import CHARTS, render
from scraping import DOCS, documented

FILES = CHARTS / "fractus" / "files"
RULES: list[dict[str, Any]] = yaml.safe_load((FILES / "alerts.yaml").read_text())["groups"][0]["rules"]
CACHE = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "fractus" / "promtool"
ON = 'job="fractus-system/fractus-mobility", node="drone-1", pod="m", instance="10.0.0.1:46813"'
"""Labels that Prometheus adds to every sample of the mobility service."""


def of(name: str, labels: str = "", values: str = "0x30") -> tuple[str, str]:
    """Return the name of a series with its labels, and its values in promtool's notation, one per 15 s."""
    return f"{name}{{{ON}{', ' if labels else ''}{labels}}}", values


FLYING = of("fractus_in_air", "", "1x30")
KNOWN = of("fractus_audit_sequence", "", "7x60")
"""Series that shows that Prometheus has scraped the service for 15 minutes."""


@dataclass(frozen=True)
class Case:
    """A case in which an alert must fire.

    Attributes:
        series: Scraped series.
        at: Time from the beginning of the series by which the alert has fired, in promtool's notation.
        well: Similar series with which the alert must not fire.
    """

    series: tuple[tuple[str, str], ...]
    at: str
    well: tuple[tuple[str, str], ...] = ()


HEALTHY = (
    ('up{job="fractus-system/fractus-agent", node="n"}', "1x60"),
    of("fractus_operator_lease_left_seconds", "", "9x60"),
    of("fractus_operator_watch_age_seconds", 'kind="drones"', "60x60"),
    of("fractus_operator_reconcile_errors_total", 'kind="application", reason="Conflict"', "3x60"),
    of("fractus_drones", 'state="flying"', "3x60"),
    of("fractus_drones", 'state="unknown"', "0x60"),
    of("fractus_agent_report_age_seconds", "", "30x60"),
    of("fractus_agent_watch_age_seconds", 'kind="grants"', "60x60"),
    of("fractus_agent_grants", 'state="stored"', "4x60"),
    of("fractus_agent_grants", 'state="unverified"', "0x60"),
    of("fractus_in_air", "", "1x60"),
    of("fractus_autopilot_heartbeat_age_seconds", "", "1x60"),
    of("fractus_telemetry_age_seconds", "", "0.05x60"),
    of("fractus_failsafes_verified", "", "1x60"),
    of("fractus_companion_alive", "", "1x60"),
    of("fractus_takeovers_total", 'controller="system", code="Old"', "2x60"),
    of("fractus_monitor_interventions_total", 'action="deny", code="Old"', "2x60"),
    of("fractus_verdicts_total", 'action="deny", code="NoGrant"', "0+3x60"),
    of("fractus_verdicts_total", 'action="allow", code="Allowed"', "0+900x60"),
    of("fractus_audit_failing", "", "0x60"),
    of("fractus_audit_sequence", "", "10+5x60"),
    of("fractus_recording_failing", "", "0x60"),
    of("fractus_certificate_expiry_timestamp_seconds", "", "864000x60"),
    of("fractus_switches_total", "", "0+0.2x60"),
    of("fractus_battery_ratio", "", "0.7x60"),
)

CASES = {
    "FractusWorkloadDown": Case((('up{job="fractus-system/fractus-agent", node="n"}', "0x30"),), "6m"),
    "FractusNoLeader": Case((of("fractus_operator_lease_left_seconds", "", "9x4 0x30"),), "3m"),
    "FractusOperatorWatchSilent": Case((of("fractus_operator_watch_age_seconds", 'kind="drones"', "100+15x30"),), "3m"),
    "FractusReconcileFails": Case(
        (of("fractus_operator_reconcile_errors_total", 'kind="application", reason="Forbidden"', "0+1x60"),), "12m"
    ),
    "FractusDroneLost": Case((of("fractus_drones", 'state="unknown"', "1x30"),), "6m"),
    "FractusAgentCutOff": Case((of("fractus_agent_report_age_seconds", "", "200+15x30"),), "4m"),
    "FractusNodeWatchSilent": Case((of("fractus_agent_watch_age_seconds", 'kind="grants"', "100+15x40"),), "6m"),
    "FractusGrantNotInForce": Case((of("fractus_agent_grants", 'state="unstored"', "1x30"),), "6m"),
    "FractusAutopilotSilent": Case(
        (FLYING, of("fractus_autopilot_heartbeat_age_seconds", "", "1 16+15x30")),
        "1m",
        (of("fractus_in_air"), of("fractus_autopilot_heartbeat_age_seconds", "", "1 16+15x30")),
    ),
    "FractusPositionStale": Case(
        (FLYING, of("fractus_telemetry_age_seconds", "", "0.1 15+15x30")),
        "1m",
        (of("fractus_in_air"), of("fractus_telemetry_age_seconds", "", "1e9x30")),
    ),
    "FractusFailsafesUnverified": Case(
        (FLYING, of("fractus_failsafes_verified")), "1m", (of("fractus_in_air"), of("fractus_failsafes_verified"))
    ),
    "FractusNoOneResponsible": Case(
        (FLYING, of("fractus_companion_alive")), "1m", (of("fractus_in_air"), of("fractus_companion_alive"))
    ),
    "FractusTakeover": Case(
        (of("fractus_takeovers_total", 'controller="system", code="DriverLost"', "_x30 1x30"), KNOWN),
        "9m",
        (of("fractus_takeovers_total", 'controller="pilot", code="PilotTookOver"', "_x30 1x30"), KNOWN),
    ),
    "FractusMonitorIntervened": Case(
        (of("fractus_monitor_interventions_total", 'action="deny", code="InsideExclusionZone"', "1x40 2x10"),), "12m"
    ),
    "FractusManyDenials": Case((of("fractus_verdicts_total", 'action="deny", code="NoGrant"', "0+60x60"),), "11m"),
    "FractusAuditFailing": Case((of("fractus_audit_failing", "", "1x30"),), "2m"),
    "FractusAuditWentBack": Case((of("fractus_audit_sequence", "", "100+5x20 3+5x20"),), "7m"),
    "FractusRecordingFailing": Case((of("fractus_recording_failing", "", "1x30"),), "3m"),
    "FractusCertificateExpires": Case(
        (of("fractus_certificate_expiry_timestamp_seconds", "", "600000x60"),), "12m",
        (of("fractus_certificate_expiry_timestamp_seconds", "", "1e9x60"),),
    ),
    "FractusLinkFlaps": Case((of("fractus_switches_total", "", "0+2x60"),), "11m"),
    "FractusBatteryLow": Case(
        (FLYING, of("fractus_battery_ratio", "", "0.15x30")), "1m", (FLYING, of("fractus_battery_ratio", "", "stale"))
    ),
}  # fmt: skip


@pytest.fixture(scope="session")
def promtool() -> str:
    """Return the path of promtool. Unpack it from Debian's package, because installing the package starts a server."""
    program = shutil.which("promtool") or str(CACHE / "usr/bin/promtool")
    if not Path(program).exists():
        CACHE.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=CACHE.parent) as unpacked:
            for argv in (["apt-get", "download", "-q", "prometheus"], ["sh", "-c", "dpkg -x prometheus_*.deb root"]):
                subprocess.run(argv, cwd=unpacked, check=True, timeout=240, stdout=subprocess.DEVNULL)
            with contextlib.suppress(OSError):  # another test worker has unpacked the package
                (Path(unpacked) / "root").rename(CACHE)
    return program


def judge(promtool: str, directory: Path, tests: list[dict[str, Any]]) -> str:
    """Return the output of promtool for tests of the rules, or an empty string if they pass."""
    # Remove annotations, because expected alerts would have to repeat them.
    bare = [{key: value for key, value in rule.items() if key != "annotations"} for rule in RULES]
    (directory / "rules.yaml").write_text(yaml.safe_dump({"groups": [{"name": "fractus", "rules": bare}]}))
    test_file = {"rule_files": ["rules.yaml"], "evaluation_interval": "15s", "tests": tests}
    (directory / "tests.yaml").write_text(yaml.safe_dump(test_file))
    argv = [promtool, "test", "rules", "tests.yaml"]
    result = subprocess.run(argv, cwd=directory, capture_output=True, text=True, timeout=120, check=False)
    return "" if result.returncode == 0 else result.stdout + result.stderr


def series(rows: tuple[tuple[str, str], ...]) -> list[dict[str, str]]:
    return [{"series": name, "values": values} for name, values in rows]


def silent(alert: str, at: str) -> dict[str, Any]:
    return {"alertname": alert, "eval_time": at, "exp_alerts": []}


def rule_test(rows: tuple[tuple[str, str], ...], *checks: dict[str, Any]) -> dict[str, Any]:
    return {"interval": "15s", "input_series": series(rows), "alert_rule_test": list(checks)}


def test_alerts_have_a_case_and_a_section_in_the_docs() -> None:
    names = [rule["alert"] for rule in RULES]
    assert sorted(names) == sorted(CASES)
    page = (DOCS / "alerts.md").read_text()
    assert re.findall(r"^## (\w+)$", page, re.MULTILINE) == names
    for rule in RULES:
        assert rule["annotations"]["runbook"] == f"docs/alerts.md#{rule['alert'].lower()}"
        assert rule["labels"]["severity"] in {"critical", "warning", "info"}


def test_alerts_fire_in_their_cases(promtool: str, tmp_path: Path) -> None:
    # An expected alert would have to list all its labels. Instead, expect no alerts, so that promtool reports each one.
    output = judge(
        promtool, tmp_path, [rule_test(case.series, silent(alert, case.at)) for alert, case in CASES.items()]
    )
    assert set(re.findall(r"alertname:\s*(\w+)", output)) == set(CASES), output


def test_alerts_do_not_fire_in_normal_operation(promtool: str, tmp_path: Path) -> None:
    healthy = rule_test(HEALTHY, *(silent(alert, at) for alert in CASES for at in ("1m", "10m", "14m")))
    well = [rule_test(case.well, silent(alert, case.at)) for alert, case in CASES.items() if case.well]
    assert judge(promtool, tmp_path, [healthy, *well]) == ""


def test_alert_rules_are_accepted_by_promtool(promtool: str, tmp_path: Path) -> None:
    (rule,) = [body for body in render("--set", "metrics.rules.enabled=true") if body["kind"] == "PrometheusRule"]
    installed = tmp_path / "rules.yaml"
    installed.write_text(yaml.safe_dump(rule["spec"]))
    subprocess.run([promtool, "check", "rules", str(installed)], check=True, timeout=60)
    assert rule["spec"] == yaml.safe_load((FILES / "alerts.yaml").read_text())


def test_alerts_and_dashboard_use_existing_metrics() -> None:
    known = set(documented())
    (config_map,) = [body for body in render("--set", "metrics.dashboard.enabled=true") if body["kind"] == "ConfigMap"]
    assert config_map["metadata"]["labels"]["grafana_dashboard"] == "1"
    dashboard = json.loads(config_map["data"]["fractus.json"])
    panels = [target["expr"] for panel in dashboard["panels"] for target in panel.get("targets", ())]
    assert len(panels) > 10
    for expression in [*panels, *(rule["expr"] for rule in RULES)]:
        for name in re.findall(r"\bfractus_\w+", expression):
            assert re.sub(r"_(bucket|sum|count)$", "", name) in known, expression
