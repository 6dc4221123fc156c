"""Import and export of zones as GeoJSON, KML, QGroundControl plans and ED-269. A note reports each omitted part."""

import json
import re

import pytest
import shapely
import yaml
from click.testing import CliRunner
from fractus_cli.zones import zones as command
from fractus_core.api import InvalidObject, Zone
from fractus_core.geo import LocalFrame, area_center, area_polygon, formats
from fractus_core.geo.formats import zone_builder
from test_planning import manifest

SQUARE = [[4.0, 50.0], [4.01, 50.0], [4.01, 50.01], [4.0, 50.01], [4.0, 50.0]]
HOLE = [[4.004, 50.004], [4.006, 50.004], [4.006, 50.006], [4.004, 50.004]]


def points(ring):
    return [{"lat": lat, "lon": lon} for lon, lat in ring[:-1]]


def zone(name, area, **more):
    return Zone.from_body(manifest("Zone", name, {"area": area, **more}))


BLOCK = zone(
    "block",
    {"polygon": {"exterior": points(SQUARE), "holes": [points(HOLE)]}},
    altitude={"lower": 10, "upper": 50, "reference": "amsl"},
    schedule=[{"days": ["Mon", "Tue"], "start": "08:00", "end": "17:30", "validFrom": "2026-01-01T00:00:00Z"}],
    description="a block",
)
ROUND = zone("round", {"circle": {"center": {"lat": 50.0, "lon": 4.0}, "radius": 300}})
WRITERS = {
    "geojson": (formats.write_geojson, formats.read_geojson),
    "kml": (formats.write_kml, formats.read_kml),
    "qgc-plan": (formats.write_qgc_plan, formats.read_qgc_plan),
    "ed269": (formats.write_ed269, formats.read_ed269),
}


def shape(spec):
    return area_polygon(LocalFrame(50.0, 4.0), spec.area)


def kml(inside, around=""):
    ring = " ".join(f"{lon},{lat}" for lon, lat in SQUARE)
    edge = f"<outerBoundaryIs><LinearRing><coordinates>{ring}</coordinates></LinearRing></outerBoundaryIs>"
    return (
        f"<kml><Document>{around}<Placemark><name>p</name>{inside.replace('EDGE', edge)}</Placemark></Document></kml>"
    )


@pytest.mark.parametrize("name", WRITERS)
def test_zone_areas_survive_export_and_import(name):
    write, read = WRITERS[name]
    read_back = read(write([BLOCK, ROUND]).text).zones
    assert len(read_back) == 2
    block, disc = sorted(read_back, key=lambda z: -shape(z.spec).area)
    if name == "qgc-plan":
        assert shape(block.spec).area == pytest.approx(
            area_polygon(LocalFrame(50, 4), zone("x", {"polygon": {"exterior": points(SQUARE)}}).spec.area).area
        )
    else:
        assert shape(block.spec).symmetric_difference(shape(BLOCK.spec)).area < 1e-3 * shape(BLOCK.spec).area
    assert shape(disc.spec).area == pytest.approx(shape(ROUND.spec).area, rel=3e-3)
    assert shape(disc.spec).buffer(0.01).covers(shape(ROUND.spec).buffer(-0.2)), (
        "the polygon is never smaller than the circle"
    )


@pytest.mark.parametrize(
    ("name", "sentences"),
    [
        ("geojson", ["round: the circle is written as a polygon of 64 corners around it"]),
        ("kml", ["block: the format has no altitude and no schedule; left out", "round: the circle is written as"]),
        ("qgc-plan", ["block: the format has no altitude and no schedule and no holes; left out"]),
        ("ed269", ["every zone: zoneAuthority is unknown"]),
    ],
)
def test_export_notes_parts_that_the_format_cannot_represent(name, sentences):
    notes = WRITERS[name][0]([BLOCK, ROUND]).notes
    assert len(notes) == len(sentences)
    assert all(note.startswith(sentence) for note, sentence in zip(notes, sentences, strict=True))


def test_geojson_keeps_altitude_and_schedule():
    read_back = formats.read_geojson(formats.write_geojson([BLOCK]).text)
    assert read_back.notes == ()
    assert read_back.zones[0].spec == BLOCK.spec


