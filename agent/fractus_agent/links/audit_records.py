"""Audit records of direct links: each decision that changes something, with its inputs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from fractus_core.linking import PathMetrics

from fractus_agent.links.decisions import LinkActions, LinkSituation

AuditRecorder = Callable[[str, dict[str, Any]], None]
"""Writes an audit record: kind and content."""


def decision_records(actions: LinkActions, situation: LinkSituation) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the records of a decision: a change of peer (`choice`), and each change of an application's path (`traffic`).

    Args:
        actions: The decision.
        situation: The inputs of the decision. Its position is in metres east, north and up of the local frame.
    """
    link = actions.link
    if link.changes:
        track = situation.track
        position = [round(value, 1) for value in track.position] if track is not None else None
        yield "choice", {"peer": link.peer, "code": link.code, "reason": link.reason, "position": position}
    for application, target in actions.targets.items():
        if target.changes:
            content = {
                "application": application,
                "path": situation.link.peer if target.direct else "cloud",
                "code": target.code,
                "reason": target.reason,
                "cloud": _metrics_record(situation.cloud),
                "direct": _metrics_record(situation.direct),
            }
            yield "traffic", content


def _metrics_record(path: PathMetrics | None) -> dict[str, float] | None:
    if path is None:
        return None
    return {
        "ingress_mbps": round(path.ingress_mbps, 2),
        "egress_mbps": round(path.egress_mbps, 2),
        "ingress_ms": round(path.ingress_latency_ms, 2),
        "egress_ms": round(path.egress_latency_ms, 2),
    }
