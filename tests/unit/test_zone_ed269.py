"""Import and export of ED-269: times, volumes, and features that a Zone cannot represent."""

import json

import pytest
from fractus_core.api import InvalidObject
from fractus_core.api.schedules import active_at
from fractus_core.geo import formats
from test_zone_formats import ROUND, SQUARE, zone


def ed269(applicability, **volume):
    geometry = {
        "uomDimensions": "M", "lowerLimit": 0, "lowerVerticalReference": "AGL", "upperLimit": 120, "upperVerticalReference": "AGL",
        "horizontalProjection": {"type": "Circle", "center": [4.0, 50.0], "radius": 500}, **volume,
    }  # fmt: skip
    feature = {
        "identifier": "BEL0001",
        "country": "BEL",
        "name": "Hospital",
        "restriction": "PROHIBITED",
        "message": "keep out",
        "applicability": applicability,
        "geometry": [geometry],
    }
    imported = formats.read_ed269(json.dumps({"title": "t", "features": [feature]}))
    return imported.zones[0].spec, imported.notes


def test_ed269_reads_foreign_file():
    spec, notes = ed269([{"permanent": "YES"}])
    assert (spec.altitude.lower, spec.altitude.upper, spec.altitude.reference) == (None, 120, "terrain")
    assert spec.description == "Hospital: PROHIBITED: keep out"
    assert notes == (
        "BEL0001: country cannot be imported; left out",
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
def test_ed269_converts_times_of_day_to_utc(day, days, start, end):
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
def test_ed269_reads_permanent_zones(applicability):
    assert ed269(applicability)[0].schedule == ()


@pytest.mark.parametrize("offset_h", range(-12, 15))
def test_ed269_times_are_local_times_of_their_time_zone_offset(offset_h):
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
        ([], {"lowerLimit": 1e6, "upperVerticalReference": "AGL"}, "geometry[0]: altitude.lower: must be less than or equal to 20000"),
        ([], {"layer": 3}, "geometry[0].layer: a Zone cannot represent this field; remove it if it does not"),
        (
            [],
            {"horizontalProjection": {"type": "Circle", "center": [4, 50], "radius": 5, "from": 90}},
            "geometry[0].horizontalProjection.from: a Zone cannot represent this field",
        ),
        (
            [],
            {"horizontalProjection": {"type": "Polygon", "coordinates": [[[4, 50, 9], [5, 50, 9], [5, 51, 9]]]}},
            "geometry[0].horizontalProjection.coordinates[0][0]: has a height; remove the heights",
        ),
        ([NO | {"schedule": [{"day": ["MON", "HOL"]}]}], {}, "applicability[0].schedule[0].day: 'HOL' is not MON to SUN or ANY"),
        ([NO | {"schedule": [{"day": [{}]}]}], {}, "applicability[0].schedule[0].day: {} is not MON to SUN"),
        ([NO | {"schedule": [{"startEvent": "BMCT"}]}], {}, "applicability[0].schedule[0].startEvent: a Zone cannot represent this field"),
        ([NO | {"schedule": [daily([], "dawn", "dusk")]}], {}, "applicability[0].schedule[0].startTime: must be a time of day"),
        ([NO | {"schedule": [daily([], "08:00", "09:00")]}], {}, "applicability[0].schedule[0].startTime: must be a time of day"),
        ([NO | {"schedule": [daily([], "24:00Z", "09:00Z")]}], {}, "applicability[0].schedule[0].startTime: must be a time of"),
        ([NO | {"schedule": [daily([], "08:00Z", "25:00Z")]}], {}, "applicability[0].schedule[0].endTime: must be a time of"),
        ([NO | {"schedule": [daily([], "08:00Z", "")]}], {}, "applicability[0].schedule[0].endTime: must be a time of day"),
        ([NO | {"schedule": [daily([], "08:00:30Z", "09:00Z")]}], {}, "applicability[0].schedule[0].startTime: must be a whole"),
        ([NO | {"startDateTime": "2026-03-01T00:00:00"}], {}, "geometry[0]: schedule[0].validFrom: must be a time with its zone"),
        ([{"permanent": "MAYBE"}], {}, "applicability[0].permanent: must be YES or NO, not 'MAYBE'"),
        ([{"permanent": "YES", "endDateTime": "2026-03-01T00:00:00Z"}], {}, "applicability[0].permanent: is YES although times are given"),
        ([NO | {"season": "winter"}], {}, "applicability[0].season: a Zone cannot represent this field"),
    ],
)  # fmt: skip
def test_ed269_rejects_features_a_zone_cannot_represent(applicability, volume, sentence):
    with pytest.raises(InvalidObject) as refused:
        ed269(applicability, **volume)
    assert str(refused.value).startswith(f"features[0].{sentence}")
    assert str(refused.value).endswith(" (in BEL0001)")


def test_ed269_rejects_features_without_geometry_and_notes_cut_descriptions():
    with pytest.raises(InvalidObject, match=r"features\[0\].geometry: is missing; give at least one volume \(in A\)"):
        formats.read_ed269('{"features": [{"identifier": "A"}]}')
    written = json.loads(formats.write_ed269([ROUND]).text)
    written["features"][0] |= {"identifier": "A", "message": "x" * 1100}
    assert "A: its description is cut after 1024 characters" in formats.read_ed269(json.dumps(written)).notes


def test_ed269_export_rejects_altitudes_above_home():
    low = zone("low", {"circle": {"center": {"lat": 50.0, "lon": 4.0}, "radius": 3}}, altitude={"upper": 50})
    with pytest.raises(InvalidObject, match=r"low: spec\.altitude\.reference: ED-269 has no altitudes above home"):
        formats.write_ed269([low])
