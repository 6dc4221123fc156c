"""Zones from and to GeoJSON, KML, QGroundControl plans and ED-269; nothing is dropped in silence."""

import json
import math

import pytest
import yaml
from click.testing import CliRunner
from fractus_cli.zones import zones as command
from fractus_core.api import InvalidObject, Zone
from fractus_core.geo import LocalFrame, formats, middle, polygon
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
    return polygon(LocalFrame(50.0, 4.0), spec.area)


@pytest.mark.parametrize("name", WRITERS)
def test_areas_survive_the_round_trip(name):
    write, read = WRITERS[name]
    back = read(write([BLOCK, ROUND]).text).zones
    assert len(back) == 2
    block, disc = sorted(back, key=lambda z: -shape(z.spec).area)
    if name == "qgc-plan":
        assert shape(block.spec).area == pytest.approx(
            polygon(LocalFrame(50, 4), zone("x", {"polygon": {"exterior": points(SQUARE)}}).spec.area).area
        )
    else:
        assert shape(block.spec).symmetric_difference(shape(BLOCK.spec)).area < 1e-3 * shape(BLOCK.spec).area
    assert shape(disc.spec).area == pytest.approx(shape(ROUND.spec).area, rel=3e-3)
    assert shape(disc.spec).buffer(0.01).covers(shape(ROUND.spec).buffer(-0.2)), "never smaller than the circle"


@pytest.mark.parametrize(
    ("name", "sentences"),
    [
        ("geojson", ["round: the circle is written as a polygon of 64 corners around it"]),
        ("kml", ["block: the format has no altitude and no schedule; left out", "round: the circle is written as"]),
        ("qgc-plan", ["block: the format has no altitude and no schedule and no holes; left out"]),
        ("ed269", ["every zone: zoneAuthority is unknown"]),
    ],
)
def test_what_a_format_cannot_say_is_told(name, sentences):
    notes = WRITERS[name][0]([BLOCK, ROUND]).notes
    assert len(notes) == len(sentences)
    assert all(note.startswith(sentence) for note, sentence in zip(notes, sentences, strict=True))


def test_geojson_keeps_altitude_and_schedule():
    back = formats.read_geojson(formats.write_geojson([BLOCK]).text)
    assert back.notes == ()
    assert back.zones[0].spec == BLOCK.spec


def test_ed269_keeps_altitude_schedule_and_circles():
    back = formats.read_ed269(formats.write_ed269([BLOCK, ROUND]).text).zones
    assert back[0].spec.altitude == BLOCK.spec.altitude
    assert back[0].spec.schedule == BLOCK.spec.schedule
    assert back[1].spec.area == ROUND.spec.area


def feature(geometry, **more):
    return {"type": "Feature", "geometry": geometry, **more}


def test_geojson_of_others():
    features = [
        feature(
            {"type": "MultiPolygon", "coordinates": [[SQUARE], [[[lon + 1, lat] for lon, lat in SQUARE]]]},
            properties={"name": "Old Town", "owner": "x", "fill": "#fff"},
        ),
        feature({"type": "Point", "coordinates": [4, 50]}, properties={"name": "Old Town", "radius": 20}),
        feature({"type": "LineString", "coordinates": SQUARE}, properties={"title": "road"}),
    ]
    found = formats.read_geojson(json.dumps({"type": "FeatureCollection", "features": features}))
    assert [z.name for z in found.zones] == ["old-town", "old-town-2", "old-town-3"]
    assert found.zones[2].spec.area.circle.radius == 20
    assert found.notes == (
        "Old Town: no place for properties owner; left out",
        "road: a geometry of type LineString is not a zone; left out",
    )


def test_kml_of_others():
    ring = " ".join(f"{lon},{lat},30" for lon, lat in SQUARE)
    text = f"""<?xml version="1.0" encoding="UTF-8"?><kml xmlns="http://www.opengis.net/kml/2.2"><Document><Folder>
    <Placemark><name>School &amp; yard</name><description>no pictures</description><TimeSpan/><styleUrl/><Polygon>
    <altitudeMode>relativeToGround</altitudeMode><outerBoundaryIs><LinearRing><coordinates>{ring}</coordinates></LinearRing></outerBoundaryIs></Polygon></Placemark>
    <Placemark><name>pin</name><Point><coordinates>4,50</coordinates></Point></Placemark></Folder></Document></kml>"""
    found = formats.read_kml(text)
    assert [(z.name, z.spec.description) for z in found.zones] == [("school-yard", "no pictures")]
    assert len(found.zones[0].spec.area.polygon.exterior) == 4
    assert [n.split(":")[0] for n in found.notes] == ["School & yard", "School & yard", "pin"]
    assert found.notes[0] == "School & yard: no place for TimeSpan; left out"


