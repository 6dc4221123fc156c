"""Gathers what a mission left on the cluster: objects, events, and the audit log from the drone."""

from __future__ import annotations

import json
import re
from datetime import datetime
from pathlib import Path
from typing import Any

from fractus_services.chain import Finding, verify

from fractus_sim.demo.kube import NAMESPACE, SYSTEM, DemoError, Kube, Object
from fractus_sim.demo.watch import Mission
from fractus_sim.report.record import AUDIT, CAMERA_AUDIT, OBJECTS

LOGS = {AUDIT: "/var/lib/fractus/audit/mobility.jsonl", CAMERA_AUDIT: "/var/lib/fractus/audit/camera.jsonl"}
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
    audit = _audit(kube, mission, folder)
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


def _audit(kube: Kube, mission: Mission, folder: Path) -> dict[str, Any]:
    """Fetch the drone's logs, check their chains, and keep what is of this mission."""
    found: dict[str, Any] = {"entries": 0, "kept": 0, "problem": ""}
    if not mission.drone:
        return {}
    try:
        pod = _mobility_pod(kube, mission.drone)
        for name, path in LOGS.items():
            command = f"cat {path} 2>/dev/null || test ! -e {path}"
            text = kube.run("exec", "-n", SYSTEM, pod, "--", "sh", "-c", command, timeout_s=120.0)
            lines = text.encode().splitlines(keepends=True)
            kept = [line for line in lines if line.endswith(b"\n") and of_mission(line, mission.times["applied"])]
            (folder / name).write_bytes(b"".join(kept))
            finding = verify(lines)
            found["entries"] += finding.entries
            found["kept"] += len(kept)
            found["problem"] = found["problem"] or _problem(path, finding)
    except DemoError as error:
        found["problem"] = f"it could not be fetched: {error}"
    return found


def of_mission(line: bytes, applied_s: float) -> bool:
    """Whether an entry was written after the application was applied."""
    try:
        return datetime.fromisoformat(json.loads(line)["time"]).timestamp() >= applied_s
    except (ValueError, KeyError, TypeError):
        return False


def _problem(path: str, finding: Finding) -> str:
    return f"line {finding.line} of {path} {finding.problem}" if finding.problem else ""


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
