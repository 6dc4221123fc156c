"""Report of a mission on a cluster: summary page, results, GeoJSON, map and altitude profile."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np
import shapely
import shapely.geometry
import yaml
from fractus_core.api import EdgeNode, Policy
from fractus_core.api.geometry import Point
from fractus_core.geo import LocalFrame, area_polygon, multipolygon_geojson

from fractus_sim.report.flight_geojson import feature, feature_collection, lonlat, path_feature, point
from fractus_sim.report.flight_map import XY, DrawnNode, DrawnZone, FlightMap, Mark, ZoneKind, draw_map
from fractus_sim.report.flight_profile import Limit, Profile, Request, Span, draw_profile
from fractus_sim.report.flight_record import PICTURES, FlightRecord, JudgedCall, picture_time_s
from fractus_sim.report.html_page import HTML_PAGE, html_page
from fractus_sim.report.report_files import format_duration, rounded, table, write_report

_PLACEMENT_REASONS = {
    "drone": "on the drone",
    "static": "at its location",
    "hybrid-edge": "beside {serves}",
    "hybrid-drone": "within reach of the drone",
    "cloud": "base in the cloud",
}
_OUTCOMES = {"correct": "corrected", "deny": "refused", "takeover": "taken over"}
_STRICTEST_FIRST: tuple[ZoneKind, ...] = ("exclusion", "denial", "camera", "inclusion", "limit")
_RETURN_MODES = {"RTL": "the system flies home", "SMART_RTL": "the system flies home", "LAND": "the system lands"}
_SPAN_GAP_S = 3.0
_SAME_ALTITUDE_M = 0.05


def write_mission_report(record: FlightRecord, folder: Path) -> None:
    """Write summary.md, report.html, report.json, flight.geojson, plan.yaml, map.png and altitude.png into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    if record.plan is not None:
        (folder / "plan.yaml").write_text(yaml.safe_dump(record.plan.to_dict(), sort_keys=False))
    write_report(
        folder,
        mission_page(record),
        mission_results(record),
        figures={
            "map.png": lambda: draw_map(mission_map(record)),
            "altitude.png": lambda: draw_profile(mission_profile(record)),
        },
        geojson={"flight.geojson": mission_geojson(record)},
        texts={HTML_PAGE: lambda: mission_html(record, folder)},
    )


# -- Page -----------------------------------------------------------------------------------------------------


def mission_page(record: FlightRecord) -> str:
    """Return the summary page in Markdown: flight, policy decisions, and placement of components."""
    files = (
        "Figures: [map.png](map.png), [altitude.png](altitude.png). Data: [flight.geojson](flight.geojson),"
        " [report.json](report.json), [plan.yaml](plan.yaml), [audit](audit). All in one file: [report.html](report.html)."
    )
    return "\n\n".join((_summary(record), *_sections(record), files)) + "\n"


def mission_html(record: FlightRecord, folder: Path) -> str:
    """Return the summary page as HTML that contains the figures and pictures of a folder."""
    return html_page(
        f"Flight of {record.application.name}",
        summary=_summary(record),
        figures=("map.png", "altitude.png"),
        sections="\n\n".join(part for part in _sections(record) if part != _pictures_section(record)),
        pictures=_picture_titles(record),
        folder=folder,
    )


def _summary(record: FlightRecord) -> str:
    return f"# Flight of {record.application.name}\n\n{_headline(record)}"


def _sections(record: FlightRecord) -> list[str]:
    parts = [
        _times_section(record),
        decisions_section(record.decisions, _utc),
        _pictures_section(record),
        _placements_section(record),
        _links_section(record),
        _pods_section(record),
        _audit_section(record),
    ]
    return [part for part in parts if part]