def test_qgc_plan_of_others():
    fence = {
        "version": 2,
        "polygons": [{"inclusion": True, "version": 1, "polygon": [[lat, lon] for lon, lat in SQUARE[:-1]]}],
        "circles": [{"inclusion": False, "version": 1, "circle": {"center": [50.0, 4.0], "radius": 100}}],
    }
    plan = {"fileType": "Plan", "geoFence": fence, "mission": {"items": [{}]}, "rallyPoints": {"points": [[1, 2, 3]]}}
    found = formats.read_qgc_plan(json.dumps(plan))
    assert [z.name for z in found.zones] == ["inclusion-polygon-1", "exclusion-circle-1"]
    assert middle(found.zones[1].spec.area).lat == 50.0
    assert len(found.notes) == 4
    assert (
        json.loads(formats.write_qgc_plan([ROUND], inclusion=True).text)["geoFence"]["circles"][0]["inclusion"] is True
    )


def ed269(applicability, **volume):
    geometry = {
        "uomDimensions": "M", "lowerLimit": 0, "lowerVerticalReference": "AGL", "upperLimit": 120, "upperVerticalReference": "AGL",
        "horizontalProjection": {"type": "Circle", "center": [4.0, 50.0], "radius": 500}, **volume,
    }  # fmt: skip
    one = {
        "identifier": "BEL0001",
        "country": "BEL",
        "name": "Hospital",
        "restriction": "PROHIBITED",
        "message": "keep out",
        "applicability": applicability,
        "geometry": [geometry],
    }
    found = formats.read_ed269(json.dumps({"title": "t", "features": [one]}))
    return found.zones[0].spec, found.notes


def test_ed269_of_others():
    spec, notes = ed269([{"permanent": "YES"}])
    assert (spec.altitude.lower, spec.altitude.upper, spec.altitude.reference) == (None, 120, "terrain")
    assert spec.description == "Hospital: PROHIBITED: keep out"
    assert notes == (
        "BEL0001: no place for country; left out",
        "BEL0001: a Zone forbids nothing by itself; add a policy for restriction PROHIBITED",
    )
    spec, _ = ed269([], uomDimensions="FT", upperLimit=400, upperVerticalReference="AMSL")
    assert (spec.altitude.upper, spec.altitude.reference) == (121.92, "amsl")
    spec, notes = ed269([], lowerLimit=30, upperVerticalReference="AMSL")
    assert spec.altitude.lower is None
    assert any("different datums" in n for n in notes)


def test_ed269_schedules_are_never_shortened():
    daily = [
        {"day": ["MON", "FRI"], "startTime": "08:00:00.00Z", "endTime": "23:59:59.00Z"},
        {"day": ["ANY"], "startTime": "dawn", "endTime": "dusk"},
    ]
    spec, notes = ed269([{"permanent": "NO", "startDateTime": "2026-03-01T00:00:00Z", "schedule": daily}])
    first, second = spec.schedule
    assert (first.days, first.start, first.end) == (("Mon", "Fri"), "08:00", "00:00")
    assert (second.days, second.start) == ((), None)
    assert any("active all day" in n for n in notes)


def test_geojson_is_cut_at_the_antimeridian():
    across = zone("a", {"circle": {"center": {"lat": 10.0, "lon": 180.0}, "radius": 500}})
    written = formats.write_geojson([across])
    geometry = json.loads(written.text)["features"][0]["geometry"]
    assert geometry["type"] == "MultiPolygon"
    for (ring,) in geometry["coordinates"]:
        assert max(lon for lon, _ in ring) - min(lon for lon, _ in ring) < 0.01
    assert written.notes[1] == "a: it crosses the antimeridian and is cut there, into parts"
    assert len(formats.read_geojson(written.text).zones) == 2


def test_geojson_tells_of_zones_around_a_pole():
    polar = zone("n", {"circle": {"center": {"lat": 90.0, "lon": 0.0}, "radius": 500}})
    assert any("contains a pole" in note for note in formats.write_geojson([polar]).notes)


@pytest.mark.parametrize(
    ("volume", "upper", "note"),
    [
        (
            {"uomDimensions": "FL"},
            None,
            "limits in FL are not taken over, M and FT are; the zone has no limits of altitude",
        ),
        (
            {"upperLimit": "120"},
            None,
            "upperLimit '120' is not a number and not taken over; the zone has no upper limit",
        ),
        ({"layer": 3}, 120, "no place for layer; left out"),
    ],
)
def test_ed269_tells_what_of_a_volume_it_cannot_take(volume, upper, note):
    spec, notes = ed269([], **volume)
    assert (spec.altitude.upper if spec.altitude is not None else None) == upper
    assert f"BEL0001: {note}" in notes


@pytest.mark.parametrize(
    ("day", "note"),
    [
        ({"day": ["MON", "HOL"]}, "HOL is not a day of the week; the zone is active every day"),
        ({"day": [{}]}, "{} is not a day of the week; the zone is active every day"),
        ({"day": ["ANY"], "startEvent": "BMCT"}, "no place for startEvent; left out"),
    ],
)
def test_ed269_zones_whose_time_is_not_understood_are_always_active(day, note):
    spec, notes = ed269([{"permanent": "NO", "schedule": [day]}])
    assert spec.schedule == ()
    assert f"BEL0001: {note}" in notes


