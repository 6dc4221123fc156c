"""Zones as UAS geographical zones of EUROCAE ED-269 (JSON)."""

from __future__ import annotations

import functools
import hashlib
import json
import re
import string
from collections.abc import Collection, Iterable
from typing import Any, NamedTuple

from fractus_core.api import InvalidObject, Zone
from fractus_core.api.geometry import MAX_ALTITUDE_M, MIN_ALTITUDE_M, AltitudeBand
from fractus_core.api.schedules import ActiveTime
from fractus_core.geo.formats.unknown_properties import EMPTY
from fractus_core.geo.formats.zone_builder import (
    Exported,
    FeatureName,
    Imported,
    ZoneBuilder,
    circle_area,
    cut_rings,
    is_number,
    object_list,
    optional_object,
    parse_json,
    parse_point,
    reject_poles,
    reject_unknown_fields,
    unsupported_parts,
)

_UNITS_M = {"M": 1.0, "FT": 0.3048}
_DAYS = {"MON": "Mon", "TUE": "Tue", "WED": "Wed", "THU": "Thu", "FRI": "Fri", "SAT": "Sat", "SUN": "Sun"}
_REFERENCES = {"AGL": "terrain", "AMSL": "amsl"}
_DESCRIBED = ("name", "restriction", "restrictionConditions", "message", "otherReasonInfo")
_OF_FEATURE = frozenset({"identifier", "applicability", "geometry", *_DESCRIBED})
_WITHOUT_EFFECT = frozenset(
    {"country", "type", "region", "reason", "regulationExemption", "uSpaceClass", "zoneAuthority"}
)
"""Fields of a feature that state neither area nor altitude nor time. An import lists them in its notes."""
_TRANSLATIONS = frozenset({"localizedMessages"})
_LISTS = ("features", "UASZoneList")
"""Names of the list of features. Files of authorities use either name."""
_OF_FILE = frozenset({"title", "description", "formatVersion", "createdAt", *_LISTS})
_OF_VOLUME = frozenset(
    {
        "uomDimensions", "lowerLimit", "lowerVerticalReference", "upperLimit", "upperVerticalReference",
        "horizontalProjection",
    }
)  # fmt: skip
_OF_PROJECTION = {"Polygon": frozenset({"type", "coordinates"}), "Circle": frozenset({"type", "center", "radius"})}
_OF_PERIOD = frozenset({"permanent", "startDateTime", "endDateTime", "schedule"})
_OF_DAY = frozenset({"day", "startTime", "endTime"})
_TIME = re.compile(
    r"([01]\d|2[0-4]):([0-5]\d)(?::([0-5]\d)(?:\.\d+)?)?(?:Z|([-+])([01]\d|2[0-3]):?([0-5]\d))", re.ASCII
)
_DAY_MIN = 1440


class LimitNames(NamedTuple):
    """Names of the fields with the altitude limits of a volume, their datums and their unit."""

    lower: str
    lower_datum: str
    upper: str
    upper_datum: str
    unit: str


_LIMITS = LimitNames("lowerLimit", "lowerVerticalReference", "upperLimit", "upperVerticalReference", "uomDimensions")


def read_ed269(text: str, without: Collection[str] = (), drop: Collection[str] = ()) -> Imported:
    """Read zones from features: identifier, name, message, restriction (in the description), applicability, geometry.

    Args:
        text: Content of the file.
        without: Identifiers of features to leave out.
        drop: Names of unknown fields to leave out although they may state the size, altitude or time of a zone.

    Raises:
        InvalidObject: The text is not an ED-269 file, a geometry is broken, or a feature cannot be represented exactly.
    """
    document = parse_json(text)
    lists = [name for name in _LISTS if name in document]
    if len(lists) != 1:
        raise InvalidObject(
            "features", "is missing; this is not an ED-269 file" if not lists else "is also UASZoneList"
        )
    if document.get("type") == "FeatureCollection":
        raise InvalidObject("type", "this is GeoJSON, not ED-269; import it with --from ed318 or --from geojson")
    builder = ZoneBuilder(without, drop)
    builder.properties("the file", document, _OF_FILE, "")
    for i, feature in enumerate(object_list(document[lists[0]], lists[0])):
        field = f"{lists[0]}[{i}]"
        identifier = str(feature.get("identifier") or "")
        given = str(feature.get("name") or "")
        name = FeatureName(identifier or given or field, given, identifier)
        builder.take(name, feature.get("geometry"), functools.partial(_read_feature, builder, name, feature, field))
    return builder.result()


