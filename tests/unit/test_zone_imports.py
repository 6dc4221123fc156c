"""Import of files as authorities and users publish them: all zones are imported exactly, or the import fails with a remedy."""

import json
import math
import re
import time
from pathlib import Path

import pytest
import shapely
import yaml
from click.testing import CliRunner
from fractus_cli.zones import zones as command
from fractus_core.api import InvalidObject
from fractus_core.geo import LocalFrame, area_polygon, formats
from test_zone_formats import BLOCK, ROUND, SQUARE, WRITERS, feature, kml

FILES = Path(__file__).parents[1] / "imported"


def import_file(path, source, *options):
    """Run `fractus zones import`. Return the exit code, the manifests and the text on standard error."""
    result = CliRunner().invoke(command, ["import", str(path), "--from", source, *options])
    return result.exit_code, list(yaml.safe_load_all(result.stdout)) if result.stdout else [], result.stderr


@pytest.mark.parametrize(
    ("name", "sentences"),
    [
        ("geo-circle-type.geojson", ["features[1].geometry.radius: a Zone cannot represent this field"]),
        (
            "geo-point-radius-other.geojson",
            [
                f"properties.{name}: may state the size"
                for name in ("radius_m", "Radius", "buffer_km", "radius (NM)")
            ],
        ),
        ("geo-polygon-buffer.geojson", ["properties.buffer: may state", "properties.Bufferzone: may state"]),
        ("geo-radius-string.geojson", ["properties.radius: must be above 0 and at most 200000 metres, not '2000'"]),
        ("kml-gx.kml", ["altitudeMode: relativeToSeaFloor uses heights, which cannot be imported; clamp"]),
        ("kml-kmz.kmz", ["this is a ZIP archive, such as a KMZ file; unpack it and import the file inside (doc.kml)"]),
        ("kml-latin1.kml", ["not a UTF-8 text file"]),
        ("kml-latlonquad-hole-outside.kml", ["the hole must lie inside the exterior"]),
        ("kml-mixed.kml", ["LineString: is a line beside polygons; draw its area as a polygon, or remove it"]),
        ("kml-region-time.kml", ["weekend: has a time, which cannot be imported"]),
        ("kml-spaces.kml", ["must be lon,lat[,alt] groups"]),
        ("kml-unbound.kml", ["this is not XML (unbound prefix"]),
        ("ed269-date-only.json", ["must be a time with its zone, such as 2026-06-01T12:00:00Z, not '2026-05-01'"]),
        ("ed269-dup-id.json", ["lower must be below upper (in N1, --leave-out n1-"]),
        ("ed269-fl.json", ["must be AGL or AMSL, not 'FL'; convert it", "must be M or FT, not 'FL'"]),
        ("ed269-inverted.json", ["lower must be below upper"]),
        ("ed269-local-time.json", ["must be a time of day with its zone, such as 08:00Z, not '08:00:00'"]),
        ("ed269-permanent-sched-empty.json", ["is YES although times are given; remove the times or set NO"]),
        ("ed269-permanent-since.json", ["is YES although times are given; remove the times or set NO"]),
        ("ed269-strings.json", ["lowerLimit: must be a number, not '0'"]),
        ("ed269-upper-zero.json", ["lower must be below upper"]),
    ],
)  # fmt: skip
def test_published_file_that_zones_cannot_represent_is_refused(name, sentences):
    code, manifests, said = import_file(FILES / name, SOURCES[name.partition(".")[0].partition("-")[0]])
    assert (code, manifests) == (1, [])
    assert [sentence for sentence in sentences if sentence not in said] == [], said


SOURCES = {"geo": "geojson", "kml": "kml", "ed269": "ed269", "ed318": "ed318"}


