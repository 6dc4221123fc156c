"""Zones as the geofence of a QGroundControl plan file (version 2 of geoFence)."""

from __future__ import annotations

import functools
import itertools
import json
from collections.abc import Collection, Iterable
from typing import Any

from fractus_core.api import InvalidObject, Zone
from fractus_core.geo.formats.zone_builder import (
    Exported,
    FeatureName,
    Imported,
    ZoneBuilder,
    circle_area,
    object_list,
    optional_object,
    parse_json,
    parse_point,
    parse_ring,
    reject_unknown_fields,
    unsupported_parts,
)

_PLAN_VERSION = 1
_FENCE_VERSION = 2
_SHAPE_VERSION = 1
_OF_PLAN = frozenset({"fileType", "version", "groundStation", "geoFence", "mission", "rallyPoints"})
_OF_FENCE = frozenset({"version", "polygons", "circles", "breachReturn"})


def read_qgc_plan(text: str, without: Collection[str] = ()) -> Imported:
    """Read zones from the polygons and circles of the fence.

    The description of a zone states if its shape is for inclusion.

    Args:
        text: Content of the file.
        without: Titles of shapes to leave out, such as `exclusion polygon 1`.

    Raises:
        InvalidObject: The text is not a plan file, or a shape is broken.
    """
    document = parse_json(text)
    if document.get("fileType") != "Plan":
        raise InvalidObject(
            "fileType", f"must be Plan, not {document.get('fileType')!r}; save the plan with QGroundControl as .plan"
        )
    if document.get("version", _PLAN_VERSION) != _PLAN_VERSION:
        raise InvalidObject(
            "version", f"must be {_PLAN_VERSION}, not {document.get('version')!r:.40}; save the plan again"
        )
    reject_unknown_fields(document, _OF_PLAN, "")
    fence = optional_object(document.get("geoFence"), "geoFence")
    if fence and fence.get("version") != _FENCE_VERSION:
        raise InvalidObject(
            "geoFence.version", f"must be {_FENCE_VERSION}, not {fence.get('version')!r}; save the plan again"
        )
    reject_unknown_fields(fence, _OF_FENCE, "geoFence")
    builder = ZoneBuilder(without)
    for i, item in enumerate(object_list(fence.get("polygons"), "geoFence.polygons")):
        field = f"geoFence.polygons[{i}]"
        kind = _kind(item, field)
        name = FeatureName(f"{kind} polygon {i + 1}", f"{kind} polygon")
        builder.take(name, item, functools.partial(_read_polygon, builder, name, item, field, kind))
    for i, item in enumerate(object_list(fence.get("circles"), "geoFence.circles")):
        field = f"geoFence.circles[{i}]"
        kind = _kind(item, field)
        name = FeatureName(f"{kind} circle {i + 1}", f"{kind} circle")
        builder.take(name, item, functools.partial(_read_circle, builder, name, item, field, kind))
    if optional_object(document.get("mission"), "mission").get("items"):
        builder.note("mission", "its items are not zones; left out")
    if optional_object(document.get("rallyPoints"), "rallyPoints").get("points"):
        builder.note("rallyPoints", "its points are not zones; left out")
    if fence.get("breachReturn"):
        builder.note("geoFence.breachReturn", "is not a zone; left out")
    return builder.result()


def _kind(item: dict[str, Any], field: str) -> str:
    if item.get("version", _SHAPE_VERSION) != _SHAPE_VERSION:
        raise InvalidObject(
            f"{field}.version", f"must be {_SHAPE_VERSION}, not {item.get('version')!r:.40}; save the plan again"
        )
    value = item.get("inclusion")
    if not isinstance(value, bool):
        raise InvalidObject(
            f"{field}.inclusion",
            f"must be true or false, not {value!r:.40}; choose Inclusion or not in QGroundControl, and save the plan again",
        )
    return "inclusion" if value else "exclusion"


def _read_polygon(builder: ZoneBuilder, name: FeatureName, item: dict[str, Any], field: str, kind: str) -> None:
    reject_unknown_fields(item, ("polygon", "inclusion", "version"), field)
    exterior = parse_ring(item.get("polygon"), f"{field}.polygon", lat_first=True)
    _add(builder, name, item, {"polygon": {"exterior": exterior}}, field=field, kind=kind)


def _read_circle(builder: ZoneBuilder, name: FeatureName, item: dict[str, Any], field: str, kind: str) -> None:
    reject_unknown_fields(item, ("circle", "inclusion", "version"), field)
    circle = optional_object(item.get("circle"), f"{field}.circle")
    reject_unknown_fields(circle, ("center", "radius"), f"{field}.circle")
    centre = parse_point(circle.get("center"), f"{field}.circle.center", lat_first=True)
    _add(
        builder, name, item, circle_area(centre, circle.get("radius"), f"{field}.circle.radius"), field=field, kind=kind
    )


def _add(
    builder: ZoneBuilder, name: FeatureName, item: dict[str, Any], area: dict[str, object], *, field: str, kind: str
) -> None:
    spec = {"area": area, "description": f"From a QGroundControl plan, for {kind}."}
    builder.add(name, item, field, lambda: spec)
    builder.note(name.title, f"a Zone forbids nothing by itself; add a GeofenceControl policy of kind {kind}")


def write_qgc_plan(zones: Iterable[Zone], *, inclusion: bool = False) -> Exported:
    """Return a plan file without a mission, whose fence contains all zones, for exclusion or for inclusion.

    Raises:
        InvalidObject: A part of a zone that the format cannot represent would make an inclusion fence larger than the
            zone.
    """
    zones = tuple(zones)
    lost = unsupported_parts(zones, "altitude", "holes") if inclusion else []
    if lost:
        raise InvalidObject(
            "", f"{lost[0].removesuffix('; left out')}; an inclusion fence would be larger than the zone"
        )
    notes = unsupported_parts(zones, "altitude", "schedule", "holes")
    polygons = []
    circles = []
    for zone in zones:
        area = zone.spec.area
        if area.circle is not None:
            centre = [area.circle.center.lat, area.circle.center.lon]
            circle = {"center": centre, "radius": area.circle.radius}
            circles.append({"circle": circle, "inclusion": inclusion, "version": _SHAPE_VERSION})
        elif area.polygon is not None:
            corners = [[p.lat, p.lon] for p in area.polygon.exterior]
            if any(abs(a[1] - b[1]) > 180 for a, b in itertools.pairwise([*corners, corners[0]])):
                notes.append(f"{zone.name}: it crosses the antimeridian; QGroundControl draws it around the world")
            polygons.append({"polygon": corners, "inclusion": inclusion, "version": _SHAPE_VERSION})
    mission = {
        "cruiseSpeed": 15, "firmwareType": 3, "globalPlanAltitudeMode": 1, "hoverSpeed": 5, "items": [],
        "plannedHomePosition": [0, 0, 0], "vehicleType": 2, "version": 2,
    }  # fmt: skip
    document = {
        "fileType": "Plan",
        "geoFence": {"circles": circles, "polygons": polygons, "version": _FENCE_VERSION},
        "groundStation": "QGroundControl",
        "mission": mission,
        "rallyPoints": {"points": [], "version": 2},
        "version": _PLAN_VERSION,
    }
    return Exported(json.dumps(document, indent=2) + "\n", tuple(notes))
