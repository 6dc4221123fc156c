"""Import of files as authorities and users publish them: all zones are imported exactly, or the import fails with a remedy."""

import json
from pathlib import Path

import pytest
import yaml
from click.testing import CliRunner
from fractus_cli.zones import zones as command
from fractus_core.api import InvalidObject
from fractus_core.geo import formats
from test_zone_formats import SQUARE, feature, kml

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
        ("geo-radius-string.geojson", ["properties.radius: must be 0 to 200000 metres, not '2000'"]),
        ("kml-gx.kml", ["altitudeMode: relativeToSeaFloor uses heights, which cannot be imported; clamp"]),
        ("kml-latin1.kml", ["not a UTF-8 text file"]),
        ("kml-latlonquad-hole-outside.kml", ["the hole must lie inside the exterior"]),
        ("kml-mixed.kml", ["LineString: is a line beside polygons; draw its area as a polygon, or remove it"]),
        ("kml-region-time.kml", ["weekend: has a time, which cannot be imported"]),
        ("kml-spaces.kml", ["must be lon,lat[,alt] groups"]),
        ("kml-unbound.kml", ["this is not XML (unbound prefix"]),
        ("ed269-date-only.json", ["must be a time with its zone, such as 2026-06-01T12:00:00Z, not '2026-05-01'"]),
        ("ed269-dup-id.json", ["lower must be below upper (in N1)"]),
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
    code, manifests, said = import_file(FILES / name, SOURCES[name.partition("-")[0]])
    assert (code, manifests) == (1, [])
    assert [sentence for sentence in sentences if sentence not in said] == [], said


SOURCES = {"geo": "geojson", "kml": "kml", "ed269": "ed269"}


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
        ("ed269-no-dates.json", ["m1", "m2"]),
        ("ed269-upper-absent.json", ["d1", "d2", "d3"]),
    ],
)
def test_published_file_is_imported_with_every_zone(name, titles):
    code, manifests, said = import_file(FILES / name, SOURCES[name.partition("-")[0]])
    assert code == 0, said
    assert [manifest["metadata"]["name"] for manifest in manifests] == titles


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
        (kml("<Polygon>EDGE</Polygon><Snippet>up to 120 m</Snippet>"), "Snippet: may state"),
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
