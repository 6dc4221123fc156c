"""Zones and areas of Grants as map features (GeoJSON)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, get_args

from fractus_core.api import Zone
from fractus_core.api.geometry import Area, Point, Polygon
from fractus_core.api.grants import GrantSpec
from fractus_core.api.model import Metadata
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.api.policies import ZoneShape, ZoneSpec, ZoneUse
from fractus_core.geo.formats.geojson import zone_feature

Feature = dict[str, Any]

_COLOURS = {"zone": "#d62728", "operationArea": "#2ca02c", "corridor": "#9467bd"}
_USE_COLOURS: dict[ZoneUse, str] = {
    "exclusion": "#d62728", "noPictures": "#e377c2", "inclusion": "#bcbd22", "denial": "#7f7f7f",
    "pictureFilter": "#e377c2", "altitudeLimit": "#ff7f0e", "speedLimit": "#ff7f0e", "grant": "#7f7f7f",
}  # fmt: skip


def zones_of(specs: Iterable[GrantSpec]) -> list[Zone]:
    """Return the zones of all policies in some Grants, sorted by name, without duplicates."""
    shapes: dict[str, ZoneShape] = {
        zone.name: zone for spec in specs for policy in spec.policies for zone in policy.zones
    }
    return [_to_zone(name, shape) for name, shape in sorted(shapes.items())]


def areas_of(spec: GrantSpec) -> list[Zone]:
    """Return the operation areas and corridors of a Grant as Zones."""
    areas_by_kind = (("operationArea", spec.operation_area), ("corridor", spec.corridor))
    return [_to_zone(kind, ZoneShape(area=area)) for kind, areas in areas_by_kind for area in areas]


def area_of_plan(plan: DeploymentPlanSpec) -> list[Zone]:
    """Return the operation area of a plan as Zones, one for each polygon."""
    multipolygon = plan.operation_area or {}
    zones = []
    for exterior, *holes in multipolygon.get("coordinates", ()):
        polygon = Polygon(exterior=_ring(exterior), holes=tuple(map(_ring, holes)))
        zones.append(_to_zone("operationArea", ZoneShape(area=Area(polygon=polygon))))
    return zones


def _ring(coordinates: Sequence[Sequence[float]]) -> tuple[Point, ...]:
    """Return a GeoJSON ring, whose last position repeats the first one."""
    return tuple(Point(lat=lat, lon=lon) for lon, lat, *_ in coordinates[:-1])


def grant_features(specs: Iterable[GrantSpec]) -> list[Feature]:
    """Return the zones, operation areas and corridors of some Grants as features with `kind` and `component` properties."""
    specs = tuple(specs)
    uses = _uses_of(specs)
    zones = [_zone_feature(zone, uses[zone.name]) for zone in zones_of(specs)]
    areas = [to_feature(area, area.name, component=spec.component) for spec in specs for area in areas_of(spec)]
    return zones + areas


def _uses_of(specs: Iterable[GrantSpec]) -> dict[str, set[ZoneUse]]:
    """Return the effects of all policies on each of their zones, by name of the zone."""
    uses: dict[str, set[ZoneUse]] = {}
    for policy in (policy for spec in specs for policy in spec.policies):
        for zone in policy.zones:
            uses.setdefault(zone.name, set()).update(policy.spec.zone_uses)
    return uses


def _zone_feature(zone: Zone, uses: set[ZoneUse]) -> Feature:
    """Return a zone with the property `uses`, in the colour of the most restrictive use."""
    feature = to_feature(zone, "zone")
    ordered = [use for use in get_args(ZoneUse) if use in uses]
    feature["properties"]["uses"] = ordered
    feature["properties"]["style"]["color"] = _USE_COLOURS[ordered[0]]
    return feature


def to_feature(zone: Zone, kind: str, **properties: str) -> Feature:
    """Return a zone as a feature of the kind zone, operationArea or corridor."""
    feature = zone_feature(zone, [])
    # Foxglove's map panel draws a feature by its `style`.
    feature["properties"] |= {"kind": kind, "style": {"color": _COLOURS[kind], "fillOpacity": 0.15}} | properties
    return feature


def _to_zone(name: str, shape: ZoneShape) -> Zone:
    spec = ZoneSpec(area=shape.area, altitude=shape.altitude, schedule=shape.schedule)
    # Skip validation, because the name of an area need not be a valid object name.
    return Zone.model_construct(metadata=Metadata.model_construct(name=name), spec=spec)