def test_ed269_keeps_altitude_schedule_and_circles():
    read_back = formats.read_ed269(formats.write_ed269([BLOCK, ROUND]).text).zones
    assert read_back[0].spec.altitude == BLOCK.spec.altitude
    assert read_back[0].spec.schedule == BLOCK.spec.schedule
    assert read_back[1].spec.area == ROUND.spec.area


def feature(geometry, **more):
    return {"type": "Feature", "geometry": geometry, **more}


def test_geojson_reads_foreign_file():
    features = [
        feature(
            {"type": "MultiPolygon", "coordinates": [[SQUARE], [[[lon + 1, lat] for lon, lat in SQUARE]]]},
            properties={"name": "Old Town", "owner": "x", "fill": "#fff"},
        ),
        feature({"type": "Point", "coordinates": [4, 50]}, properties={"name": "Old Town", "radius": 20}),
        feature({"type": "LineString", "coordinates": SQUARE[:3]}, properties={"title": "road"}),
    ]
    imported = formats.read_geojson(json.dumps({"type": "FeatureCollection", "features": features}))
    assert [z.name.rpartition("-")[0] for z in imported.zones] == ["old-town"] * 3
    assert imported.zones[2].spec.area.circle.radius == 20
    assert imported.notes == (
        "Old Town: properties owner cannot be imported; left out",
        "road: a geometry of type LineString is not a zone; left out",
    )


def test_geojson_is_cut_at_the_antimeridian():
    across = zone("a", {"circle": {"center": {"lat": 10.0, "lon": 180.0}, "radius": 500}})
    written = formats.write_geojson([across])
    geometry = json.loads(written.text)["features"][0]["geometry"]
    assert geometry["type"] == "MultiPolygon"
    for (ring,) in geometry["coordinates"]:
        assert max(lon for lon, _ in ring) - min(lon for lon, _ in ring) < 0.01
    assert written.notes[1] == "a: it crosses the antimeridian and is cut there, into parts"
    assert len(formats.read_geojson(written.text).zones) == 2


@pytest.mark.parametrize("name", ["geojson", "ed269", "kml"])
def test_polygons_across_the_antimeridian_survive_the_round_trip_in_parts(name):
    corners = [[179.99, -17.0], [-179.98, -17.0], [-179.98, -16.99], [179.99, -16.99], [179.99, -17.0]]
    across = zone("a", {"polygon": {"exterior": points(corners)}}, altitude={"upper": 50, "reference": "amsl"})
    write, read = WRITERS[name]
    written = write([across])
    assert "a: it crosses the antimeridian and is cut there, into parts" in written.notes
    frame = LocalFrame(-17.0, 180.0)
    parts = [area_polygon(frame, z.spec.area) for z in read(written.text).zones]
    assert len(parts) == 2
    whole = area_polygon(frame, across.spec.area)
    assert shapely.union_all(parts).symmetric_difference(whole).area < 1e-4 * whole.area


AROUND_POLE = zone("n", {"polygon": {"exterior": [{"lat": 89.9995, "lon": lon} for lon in (0, 90, 180, -90)]}})


@pytest.mark.parametrize("name", ["geojson", "ed269"])
def test_export_refuses_a_polygon_around_a_pole_that_an_import_would_refuse(name):
    with pytest.raises(
        InvalidObject, match=r"n: spec\.area: contains a pole, around which .* has no polygon; export it"
    ):
        WRITERS[name][0]([AROUND_POLE])


@pytest.mark.parametrize("lat", [90.0, -90.0, 89.9999, 89.9995, -89.9992])
@pytest.mark.parametrize("radius", [5, 50, 500])
@pytest.mark.parametrize("name", WRITERS)
def test_zone_near_a_pole_that_is_exported_can_be_imported(name, lat, radius):
    write, read = WRITERS[name]
    near = zone("n", {"circle": {"center": {"lat": lat, "lon": 179.99}, "radius": radius}})
    try:
        text = write([near]).text
    except InvalidObject:
        return
    frame = LocalFrame(lat, 0.0)
    parts = [area_polygon(frame, z.spec.area) for z in read(text).zones]
    meant = area_polygon(frame, near.spec.area)
    assert shapely.union_all(parts).symmetric_difference(meant).area < 0.01 * meant.area


