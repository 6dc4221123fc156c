"""Zones and areas of Grants as map features (GeoJSON)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from fractus_core.api import Zone
from fractus_core.api.grants import GrantSpec
from fractus_core.api.model import Metadata
from fractus_core.api.policies import ZoneShape, ZoneSpec
from fractus_core.geo.formats.geojson import zone_feature

Feature = dict[str, Any]

_COLOURS = {"zone": "#d62728", "operationArea": "#2ca02c", "corridor": "#9467bd"}


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


def grant_features(specs: Iterable[GrantSpec]) -> list[Feature]:
    """Return the zones, operation areas and corridors of some Grants as features with `kind` and `component` properties."""
    specs = tuple(specs)
    zones = [to_feature(zone, "zone") for zone in zones_of(specs)]
    areas = [to_feature(area, area.name, component=spec.component) for spec in specs for area in areas_of(spec)]
    return zones + areas


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
