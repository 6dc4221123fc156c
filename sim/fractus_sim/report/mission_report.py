"""Output of all files of a report."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import shapely
import shapely.geometry
import yaml
from fractus_core.api import EdgeNode, Policy
from fractus_core.geo import LocalFrame, area_polygon, multipolygon_geojson

from fractus_sim.report.figure_style import save
from fractus_sim.report.flight_map import XY, DrawnNode, DrawnZone, Mark, Scene, ZoneKind, draw_map
from fractus_sim.report.flight_profile import Limit, Profile, Request, Span, draw_profile
from fractus_sim.report.flight_record import PICTURES, Judgement, Record, taken_s
from fractus_sim.report.geojson import feature, lonlat, path, point
from fractus_sim.report.report_files import clock, rounded, table, write_page


def write_report(record: Record, folder: Path) -> None:
    """Write summary.md, report.json, flight.geojson, plan.yaml, map.png and altitude.png into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "report.json").write_text(json.dumps(figures(record), indent=2) + "\n")
    (folder / "flight.geojson").write_text(json.dumps(features(record)) + "\n")
    if record.plan is not None:
        (folder / "plan.yaml").write_text(yaml.safe_dump(record.plan.to_dict(), sort_keys=False))
    save(draw_map(scene_of(record)), folder / "map.png")
    save(draw_profile(profile_of(record)), folder / "altitude.png")
    write_page(folder, summary(record))


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


_STRICTEST: tuple[ZoneKind, ...] = ("exclusion", "denial", "camera", "inclusion", "limit")
_HOME_MODES = {"RTL": "the system flies home", "SMART_RTL": "the system flies home", "LAND": "the system lands"}


def scene_of(record: Record) -> Scene:
    """Return the map of the mission."""
    frame = record.frame
    used = {p.node for p in record.plan.spec.placements} if record.plan else set()
    nodes = tuple(
        DrawnNode(n.name, frame.xy(n.spec.location.lat, n.spec.location.lon), _reach_m(n), n.name in used)
        for n in record.edge_nodes
    )
    depots = tuple((d.name, frame.xy(d.spec.location.lat, d.spec.location.lon)) for d in record.depots)
    return Scene(
        title=f"{record.application.name}: {record.track.name}, {record.track.distance_m:.0f} m",
        frame=frame,
        tracks=(record.track,),
        zones=tuple(_zones(record)),
        area=_area_shape(record),
        nodes=nodes,
        depots=depots,
        marks=tuple(marks_of(record.judgements, frame)),
        links=tuple(_link_lines(record, {node.name: node.at for node in nodes})),
    )


def _link_lines(record: Record, nodes: Mapping[str, XY]) -> Iterable[tuple[XY, XY]]:
    for change in record.links:
        if change.direct and change.node in nodes and record.samples:
            at = min(record.samples, key=lambda sample: abs(sample.time_s - change.time_s)).place
            yield record.frame.xy(at.lat, at.lon), nodes[change.node]


def profile_of(record: Record) -> Profile:
    """Return the profile of the mission. Times are relative to the takeoff."""
    start_s = record.takeoff_s if record.takeoff_s is not None else record.times.get("applied", 0.0)
    return Profile(
        title=f"{record.application.name}: altitude",
        tracks=(record.track,),
        start_s=start_s,
        panels=("altitude",),
        limits=tuple(_limits(record)),
        spans=tuple(_home_leg(record)),
        requests=tuple(requests_of(record.judgements)),
        axis="seconds since takeoff",
    )


def _reach_m(node: EdgeNode) -> float | None:
    return max((i.range for i in node.spec.interfaces if i.range is not None and i.pairing is not None), default=None)


def _area_shape(record: Record) -> Any:
    if record.plan is None or record.plan.spec.operation_area is None:
        return None
    shape = shapely.geometry.shape(record.plan.spec.operation_area)
    frame = record.frame

    def metres(lonlat: np.ndarray) -> np.ndarray:
        return np.array([frame.xy(lat, lon) for lon, lat in lonlat])

    return shapely.transform(shape, metres)


