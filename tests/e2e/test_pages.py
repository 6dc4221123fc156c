"""Logs and files of pods, read by the commands of docs/logs.md, docs/alerts.md and docs/backup.md."""

from __future__ import annotations

import json

import pytest
from conftest import DRONE, SYSTEM
from kubectl import Kube

pytestmark = pytest.mark.slow

AUDIT = "/var/lib/fractus/audit"


def test_documented_commands_show_logs_and_audit_logs(kube: Kube) -> None:
    pod = kube.pod("app.kubernetes.io/component=mobility", SYSTEM, node=DRONE)["metadata"]["name"]
    assert kube.must("-n", SYSTEM, "logs", "deploy/fractus-operator").strip()
    assert "fractus_services" in kube.must("-n", SYSTEM, "logs", pod)
    assert "mobility.jsonl" in kube.must("exec", "-n", SYSTEM, pod, "--", "ls", AUDIT).split()
    entries = kube.must("exec", "-n", SYSTEM, pod, "--", "cat", f"{AUDIT}/mobility.jsonl").splitlines()
    assert entries
    assert all(json.loads(entry) for entry in entries)
