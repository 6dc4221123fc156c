"""`fractus audit export` with the plan and the Zones of a cluster."""

from __future__ import annotations

import json
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from fractus_cli.audit import audit
from fractus_runtime.audit import AuditLog

SQUARE = [[4.67, 50.86], [4.69, 50.86], [4.69, 50.87], [4.67, 50.86]]
PLAN = {
    "apiVersion": "fractus.dev/v1alpha1",
    "kind": "DeploymentPlan",
    "metadata": {"name": "traffic", "namespace": "city"},
    "spec": {
        "application": "traffic",
        "operationArea": {"type": "MultiPolygon", "coordinates": [[SQUARE]]},
        "flown": {"outcome": "Complete", "landed": True, "landedAt": "2026-06-01T12:00:00Z"},
    },
}
ZONE = {
    "apiVersion": "fractus.dev/v1alpha1",
    "kind": "Zone",
    "metadata": {"name": "pool"},
    "spec": {"area": {"circle": {"center": {"lat": 50.86, "lon": 4.68}, "radius": 50}}},
}


class FakeCluster:
    """A cluster with the plan of a finished mission, and a zone. There are no Grants."""

    def get(self, path: str) -> Any:
        return PLAN if path.endswith("/namespaces/city/deploymentplans/traffic") else None

    def list(self, path: str) -> Any:
        return [ZONE] if path.endswith("/zones") else []


@pytest.fixture
async def log(tmp_path: Path) -> Path:
    path = tmp_path / "mobility.jsonl"
    writer = AuditLog(path, lambda: 1_780_000_000.0)
    writer.append("started", {"node": "drone-1"})
    await writer.close()
    return path


def test_export_reads_plan_and_zones_of_a_finished_mission(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fractus_cli.cluster_reader.open_cluster", lambda _config: nullcontext(FakeCluster()))

    def export(application: str) -> Any:
        return CliRunner().invoke(audit, ["export", str(log), "--to", "geojson", "--application", application])

    result = export("city/traffic")
    assert result.exit_code == 0, result.output
    kinds = {f["properties"]["kind"]: f for f in json.loads(result.stdout)["features"]}
    assert kinds["operationArea"]["geometry"]["coordinates"] == [SQUARE]
    assert kinds["zone"]["properties"]["name"] == "pool"
    missing = export("traffic")
    assert missing.exit_code == 1
    assert "--application traffic: there is no DeploymentPlan of this name" in missing.output
