"""What the audit log keeps of direct links: each decision that changes something, with what it was made of."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from fractus_core.linking import PathMetrics

from fractus_agent.links.decisions import Actions, Situation

Record = Callable[[str, dict[str, Any]], None]
"""Writes an entry: its kind and content."""


def records(actions: Actions, now: Situation) -> Iterator[tuple[str, dict[str, Any]]]:
    """The entries of a decision: which link is wanted, and which path each application's traffic takes; none if all stays."""
    link = actions.link
    if link.changes:
        # In the frame of the decision: metres east, north and up of the application's first waypoint, or of where links began.
        where = [round(value, 1) for value in now.track.position] if now.track is not None else None
        yield "choice", {"peer": link.peer, "code": link.code, "reason": link.reason, "position": where}
    for application, target in actions.targets.items():
        if target.changes:
            content = {
                "application": application,
                "path": now.link.peer if target.direct else "cloud",
                "code": target.code,
                "reason": target.reason,
                "cloud": _offer(now.cloud),
                "direct": _offer(now.direct),
            }
            yield "traffic", content


def _offer(path: PathMetrics | None) -> dict[str, float] | None:
    """What a path was taken to offer, to and from the component that serves."""
    if path is None:
        return None
    return {
        "ingress_mbps": round(path.ingress_mbps, 2),
        "egress_mbps": round(path.egress_mbps, 2),
        "ingress_ms": round(path.ingress_latency_ms, 2),
        "egress_ms": round(path.egress_latency_ms, 2),
    }