@pytest.mark.parametrize(
    ("name", "titles"),
    [
        ("geo-restriction-no.geojson", ["x"]),
        ("kml-names.kml", ["zone-a"]),
        ("kml-visibility.kml", ["a"]),
        ("ed269-24h.json", ["j1", "j2", "j3", "j4"]),
        ("ed269-excluded.json", ["q1"]),
        ("ed269-html.json", ["p1"]),
        ("ed269-low99999.json", ["b1", "b2", "b3"]),
        ("ed269-night.json", ["i1", "i2"]),
        ("ed269-no-ceiling.json", ["a1", "a2", "a3", "a4"]),
        ("ed318-name-only.json", ["t3"]),
        ("ed318.json", ["t1", "t2", "t3"]),
        ("ed269-no-dates.json", ["m1", "m2"]),
        ("ed269-upper-absent.json", ["d1", "d2", "d3"]),
    ],
)
def test_published_file_is_imported_with_every_zone(name, titles):
    code, manifests, said = import_file(FILES / name, SOURCES[name.partition(".")[0].partition("-")[0]])
    assert code == 0, said
    names = [manifest["metadata"]["name"] for manifest in manifests]
    if not name.startswith("ed"):
        names = [without_digest(name) for name in names]
    assert names == titles


def without_digest(name):
    """Return the part of a stable name that was derived from the name in the file."""
    stem, _, digest = name.rpartition("-")
    assert re.fullmatch("[0-9a-f]{10}", digest)
    return stem


FLAT = {"type": "Polygon", "coordinates": [SQUARE]}
POINT = {"type": "Point", "coordinates": [4, 50]}
LIMITS = [
    *(
        (name, 500)
        for name in (
            "radius_m", "Radius", "RADIUS_KM", "radiusNM", "diameter", "dia", "buffer", "buffer_dist", "BUFF_DIST", "r", "R_m", "size", "range",
            "distance", "clearance", "width", "halfWidth", "extent", "rayon", "Puffer", "Umkreis", "straal", "protection", "outer",
            "maxalt", "minalt", "alt_max", "altm", "ceil", "top", "zmax", "Höhe", "hauteur_max", "plafond", "upperlimit", "hgt", "fl_upper",
            "validfrom", "startdate", "dateend", "epoch", "Gültig bis",
        )
    ),
    ("note", "500 m"), ("note", "1.5NM"), ("note", "5 km around the tower"), ("note", "500"), ("note", "1'500"), ("note", "400 ft"), ("note", "FL95"),
    ("note", "GND"), ("note", "up to 150m AGL"), ("note", "08:00-16:00"), ("note", "0800-1600"), ("note", "2026-05-01"), ("note", "01.05.2026"),
    ("note", "Mon-Fri"), ("note", "H24"), ("note", "ca. 300"), ("note", "24/7"), ("note", "08-18"), ("note", "18h00"), ("note", "Mo-Fr"), ("note", "until further notice"),
    ("note", "Sector 5"), ("keepout", "wide"), ("Länge", "x"), ("note", "sunrise to sunset"), ("note", ["a", {"b": "5 km"}]), ("note", {"circle": {"value": "five"}}),
    ("ref", {"upperLimit": 120}), ("address", [{"radius": 500}]),
]  # fmt: skip


@pytest.mark.parametrize(("name", "value"), LIMITS)
@pytest.mark.parametrize("geometry", [FLAT, POINT], ids=["polygon", "point"])
def test_geojson_property_that_may_state_a_limit_is_refused_by_name(geometry, name, value):
    whole = feature(geometry, properties={"name": "a", name: value})
    with pytest.raises(InvalidObject, match="may state the size, altitude or time of the zone") as refused:
        formats.read_geojson(json.dumps(whole))
    assert refused.value.field == f"properties.{name}"
    assert "--drop" in refused.value.problem


@pytest.mark.parametrize(("name", "value"), [(name, value) for name, value in LIMITS if isinstance(value, (int, str))])
def test_kml_data_that_may_state_a_limit_is_refused_by_name(name, value):
    for data in (
        f'<Data name="{name}"><value>{value}</value></Data>',
        f'<SchemaData><SimpleData name="{name}">{value}</SimpleData></SchemaData>',
        f'<Data name="a1"><displayName>{name}</displayName><value>{value}</value></Data>',
    ):
        with pytest.raises(InvalidObject, match="may state the size, altitude or time of the zone"):
            formats.read_kml(kml(f"<Polygon>EDGE</Polygon><ExtendedData>{data}</ExtendedData>"))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("OBJECTID", 7), ("fid", 3), ("Shape__Area", 15.2), ("styleUrl", "#m"), ("visibility", -1), ("tessellate", 1), ("marker-size", "medium"),
        ("postcode", "38333"), ("website", "https://example.org/2026-01-01"), ("category", "hospital"), ("restricted", True), ("x", None),
        ("remarks", "ask the tower"), ("operator", "Town of Volos"),
    ],
)  # fmt: skip
def test_property_without_a_limit_is_noted(name, value):
    found = formats.read_geojson(json.dumps(feature(FLAT, properties={"name": "a", name: value})))
    assert len(found.zones) == 1
    assert len(found.notes) == (value is not None)