def test_ed269_tells_of_features_without_geometry():
    found = formats.read_ed269('{"features": [{"identifier": "A", "message": "%s"}]}' % ("x" * 1100))
    assert found.notes == ("A: its description is cut after 1024 characters", "A: it has no geometry; left out")


def test_geojson_tells_of_heights_and_reference_systems():
    high = [[lon, lat, 30] for lon, lat in SQUARE]
    whole = feature({"type": "Polygon", "coordinates": [high]}, id="a") | {"crs": {"type": "name"}}
    found = formats.read_geojson("\ufeff" + json.dumps(whole))
    assert len(found.zones) == 1
    assert [n.split(":")[0] for n in found.notes] == ["crs", "a"]
    assert "heights of its points are not taken over" in found.notes[1]


@pytest.mark.parametrize(
    ("read", "text", "sentence"),
    [
        (formats.read_geojson, "{", "line 1: this is not JSON"),
        (formats.read_geojson, '{"type": "Topology"}', "type: 'Topology' is not GeoJSON"),
        (
            formats.read_geojson,
            json.dumps(feature({"type": "Polygon", "coordinates": [[[4, 500], [4, 5], [5, 5]]]})),
            "features[0].geometry.coordinates[0][0]: 4, 500 is not a place on Earth; the order is lon, lat",
        ),
        (
            formats.read_geojson,
            json.dumps(
                feature({"type": "Polygon", "coordinates": [[SQUARE[0], SQUARE[2], SQUARE[1], SQUARE[3]]]}, id="bow")
            ),
            "bow: polygon.exterior: the ring crosses itself",
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
            formats.read_geojson, '{"type":' * 100_000, "its lists or objects are nested too deeply", id="deep"
        ),
        pytest.param(formats.read_geojson, "1" * 5000, "a number in it has thousands of digits", id="digits"),
        (
            formats.read_geojson,
            json.dumps(feature(None, properties=[1])),
            "features[0].properties: must be an object, not [1]",
        ),
        (formats.read_geojson, json.dumps(feature("x")), "features[0].geometry: must be an object, not 'x'"),
        (
            formats.read_geojson,
            json.dumps(feature({"type": "MultiPolygon", "coordinates": 5})),
            "features[0].geometry.coordinates: must be a list of polygons",
        ),
        (
            formats.read_geojson,
            json.dumps(feature({"type": "Polygon", "coordinates": [[[True, 5], [4, 5], [5, 5]]]})),
            "features[0].geometry.coordinates[0][0]: must be two numbers",
        ),
        (
            formats.read_geojson,
            json.dumps(feature({"type": "Polygon", "coordinates": [[[10**99, 5], [4, 5], [5, 5]]]})),
            "features[0].geometry.coordinates[0][0]: a number of many digits, 5 is not a place on Earth",
        ),
        *(
            (
                formats.read_geojson,
                json.dumps(feature({"type": "Point", "coordinates": [4, 50]}, properties={"radius": radius})),
                "features[0].properties.radius: must be 0 to 200000 metres, not",
            )
            for radius in (0, -1, True, "5", math.nan, math.inf, 10**400)
        ),
        (formats.read_qgc_plan, '{"fileType": "Plan", "geoFence": [1]}', "geoFence: must be an object, not [1]"),
        (formats.read_qgc_plan, '{"fileType": "Plan", "mission": "x"}', "mission: must be an object"),
        (
            formats.read_qgc_plan,
            '{"fileType": "Plan", "geoFence": {"version": 2, "circles": [{"circle": 5}]}}',
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
def test_bad_files_have_their_sentence(read, text, sentence):
    with pytest.raises(InvalidObject) as caught:
        read(text)
    assert str(caught.value).startswith(sentence)


def test_the_command_imports_and_exports(tmp_path):
    source = tmp_path / "town.geojson"
    source.write_text(formats.write_geojson([BLOCK, ROUND]).text)
    found = CliRunner().invoke(command, ["import", str(source), "--from", "geojson", "--prefix", "town-"])
    assert found.exit_code == 0, found.output
    manifests = list(yaml.safe_load_all(found.stdout))
    assert [m["metadata"]["name"] for m in manifests] == ["town-block", "town-round"]
    assert all(Zone.from_body(m) for m in manifests)
    target = tmp_path / "zones.yaml"
    target.write_text(found.stdout)
    written = CliRunner().invoke(command, ["export", str(target), "--to", "qgc-plan", "--inclusion"])
    assert json.loads(written.stdout)["geoFence"]["polygons"][0]["inclusion"] is True
    assert "left out" in written.stderr
    wrong = CliRunner().invoke(command, ["import", str(source), "--from", "kml"])
    assert wrong.exit_code == 1
    assert f"{source}: this is not XML" in wrong.stderr