def _headline(record: FlightRecord) -> str:
    status = record.application.status
    phase = (status.phase if status else None) or "Unknown"
    if record.track.takeoff_s is None:
        reason = (status.message if status else None) or ""
        drone = record.drone.name if record.drone else "The drone"
        return f"**{phase}.** {drone} did not fly. {reason}".strip()
    drone = record.drone.name if record.drone else "no drone"
    landing_error_m = record.track.landing_error_m
    if landing_error_m is None:
        end = "is still in the air"
    else:
        end = f"landed {landing_error_m:.1f} m from the takeoff position"
    flight_s = _difference(record.track.takeoff_s, record.track.landing_s)
    duration = f" in {format_duration(flight_s)}" if flight_s is not None else ""
    corrected, refused = _decision_counts(record)
    kept = f" {record.results} pictures were checked and kept." if record.results else ""
    return (
        f"**{phase}.** {drone} flew {record.track.distance_m:.0f} m{duration}, up to {record.track.max_altitude_m:.1f} m"
        f" high and {record.track.max_speed_mps:.1f} m/s fast, and {end}. Of {record.calls} calls, policies corrected"
        f" {corrected} and refused {refused}.{kept}"
    )


def _times_section(record: FlightRecord) -> str:
    rows = [(name, format_duration(seconds)) for name, seconds in _times_since_apply(record)]
    return "## Times\n\n" + table(("Event", "Time since the apply"), rows) if rows else ""


def decisions_section(decisions: Sequence[JudgedCall], format_time: Callable[[float], str]) -> str:
    """Return the section with the calls that policies changed.

    Args:
        decisions: Changed calls in the order of their numbers in the figures.
        format_time: Formats the time of a call.
    """
    if not decisions:
        return "## Policy decisions\n\nEvery call was allowed unchanged."
    rows = [
        (
            str(number),
            format_time(call.time_s),
            call.caller,
            f"{call.method} {call.arguments}".strip() + (f" (x{call.count})" if call.count > 1 else ""),
            _OUTCOMES[call.action],
            ", ".join(call.policies) or "-",
            f"{call.code}: {call.reason}" if call.code else call.reason,
        )
        for number, call in enumerate(decisions, 1)
    ]
    head = ("No", "Time", "Component", "Requested", "Outcome", "Policies", "Reason")
    return "## Policy decisions\n\n" + table(head, rows) + "\n\nThe numbers match the figures."


def _pictures_section(record: FlightRecord) -> str:
    titles = _picture_titles(record)
    if not titles:
        return ""
    row = [f"![from the drone]({name})" for name in titles]
    return "## Camera pictures\n\n" + table(list(titles.values()), [row])


def _picture_titles(record: FlightRecord) -> dict[str, str]:
    """Return time and altitude of each picture by the name of its file in the folder of the report."""
    titles = {}
    for name in record.pictures:
        time_s = picture_time_s(name)
        nearest = record.track.sample_at(time_s)
        altitude_m = nearest.place.alt_m if nearest is not None else 0.0
        titles[f"{PICTURES}/{name}"] = f"{_utc(time_s)}, {altitude_m:.0f} m above home"
    return titles


def _placements_section(record: FlightRecord) -> str:
    if record.plan is None:
        return ""
    rows = []
    for placement in record.plan.spec.placements:
        serves = f"{placement.serves.component} on {placement.serves.node}" if placement.serves else ""
        reason = _PLACEMENT_REASONS[placement.role].format(serves=serves)
        if placement.coverage is not None:
            reason += f", adds {placement.coverage:.0%} of the operation area"
        count = f" x{placement.replicas}" if placement.replicas > 1 else ""
        rows.append((placement.component, (placement.node or "any cloud node") + count, reason))
    section = "## Placement\n\n" + table(("Component", "Node", "Reason"), rows)
    rejected = [(r.component, r.node, f"{r.reason}: {r.message}") for r in record.plan.spec.rejected]
    if rejected:
        section += "\n\nRejected nodes:\n\n" + table(("Component", "Node", "Reason"), rejected)
    return section


def _links_section(record: FlightRecord) -> str:
    if not record.links:
        return ""
    rows = [(_utc(c.time_s), c.node, "WiFi" if c.direct else "back to the cloud", c.reason) for c in record.links]
    return "## Direct links\n\n" + table(("Time", "Node", "Traffic path", "Reason"), rows)


