"""Import and export of Zones: GeoJSON, KML, QGroundControl plans, ED-269 and ED-318 (import only)."""

from fractus_core.geo.formats.ed269 import read_ed269, write_ed269
from fractus_core.geo.formats.ed318 import read_ed318
from fractus_core.geo.formats.geojson import read_geojson, write_geojson, zone_feature
from fractus_core.geo.formats.kml import kml_document, read_kml, write_kml, zone_placemark
from fractus_core.geo.formats.qgc_plan import read_qgc_plan, write_qgc_plan
from fractus_core.geo.formats.zone_builder import Exported, Imported, InexactFeatures

__all__ = [
    "Exported",
    "Imported",
    "InexactFeatures",
    "kml_document",
    "read_ed269",
    "read_ed318",
    "read_geojson",
    "read_kml",
    "read_qgc_plan",
    "write_ed269",
    "write_geojson",
    "write_kml",
    "write_qgc_plan",
    "zone_feature",
    "zone_placemark",
]