@pytest.mark.parametrize("name", ["geojson", "ed269"])
@pytest.mark.parametrize(
    "corners",
    [
        [(50, 4), (50, 6), (50.5, 6), (50.5, 4)],
        [(-60, 179), (-60, -179), (-60.5, -179), (-60.5, 179)],
        [(89.9994, 20), (89.9994, 160), (89.9994, 90)],
        [(89.9994, 110), (89.9994, -110), (89.9994, 180)],
    ],
)
def test_long_sides_survive_export_and_import(name, corners):
    """The middle of a side of 140 km is 470 m beside its parallel."""
    large = zone("n", {"polygon": {"exterior": [{"lat": lat, "lon": lon} for lat, lon in corners]}})
    write, read = WRITERS[name]
    frame = LocalFrame.at(area_center(large.spec.area))
    parts = [area_polygon(frame, z.spec.area) for z in read(write([large]).text).zones]
    meant = area_polygon(frame, large.spec.area)
    assert shapely.union_all(parts).symmetric_difference(meant).area < 0.6 * meant.length
    assert shapely.union_all(parts).symmetric_difference(meant).area < 0.01 * meant.area


def test_qgc_plan_export_notes_polygons_across_the_antimeridian():
    corners = [{"lat": lat, "lon": lon} for lat, lon in ((1, 179.99), (1, -179.99), (1.01, -179.99))]
    notes = formats.write_qgc_plan([zone("a", {"polygon": {"exterior": corners}})]).notes
    assert notes == ("a: it crosses the antimeridian; QGroundControl draws it around the world",)


HIGH = {"type": "Polygon", "coordinates": [[[lon, lat, 30] for lon, lat in SQUARE]]}
FLAT = {"type": "Polygon", "coordinates": [SQUARE]}