def _pods_section(record: FlightRecord) -> str:
    rows = []
    for pod in record.pods:
        start = f"{pod.running_s - pod.created_s:.0f} s" if pod.running_s is not None else "never"
        rows.append((pod.name, pod.node, start, str(pod.restarts)))
    return "## Pods\n\n" + table(("Pod", "Node", "Time to Running", "Restarts"), rows) if rows else ""


def _audit_section(record: FlightRecord) -> str:
    if not record.audit:
        return "## Audit log\n\nNo audit log was collected."
    problem = record.audit.get("problem")
    result = f"**The hash chain is broken: {problem}.**" if problem else "The hash chain is valid."
    return (
        f"## Audit log\n\n{record.audit.get('entries', 0)} entries on the drone, {record.audit.get('kept', 0)} of this"
        f" mission. {result} To check it again, run `fractus audit verify audit` in this folder."
    )


# -- Results --------------------------------------------------------------------------------------------------


def mission_results(record: FlightRecord) -> dict[str, Any]:
    """Return the results as JSON-compatible values."""
    status = record.application.status
    plan = record.plan.spec if record.plan else None
    corrected, refused = _decision_counts(record)
    return {
        "application": record.application.name,
        "phase": status.phase if status else None,
        "message": status.message if status else None,
        "drone": record.drone.name if record.drone else None,
        "calls": record.calls,
        "pictures": record.results,
        "corrected": corrected,
        "refused": refused,
        "flight_s": rounded(_difference(record.track.takeoff_s, record.track.landing_s)),
        "distance_m": rounded(record.track.distance_m),
        "max_altitude_m": rounded(record.track.max_altitude_m),
        "max_speed_mps": rounded(record.track.max_speed_mps),
        "landed": record.track.landing_s is not None,
        "landed_from_home_m": rounded(record.track.landing_error_m),
        "times": {name: rounded(seconds) for name, seconds in _times_since_apply(record)},
        "judgements": [
            {
                "time": _iso_time(call.time_s),
                "component": call.caller,
                "method": call.method,
                "action": call.action,
                "code": call.code,
                "reason": call.reason,
                "policies": list(call.policies),
                "asked": call.arguments,
                "count": call.count,
            }
            for call in record.decisions
        ],
        "links": [
            {"time": _iso_time(c.time_s), "node": c.node, "direct": c.direct, "why": c.reason} for c in record.links
        ],
        "placements": [p.to_dict() for p in plan.placements] if plan else [],
        "rejected": [r.to_dict() for r in plan.rejected] if plan else [],
        "audit": dict(record.audit),
    }


def _decision_counts(record: FlightRecord) -> tuple[int, int]:
    """Return the numbers of corrected and refused calls."""
    corrected = sum(call.count for call in record.decisions if not call.refused)
    refused = sum(call.count for call in record.decisions if call.refused)
    return corrected, refused


def _times_since_apply(record: FlightRecord) -> list[tuple[str, float]]:
    """Return the events of the mission in order, with their times in seconds since the apply."""
    applied_s = record.times.get("applied")
    if applied_s is None:
        return []
    events: list[tuple[str, float | None]] = [
        ("planned", record.times.get("planned")),
        ("all pods Running", record.times.get("running")),
        ("takeoff", record.track.takeoff_s),
        ("landed", record.track.landing_s),
        ("mission over, flying home", record.times.get("ended")),
    ]
    known = [(name, time_s - applied_s) for name, time_s in events if time_s is not None]
    return sorted(known, key=lambda event: event[1])


def _difference(begin: float | None, end: float | None) -> float | None:
    return end - begin if begin is not None and end is not None else None


def _utc(time_s: float) -> str:
    return datetime.fromtimestamp(time_s, UTC).strftime("%H:%M:%S UTC")


def _iso_time(time_s: float) -> str:
    return datetime.fromtimestamp(time_s, UTC).isoformat(timespec="milliseconds")


# -- Map and profile ------------------------------------------------------------------------------------------