@pytest.mark.parametrize(
    ("whole", "field"),
    [
        (feature(POINT, radius=500, properties={"name": "a"}), "radius"),
        (feature(FLAT, altitude={"upper": 5}, properties={"name": "a"}), "altitude"),
        ({"type": "FeatureCollection", "features": [feature(FLAT)], "validFrom": "2026-01-01"}, "validFrom"),
        (feature(FLAT, bbox=[4, 50, 0, 5, 51, 120], properties={"name": "a"}), "bbox"),
        (feature(FLAT, properties={"name": "a", "title": "CTR, 5 km"}), "properties.title"),
    ],
)
def test_geojson_limit_outside_the_properties_is_refused(whole, field):
    with pytest.raises(InvalidObject) as refused:
        formats.read_geojson(json.dumps(whole))
    assert refused.value.field == field


OPEN = SQUARE[:3]
HALVES = [SQUARE[:3], SQUARE[2:]]


@pytest.mark.parametrize(
    "geometry",
    [
        {"type": "LineString", "coordinates": SQUARE},
        {"type": "LineString", "coordinates": [*SQUARE[:-1], [4.0003, 50.0001]]},
        {"type": "LineString", "coordinates": [[lon, lat, 30] for lon, lat in SQUARE]},
        {"type": "MultiLineString", "coordinates": HALVES},
        {"type": "GeometryCollection", "geometries": [{"type": "LineString", "coordinates": half} for half in HALVES]},
    ],
)
def test_geojson_outline_that_is_drawn_as_a_line_is_refused(geometry):
    with pytest.raises(InvalidObject, match="is a line around an area; draw the area as a polygon"):
        formats.read_geojson(json.dumps(feature(geometry, properties={"name": "a"})))


@pytest.mark.parametrize(
    "inside",
    [
        f"<LineString><coordinates>{' '.join(f'{lon},{lat}' for lon, lat in SQUARE)}</coordinates></LineString>",
        f"<LinearRing><coordinates>{' '.join(f'{lon},{lat},9' for lon, lat in SQUARE)}</coordinates></LinearRing>",
        f"<LinearRing><coordinates>{' '.join(f'{lon},{lat},9' for lon, lat in SQUARE[:-1])}</coordinates></LinearRing>",
        "<MultiGeometry>"
        + "".join(
            f"<LineString><coordinates>{' '.join(f'{lon},{lat}' for lon, lat in half)}</coordinates></LineString>"
            for half in HALVES
        )
        + "</MultiGeometry>",
    ],
)
def test_kml_outline_that_is_drawn_as_a_line_is_refused(inside):
    with pytest.raises(InvalidObject, match="is a line around an area; draw the area as a polygon"):
        formats.read_kml(kml(inside))


def test_lines_and_points_without_area_are_noted():
    lines = feature({"type": "MultiLineString", "coordinates": [OPEN]}, properties={"name": "road"})
    points = feature({"type": "MultiPoint", "coordinates": [[4, 50]]}, properties={"name": "pins"})
    found = formats.read_geojson(json.dumps({"type": "FeatureCollection", "features": [lines, points, feature(FLAT)]}))
    assert len(found.zones) == 1
    assert [note.partition(":")[0] for note in found.notes] == ["road", "pins"]
    coordinates = " ".join(f"{lon},{lat}" for lon, lat in OPEN)
    found = formats.read_kml(kml(f"<LineString><coordinates>{coordinates}</coordinates></LineString>"))
    assert found.notes == ("p: LineString is not a zone; left out",)