def _zones(record: Record) -> Iterable[DrawnZone]:
    """Return each zone with the strictest policy that applies to this drone in it."""
    for zone in record.zones:
        kinds = {_kind(p) for p in record.policies_in_force if zone.name in p.spec.selector.zones}
        strictest = next((kind for kind in _STRICTEST if kind in kinds), None)
        if strictest is not None:
            yield DrawnZone(zone.name, strictest, area_polygon(record.frame, zone.spec.area))


def _kind(policy: Policy) -> str:
    return "limit" if policy.spec.type == "LimitControl" else policy.spec.kind


def marks_of(judgements: Sequence[Judgement], frame: LocalFrame) -> Iterable[Mark]:
    """Return map marks of calls that policies changed."""
    for index, judged in enumerate(judgements, 1):
        place = judged.asked or judged.at
        if place is None:
            continue
        origin = judged.at if judged.refused and judged.asked is not None else None
        yield Mark(
            "refused" if judged.refused else "corrected",
            str(index),
            frame.xy(place.lat, place.lon),
            frame.xy(origin.lat, origin.lon) if origin is not None else None,
        )


def _limits(record: Record) -> Iterable[Limit]:
    """Return the altitude limits. The summary lists where each limit applies."""
    for policy in record.policies_in_force:
        spec = policy.spec
        if spec.type != "LimitControl" or spec.kind != "altitude" or spec.altitude_reference != "home":
            continue
        for limit, word in ((spec.upper_limit, "at most"), (spec.lower_limit, "at least")):
            if limit is not None:
                yield Limit("altitude", limit, f"{policy.name}: {word} {limit:g} m")


def _home_leg(record: Record) -> Iterable[Span]:
    """Return the time spans of flights by the system."""
    spans: list[Span] = []
    for sample in record.samples:
        if sample.mode not in _HOME_MODES or not sample.in_air:
            continue
        if spans and sample.time_s - spans[-1].end_s < 3.0:
            spans[-1] = Span(spans[-1].begin_s, sample.time_s, spans[-1].words)
        else:
            spans.append(Span(sample.time_s, sample.time_s, _HOME_MODES[sample.mode]))
    return spans


def requests_of(judgements: Sequence[Judgement]) -> Iterable[Request]:
    """Return profile marks of calls that policies changed."""
    for index, judged in enumerate(judgements, 1):
        place = judged.asked or judged.at
        if place is None:
            continue
        flown_m = None
        if not judged.refused and _climbs(judged):
            flown_m = judged.flown.alt_m if judged.flown is not None else place.alt_m
        if judged.refused:
            yield Request("refused", str(index), judged.time_s, place.alt_m, "refused")
        else:
            yield Request("corrected", str(index), judged.time_s, place.alt_m, "requested, and corrected", flown_m)


def _climbs(judged: Judgement) -> bool:
    return judged.asked is not None and judged.flown is not None and abs(judged.asked.alt_m - judged.flown.alt_m) > 0.05


def features(record: Record) -> dict[str, Any]:
    """Return a FeatureCollection with path, requests, zones, operation area, nodes and depots."""
    found: list[dict[str, Any]] = []
    if record.samples:
        found.append(path(record.track))
    for number, judged in enumerate(record.judgements, 1):
        found += _request(number, judged)
    for zone in record.zones:
        policies = [p.name for p in record.policies if zone.name in p.spec.selector.zones]
        shape = multipolygon_geojson(record.frame, area_polygon(record.frame, zone.spec.area))
        found.append(feature(shape, what="zone", name=zone.name, policies=policies))
    if record.plan is not None and record.plan.spec.operation_area is not None:
        found.append(feature(record.plan.spec.operation_area, what="operationArea"))
    for node in record.edge_nodes:
        at = node.spec.location
        found.append(feature(point([at.lon, at.lat]), what="edgeNode", name=node.name))
    for depot in record.depots:
        at_depot = depot.spec.location
        found.append(feature(point([at_depot.lon, at_depot.lat]), what="depot", name=depot.name))
    return {"type": "FeatureCollection", "features": found}


def _request(number: int, judged: Judgement) -> list[dict[str, Any]]:
    place = judged.asked or judged.at
    if place is None:
        return []
    properties = {
        "what": "refused" if judged.refused else "corrected",
        "number": number,
        "component": judged.component,
        "method": judged.method,
        "code": judged.code,
        "reason": judged.reason,
        "policies": list(judged.policies),
    }
    return [feature(point(lonlat(place)), **properties)]