def _read_feature(builder: ZoneBuilder, name: FeatureName, feature: dict[str, Any], field: str) -> None:
    title = name.title
    parts = [_joined(feature[key]) for key in _DESCRIBED if feature.get(key)]
    spec: dict[str, Any] = {"description": builder.described(title, ": ".join(parts))} if parts else {}
    without_effect = sorted(key for key in _WITHOUT_EFFECT if feature.get(key) not in EMPTY)
    if without_effect:
        builder.note(title, f"{', '.join(without_effect)} cannot be imported; left out")
    builder.properties(title, feature, _OF_FEATURE | _WITHOUT_EFFECT | {"extendedProperties"}, field)
    extended = feature.get("extendedProperties")
    if not isinstance(extended, dict):
        extended = {"extendedProperties": extended}
    builder.properties(title, extended, _TRANSLATIONS, f"{field}.extendedProperties")
    if feature.get("restriction"):
        builder.note(title, f"a Zone forbids nothing by itself; add a policy for restriction {feature['restriction']}")
    schedule = read_schedule(feature.get("applicability"), f"{field}.applicability")
    if schedule:
        spec["schedule"] = schedule
    volumes = object_list(feature.get("geometry"), f"{field}.geometry")
    if not volumes:
        raise InvalidObject(f"{field}.geometry", "is missing; give at least one volume")
    for j, volume in enumerate(volumes):
        path = f"{field}.geometry[{j}]"
        build = functools.partial(_volume_spec, builder, title, volume, path, spec)
        builder.add(name, volume, path, build)


def _volume_spec(
    builder: ZoneBuilder, title: str, volume: dict[str, Any], field: str, spec: dict[str, Any]
) -> dict[str, Any]:
    reject_unknown_fields(volume, _OF_VOLUME, field)
    band = read_band(builder, title, volume, _LIMITS, field)
    area = _area(builder, title, volume, field)
    return {**spec, "area": area, **({"altitude": band} if band else {})}


def _joined(value: Any) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def _area(builder: ZoneBuilder, title: str, volume: dict[str, Any], field: str) -> dict[str, Any]:
    path = f"{field}.horizontalProjection"
    projection = optional_object(volume.get("horizontalProjection"), path)
    shape = projection.get("type")
    if not isinstance(shape, str) or shape not in _OF_PROJECTION:
        raise InvalidObject(f"{path}.type", f"must be Polygon or Circle, not {shape!r}")
    reject_unknown_fields(projection, _OF_PROJECTION[shape], path)
    if shape == "Polygon":
        return builder.rings(title, projection.get("coordinates"), f"{path}.coordinates")
    if volume.get("uomDimensions") not in (None, "M"):
        raise InvalidObject(f"{path}.radius", "may be metres or feet; give the volume in metres (uomDimensions M)")
    centre = parse_point(projection.get("center"), f"{path}.center")
    return circle_area(centre, projection.get("radius"), f"{path}.radius")


