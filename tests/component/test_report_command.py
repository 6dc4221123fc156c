"""`fractus report` from files: the report of an Application's last flight."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import demo_flight
import pytest
import yaml
from click.testing import CliRunner
from fractus_sim.report.flight_record import last_mission
from fractus_sim.report_command import report


def grant(seconds: float, change: str = "added", uid: str = "m1", identity: str = demo_flight.DRIVER) -> dict[str, Any]:
    return {
        "kind": "grant", "change": change, "identity": identity, "key": f"{identity}#{uid}",
        "time": demo_flight.stamp(demo_flight.APPLIED_S + seconds),
    }  # fmt: skip


def control(seconds: float, action: str, controller: str = demo_flight.DRIVER) -> dict[str, Any]:
    time = demo_flight.stamp(demo_flight.APPLIED_S + seconds)
    return {"kind": "control", "action": action, "controller": controller, "time": time}


OTHER = demo_flight.DRIVER.replace("traffic-monitoring", "other")


@pytest.mark.parametrize(
    ("entries", "begin", "end"),
    [
        ([grant(0), control(5, "granted"), control(90, "landed", "system")], 0, 93),
        ([grant(0), control(5, "granted")], 0, math.inf),
        ([grant(0), control(5, "granted"), grant(20), control(90, "landed", "system")], 0, 93),
        ([grant(0), control(5, "granted"), control(90, "landed", "system"), grant(95, "removed")], 0, 98),
        ([grant(0), control(5, "granted"), control(90, "landed", "system"), grant(200, uid="m2"), control(205, "granted")], 200, math.inf),
        ([grant(0), control(5, "granted"), control(60, "granted", OTHER), control(90, "landed", "system")], 0, 60),
        ([grant(0, identity=OTHER)], None, None),
        ([], None, None),
    ],
)  # fmt: skip
def test_last_mission_lasts_from_its_grants_to_its_landing(
    entries: list[dict[str, Any]], begin: float | None, end: float | None
) -> None:
    window = last_mission(entries, "default", "traffic-monitoring")
    if begin is None or end is None:
        assert window is None
    else:
        assert window is not None
        assert (window.begin_s - demo_flight.APPLIED_S, window.end_s - demo_flight.APPLIED_S) == (begin, end)


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    """Manifests of the example, and the audit log of its flight."""
    manifests = tmp_path / "manifests.yaml"
    manifests.write_text(
        yaml.safe_dump_all([body for body in demo_flight.objects() if body["kind"] != "DeploymentPlan"])
    )
    audit = tmp_path / "audit"
    audit.mkdir()
    lines = [grant(0), *demo_flight.audit(), control(400, "landed", "system")]
    (audit / "mobility.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return manifests, audit


def run(*arguments: str | Path) -> tuple[int, str]:
    result = CliRunner().invoke(report, [str(argument) for argument in arguments])
    return result.exit_code, result.output


def test_report_is_written_from_manifests_and_audit_log(files: tuple[Path, Path], tmp_path: Path) -> None:
    manifests, audit = files
    out = tmp_path / "report"
    code, output = run("traffic-monitoring", "-f", manifests, "--audit", audit, "--out", out)
    assert code == 0, output
    page = (out / "summary.md").read_text()
    assert page.startswith("# Flight of traffic-monitoring")
    assert "no-fly-hospital" in page
    assert {"report.html", "map.png", "altitude.png", "flight.geojson", "report.json"} <= {
        path.name for path in out.iterdir()
    }


def test_report_replaces_only_an_earlier_report(files: tuple[Path, Path], tmp_path: Path) -> None:
    manifests, audit = files
    arguments: list[str | Path] = ["traffic-monitoring", "-f", manifests, "--audit", audit, "--out"]
    before = (audit / "mobility.jsonl").read_bytes()
    code, output = run(*arguments, tmp_path)
    assert code == 1
    assert "contains other files than an earlier report" in output
    (tmp_path / "objects.json").write_text("{}")
    code, output = run(*arguments, tmp_path)
    assert code == 1
    assert "--audit is inside" in output
    assert (audit / "mobility.jsonl").read_bytes() == before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["traffic", "-f", "MANIFESTS", "--audit", "AUDIT"], "no manifest of --filename contains the Application traffic"),
        (["traffic-monitoring", "--audit", "AUDIT"], "--audit also needs the manifest of the Application"),
        (["traffic-monitoring", "-n", "other", "-f", "MANIFESTS", "--audit", "AUDIT"], "no mission of other/traffic-monitoring"),
        (["traffic-monitoring", "-f", "AUDIT/mobility.jsonl", "--audit", "AUDIT"], "is not YAML"),
    ],
)  # fmt: skip
def test_report_names_missing_input(
    arguments: list[str], message: str, files: tuple[Path, Path], tmp_path: Path
) -> None:
    manifests, audit = files
    arguments = [a.replace("MANIFESTS", str(manifests)).replace("AUDIT", str(audit)) for a in arguments]
    code, output = run(*arguments, "--out", tmp_path / "report")
    assert code != 0
    assert message in output