@pytest.mark.parametrize(
    ("geometry", "sentence"),
    [
        (None, "geometry: is missing; draw the zone, or leave the feature out"),
        ({"type": "Circle", "coordinates": [4, 50]}, "geometry.type: 'Circle' is not a geometry of GeoJSON"),
        ({"type": "CurvePolygon"}, "geometry.type: 'CurvePolygon' is not a geometry of GeoJSON"),
        (
            {"type": "GeometryCollection", "geometries": [FLAT, {"type": "LineString", "coordinates": OPEN}]},
            "geometry.geometries[1]: is a line beside polygons",
        ),
        ({"type": "LineString", "coordinates": [5]}, "geometry.coordinates: must be"),
    ],
)
def test_geojson_feature_without_an_area_that_a_zone_can_have_is_refused(geometry, sentence):
    with pytest.raises(InvalidObject) as refused:
        formats.read_geojson(json.dumps(feature(geometry, properties={"name": "a"})))
    assert str(refused.value).startswith(sentence)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (kml("<Polygon>EDGE<gx:altitudeOffset>5</gx:altitudeOffset></Polygon>"), "Polygon[0].altitudeOffset: may state"),
        (kml("<Polygon>EDGE</Polygon><radius>500</radius>"), "radius: may state"),
        (kml("<Polygon>EDGE</Polygon><Snippet>up to 120 m</Snippet><Snippet>x</Snippet>"), "Snippet: may state"),
        (kml("<Polygon>EDGE</Polygon>", '<ExtendedData><Data name="ceiling"><value>1</value></Data></ExtendedData>'), "ExtendedData.ceiling: may"),
        (kml("<Polygon>EDGE</Polygon>", "<Folder><name>f</name><description>until 2027-01-01</description></Folder>"), "description: may state"),
        (kml("<MultiGeometry><Polygon>EDGE</Polygon><Circle><radius>5</radius></Circle></MultiGeometry>"), "MultiGeometry.Circle: may"),
        (kml("<Polygon>EDGE</Polygon>", "<GroundOverlay><name>map</name></GroundOverlay>"), "map: a GroundOverlay is a picture"),
        (kml(""), "has no geometry; draw the zone as a Polygon"),
    ],
)  # fmt: skip
def test_kml_element_that_may_state_a_limit_is_refused(text, sentence):
    with pytest.raises(InvalidObject) as refused:
        formats.read_kml(text.replace("<kml>", '<kml xmlns:gx="http://www.google.com/kml/ext/2.2">'))
    assert str(refused.value).startswith(sentence)


@pytest.mark.parametrize(
    ("extra", "field"),
    [
        ({"buffer": 50}, "features[0].buffer"),
        ({"validity": "2026"}, "features[0].validity"),
        ({"extendedProperties": {"radius": 5}}, "features[0].extendedProperties.radius"),
    ],
)
def test_ed269_field_that_may_state_a_limit_is_refused_or_dropped(extra, field):
    document = json.loads((FILES / "ed269-html.json").read_text())
    document["features"][0] |= extra
    with pytest.raises(InvalidObject) as refused:
        formats.read_ed269(json.dumps(document))
    assert refused.value.field == field
    assert formats.read_ed269(json.dumps(document), drop=[field.rpartition(".")[2]]).zones


def test_ed269_conditions_of_a_restriction_are_kept_in_the_description():
    document = json.loads((FILES / "ed269-html.json").read_text())
    document["features"][0] |= {"restrictionConditions": ["below 50 m only", "by day"]}
    (zone,) = formats.read_ed269(json.dumps(document)).zones
    assert "below 50 m only, by day" in zone.spec.description


@pytest.mark.parametrize("name", ["ed318.json", "ed318-name-only.json"])
@pytest.mark.parametrize("source", ["geojson", "ed269"])
def test_ed318_file_is_recognised_in_other_formats(name, source):
    code, _, said = import_file(FILES / name, source)
    assert code == 1
    assert "--from ed318" in said


