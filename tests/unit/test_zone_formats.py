"""Zones from and to GeoJSON, KML, QGroundControl plans and ED-269; nothing is dropped in silence."""

import json
import re

import pytest
import shapely
import yaml
from click.testing import CliRunner
from fractus_cli.zones import zones as command
from fractus_core.api import InvalidObject, Zone
from fractus_core.api.schedules import active_at
from fractus_core.geo import LocalFrame, formats, middle, polygon
from fractus_core.geo.formats import drafts
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
    <Placemark><name>School &amp; yard</name><description>no pictures</description><ExtendedData><Data name="owner"><value>x</value></Data></ExtendedData><styleUrl/><Polygon>
    <altitudeMode>clampToGround</altitudeMode><outerBoundaryIs><LinearRing><coordinates>{ring}</coordinates></LinearRing></outerBoundaryIs></Polygon></Placemark>
    <Placemark><name>pin</name><Point><coordinates>4,50</coordinates></Point></Placemark></Folder></Document></kml>"""
    found = formats.read_kml(text)
    assert [(z.name, z.spec.description) for z in found.zones] == [("school-yard", "no pictures")]
    assert len(found.zones[0].spec.area.polygon.exterior) == 4
    assert found.notes == (
        "School & yard: no place for properties owner; left out",
        "pin: Point is not a zone; left out",
    )


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
    square = {"type": "Polygon", "coordinates": [SQUARE]}
    feet = {"uomDimensions": "FT", "horizontalProjection": square, "upperLimit": 400, "upperVerticalReference": "AMSL"}
    spec, _ = ed269([], **feet)
    assert (spec.altitude.upper, spec.altitude.reference) == (121.92, "amsl")


def daily(day, start, end):
    return {"day": day, "startTime": start, "endTime": end}


WEEK = ("Mon", "Tue", "Wed", "Thu", "Fri", "Sat", "Sun")


@pytest.mark.parametrize(
    ("day", "days", "start", "end"),
    [
        (daily(["MON", "FRI"], "08:00:00.00Z", "23:59:59.00Z"), ("Mon", "Fri"), "08:00", "00:00"),
        (daily(["MON"], "00:30+02:00", "10:00+02:00"), ("Sun",), "22:30", "08:00"),
        (daily(["MON", "SUN"], "22:00-0500", "06:00-0500"), ("Mon", "Tue"), "03:00", "11:00"),
        (daily(["SUN"], "22:00-05:00", "23:00-05:00"), ("Mon",), "03:00", "04:00"),
        (daily(["ANY"], "22:00:00Z", "06:00:00.5Z"), (), "22:00", "06:00"),
        (daily(["FRI"], "00:00Z", "24:00Z"), ("Fri",), None, None),
        (daily(list(map(str.upper, WEEK)), "12:00Z", "13:00Z"), (), "12:00", "13:00"),
    ],
)
def test_ed269_times_of_day_are_kept_in_utc(day, days, start, end):
    spec, _ = ed269([{"permanent": "NO", "startDateTime": "2026-03-01T00:00:00+01:00", "schedule": [day]}])
    (time,) = spec.schedule
    assert (time.days, time.start, time.end) == (days, start, end)
    assert time.valid_from.isoformat() == "2026-03-01T00:00:00+01:00"


@pytest.mark.parametrize(
    "applicability",
    [
        [],
        [{}],
        [{"permanent": "YES"}],
        [{"permanent": "YES", "schedule": [daily(["ANY"], "00:00:00.00Z", "23:59:59.00Z")]}],
        [{"permanent": "NO", "schedule": [daily(["MON"], "08:00Z", "09:00Z")]}, {"permanent": "NO"}],
        [{"permanent": "NO", "schedule": [daily(["MON"], "08:00Z", "09:00Z"), {"day": ["ANY"]}]}],
    ],
)
def test_ed269_zones_that_are_always_active(applicability):
    assert ed269(applicability)[0].schedule == ()


@pytest.mark.parametrize("offset_h", range(-12, 15))
def test_ed269_offsets_mean_the_same_moments(offset_h):
    zone_text = f"{'-' if offset_h < 0 else '+'}{abs(offset_h):02d}:30"
    offset_s = (abs(offset_h) * 3600 + 1800) * (-1 if offset_h < 0 else 1)
    spec, _ = ed269([{"schedule": [daily(["MON"], f"06:00{zone_text}", f"03:00{zone_text}")]}])
    monday_s = 4 * 86_400
    for minute in range(0, 14 * 1440, 7):
        local_s = minute * 60 % (7 * 86_400)
        meant = monday_s + 6 * 3600 <= local_s < monday_s + 27 * 3600
        assert active_at(spec.schedule, 7 * 86_400 + minute * 60 - offset_s) == meant


NO = {"permanent": "NO"}


@pytest.mark.parametrize(
    ("applicability", "volume", "sentence"),
    [
        ([], {"uomDimensions": "FL"}, "geometry[0].uomDimensions: must be M or FT, not 'FL'; convert the limits"),
        ([], {"uomDimensions": "FT"}, "geometry[0].horizontalProjection.radius: may be metres or feet; give"),
        ([], {"upperLimit": "120"}, "geometry[0].upperLimit: must be a number, not '120'"),
        ([], {"upperVerticalReference": "WGS84"}, "geometry[0].upperVerticalReference: must be AGL or AMSL, not 'WGS84'"),
        ([], {"upperVerticalReference": None}, "geometry[0].upperVerticalReference: must be AGL or AMSL, not None"),
        ([], {"lowerLimit": 30, "upperVerticalReference": "AMSL"}, "geometry[0].lowerVerticalReference: differs from"),
        ([], {"upperLimit": 1e6}, "geometry[0]: altitude.upper: must be less than or equal to 20000"),
        ([], {"layer": 3}, "geometry[0].layer: a Zone has no place for it; remove it if it means nothing"),
        (
            [],
            {"horizontalProjection": {"type": "Circle", "center": [4, 50], "radius": 5, "from": 90}},
            "geometry[0].horizontalProjection.from: a Zone has no place for it",
        ),
        (
            [],
            {"horizontalProjection": {"type": "Polygon", "coordinates": [[[4, 50, 9], [5, 50, 9], [5, 51, 9]]]}},
            "geometry[0].horizontalProjection.coordinates[0][0]: has a height; say how high",
        ),
        ([NO | {"schedule": [{"day": ["MON", "HOL"]}]}], {}, "applicability[0].schedule[0].day: 'HOL' is not MON to SUN or ANY"),
        ([NO | {"schedule": [{"day": [{}]}]}], {}, "applicability[0].schedule[0].day: {} is not MON to SUN"),
        ([NO | {"schedule": [{"startEvent": "BMCT"}]}], {}, "applicability[0].schedule[0].startEvent: a Zone has no place"),
        ([NO | {"schedule": [daily([], "dawn", "dusk")]}], {}, "applicability[0].schedule[0].startTime: must be a time of day"),
        ([NO | {"schedule": [daily([], "08:00", "09:00")]}], {}, "applicability[0].schedule[0].startTime: must be a time of day"),
        ([NO | {"schedule": [daily([], "24:00Z", "09:00Z")]}], {}, "applicability[0].schedule[0].startTime: must be a time of"),
        ([NO | {"schedule": [daily([], "08:00Z", "25:00Z")]}], {}, "applicability[0].schedule[0].endTime: must be a time of"),
        ([NO | {"schedule": [daily([], "08:00Z", "")]}], {}, "applicability[0].schedule[0].endTime: must be a time of day"),
        ([NO | {"schedule": [daily([], "08:00:30Z", "09:00Z")]}], {}, "applicability[0].schedule[0].startTime: must be a whole"),
        ([NO | {"startDateTime": "2026-03-01T00:00:00"}], {}, "geometry[0]: schedule[0].validFrom: must be a time with its zone"),
        ([{"permanent": "MAYBE"}], {}, "applicability[0].permanent: must be YES or NO, not 'MAYBE'"),
        ([{"permanent": "YES", "endDateTime": "2026-03-01T00:00:00Z"}], {}, "applicability[0].permanent: is YES, but there are"),
        ([NO | {"season": "winter"}], {}, "applicability[0].season: a Zone has no place for it"),
    ],
)  # fmt: skip
def test_ed269_refuses_what_a_zone_cannot_keep(applicability, volume, sentence):
    with pytest.raises(InvalidObject) as refused:
        ed269(applicability, **volume)
    assert str(refused.value).startswith(f"features[0].{sentence}")
    assert str(refused.value).endswith(" (in BEL0001)")


def test_ed269_refuses_features_without_geometry_and_says_what_it_cuts():
    with pytest.raises(InvalidObject, match=r"features\[0\].geometry: is missing; give at least one volume \(in A\)"):
        formats.read_ed269('{"features": [{"identifier": "A"}]}')
    written = json.loads(formats.write_ed269([ROUND]).text)
    written["features"][0] |= {"identifier": "A", "message": "x" * 1100}
    assert "A: its description is cut after 1024 characters" in formats.read_ed269(json.dumps(written)).notes


def test_ed269_has_no_altitude_above_home():
    low = zone("low", {"circle": {"center": {"lat": 50.0, "lon": 4.0}, "radius": 3}}, altitude={"upper": 50})
    with pytest.raises(InvalidObject, match=r"low: spec\.altitude\.reference: ED-269 has no altitudes above home"):
        formats.write_ed269([low])


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
    parts = [polygon(frame, z.spec.area) for z in read(written.text).zones]
    assert len(parts) == 2
    whole = polygon(frame, across.spec.area)
    assert shapely.union_all(parts).symmetric_difference(whole).area < 1e-4 * whole.area


def test_geojson_tells_of_zones_around_a_pole():
    polar = zone("n", {"circle": {"center": {"lat": 90.0, "lon": 0.0}, "radius": 500}})
    assert any("contains a pole" in note for note in formats.write_geojson([polar]).notes)


HIGH = {"type": "Polygon", "coordinates": [[[lon, lat, 30] for lon, lat in SQUARE]]}
FLAT = {"type": "Polygon", "coordinates": [SQUARE]}


def test_geojson_takes_the_reference_system_that_it_has_anyway_and_heights_beside_an_altitude():
    named = {"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}
    whole = feature(HIGH, id="a", properties={"altitude": {"upper": 30, "reference": "terrain"}}) | {"crs": named}
    found = formats.read_geojson("\ufeff" + json.dumps(whole))
    assert found.zones[0].spec.altitude.upper == 30
    assert found.notes == ("a: heights of its points are not taken over, properties.altitude is",)


def test_geojson_keeps_every_polygon_of_a_collection():
    parts = [
        FLAT,
        {"type": "GeometryCollection", "geometries": [{"type": "MultiPolygon", "coordinates": [[SQUARE]] * 2}]},
    ]
    collection = {"type": "GeometryCollection", "geometries": [*parts, {"type": "Point", "coordinates": [4, 50]}]}
    for whole in (feature(collection, id="a"), collection):
        found = formats.read_geojson(json.dumps(whole))
        assert len(found.zones) == 3
        assert len(found.notes) == 1


def test_geojson_follows_parallels():
    """A side of 140 km leaves its parallel by 470 m in the middle; the zone follows it to half a metre."""
    wide = [[4, 50], [6, 50], [6, 50.5], [4, 50.5], [4, 50]]
    (found,) = formats.read_geojson(json.dumps(feature({"type": "Polygon", "coordinates": [wide]}))).zones
    frame = LocalFrame.at(middle(found.spec.area))
    shape = polygon(frame, found.spec.area)
    for i in range(1, 200):
        for lat in (50, 50.5):
            along = shapely.Point(frame.xy(lat, 4 + i / 100))
            assert shape.exterior.distance(along) < 0.6
    assert len(found.spec.area.polygon.exterior) < 100


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
        (feature(HIGH), "geometry.coordinates[0][0]: has a height; say how high the zone is in its altitude"),
        (feature(FLAT | {"layer": {"upper": 50}}), "geometry.layer: a Zone has no place for it"),
        (
            feature({"type": "Point", "coordinates": [4, 50], "extent": {"radius": 5}}),
            "geometry.extent: a Zone has no place for it",
        ),
        (
            feature({"type": "LineString", "coordinates": SQUARE}, properties={"radius": 5}),
            "properties.radius: goes with a Point",
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
def test_geojson_refuses_what_a_zone_cannot_keep(whole, sentence):
    with pytest.raises(InvalidObject) as refused:
        formats.read_geojson(json.dumps(whole))
    assert str(refused.value).startswith(sentence)


def kml(inside, around=""):
    ring = " ".join(f"{lon},{lat}" for lon, lat in SQUARE)
    edge = f"<outerBoundaryIs><LinearRing><coordinates>{ring}</coordinates></LinearRing></outerBoundaryIs>"
    return (
        f"<kml><Document>{around}<Placemark><name>p</name>{inside.replace('EDGE', edge)}</Placemark></Document></kml>"
    )


def test_kml_keeps_all_holes_and_every_polygon_of_a_multigeometry():
    rings = [[[lon + shift, lat] for lon, lat in HOLE] for shift in (0, -0.003)]
    texts = [
        f"<LinearRing><coordinates>{' '.join(f'{x},{y},99' for x, y in r)}</coordinates></LinearRing>" for r in rings
    ]
    both = f"<Polygon>EDGE<innerBoundaryIs>{''.join(texts)}</innerBoundaryIs></Polygon>"
    found = formats.read_kml(
        kml(f"<MultiGeometry>{both}<MultiGeometry><Polygon>EDGE</Polygon></MultiGeometry></MultiGeometry>")
    )
    assert [len(z.spec.area.polygon.holes) for z in found.zones] == [2, 0]
    assert found.notes == ()


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            kml("<Polygon><altitudeMode>absolute</altitudeMode>EDGE</Polygon>"),
            "Polygon[0].altitudeMode: absolute has heights",
        ),
        (
            kml("<TimeSpan><begin>2026</begin></TimeSpan><Polygon>EDGE</Polygon>"),
            "has a time, which a Zone says otherwise",
        ),
        (kml("<Polygon>EDGE</Polygon>", "<Folder><name>f</name><TimeStamp/></Folder>"), "f: has a time, which"),
        (
            kml("<Polygon>EDGE</Polygon>", "<NetworkLink><name>n</name></NetworkLink>"),
            "n: a NetworkLink leads to another file",
        ),
        (kml("<Polygon>EDGEEDGE</Polygon>"), "Polygon[0].outerBoundaryIs: a polygon has exactly one"),
        (kml("<Polygon/>"), "Polygon[0].outerBoundaryIs: a polygon has exactly one"),
    ],
)
def test_kml_refuses_what_a_zone_cannot_keep(text, sentence):
    with pytest.raises(InvalidObject) as refused:
        formats.read_kml(text)
    assert str(refused.value).startswith(sentence)


@pytest.mark.parametrize(
    ("fence", "sentence"),
    [
        ({"polygons": [{"polygon": SQUARE}]}, "geoFence.polygons[0].inclusion: must be true or false, not None"),
        (
            {"polygons": [{"polygon": SQUARE, "inclusion": True, "maxAltitude": 50}]},
            "geoFence.polygons[0].maxAltitude: a Zone has",
        ),
        ({"polygons": [{"polygon": [[1, 2, 3]], "inclusion": True}]}, "geoFence.polygons[0].polygon[0]: has a height"),
        (
            {"circles": [{"circle": {"center": [1, 2], "radius": 3, "units": "ft"}, "inclusion": True}]},
            "geoFence.circles[0].circle.units: a Zone has no place for it",
        ),
        ({"corridors": [1]}, "geoFence.corridors: a Zone has no place for it"),
    ],
)
def test_qgc_plan_refuses_what_a_zone_cannot_keep(fence, sentence):
    with pytest.raises(InvalidObject) as refused:
        formats.read_qgc_plan(json.dumps({"fileType": "Plan", "geoFence": {"version": 2, **fence}}))
    assert str(refused.value).startswith(sentence)


def test_every_refused_feature_is_told_with_its_line_and_can_be_left_out(tmp_path):
    features = [feature(HIGH, id="a"), feature(FLAT, id="b"), feature(FLAT | {"layer": 1}, id="c")]
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
    found = CliRunner().invoke(command, ["import", str(source), "--from", "geojson", *without])
    assert [m["metadata"]["name"] for m in yaml.safe_load_all(found.stdout)] == ["b"]
    assert "a: left out, as asked for" in found.stderr
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
def test_properties_that_say_how_high_or_when_in_other_words_are_refused(name, tmp_path):
    sentence = (
        "seems to say how high or when the zone counts, in other words than a Zone; say it as altitude or schedule"
    )
    text = json.dumps(feature(FLAT, properties={"name": "a", "owner": "x", name: 120}))
    with pytest.raises(InvalidObject, match=sentence) as refused:
        formats.read_geojson(text)
    assert refused.value.field == f"properties.{name}"
    dropped = formats.read_geojson(text, drop=[name])
    assert dropped.notes == (f"a: no place for properties {', '.join(sorted([name, 'owner']))}; left out",)
    assert formats.read_geojson(text.replace("120", "null")).zones == dropped.zones
    data = f'<ExtendedData><Data name="{name}"><value>120</value></Data></ExtendedData>'
    with pytest.raises(InvalidObject, match=sentence):
        formats.read_kml(kml(f"<Polygon>EDGE</Polygon>{data}"))
    assert formats.read_kml(kml(f"<Polygon>EDGE</Polygon>{data}"), drop=[name]).zones
    source = tmp_path / "town.geojson"
    source.write_text(text)
    refused = CliRunner().invoke(command, ["import", str(source), "--from", "geojson"])
    assert (refused.exit_code, sentence in refused.stderr) == (1, True)
    assert CliRunner().invoke(command, ["import", str(source), "--from", "geojson", "--drop", name]).exit_code == 0


@pytest.mark.parametrize("name", ["owner", "kind", "fromage", "timer", "status", "id", "restriction"])
def test_other_properties_are_told(name):
    found = formats.read_geojson(json.dumps(feature(FLAT, properties={"name": "a", name: "x"})))
    assert found.notes == (f"a: no place for properties {name}; left out",)


def test_what_is_to_be_dropped_has_to_be_there(tmp_path):
    with pytest.raises(InvalidObject, match="there is no property ceiling to drop; correct its name"):
        formats.read_geojson(json.dumps(feature(FLAT)), drop=["ceiling"])
    source = tmp_path / "a.json"
    source.write_text("{}")
    refused = CliRunner().invoke(command, ["import", str(source), "--from", "ed269", "--drop", "ceiling"])
    assert "--drop is for --from geojson and kml" in refused.stderr


def test_the_points_of_a_whole_file_have_a_limit(monkeypatch):
    long = [[-179, 60], [179, 60], [179, 70], [-179, 70]]
    around = [[[x / 2 - 80, y] for x, y in long]]
    one = feature({"type": "Polygon", "coordinates": around})
    count = len(formats.read_geojson(json.dumps(one)).zones[0].spec.area.polygon.exterior)
    assert count > 100 * len(long)
    monkeypatch.setattr(drafts, "MAX_POINTS", 3 * count)
    collection = {"type": "FeatureCollection", "features": [one] * 3}
    assert len(formats.read_geojson(json.dumps(collection)).zones) == 3
    holes = feature({"type": "Polygon", "coordinates": around * 4})
    for more in (collection | {"features": [one] * 1000}, collection | {"features": [holes, one]}):
        with pytest.raises(InvalidObject, match=f"the file needs more than {3 * count} points") as refused:
            formats.read_geojson(json.dumps(more))
        assert not isinstance(refused.value, formats.Inexact), "it is not read on"


def test_a_file_with_a_key_twice_is_refused():
    with pytest.raises(InvalidObject, match="line 1: type is given twice"):
        formats.read_geojson('{"type": "Feature", "type": "FeatureCollection"}')


@pytest.mark.parametrize(
    ("read", "text", "sentence"),
    [
        (formats.read_geojson, "{", "line 1: this is not JSON"),
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
            formats.read_geojson, '{"type":' * 100_000, "its lists or objects are nested deeper than 100", id="deep"
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
                "properties.radius: must be 0 to 200000 metres, not",
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
    written = CliRunner().invoke(command, ["export", str(target), "--to", "qgc-plan"])
    assert json.loads(written.stdout)["geoFence"]["polygons"][0]["inclusion"] is False
    assert "left out" in written.stderr
    larger = CliRunner().invoke(command, ["export", str(target), "--to", "qgc-plan", "--inclusion"])
    assert larger.exit_code == 1
    assert "town-block: the format has no altitude and no holes; a fence to stay in would be larger" in larger.stderr
    wrong = CliRunner().invoke(command, ["import", str(source), "--from", "kml"])
    assert wrong.exit_code == 1
    assert f"{source}: this is not XML" in wrong.stderr


def test_notes_have_no_characters_that_a_terminal_acts_on(tmp_path):
    source = tmp_path / "town.geojson"
    square = {"type": "Polygon", "coordinates": [[[4.0, 50.0], [4.01, 50.0], [4.01, 50.01], [4.0, 50.0]]]}
    features = [
        {"type": "Feature", "properties": {"name": name}, "geometry": square} for name in ("school", "a\x1b[2J")
    ]
    source.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    told = CliRunner().invoke(command, ["import", str(source), "--from", "geojson", "--leave-out", "a\x1b[2J"])
    assert told.exit_code == 0
    assert "a\\x1b[2J" in told.stderr
    assert "\x1b" not in told.output