def read_band(
    builder: ZoneBuilder, title: str, volume: dict[str, Any], names: LimitNames, field: str
) -> dict[str, Any]:
    """Return the altitude band of a volume, empty if it has no limits.

    A lower limit of 0 above ground means that the zone starts at the ground. Authorities write limits that no aircraft
    reaches (99999) for a zone without a limit.

    Args:
        builder: Builder that receives notes.
        title: Title of the feature.
        volume: Fields with the limits.
        names: Names of these fields.
        field: Path of the volume in the file.

    Raises:
        InvalidObject: A limit is not a number, or its unit or datum is unknown.
    """
    unit = volume.get(names.unit) or "M"
    metres = _UNITS_M.get(unit.upper()) if isinstance(unit, str) else None
    if metres is None:
        raise InvalidObject(f"{field}.{names.unit}", f"must be M or FT, not {unit!r:.40}; convert the limits")
    limits: dict[str, Any] = {}
    references = set()
    for side, name, datum_name in (
        ("lower", names.lower, names.lower_datum),
        ("upper", names.upper, names.upper_datum),
    ):
        value = volume.get(name)
        datum = volume.get(datum_name)
        if value is None:
            continue
        if not is_number(value):
            raise InvalidObject(f"{field}.{name}", f"must be a number, not {value!r:.40}")
        if side == "lower" and value <= 0 and datum == "AGL":
            continue
        if not isinstance(datum, str) or datum not in _REFERENCES:
            raise InvalidObject(f"{field}.{datum_name}", f"must be AGL or AMSL, not {datum!r:.40}; convert it")
        limit_m = round(value * metres, 3)
        if (side == "upper" and limit_m > MAX_ALTITUDE_M) or (side == "lower" and limit_m < MIN_ALTITUDE_M):
            builder.note(title, f"its {side} limit of {value} {unit} {datum} counts as no limit")
            continue
        limits[side] = limit_m
        references.add(_REFERENCES[datum])
    if len(references) > 1:
        raise InvalidObject(
            f"{field}.{names.lower_datum}",
            "differs from that of the upper limit; convert one of them, or split the volume",
        )
    return limits | {"reference": references.pop()} if limits else {}


def read_schedule(value: Any, field: str) -> list[dict[str, Any]]:
    """Return the active times of the zone. If the result is empty, the zone is always active.

    Args:
        value: List of the periods in which the zone applies.
        field: Path of the list in the file.

    Raises:
        InvalidObject: A period cannot be represented exactly.
    """
    times: list[dict[str, Any]] = []
    for i, period in enumerate(object_list(value, field)):
        path = f"{field}[{i}]"
        reject_unknown_fields(period, _OF_PERIOD, path)
        valid = {
            key: period[ed269_key]
            for key, ed269_key in (("validFrom", "startDateTime"), ("validUntil", "endDateTime"))
            if period.get(ed269_key)
        }
        daily = object_list(period.get("schedule"), f"{path}.schedule")
        active_times = [{**valid, **_daily(day, f"{path}.schedule[{j}]")} for j, day in enumerate(daily)] or [valid]
        permanent = period.get("permanent", "NO")
        if permanent not in ("YES", "NO"):
            raise InvalidObject(f"{path}.permanent", f"must be YES or NO, not {permanent!r:.40}")
        if permanent == "YES" and {} not in active_times:
            raise InvalidObject(f"{path}.permanent", "is YES although times are given; remove the times or set NO")
        times += active_times
    return [] if {} in times else times