def test_ed269_limits_that_no_aircraft_reaches_count_as_no_limit():
    zones = formats.read_ed269((FILES / "ed269-no-ceiling.json").read_text())
    assert [zone.spec.altitude and zone.spec.altitude.upper for zone in zones.zones] == [None, None, None, 120]
    assert "A1: its upper limit of 99999 M AMSL counts as no limit" in zones.notes
    deep = json.loads((FILES / "ed269-no-ceiling.json").read_text())
    deep["features"][3]["geometry"][0] |= {"lowerLimit": -9999, "lowerVerticalReference": "AMSL"}
    assert formats.read_ed269(json.dumps(deep)).zones[3].spec.altitude.lower is None


def test_ed269_reads_the_list_of_either_name():
    document = json.loads((FILES / "ed269-html.json").read_text())
    published = {"formatVersion": "1.0.0", "createdAt": "2026-10-01T00:00:00Z", "UASZoneList": document["features"]}
    assert formats.read_ed269(json.dumps(published)).zones == formats.read_ed269(json.dumps(document)).zones
    with pytest.raises(InvalidObject, match="is also UASZoneList"):
        formats.read_ed269(json.dumps(published | document))


def ed318(geometry, **properties):
    """Return an ED-318 file of one feature."""
    known = {
        "identifier": "T1",
        "country": "XXX",
        "name": [{"text": "Port"}],
        "type": "PROHIBITED",
        "variant": "COMMON",
    }
    return json.dumps({"type": "FeatureCollection", "features": [feature(geometry, properties=known | properties)]})


LAYER = {"upper": 400, "upperReference": "AGL", "lower": 100, "lowerReference": "AGL", "uom": "ft"}
CIRCLE = {"subType": "Circle", "radius": 250}


def test_ed318_reads_each_geometry_with_its_own_layer():
    parts = [
        {**FLAT, "layer": LAYER},
        {"type": "MultiPolygon", "coordinates": [[SQUARE]], "layer": LAYER | {"upper": 99999, "uom": "m"}},
        {**POINT, "extent": CIRCLE},
    ]
    conditions = {"restrictionConditions": {"maxNoise": 60}, "message": [{"text": "call the tower", "lang": "en"}]}
    found = formats.read_ed318(ed318({"type": "GeometryCollection", "geometries": parts}, **conditions))
    first, second, third = (zone.spec for zone in found.zones)
    assert (first.altitude.lower, first.altitude.upper, first.altitude.reference) == (30.48, 121.92, "terrain")
    assert (second.altitude.lower, second.altitude.upper) == (100, None)
    assert (third.altitude, third.area.circle.radius) == (None, 250)
    assert first.description == "Port: PROHIBITED: maxNoise 60: call the tower"
    assert "T1: country, variant cannot be imported; left out" in found.notes


@pytest.mark.parametrize(
    ("geometry", "properties", "sentence"),
    [
        (POINT, {}, "geometry.extent.subType: must be Circle"),
        ({**POINT, "extent": {**CIRCLE, "uom": "NM"}}, {}, "geometry.extent.uom: a Zone cannot represent"),
        ({**POINT, "extent": CIRCLE | {"radius": "5"}}, {}, "geometry.extent.radius: must be above 0 and at most 200000 metres"),
        ({**FLAT, "layer": LAYER | {"uom": "FL"}}, {}, "geometry.layer.uom: must be M or FT"),
        ({**FLAT, "layer": LAYER | {"lowerReference": "WGS84"}}, {}, "geometry.layer.lowerReference: must be AGL or AMSL"),
        ({**FLAT, "layer": LAYER | {"to": 9}}, {}, "geometry.layer.to: a Zone cannot represent"),
        ({**FLAT, "layer": LAYER | {"upper": "400"}}, {}, "geometry.layer.upper: must be a number"),
        ({"type": "LineString", "coordinates": SQUARE}, {}, "geometry.type: must be a Polygon"),
        ({"type": "GeometryCollection", "geometries": []}, {}, "geometry.geometries: is empty"),
        ({"type": "GeometryCollection", "geometries": [FLAT], "layer": LAYER}, {}, "geometry.layer: a Zone cannot"),
        (None, {}, "geometry.type: must be a Polygon"),
        (FLAT, {"radius": 500}, "properties.radius: may state the size"),
        (FLAT, {"extendedProperties": {"buffer": 5}}, "properties.extendedProperties.buffer: may state the size"),
        (FLAT, {"limitedApplicability": [{"schedule": [{"day": ["ANY"], "startEvent": "SR"}]}]}, "properties.limitedApplicability[0].schedule[0].startEvent: a Zone"),
    ],
)  # fmt: skip
def test_ed318_rejects_features_a_zone_cannot_represent(geometry, properties, sentence):
    with pytest.raises(InvalidObject) as refused:
        formats.read_ed318(ed318(geometry, **properties))
    assert str(refused.value).startswith(f"features[0].{sentence}")
    assert str(refused.value).endswith(" (in T1)")


