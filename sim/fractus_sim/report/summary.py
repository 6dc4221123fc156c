"""Summary page: flight, policy decisions, and placement of components."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from typing import Any

from fractus_sim.report.page import clock, rounded, table
from fractus_sim.report.record import PICTURES, Judgement, Record, taken_s

_ROLES = {
    "drone": "on the drone",
    "static": "at its location",
    "hybrid-edge": "beside {serves}",
    "hybrid-drone": "within reach of the drone",
    "cloud": "base in the cloud",
}


def summary(record: Record) -> str:
    """Return the page in Markdown."""
    parts = [
        f"# Flight of {record.application.name}\n\n{_headline(record)}",
        _figures(record),
        judged(record.judgements, _utc),
        _pictures(record),
        _placements(record),
        _links(record),
        _pods(record),
        _audit(record),
        "Drawings: [map.png](map.png), [altitude.png](altitude.png). For other tools: [flight.geojson](flight.geojson),"
        " [report.json](report.json), [plan.yaml](plan.yaml), [audit](audit).",
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def figures(record: Record) -> dict[str, Any]:
    """Return the results as JSON-compatible values."""
    status = record.application.status
    plan = record.plan.spec if record.plan else None
    return {
        "application": record.application.name,
        "phase": status.phase if status else None,
        "message": status.message if status else None,
        "drone": record.drone.name if record.drone else None,
        "calls": record.calls,
        "pictures": record.results,
        "corrected": sum(j.count for j in record.judgements if not j.refused),
        "refused": sum(j.count for j in record.judgements if j.refused),
        "flight_s": rounded(_span(record.takeoff_s, record.landing_s)),
        "distance_m": rounded(record.track.distance_m),
        "max_altitude_m": rounded(record.track.max_altitude_m),
        "max_speed_mps": rounded(record.track.max_speed_mps),
        "landed": record.landing_s is not None,
        "landed_from_home_m": rounded(record.track.miss_m),
        "times": {name: rounded(seconds) for name, seconds in _durations(record)},
        "judgements": [
            {
                "time": _stamp(j.time_s),
                "component": j.component,
                "method": j.method,
                "action": j.action,
                "code": j.code,
                "reason": j.reason,
                "policies": list(j.policies),
                "asked": j.detail,
                "count": j.count,
            }
            for j in record.judgements
        ],
        "links": [{"time": _stamp(c.time_s), "node": c.node, "direct": c.direct, "why": c.why} for c in record.links],
        "placements": [p.to_dict() for p in plan.placements] if plan else [],
        "rejected": [r.to_dict() for r in plan.rejected] if plan else [],
        "audit": dict(record.audit),
    }


def _headline(record: Record) -> str:
    status = record.application.status
    phase = (status.phase if status else None) or "Unknown"
    drone = record.drone.name if record.drone else "no drone"
    flight_s = _span(record.takeoff_s, record.landing_s)
    if record.takeoff_s is None:
        reason = (status.message if status else None) or ""
        who = record.drone.name if record.drone else "The drone"
        return f"**{phase}.** {who} did not fly. {reason}".strip()
    miss = record.track.miss_m
    end = "is still in the air" if miss is None else f"landed {miss:.1f} m from the takeoff position"
    took = f" in {clock(flight_s)}" if flight_s is not None else ""
    corrected = sum(j.count for j in record.judgements if not j.refused)
    refused = sum(j.count for j in record.judgements if j.refused)
    return (
        f"**{phase}.** {drone} flew {record.track.distance_m:.0f} m{took}, up to {record.track.max_altitude_m:.1f} m high and"
        f" {record.track.max_speed_mps:.1f} m/s fast, and {end}. Of {record.calls} calls, policies corrected {corrected}"
        f" and refused {refused}. {record.results} pictures were checked and kept."
    )


def _figures(record: Record) -> str:
    rows = [(name, clock(seconds)) for name, seconds in _durations(record)]
    return "## Times\n\n" + table(("Since the apply", "After"), rows) if rows else ""


def _durations(record: Record) -> list[tuple[str, float]]:
    start = record.times.get("applied")
    if start is None:
        return []
    marks: list[tuple[str, float | None]] = [
        ("planned", record.times.get("planned")),
        ("all pods Running", record.times.get("running")),
        ("takeoff", record.takeoff_s),
        ("landed", record.landing_s),
        ("mission over, flying home", record.times.get("ended")),
    ]
    known = [(name, at - start) for name, at in marks if at is not None]
    return sorted(known, key=lambda mark: mark[1])


def judged(judgements: Sequence[Judgement], stamp: Callable[[float], str]) -> str:
    """Return the section about policy decisions. `stamp` formats a time."""
    if not judgements:
        return "## Policy decisions\n\nEvery call was allowed unchanged."
    rows = [
        (
            str(number),
            stamp(j.time_s),
            j.component,
            f"{j.method} {j.detail}".strip() + (f" (x{j.count})" if j.count > 1 else ""),
            {"correct": "corrected", "deny": "refused", "takeover": "taken over"}[j.action],
            ", ".join(j.policies) or "-",
            f"{j.code}: {j.reason}" if j.code else j.reason,
        )
        for number, j in enumerate(judgements, 1)
    ]
    head = ("No", "At", "Component", "Asked", "Outcome", "Policies", "Reason")
    return "## Policy decisions\n\n" + table(head, rows) + "\n\nThe numbers match the figures."


def _pictures(record: Record) -> str:
    if not record.pictures:
        return ""
    shots = [(name, taken_s(name)) for name in record.pictures]
    head = [f"{_utc(at_s)}, {_height_m(record, at_s):.0f} m above home" for _, at_s in shots]
    row = [f"![from the drone]({PICTURES}/{name})" for name, _ in shots]
    return "## Camera pictures\n\n" + table(head, [row])


def _height_m(record: Record, at_s: float) -> float:
    return min(record.samples, key=lambda sample: abs(sample.time_s - at_s)).place.alt_m if record.samples else 0.0


def _placements(record: Record) -> str:
    if record.plan is None:
        return ""
    rows = []
    for placed in record.plan.spec.placements:
        serves = f"{placed.serves.component} on {placed.serves.node}" if placed.serves else ""
        why = _ROLES[placed.role].format(serves=serves)
        if placed.coverage is not None:
            why += f", adds {placed.coverage:.0%} of the operation area"
        count = f" x{placed.replicas}" if placed.replicas > 1 else ""
        rows.append((placed.component, (placed.node or "any cloud node") + count, why))
    text = "## Placement\n\n" + table(("Component", "Node", "Why"), rows)
    rejected = [(r.component, r.node, f"{r.reason}: {r.message}") for r in record.plan.spec.rejected]
    if rejected:
        text += "\n\nDropped:\n\n" + table(("Component", "Node", "Why not"), rejected)
    return text


def _links(record: Record) -> str:
    if not record.links:
        return ""
    rows = [(_utc(c.time_s), c.node, "by WiFi" if c.direct else "by the cloud again", c.why) for c in record.links]
    return "## Direct links\n\n" + table(("At", "Node", "Traffic goes", "Why"), rows)


def _pods(record: Record) -> str:
    rows = [
        (p.name, p.node, f"{p.running_s - p.created_s:.0f} s" if p.running_s is not None else "never", str(p.restarts))
        for p in record.pods
    ]
    return "## Pods\n\n" + table(("Pod", "Node", "To Running", "Restarts"), rows) if rows else ""


def _audit(record: Record) -> str:
    if not record.audit:
        return "## Audit log\n\nNone was collected."
    entries = record.audit.get("entries", 0)
    problem = record.audit.get("problem")
    verdict = f"**broken: {problem}**" if problem else "the chain is sound"
    return (
        f"## Audit log\n\n{entries} entries on the drone, {record.audit.get('kept', 0)} of this mission; {verdict}."
        " To check it again: `fractus audit verify audit` in this folder."
    )


def _span(start: float | None, end: float | None) -> float | None:
    return end - start if start is not None and end is not None else None


def _utc(time_s: float) -> str:
    return datetime.fromtimestamp(time_s, UTC).strftime("%H:%M:%S UTC")


def _stamp(time_s: float) -> str:
    return datetime.fromtimestamp(time_s, UTC).isoformat(timespec="milliseconds")