def _daily(day: dict[str, Any], field: str) -> dict[str, Any]:
    """Return days and times of day in UTC. An empty result means that the zone is always active."""
    reject_unknown_fields(day, _OF_DAY, field)
    value = day.get("day") or []
    named = value if isinstance(value, list) else [value]
    unknown = [name for name in named if name not in (*_DAYS, "ANY")]
    if unknown:
        raise InvalidObject(f"{field}.day", f"{unknown[0]!r:.40} is not MON to SUN or ANY; name the days of the week")
    days = [] if "ANY" in named else [list(_DAYS.values()).index(_DAYS[name]) for name in named]
    start = day.get("startTime")
    end = day.get("endTime")
    times: dict[str, Any] = {}
    if start or end:
        begin_min = _minutes(start, f"{field}.startTime")
        finish_min = _minutes(end, f"{field}.endTime", last=True)
        # East of Greenwich, a day begins on the previous day in UTC.
        days = [(index + begin_min // _DAY_MIN) % 7 for index in days]
        begin_min = begin_min % _DAY_MIN
        finish_min = finish_min % _DAY_MIN
        if begin_min or finish_min:
            times = {"start": _clock(begin_min), "end": _clock(finish_min)}
    whole_week = len(set(days)) in (0, 7)
    return times if whole_week else {"days": [list(_DAYS.values())[i] for i in sorted(set(days))], **times}


def _minutes(value: Any, field: str, *, last: bool = False) -> int:
    """Return minutes from midnight UTC of the named day, negative on the previous day.

    Second 59 counts as the end of its minute.
    """
    match = _TIME.fullmatch(value) if isinstance(value, str) else None
    minutes = int(match[1]) * 60 + int(match[2]) if match is not None else _DAY_MIN + 1
    if match is None or minutes > (_DAY_MIN if last else _DAY_MIN - 1):
        raise InvalidObject(field, f"must be a time of day with its zone, such as 08:00Z, not {value!r:.40}")
    seconds = int(match[3] or 0)
    if seconds and not (last and seconds == 59):
        raise InvalidObject(field, f"must be a whole minute, not {value}")
    offset = int(match[5] or 0) * 60 + int(match[6] or 0)
    return minutes + bool(seconds) + (offset if match[4] == "-" else -offset)


def _clock(minutes: int) -> str:
    return f"{minutes // 60:02d}:{minutes % 60:02d}"


def write_ed269(zones: Iterable[Zone], *, country: str = "XXX", restriction: str = "CONDITIONAL") -> Exported:
    """Return a feature for each zone. Required fields that a Zone does not have are filled in, with a note.

    Raises:
        InvalidObject: An altitude is measured from home, for which ED-269 has no datum, or a polygon contains a pole.
    """
    zones = tuple(zones)
    reject_poles((zone for zone in zones if zone.spec.area.circle is None), "around which ED-269 has no polygon")
    notes = unsupported_parts(zones)
    features = []
    for zone in zones:
        feature = {
            "identifier": _identifier(zone.name),
            "country": country,
            "name": zone.name,
            "type": "COMMON",
            "restriction": restriction,
            "reason": ["OTHER"],
            "otherReasonInfo": "",
            "message": zone.spec.description,
            "applicability": _applicability(zone.spec.schedule),
            "zoneAuthority": [],
            "geometry": _volumes(zone, notes),
        }
        features.append(feature)
    if zones:
        notes.append(f"every zone: zoneAuthority is unknown; restriction is {restriction}, country {country}")
    document = {"title": "Zones", "description": "", "features": features}
    return Exported(json.dumps(document, indent=1) + "\n", tuple(notes))


def _identifier(name: str) -> str:
    """Return an identifier of 7 letters and digits, the maximum of ED-269, that depends on the name alone."""
    number = int.from_bytes(hashlib.sha256(name.encode()).digest())
    characters = string.digits + string.ascii_uppercase
    return "F" + "".join(characters[number // 36**i % 36] for i in range(6))


def _volumes(zone: Zone, notes: list[str]) -> list[dict[str, Any]]:
    band = zone.spec.altitude or AltitudeBand(reference="terrain")
    if band.reference == "home":
        raise InvalidObject(
            f"{zone.name}: spec.altitude.reference", "ED-269 has no altitudes above home; give them as amsl or terrain"
        )
    datum = "AMSL" if band.reference == "amsl" else "AGL"
    area = zone.spec.area
    if area.circle is not None:
        centre = [area.circle.center.lon, area.circle.center.lat]
        projections: list[dict[str, Any]] = [{"type": "Circle", "center": centre, "radius": area.circle.radius}]
    else:
        projections = [{"type": "Polygon", "coordinates": part} for part in cut_rings(zone, notes)]
    volume: dict[str, Any] = {
        "uomDimensions": "M",
        "lowerLimit": band.lower if band.lower is not None else 0,
        "lowerVerticalReference": datum if band.lower is not None else "AGL",
        "upperVerticalReference": datum,
    }
    if band.upper is not None:
        volume["upperLimit"] = band.upper
    return [{**volume, "horizontalProjection": projection} for projection in projections]


def _applicability(schedule: Iterable[ActiveTime]) -> list[dict[str, Any]]:
    periods = []
    names = {day: ed269_day for ed269_day, day in _DAYS.items()}
    for time in schedule:
        period: dict[str, Any] = {"permanent": "NO"}
        if time.valid_from is not None:
            period["startDateTime"] = time.valid_from.isoformat()
        if time.valid_until is not None:
            period["endDateTime"] = time.valid_until.isoformat()
        if time.days or time.start:
            day = [names[d] for d in time.days] or ["ANY"]
            start = time.start or "00:00"
            end = time.end or "00:00"
            period["schedule"] = [{"day": day, "startTime": f"{start}Z", "endTime": f"{end}Z"}]
        periods.append(period)
    return periods or [{"permanent": "YES"}]