def test_import_reports_many_refused_features_of_a_large_file_in_seconds(tmp_path):
    source = tmp_path / "many.geojson"
    ring = around(60)
    many = [feature({"type": "Polygon", "coordinates": [ring]}, properties={"upperLimit": 120}) for _ in range(300)]
    source.write_text(json.dumps({"type": "FeatureCollection", "features": many}))
    start_s = time.process_time()
    code, _, said = import_file(source, "geojson")
    assert code == 1
    assert len(said.splitlines()) == 300
    assert time.process_time() - start_s < 30, "each message parsed the whole file"


def around(count, *, bend=0.0):
    """Return a ring of `count` points on a circle of 5 km. Every second point is moved inwards by the share `bend`."""
    radii = [0.05 * (1 - bend * (i % 2)) for i in range(count)]
    angles = [2 * math.pi * i / count for i in range(count)]
    ring = [[4 + r * math.cos(a), 50 + r * math.sin(a)] for r, a in zip(radii, angles, strict=True)]
    return [*ring, ring[0]]


def test_import_simplifies_a_ring_with_too_many_points_by_half_a_metre():
    ring = around(10_100)
    coordinates = " ".join(f"{lon},{lat}" for lon, lat in ring)
    edge = f"<outerBoundaryIs><LinearRing><coordinates>{coordinates}</coordinates></LinearRing></outerBoundaryIs>"
    frame = LocalFrame(50, 4)
    meant = shapely.Polygon([frame.xy(lat, lon) for lon, lat in ring])
    for found in (
        formats.read_geojson(json.dumps(feature({"type": "Polygon", "coordinates": [ring]}, id="a"))),
        formats.read_kml(kml(f"<Polygon>{edge}</Polygon>")),
    ):
        outline = area_polygon(frame, found.zones[0].spec.area)
        assert shapely.hausdorff_distance(outline.exterior, meant.exterior) < 0.51
        assert "a ring of 10101 points is simplified to" in found.notes[0]


def test_import_refuses_a_ring_that_needs_too_many_points():
    whole = feature({"type": "Polygon", "coordinates": [around(10_100, bend=0.1)]})
    with pytest.raises(InvalidObject, match="has 10100 points, more than 10000; simplify the ring, or split the area"):
        formats.read_geojson(json.dumps(whole))


def moved(shift, **more):
    """Return a feature with the square moved east, in degrees."""
    return feature({"type": "Polygon", "coordinates": [[[lon + shift, lat] for lon, lat in SQUARE]]}, **more)


def names_by_west_edge(features, **options):
    """Return the name of each zone by the longitude of its western edge, in tenths of a degree."""
    found = formats.read_geojson(json.dumps({"type": "FeatureCollection", "features": features}), **options)
    return {round(min(p.lon for p in zone.spec.area.polygon.exterior) * 10): zone.name for zone in found.zones}


@pytest.mark.parametrize("title", ["Old Town", "\u0391\u03b5\u03c1\u03bf\u03b4\u03c1\u03cc\u03bc\u03b9\u03bf", "", "5"])
def test_zone_keeps_its_name_when_the_file_changes_around_it(title):
    first, second, third = (moved(i / 10, properties={"name": title}) for i in range(3))
    names = names_by_west_edge([first, second])
    assert len(set(names.values())) == 2
    assert names_by_west_edge([second, first]) == names
    assert names_by_west_edge([third, second]) == {41: names[41], 42: names_by_west_edge([third])[42]}
    assert names_by_west_edge([first]) == {40: names[40]}
    assert names_by_west_edge([second]) == {41: names[41]}