def mission_map(record: FlightRecord) -> FlightMap:
    """Return the content of the map."""
    frame = record.frame
    used = {p.node for p in record.plan.spec.placements} if record.plan else set()
    nodes = tuple(
        DrawnNode(n.name, frame.xy(n.spec.location.lat, n.spec.location.lon), _wifi_range_m(n), n.name in used)
        for n in record.edge_nodes
    )
    return FlightMap(
        title=f"{record.application.name}: {record.track.name}, {record.track.distance_m:.0f} m",
        frame=frame,
        tracks=(record.track,),
        zones=tuple(_restricted_zones(record)),
        area=_operation_area(record),
        nodes=nodes,
        depots=tuple((d.name, frame.xy(d.spec.location.lat, d.spec.location.lon)) for d in record.depots),
        landings=tuple(_landing_places(record)),
        marks=tuple(decision_marks(record.decisions, frame)),
        links=tuple(_link_lines(record, {node.name: node.position for node in nodes})),
    )


def _landing_places(record: FlightRecord) -> Iterable[tuple[str, tuple[float, float]]]:
    """Yield the names and positions of the landing places that the application or its policies specify.

    The place of a policy also applies if the application selects `abort` without an own place.
    """
    spec = record.application.spec
    selections = {selection.policy: selection for selection in spec.policy_actions}
    places: list[tuple[str, Point | None]] = []
    for policy in record.policies:
        selection = selections.get(policy.name)
        action = selection.action if selection is not None else policy.spec.action
        own_place = selection.land_at if selection is not None else None
        if action == "abort":
            places.append((policy.name, own_place or policy.spec.land_at))
    if spec.contact_lost is not None:
        places.append(("contact lost", spec.contact_lost.land_at))
    for name, place in places:
        if place is not None:
            yield f"landing ({name})", record.frame.xy(place.lat, place.lon)


def mission_profile(record: FlightRecord) -> Profile:
    """Return the content of the altitude profile. Times are relative to the takeoff."""
    start_s = record.track.takeoff_s if record.track.takeoff_s is not None else record.times.get("applied", 0.0)
    return Profile(
        title=f"{record.application.name}: altitude",
        tracks=(record.track,),
        start_s=start_s,
        panels=("altitude",),
        limits=tuple(_altitude_limits(record)),
        spans=tuple(_return_flights(record)),
        requests=tuple(decision_requests(record.decisions)),
        time_label="seconds since takeoff",
    )


def decision_marks(decisions: Sequence[JudgedCall], frame: LocalFrame) -> Iterable[Mark]:
    """Yield map marks of calls that policies changed."""
    for number, call in enumerate(decisions, 1):
        place = call.requested or call.position
        if place is None:
            continue
        kind: Literal["refused", "corrected"] = "refused" if call.refused else "corrected"
        origin = None
        if call.refused and call.requested is not None and call.position is not None:
            origin = frame.xy(call.position.lat, call.position.lon)
        yield Mark(kind, str(number), frame.xy(place.lat, place.lon), origin)


def decision_requests(decisions: Sequence[JudgedCall]) -> Iterable[Request]:
    """Yield profile marks of calls that policies changed."""
    for number, call in enumerate(decisions, 1):
        place = call.requested or call.position
        if place is None:
            continue
        if call.refused:
            yield Request("refused", str(number), call.time_s, place.alt_m, "refused")
            continue
        flown_m = None
        if call.requested is not None and call.flown is not None:
            changed = abs(call.requested.alt_m - call.flown.alt_m) > _SAME_ALTITUDE_M
            flown_m = call.flown.alt_m if changed else None
        yield Request("corrected", str(number), call.time_s, place.alt_m, "requested, and corrected", flown_m)


def _link_lines(record: FlightRecord, nodes: Mapping[str, XY]) -> Iterable[tuple[XY, XY]]:
    """Yield lines between the drone and the node at each change of traffic to a direct link."""
    for change in record.links:
        sample = record.track.sample_at(change.time_s)
        if change.direct and change.node in nodes and sample is not None:
            yield record.frame.xy(sample.place.lat, sample.place.lon), nodes[change.node]


