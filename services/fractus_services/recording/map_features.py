"""The zones and areas of grants, as Zones and as features of a map."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from fractus_core.api import Zone
from fractus_core.api.model import Metadata
from fractus_core.api.plans import GrantSpec
from fractus_core.api.policies import ZoneShape, ZoneSpec
from fractus_core.geo.formats.geojson import zone_feature

Feature = dict[str, Any]

_COLOURS = {"zone": "#d62728", "operationArea": "#2ca02c", "corridor": "#9467bd"}


def zones_of(specs: Iterable[GrantSpec]) -> list[Zone]:
    """The zones of the policies in some grants, each once, by name."""
    found: dict[str, ZoneShape] = {
        zone.name: zone for spec in specs for policy in spec.policies for zone in policy.zones
    }
    return [_zone(name, shape) for name, shape in sorted(found.items())]


def areas_of(spec: GrantSpec) -> list[Zone]:
    """Where a grant lets the drone be, in the shape of Zones."""
    said = (("operationArea", spec.operation_area), ("corridor", spec.corridor))
    return [_zone(kind, ZoneShape(area=area)) for kind, areas in said for area in areas]


def features(specs: Iterable[GrantSpec]) -> list[Feature]:
    """What some grants say of the map: zones, operation areas and corridors; `kind` and `component` say which."""
    specs = tuple(specs)
    zones = [placed(zone, "zone") for zone in zones_of(specs)]
    return zones + [placed(area, area.name, component=spec.component) for spec in specs for area in areas_of(spec)]


def placed(zone: Zone, kind: str, **more: str) -> Feature:
    """A zone as a feature of some kind: zone, operationArea or corridor."""
    feature = zone_feature(zone, [])
    # Foxglove's map draws a feature by its `style`.
    feature["properties"] |= {"kind": kind, "style": {"color": _COLOURS[kind], "fillOpacity": 0.15}} | more
    return feature


def _zone(name: str, shape: ZoneShape) -> Zone:
    spec = ZoneSpec(area=shape.area, altitude=shape.altitude, schedule=shape.schedule)
    # What an area is called is no name of an object, and is not checked as one.
    return Zone.model_construct(metadata=Metadata.model_construct(name=name), spec=spec)
