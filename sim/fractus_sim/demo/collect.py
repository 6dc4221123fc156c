"""Gathers what a mission left on the cluster: objects, events, and the audit log from the drone."""

from __future__ import annotations

import json
import re
from datetime import datetime
from pathlib import Path
from typing import Any

from fractus_services.audit import Finding, verify

from fractus_sim.demo.kube import NAMESPACE, SYSTEM, DemoError, Kube, Object
from fractus_sim.demo.report.record import AUDIT, OBJECTS
from fractus_sim.demo.watch import Mission

AUDIT_PATH = "/var/lib/fractus/audit/mobility.jsonl"
_KINDS = "applications,deploymentplans,depots,drones,edgenodes,policies,zones"
_KEPT = re.compile(rb"\[pod/[^/]+/data-store\] .* kept ")


def collect(kube: Kube, mission: Mission, folder: Path, logs: Path) -> None:
    """Write objects.json, audit.jsonl and events.json into a folder.

    Raises:
        DemoError: the API server does not answer.
    """
    objects = [body for body in kube.objects(_KINDS) if _concerns(body, mission.application)]
    events = [
        event for event in kube.objects("events") if mission.application in event["involvedObject"].get("name", "")
    ]
    audit = _audit(kube, mission, folder / AUDIT)
    content = {
        "objects": objects,
        "pods": list(mission.pods.values()),
        "times": mission.times,
        "audit": audit,
        "results": len(_KEPT.findall(logs.read_bytes())) if logs.exists() else 0,
    }
    (folder / OBJECTS).write_text(json.dumps(content, indent=1) + "\n")
    (folder / "events.json").write_text(json.dumps([_event(e) for e in events], indent=1) + "\n")


def _concerns(body: Object, application: str) -> bool:
    own = body["kind"] not in {"Application", "DeploymentPlan"}
    return own or (body["metadata"]["name"] == application and body["metadata"].get("namespace") == NAMESPACE)


def _audit(kube: Kube, mission: Mission, path: Path) -> dict[str, Any]:
    """Fetch the drone's log, check its chain, and keep what is of this mission."""
    path.write_bytes(b"")
    if not mission.drone:
        return {}
    try:
        text = kube.run(
            "exec", "-n", SYSTEM, _mobility_pod(kube, mission.drone), "--", "cat", AUDIT_PATH, timeout_s=120.0
        )
    except DemoError as error:
        return {"entries": 0, "kept": 0, "problem": f"it could not be fetched: {error}"}
    lines = text.encode().splitlines(keepends=True)
    finding = verify(lines)
    kept = [line for line in lines if line.endswith(b"\n") and of_mission(line, mission.times["applied"])]
    path.write_bytes(b"".join(kept))
    return {"entries": finding.entries, "kept": len(kept), "problem": _problem(finding)}


def of_mission(line: bytes, applied_s: float) -> bool:
    """Whether an entry was written after the application was applied."""
    try:
        return datetime.fromisoformat(json.loads(line)["time"]).timestamp() >= applied_s
    except (ValueError, KeyError, TypeError):
        return False


def _problem(finding: Finding) -> str:
    return f"line {finding.line} {finding.problem}" if finding.problem else ""


def _mobility_pod(kube: Kube, node: str) -> str:
    text = kube.run(
        "get", "pods", "-n", SYSTEM, "--field-selector", f"spec.nodeName={node},status.phase=Running", "-o",
        "jsonpath={range .items[*]}{.metadata.name}{\"\\n\"}{end}",
    )  # fmt: skip
    for name in text.split():
        if name.startswith("fractus-mobility"):
            return name
    raise DemoError(f"no mobility service runs on {node}")


def _event(event: Object) -> dict[str, Any]:
    return {
        "time": event.get("lastTimestamp") or event.get("eventTime"),
        "object": f"{event['involvedObject']['kind']}/{event['involvedObject'].get('name', '')}",
        "reason": event.get("reason"),
        "message": event.get("message"),
        "count": event.get("count", 1),
    }