def _wifi_range_m(node: EdgeNode) -> float | None:
    return max((i.range for i in node.spec.interfaces if i.range is not None and i.pairing is not None), default=None)


def _operation_area(record: FlightRecord) -> Any:
    """Return the shape of the operation area in metres, or None if there is no plan."""
    if record.plan is None or record.plan.spec.operation_area is None:
        return None
    shape = shapely.geometry.shape(record.plan.spec.operation_area)
    frame = record.frame

    def to_metres(coordinates: np.ndarray) -> np.ndarray:
        return np.array([frame.xy(lat, lon) for lon, lat in coordinates])

    return shapely.transform(shape, to_metres)


def _restricted_zones(record: FlightRecord) -> Iterable[DrawnZone]:
    """Yield each zone, with the kind of the strictest policy that applies to this drone in the zone."""
    for zone in record.zones:
        kinds = {_zone_kind(p) for p in record.policies_in_force if zone.name in p.spec.selector.zones}
        strictest = next((kind for kind in _STRICTEST_FIRST if kind in kinds), None)
        if strictest is not None:
            yield DrawnZone(zone.name, strictest, area_polygon(record.frame, zone.spec.area))


def _zone_kind(policy: Policy) -> str:
    return "limit" if policy.spec.type == "LimitControl" else policy.spec.kind


def _altitude_limits(record: FlightRecord) -> Iterable[Limit]:
    """Yield the altitude limits, regardless of the zones in which they apply."""
    for policy in record.policies_in_force:
        spec = policy.spec
        if spec.type != "LimitControl" or spec.kind != "altitude" or spec.altitude_reference != "home":
            continue
        for limit, word in ((spec.upper_limit, "at most"), (spec.lower_limit, "at least")):
            if limit is not None:
                yield Limit("altitude", limit, f"{policy.name}: {word} {limit:g} m")


def _return_flights(record: FlightRecord) -> Iterable[Span]:
    """Return the time spans of return flights."""
    spans: list[Span] = []
    for sample in record.samples:
        if sample.mode not in _RETURN_MODES or not sample.in_air:
            continue
        if spans and sample.time_s - spans[-1].end_s < _SPAN_GAP_S:
            spans[-1] = Span(spans[-1].begin_s, sample.time_s, spans[-1].label)
        else:
            spans.append(Span(sample.time_s, sample.time_s, _RETURN_MODES[sample.mode]))
    return spans


# -- GeoJSON --------------------------------------------------------------------------------------------------


def mission_geojson(record: FlightRecord) -> dict[str, Any]:
    """Return a FeatureCollection with path, changed calls, zones, operation area, nodes and depots."""
    features: list[dict[str, Any]] = []
    if record.samples:
        features.append(path_feature(record.track))
    for number, call in enumerate(record.decisions, 1):
        place = call.requested or call.position
        if place is not None:
            features.append(_decision_feature(number, call, point(lonlat(place))))
    for zone in record.zones:
        policies = [p.name for p in record.policies if zone.name in p.spec.selector.zones]
        shape = multipolygon_geojson(record.frame, area_polygon(record.frame, zone.spec.area))
        features.append(feature(shape, what="zone", name=zone.name, policies=policies))
    if record.plan is not None and record.plan.spec.operation_area is not None:
        features.append(feature(record.plan.spec.operation_area, what="operationArea"))
    for node in record.edge_nodes:
        location = node.spec.location
        features.append(feature(point([location.lon, location.lat]), what="edgeNode", name=node.name))
    for depot in record.depots:
        home = depot.spec.location
        features.append(feature(point([home.lon, home.lat]), what="depot", name=depot.name))
    return feature_collection(features)


def _decision_feature(number: int, call: JudgedCall, geometry: dict[str, Any]) -> dict[str, Any]:
    return feature(
        geometry,
        what="refused" if call.refused else "corrected",
        number=number,
        component=call.caller,
        method=call.method,
        code=call.code,
        reason=call.reason,
        policies=list(call.policies),
    )
