"""Import of foreign KML files and QGroundControl plans, and features that a Zone cannot represent."""

import json

import pytest
from fractus_core.api import InvalidObject
from fractus_core.geo import area_center, formats
from test_zone_formats import HOLE, ROUND, SQUARE, kml


def test_kml_reads_foreign_file():
    ring = " ".join(f"{lon},{lat},30" for lon, lat in SQUARE)
    text = f"""<?xml version="1.0" encoding="UTF-8"?><kml xmlns="http://www.opengis.net/kml/2.2"><Document><Folder>
    <Placemark><name>School &amp; yard</name><description>no pictures</description><ExtendedData><Data name="owner"><value>x</value></Data></ExtendedData><styleUrl/><Polygon>
    <altitudeMode>clampToGround</altitudeMode><outerBoundaryIs><LinearRing><coordinates>{ring}</coordinates></LinearRing></outerBoundaryIs></Polygon></Placemark>
    <Placemark><name>pin</name><Point><coordinates>4,50</coordinates></Point></Placemark></Folder></Document></kml>"""
    found = formats.read_kml(text)
    (zone,) = found.zones
    assert (zone.name.rpartition("-")[0], zone.spec.description) == ("school-yard", "no pictures")
    assert len(found.zones[0].spec.area.polygon.exterior) == 4
    assert found.notes == (
        "School & yard: properties owner cannot be imported; left out",
        "pin: Point is not a zone; left out",
    )


def test_qgc_plan_reads_foreign_file():
    fence = {
        "version": 2,
        "polygons": [{"inclusion": True, "version": 1, "polygon": [[lat, lon] for lon, lat in SQUARE[:-1]]}],
        "circles": [{"inclusion": False, "version": 1, "circle": {"center": [50.0, 4.0], "radius": 100}}],
    }
    plan = {"fileType": "Plan", "geoFence": fence, "mission": {"items": [{}]}, "rallyPoints": {"points": [[1, 2, 3]]}}
    found = formats.read_qgc_plan(json.dumps(plan))
    assert [z.name.rpartition("-")[0] for z in found.zones] == ["inclusion-polygon", "exclusion-circle"]
    assert area_center(found.zones[1].spec.area).lat == 50.0
    assert len(found.notes) == 4
    assert (
        json.loads(formats.write_qgc_plan([ROUND], inclusion=True).text)["geoFence"]["circles"][0]["inclusion"] is True
    )


def test_kml_imports_all_holes_and_polygons_of_a_multigeometry():
    rings = [[[lon + shift, lat] for lon, lat in HOLE] for shift in (0, -0.003)]
    texts = [
        f"<LinearRing><coordinates>{' '.join(f'{x},{y},99' for x, y in r)}</coordinates></LinearRing>" for r in rings
    ]
    both = f"<Polygon>EDGE<innerBoundaryIs>{''.join(texts)}</innerBoundaryIs></Polygon>"
    imported = formats.read_kml(
        kml(f"<MultiGeometry>{both}<MultiGeometry><Polygon>EDGE</Polygon></MultiGeometry></MultiGeometry>")
    )
    assert [len(z.spec.area.polygon.holes) for z in imported.zones] == [2, 0]
    assert imported.notes == ()


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            kml("<Polygon><altitudeMode>absolute</altitudeMode>EDGE</Polygon>"),
            "Polygon[0].altitudeMode: absolute uses heights",
        ),
        (
            kml("<TimeSpan><begin>2026</begin></TimeSpan><Polygon>EDGE</Polygon>"),
            "has a time, which cannot be imported",
        ),
        (kml("<Polygon>EDGE</Polygon>", "<Folder><name>f</name><TimeStamp/></Folder>"), "f: has a time, which"),
        (
            kml("<Polygon>EDGE</Polygon>", "<NetworkLink><name>n</name></NetworkLink>"),
            "n: a NetworkLink refers to another file",
        ),
        (
            kml("<Polygon>EDGEEDGE</Polygon>"),
            "Polygon[0].outerBoundaryIs: a polygon must have exactly one outer boundary",
        ),
        (kml("<Polygon/>"), "Polygon[0].outerBoundaryIs: a polygon must have exactly one outer boundary"),
    ],
)
def test_kml_rejects_placemarks_a_zone_cannot_represent(text, sentence):
    with pytest.raises(InvalidObject) as refused:
        formats.read_kml(text)
    assert str(refused.value).startswith(sentence)


@pytest.mark.parametrize(
    ("fence", "sentence"),
    [
        ({"polygons": [{"polygon": SQUARE}]}, "geoFence.polygons[0].inclusion: must be true or false, not None"),
        (
            {"polygons": [{"polygon": SQUARE, "inclusion": True, "maxAltitude": 50}]},
            "geoFence.polygons[0].maxAltitude: a Zone cannot represent",
        ),
        ({"polygons": [{"polygon": [[1, 2, 3]], "inclusion": True}]}, "geoFence.polygons[0].polygon[0]: has a height"),
        (
            {"circles": [{"circle": {"center": [1, 2], "radius": 3, "units": "ft"}, "inclusion": True}]},
            "geoFence.circles[0].circle.units: a Zone cannot represent this field",
        ),
        ({"corridors": [1]}, "geoFence.corridors: a Zone cannot represent this field"),
    ],
)
def test_qgc_plan_rejects_shapes_a_zone_cannot_represent(fence, sentence):
    with pytest.raises(InvalidObject) as refused:
        formats.read_qgc_plan(json.dumps({"fileType": "Plan", "geoFence": {"version": 2, **fence}}))
    assert str(refused.value).startswith(sentence)