def test_zone_name_does_not_depend_on_the_notation_of_numbers():
    rings = [[[4, 50], [4.01, 50.0], [4.01, 50.01]], [[4.0, 50.00000001], [4.01, 50], [4.0100000, 50.01]]]
    first, second = ({"type": "Polygon", "coordinates": [ring]} for ring in rings)
    assert [formats.read_geojson(json.dumps(feature(g))).zones[0].name for g in (first, second)] == [
        formats.read_geojson(json.dumps(feature(first))).zones[0].name
    ] * 2


def test_identifier_of_an_authority_is_the_name_of_its_zone_wherever_it_moves():
    document = json.loads((FILES / "ed318.json").read_text())
    document["features"].reverse()
    document["features"][0]["geometry"]["coordinates"] = [SQUARE]
    assert [zone.name for zone in formats.read_ed318(json.dumps(document)).zones] == ["t3", "t2", "t1"]
    named = formats.read_geojson(json.dumps(moved(1, properties={"identifier": "LGBL-7", "name": "x"}))).zones
    assert [zone.name for zone in named] == ["lgbl-7"]


def test_identifiers_that_differ_in_separators_only_get_different_stable_names():
    first, second = (moved(i, properties={"identifier": text, "name": "x"}) for i, text in enumerate(["A/1", "A-1"]))
    names = names_by_west_edge([first, second])
    assert names[50] == "a-1"
    assert names[40].startswith("a-1-")
    assert names_by_west_edge([first]) == {40: names[40]}


def test_given_name_is_kept_in_an_annotation(tmp_path):
    source = tmp_path / "a.geojson"
    source.write_text(json.dumps(moved(0, properties={"name": "\u00c9cole N\u00ba 5"})))
    _, (manifest,), _ = import_file(source, "geojson")
    assert manifest["metadata"]["annotations"] == {"fractus.dev/imported-name": "\u00c9cole N\u00ba 5"}
    for name in ("ed269-html.json", "kml-names.kml"):
        _, (manifest,), _ = import_file(FILES / name, SOURCES[name.partition("-")[0]])
        assert manifest["metadata"]["annotations"]


def test_one_bad_part_of_a_multipolygon_is_left_out_by_its_stable_name(tmp_path):
    bow = [SQUARE[0], SQUARE[2], SQUARE[1], SQUARE[3], SQUARE[0]]
    squares = [[[[lon + i, lat] for lon, lat in SQUARE]] for i in range(2)]
    whole = feature({"type": "MultiPolygon", "coordinates": [squares[0], [bow], squares[1]]}, properties={"name": "P"})
    source = tmp_path / "a.geojson"
    source.write_text(json.dumps(whole))
    code, _, said = import_file(source, "geojson")
    assert code == 1
    (line,) = said.splitlines()
    assert "geometry.coordinates[1]: polygon.exterior: the ring crosses itself" in line
    name = re.search(r"\(in P, --leave-out (p-[0-9a-f]{10})\)", line)[1]
    code, manifests, said = import_file(source, "geojson", "--leave-out", name)
    assert (code, len(manifests)) == (0, 2)
    assert f"P ({name}): left out as requested" in said


def test_feature_is_left_out_by_its_stable_name_or_its_title():
    first, second = (moved(i / 10, properties={"name": "Old Town"}) for i in range(2))
    names = names_by_west_edge([first, second])
    assert names_by_west_edge([first, second], without=[names[40]]) == {41: names[41]}
    with pytest.raises(InvalidObject, match="there is no feature old-town to leave out"):
        names_by_west_edge([first, second], without=["old-town"])


def test_zones_with_the_same_area_differ_in_altitude_or_times():
    monday = [{"days": ["Mon"]}]
    variants = [
        {"altitude": {"upper": 50}},
        {"altitude": {"upper": 90}},
        {"altitude": {"upper": 90}, "schedule": monday},
    ]
    features = [moved(0, properties={"name": "a", **variant}) for variant in (*variants, variants[0])]
    found = formats.read_geojson(json.dumps({"type": "FeatureCollection", "features": features}))
    assert len({zone.name for zone in found.zones}) == len(found.zones) == 3
    assert found.notes == ("a: occurs twice with the same area, altitude and times; imported once",)