def test_geojson_accepts_wgs84_and_ignores_heights_with_an_altitude_property():
    named = {"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}
    whole = feature(HIGH, id="a", properties={"altitude": {"upper": 30, "reference": "terrain"}}) | {"crs": named}
    imported = formats.read_geojson("\ufeff" + json.dumps(whole))
    assert imported.zones[0].spec.altitude.upper == 30
    assert imported.notes == ("a: heights of its points are ignored; properties.altitude is used",)


def test_geojson_imports_every_polygon_of_a_collection():
    parts = [
        FLAT,
        {"type": "GeometryCollection", "geometries": [{"type": "MultiPolygon", "coordinates": [[HOLE], [SQUARE[:3]]]}]},
    ]
    collection = {"type": "GeometryCollection", "geometries": [*parts, {"type": "Point", "coordinates": [4, 50]}]}
    for whole in (feature(collection, id="a"), collection):
        imported = formats.read_geojson(json.dumps(whole))
        assert len(imported.zones) == 3
        assert len(imported.notes) == 1


def test_geojson_adds_points_along_parallels():
    """A straight side of 140 km deviates from its parallel by 470 m in the middle.

    The imported zone follows the parallel with a deviation below half a metre.
    """
    wide = [[4, 50], [6, 50], [6, 50.5], [4, 50.5], [4, 50]]
    (imported,) = formats.read_geojson(json.dumps(feature({"type": "Polygon", "coordinates": [wide]}))).zones
    frame = LocalFrame.at(area_center(imported.spec.area))
    shape = area_polygon(frame, imported.spec.area)
    for i in range(1, 200):
        for lat in (50, 50.5):
            along = shapely.Point(frame.xy(lat, 4 + i / 100))
            assert shape.exterior.distance(along) < 0.6
    assert len(imported.spec.area.polygon.exterior) < 100


LAMBERT = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::31370"}}


@pytest.mark.parametrize(
    ("whole", "sentence"),
    [
        (feature(FLAT) | {"crs": LAMBERT}, "crs: must be WGS 84, not urn:ogc:def:crs:EPSG::31370; convert the file"),
        (feature(FLAT) | {"crs": {"type": "link"}}, "crs: must be WGS 84, not an unnamed one"),
        (feature(FLAT | {"crs": LAMBERT}), "geometry.crs: must be WGS 84"),
        (
            {"type": "FeatureCollection", "features": [feature(FLAT) | {"crs": LAMBERT}]},
            "features[0].crs: must be WGS 84",
        ),
        (feature(HIGH), "geometry.coordinates[0][0]: has a height; remove the heights"),
        (feature(FLAT | {"layer": {"upper": 50}}), "geometry.layer: a Zone cannot represent this field"),
        (
            feature({"type": "Point", "coordinates": [4, 50], "extent": {"radius": 5}}),
            "geometry.extent: a Zone cannot represent this field",
        ),
        (
            feature({"type": "LineString", "coordinates": SQUARE}, properties={"radius": 5}),
            "properties.radius: is valid for a Point only",
        ),
        (feature(FLAT, properties={"altitude": 0}), "geometry: altitude: must be an object with named fields"),
        (
            feature(FLAT, properties={"altitude": {"upper": "50"}}),
            "geometry: altitude.upper: must be a number, not '50'",
        ),
        (
            {"type": "FeatureCollection", "features": [{"type": "FeatureCollection", "features": [feature(FLAT)]}]},
            "features[0].type: must be Feature, not 'FeatureCollection'",
        ),
        (
            feature({"type": "Polygon", "coordinates": [[[179, 0], [-179, 0], [-179, 1], [179, 1]]]}),
            "geometry.coordinates[0]: crosses the antimeridian; cut it there",
        ),
        (
            feature({"type": "Polygon", "coordinates": [[[i % 2 * 170, 60 + i / 100] for i in range(1000)]]}),
            "geometry.coordinates[0]: has sides so long that they need more than 10000 points; split it",
        ),
    ],
)
def test_geojson_rejects_features_a_zone_cannot_represent(whole, sentence):
    with pytest.raises(InvalidObject) as refused:
        formats.read_geojson(json.dumps(whole))
    assert str(refused.value).startswith(sentence)


def test_import_reports_every_rejected_feature_and_can_leave_it_out(tmp_path):
    features = [
        feature(geometry, properties={"name": name})
        for name, geometry in (("a", HIGH), ("b", FLAT), ("c", FLAT | {"layer": 1}))
    ]
    source = tmp_path / "town.geojson"
    source.write_text(json.dumps({"type": "FeatureCollection", "features": features}, indent=1))
    refused = CliRunner().invoke(command, ["import", str(source), "--from", "geojson"])
    assert refused.exit_code == 1
    assert refused.stdout == ""
    first, second = refused.stderr.splitlines()
    assert re.search(
        r"town.geojson:[1-9][0-9]*: features\[0\].geometry.coordinates\[0\]\[0\]: has a height.* \(in a\)", first
    )
    assert re.search(r"town.geojson:[1-9][0-9]*: features\[2\].geometry.layer: .* \(in c\)", second)
    without = ["--leave-out", "a", "--leave-out", "c"]
    imported = CliRunner().invoke(command, ["import", str(source), "--from", "geojson", *without])
    (manifest,) = yaml.safe_load_all(imported.stdout)
    assert manifest["metadata"]["annotations"] == {"fractus.dev/imported-name": "b"}
    assert "a: left out as requested" in imported.stderr
    lost = CliRunner().invoke(command, ["import", str(source), "--from", "geojson", *without, "--leave-out", "d"])
    assert "there is no feature d to leave out; correct its name" in lost.stderr


@pytest.mark.parametrize(
    "name",
    [
        "upperLimit",
        "LOWER_LIMIT",
        "maxHeight",
        "height_agl",
        "ceiling",
        "Floor",
        "validFrom",
        "end_date",
        "activeHours",
        "FL",
        "Altitude",
    ],
)
def test_import_rejects_properties_that_may_state_altitude_or_time(name, tmp_path):
    sentence = "may state the size, altitude or time of the zone"
    text = json.dumps(feature(FLAT, properties={"name": "a", "owner": "x", name: 120}))
    with pytest.raises(InvalidObject, match=sentence) as refused:
        formats.read_geojson(text)
    assert refused.value.field == f"properties.{name}"
    dropped = formats.read_geojson(text, drop=[name])
    assert dropped.notes == (f"a: properties {', '.join(sorted([name, 'owner']))} cannot be imported; left out",)
    assert formats.read_geojson(text.replace("120", "null")).zones == dropped.zones
    data = f'<ExtendedData><Data name="{name}"><value>120</value></Data></ExtendedData>'
    with pytest.raises(InvalidObject, match=sentence):
        formats.read_kml(kml(f"<Polygon>EDGE</Polygon>{data}"))
    assert formats.read_kml(kml(f"<Polygon>EDGE</Polygon>{data}"), drop=[name]).zones
    source = tmp_path / "town.geojson"
    source.write_text(text)
    result = CliRunner().invoke(command, ["import", str(source), "--from", "geojson"])
    assert (result.exit_code, sentence in result.stderr) == (1, True)
    assert CliRunner().invoke(command, ["import", str(source), "--from", "geojson", "--drop", name]).exit_code == 0


@pytest.mark.parametrize("name", ["owner", "kind", "fromage", "timer", "status", "id", "restriction"])
def test_import_notes_other_properties(name):
    imported = formats.read_geojson(json.dumps(feature(FLAT, properties={"name": "a", name: "x"})))
    assert imported.notes == (f"a: properties {name} cannot be imported; left out",)


def test_import_rejects_unknown_properties_to_drop(tmp_path):
    with pytest.raises(InvalidObject, match="there is no property ceiling to drop; correct its name"):
        formats.read_geojson(json.dumps(feature(FLAT)), drop=["ceiling"])
    source = tmp_path / "a.json"
    source.write_text("{}")
    refused = CliRunner().invoke(command, ["import", str(source), "--from", "qgc-plan", "--drop", "ceiling"])
    assert "--drop requires --from geojson, kml, ed269" in refused.stderr


def test_import_limits_the_points_of_a_file(monkeypatch):
    long = [[-179, 60], [179, 60], [179, 70], [-179, 70]]
    around = [[[x / 2 - 80, y] for x, y in long]]
    polygon = feature({"type": "Polygon", "coordinates": around})
    count = len(formats.read_geojson(json.dumps(polygon)).zones[0].spec.area.polygon.exterior)
    assert count > 100 * len(long)
    monkeypatch.setattr(zone_builder, "MAX_POINTS", 3 * count)
    collection = {"type": "FeatureCollection", "features": [polygon | {"properties": {"name": n}} for n in "abc"]}
    assert len(formats.read_geojson(json.dumps(collection)).zones) == 3
    holes = feature({"type": "Polygon", "coordinates": around * 4})
    for more in (collection | {"features": [polygon] * 1000}, collection | {"features": [holes, polygon]}):
        with pytest.raises(InvalidObject, match=f"the file needs more than {3 * count} points") as refused:
            formats.read_geojson(json.dumps(more))
        assert not isinstance(refused.value, formats.InexactFeatures), "the file is not read further"


def test_import_rejects_duplicate_keys():
    with pytest.raises(InvalidObject, match="line 1: type is also defined on line 1"):
        formats.read_geojson('{"type": "Feature", "type": "FeatureCollection"}')


@pytest.mark.parametrize(
    ("read", "text", "sentence"),
    [
        (formats.read_geojson, "{", "line 1: invalid JSON"),
        (formats.read_geojson, '{"type": "Topology"}', "type: 'Topology' is not GeoJSON"),
        (
            formats.read_geojson,
            json.dumps(feature({"type": "Polygon", "coordinates": [[[4, 500], [4, 5], [5, 5]]]})),
            "geometry.coordinates[0][0]: 4, 500 is not a place on Earth; the order is lon, lat",
        ),
        (
            formats.read_geojson,
            json.dumps(
                feature({"type": "Polygon", "coordinates": [[SQUARE[0], SQUARE[2], SQUARE[1], SQUARE[3]]]}, id="bow")
            ),
            "geometry: polygon.exterior: the ring crosses itself",
        ),
        (formats.read_kml, "<kml", "this is not XML"),
        (formats.read_kml, '<!DOCTYPE kml [<!ENTITY a "b">]><kml/>', "a KML file must not declare entities"),
        (formats.read_qgc_plan, '{"fileType": "Mission"}', "fileType: must be Plan"),
        (formats.read_qgc_plan, '{"fileType": "Plan", "geoFence": {"version": 1}}', "geoFence.version: must be 2"),
        (formats.read_ed269, "{}", "features: is missing"),
        (
            formats.read_ed269,
            '{"features": [{"geometry": [{"horizontalProjection": {"type": "Blob"}}]}]}',
            "features[0].geometry[0].horizontalProjection.type: must be Polygon or Circle",
        ),
        pytest.param(
            formats.read_geojson, '{"type":' * 100_000, "lists or objects are nested deeper than 100 levels", id="deep"
        ),
        pytest.param(formats.read_geojson, "1" * 5000, "line 1: a number has more than 300 digits", id="digits"),
        (
            formats.read_geojson,
            json.dumps(feature(None, properties=[1])),
            "properties: must be an object, not [1]",
        ),
        (formats.read_geojson, json.dumps(feature("x")), "geometry: must be an object, not 'x'"),
        (
            formats.read_geojson,
            json.dumps(feature({"type": "MultiPolygon", "coordinates": 5})),
            "geometry.coordinates: must be a list of polygons",
        ),
        (
            formats.read_geojson,
            json.dumps(feature({"type": "Polygon", "coordinates": [[[True, 5], [4, 5], [5, 5]]]})),
            "geometry.coordinates[0][0]: must be two numbers",
        ),
        (
            formats.read_geojson,
            json.dumps(feature({"type": "Polygon", "coordinates": [[[10**99, 5], [4, 5], [5, 5]]]})),
            "geometry.coordinates[0][0]: 1e+99, 5 is not a place on Earth",
        ),
        *(
            (
                formats.read_geojson,
                json.dumps(feature({"type": "Point", "coordinates": [4, 50]}, properties={"radius": radius})),
                "properties.radius: must be above 0 and at most 200000 metres, not",
            )
            for radius in (0, -1, True, "5", 10**200)
        ),
        (formats.read_qgc_plan, '{"fileType": "Plan", "geoFence": [1]}', "geoFence: must be an object, not [1]"),
        (formats.read_qgc_plan, '{"fileType": "Plan", "mission": "x"}', "mission: must be an object"),
        (
            formats.read_qgc_plan,
            '{"fileType": "Plan", "geoFence": {"version": 2, "circles": [{"circle": 5, "inclusion": true}]}}',
            "geoFence.circles[0].circle: must be an object",
        ),
        (
            formats.read_qgc_plan,
            json.dumps(
                {"fileType": "Plan", "geoFence": {"version": 2, "polygons": [{"polygon": SQUARE, "inclusion": "no"}]}}
            ),
            "geoFence.polygons[0].inclusion: must be true or false, not 'no'",
        ),
        (
            formats.read_ed269,
            '{"features": [{"geometry": [{"horizontalProjection": 5}]}]}',
            "features[0].geometry[0].horizontalProjection: must be an object",
        ),
    ],
)
def test_import_of_bad_file_raises_readable_error(read, text, sentence):
    with pytest.raises(InvalidObject) as caught:
        read(text)
    assert str(caught.value).startswith(sentence)


def test_zones_command_imports_and_exports(tmp_path):
    source = tmp_path / "town.geojson"
    source.write_text(formats.write_geojson([BLOCK, ROUND]).text)
    imported = CliRunner().invoke(command, ["import", str(source), "--from", "geojson", "--prefix", "town-"])
    assert imported.exit_code == 0, imported.output
    manifests = list(yaml.safe_load_all(imported.stdout))
    assert [m["metadata"]["name"] for m in manifests] == ["town-block", "town-round"]
    assert all(Zone.from_body(m) for m in manifests)
    target = tmp_path / "zones.yaml"
    target.write_text(imported.stdout)
    written = CliRunner().invoke(command, ["export", str(target), "--to", "qgc-plan"])
    assert json.loads(written.stdout)["geoFence"]["polygons"][0]["inclusion"] is False
    assert "left out" in written.stderr
    larger = CliRunner().invoke(command, ["export", str(target), "--to", "qgc-plan", "--inclusion"])
    assert larger.exit_code == 1
    assert "town-block: the format has no altitude and no holes; an inclusion fence would be larger" in larger.stderr
    wrong = CliRunner().invoke(command, ["import", str(source), "--from", "kml"])
    assert wrong.exit_code == 1
    assert f"{source}: this is not XML" in wrong.stderr


def test_import_notes_contain_no_control_characters(tmp_path):
    source = tmp_path / "town.geojson"
    square = {"type": "Polygon", "coordinates": [[[4.0, 50.0], [4.01, 50.0], [4.01, 50.01], [4.0, 50.0]]]}
    features = [
        {"type": "Feature", "properties": {"name": name}, "geometry": square} for name in ("school", "a\x1b[2J")
    ]
    source.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    result = CliRunner().invoke(command, ["import", str(source), "--from", "geojson", "--leave-out", "a\x1b[2J"])
    assert result.exit_code == 0
    assert "a\\x1b[2J" in result.stderr
    assert "\x1b" not in result.output
