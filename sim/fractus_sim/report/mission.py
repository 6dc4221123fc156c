"""Map and profile of a mission on a cluster."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import shapely
import shapely.geometry
from fractus_core.api import EdgeNode, Policy
from fractus_core.geo import LocalFrame, area_polygon

from fractus_sim.report.profile import Limit, Profile, Request, Span
from fractus_sim.report.record import Judgement, Record
from fractus_sim.report.scene import XY, DrawnNode, DrawnZone, Mark, Scene, ZoneKind

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
        links=tuple(_links(record, {node.name: node.at for node in nodes})),
    )


def _links(record: Record, nodes: Mapping[str, XY]) -> Iterable[tuple[XY, XY]]:
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