def test_many_features_of_one_name_are_named_in_seconds():
    features = [moved(i / 1000, properties={"name": "school"}) for i in range(3000)]
    start_s = time.process_time()
    found = formats.read_geojson(json.dumps({"type": "FeatureCollection", "features": features}))
    assert len({zone.name for zone in found.zones}) == 3000
    assert time.process_time() - start_s < 30


def test_zone_whose_identifier_is_the_stable_name_of_another_is_not_lost():
    first, other = moved(0, properties={"name": "a"}), moved(1, properties={"name": "a"})
    whole = {"type": "FeatureCollection", "features": [first, other]}
    stable = formats.read_geojson(json.dumps(whole)).zones[0].name
    clash = moved(2, properties={"identifier": stable})
    found = formats.read_geojson(json.dumps({"type": "FeatureCollection", "features": [first, other, clash]}))
    assert len({zone.name for zone in found.zones}) == 3


@pytest.mark.parametrize("name", ["geojson", "kml"])
def test_exported_zone_keeps_its_name_when_it_is_imported_again(name):
    write, read = WRITERS[name]
    assert {zone.name for zone in read(write([BLOCK, ROUND]).text).zones} == {"block", "round"}


def test_ed269_export_gives_a_zone_the_same_identifier_in_every_file():
    exported = [json.loads(formats.write_ed269(zones).text)["features"] for zones in ([BLOCK, ROUND], [ROUND])]
    assert exported[0][1]["identifier"] == exported[1][0]["identifier"]
    assert re.fullmatch("[0-9A-Z]{7}", exported[1][0]["identifier"])


@pytest.mark.parametrize("odd", [{}, [], 5, None, True])
def test_value_of_another_type_is_refused_with_a_sentence(odd):
    circle = {"type": odd, "center": [4.0, 50.0], "radius": 500}
    volume = {"upperLimit": 5, "upperVerticalReference": odd, "horizontalProjection": circle}
    crs = {"crs": {"properties": {"name": odd or [1]}}}
    files = [
        (formats.read_geojson, {"type": odd}),
        (formats.read_geojson, feature({"type": odd, "coordinates": SQUARE})),
        (formats.read_geojson, feature({"type": "GeometryCollection", "geometries": [FLAT, {"type": odd}]})),
        (formats.read_geojson, feature(FLAT) | crs),
        (formats.read_ed269, {"features": [{"geometry": [volume]}]}),
        (formats.read_ed269, {"features": [{"geometry": [volume | {"upperVerticalReference": "AGL"}]}]}),
        (formats.read_ed318, json.loads(ed318({**FLAT, "layer": LAYER | {"lowerReference": odd}}))),
        (formats.read_ed318, json.loads(ed318({"type": odd}))),
    ]
    for read, document in files:
        with pytest.raises(InvalidObject):
            read(json.dumps(document))


@pytest.mark.parametrize(
    "around",
    [
        '<Snippet maxLines="0"/>',
        "<ScreenOverlay><name>legend</name><overlayXY x='0' y='1'/></ScreenOverlay>",
        '<Style id="s1"><LineStyle><width>2</width></LineStyle></Style>',
        '<Schema name="s"><SimpleField type="int" name="radius"/></Schema>',
    ],
)
def test_kml_elements_for_the_display_do_not_refuse_a_file(around):
    assert len(formats.read_kml(kml("<Polygon>EDGE</Polygon>", around)).zones) == 1
    assert len(formats.read_kml(kml("<Snippet maxLines='2'>x</Snippet><Polygon>EDGE</Polygon>")).zones) == 1


def test_qgc_plan_with_an_unknown_part_is_refused():
    with pytest.raises(InvalidObject, match="corridors: a Zone cannot represent this field"):
        formats.read_qgc_plan(json.dumps({"fileType": "Plan", "corridors": [{"width": 50}]}))
