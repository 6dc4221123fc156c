"""Zones as UAS geographical zones of EUROCAE ED-269 (JSON)."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from typing import Any

from fractus_core.api import InvalidObject, Zone
from fractus_core.api.geometry import AltitudeBand
from fractus_core.api.policies import ActiveTime
from fractus_core.geo.formats.drafts import (
    Drafts,
    Exported,
    Imported,
    area_rings,
    fields,
    number,
    objects,
    parse_json,
    place,
    rings,
    round_area,
    unsaid,
)

_UNITS_M = {"M": 1.0, "FT": 0.3048}
_DAYS = {"MON": "Mon", "TUE": "Tue", "WED": "Wed", "THU": "Thu", "FRI": "Fri", "SAT": "Sat", "SUN": "Sun"}
_REFERENCES = {"AGL": "terrain", "WGS84": None, "AMSL": "amsl"}
_USED = frozenset({"identifier", "name", "message", "restriction", "applicability", "geometry"})
_OF_VOLUME = frozenset(
    {
        "uomDimensions", "lowerLimit", "lowerVerticalReference", "upperLimit", "upperVerticalReference",
        "horizontalProjection",
    }
)  # fmt: skip
_OF_PERIOD = frozenset({"permanent", "startDateTime", "endDateTime", "schedule"})
_OF_DAY = frozenset({"day", "startTime", "endTime"})
_TIME = re.compile(r"^(\d{2}):(\d{2})(?::(\d{2})(?:\.\d+)?)?Z?$")


def read_ed269(text: str) -> Imported:
    """Zones from features: identifier, name, message, restriction (told in the description), applicability, geometry.

    Raises:
        InvalidObject: this is not an ED-269 file, or a geometry is broken.
    """
    whole = parse_json(text)
    if "features" not in whole:
        raise InvalidObject("features", "is missing; this is not an ED-269 file")
    drafts = Drafts()
    for i, feature in enumerate(objects(whole["features"], "features")):
        _read_feature(drafts, feature, f"features[{i}]")
    return drafts.result()


def _read_feature(drafts: Drafts, feature: dict[str, Any], field: str) -> None:
    title = str(feature.get("identifier") or feature.get("name") or field)
    told = [str(feature[key]) for key in ("name", "restriction", "message") if feature.get(key)]
    spec: dict[str, Any] = {"description": drafts.described(title, ": ".join(told))} if told else {}
    drafts.unmapped(title, _given(feature), _USED)
    if feature.get("restriction"):
        drafts.note(title, f"a Zone forbids nothing by itself; add a policy for restriction {feature['restriction']}")
    schedule = _schedule(drafts, title, feature, field)
    if schedule:
        spec["schedule"] = schedule
    volumes = objects(feature.get("geometry"), f"{field}.geometry")
    if not volumes:
        drafts.note(title, "it has no geometry; left out")
    for j, volume in enumerate(volumes):
        where = f"{field}.geometry[{j}]"
        drafts.unmapped(title, _given(volume), _OF_VOLUME)
        band = _band(drafts, title, volume)
        drafts.add(title, {**spec, "area": _area(volume, where), **({"altitude": band} if band else {})})


def _given(found: dict[str, Any]) -> list[str]:
    """The fields that say something."""
    return [key for key, value in found.items() if value not in (None, "", [], {})]


def _area(volume: dict[str, Any], field: str) -> dict[str, Any]:
    where = f"{field}.horizontalProjection"
    projection = fields(volume.get("horizontalProjection"), where)
    match projection.get("type"):
        case "Polygon":
            return rings(projection.get("coordinates"), f"{where}.coordinates")
        case "Circle":
            return round_area(
                place(projection.get("center"), f"{where}.center"), projection.get("radius"), f"{where}.radius"
            )
        case other:
            raise InvalidObject(f"{where}.type", f"must be Polygon or Circle, not {other!r}")


def _band(drafts: Drafts, title: str, volume: dict[str, Any]) -> dict[str, Any]:
    """The altitude band; what cannot be said makes the zone higher and deeper, never smaller."""
    unit = str(volume.get("uomDimensions") or "M")
    scale = _UNITS_M.get(unit)
    if scale is None:
        drafts.note(title, f"limits in {unit} are not taken over, M and FT are; the zone has no limits of altitude")
        return {}
    limits: dict[str, tuple[float, str]] = {}
    for side in ("lower", "upper"):
        value, datum = volume.get(f"{side}Limit"), str(volume.get(f"{side}VerticalReference"))
        if value is None:
            continue
        if not number(value):
            drafts.note(
                title, f"{side}Limit {value!r} is not a number and not taken over; the zone has no {side} limit"
            )
            continue
        if side == "lower" and value <= 0 and datum == "AGL":
            continue
        reference = _REFERENCES.get(datum)
        if reference is None:
            drafts.note(title, f"{side}Limit above {datum} is not taken over; the zone has no {side} limit")
        else:
            limits[side] = (round(value * scale, 3), reference)
    if len({reference for _, reference in limits.values()}) > 1:
        drafts.note(title, "lowerLimit and upperLimit have different datums; the zone reaches from the ground up")
        limits.pop("lower")
    reference = next((r for _, r in limits.values()), None)
    return {**{s: v for s, (v, _) in limits.items()}, "reference": reference} if reference else {}


def _schedule(drafts: Drafts, title: str, feature: dict[str, Any], field: str) -> list[dict[str, Any]]:
    times: list[dict[str, Any]] = []
    for i, period in enumerate(objects(feature.get("applicability"), f"{field}.applicability")):
        drafts.unmapped(title, _given(period), _OF_PERIOD)
        if period.get("permanent") == "YES":
            return []
        valid = {
            ours: period[theirs]
            for ours, theirs in (("validFrom", "startDateTime"), ("validUntil", "endDateTime"))
            if period.get(theirs)
        }
        daily = objects(period.get("schedule"), f"{field}.applicability[{i}].schedule")
        times += [{**valid, **_daily(drafts, title, day)} for day in daily or [{}]]
    return [time for time in times if time]


def _daily(drafts: Drafts, title: str, day: dict[str, Any]) -> dict[str, Any]:
    drafts.unmapped(title, _given(day), _OF_DAY)
    given = day.get("day") or []
    named = [str(d) for d in (given if isinstance(given, list) else [given])]
    unknown = sorted(set(named) - set(_DAYS) - {"ANY"})
    if unknown:
        drafts.note(title, f"{', '.join(unknown)} is not a day of the week; the zone is active every day")
    days = [_DAYS[d] for d in named if d in _DAYS]
    found: dict[str, Any] = {"days": days} if days and not unknown and "ANY" not in named else {}
    start, end = (_TIME.match(str(day.get(key, ""))) for key in ("startTime", "endTime"))
    if start is not None and end is not None:
        # Whole minutes that contain the time: a zone is rather active too long.
        minutes = int(end[1]) * 60 + int(end[2]) + (1 if int(end[3] or 0) else 0)
        found |= {"start": f"{start[1]}:{start[2]}", "end": f"{minutes // 60 % 24:02d}:{minutes % 60:02d}"}
    elif day.get("startTime") or day.get("endTime"):
        drafts.note(title, "startTime and endTime are not both HH:MM in UTC; the zone is active all day")
    return found


def write_ed269(zones: Iterable[Zone], *, country: str = "XXX", restriction: str = "CONDITIONAL") -> Exported:
    """A feature for each zone; what ED-269 asks for and a Zone does not know is filled in, and noted."""
    zones = tuple(zones)
    notes = unsaid(zones)
    features = []
    for i, zone in enumerate(zones):
        feature = {
            "identifier": f"FX{i + 1:05d}",
            "country": country,
            "name": zone.name,
            "type": "COMMON",
            "restriction": restriction,
            "reason": ["OTHER"],
            "otherReasonInfo": "",
            "message": zone.spec.description,
            "applicability": _applicability(zone.spec.schedule),
            "zoneAuthority": [],
            "geometry": [_geometry(zone, notes)],
        }
        features.append(feature)
    if zones:
        notes.append(f"every zone: zoneAuthority is unknown; restriction is {restriction}, country {country}")
    whole = {"title": "Zones", "description": "", "features": features}
    return Exported(json.dumps(whole, indent=1) + "\n", tuple(notes))


def _geometry(zone: Zone, notes: list[str]) -> dict[str, Any]:
    band = zone.spec.altitude or AltitudeBand(reference="terrain")
    if band.reference == "home":
        notes.append(f"{zone.name}: altitudes above home are written as above ground (AGL)")
    datum = "AMSL" if band.reference == "amsl" else "AGL"
    area = zone.spec.area
    projection: dict[str, Any] = {"type": "Polygon", "coordinates": area_rings(area)}
    if area.circle is not None:
        centre = [area.circle.center.lon, area.circle.center.lat]
        projection = {"type": "Circle", "center": centre, "radius": area.circle.radius}
    found: dict[str, Any] = {
        "uomDimensions": "M",
        "lowerLimit": band.lower if band.lower is not None else 0,
        "lowerVerticalReference": datum if band.lower is not None else "AGL",
        "upperVerticalReference": datum,
        "horizontalProjection": projection,
    }
    if band.upper is not None:
        found["upperLimit"] = band.upper
    return found


def _applicability(schedule: Iterable[ActiveTime]) -> list[dict[str, Any]]:
    periods = []
    names = {ours: theirs for theirs, ours in _DAYS.items()}
    for time in schedule:
        period: dict[str, Any] = {"permanent": "NO"}
        if time.valid_from is not None:
            period["startDateTime"] = time.valid_from.isoformat()
        if time.valid_until is not None:
            period["endDateTime"] = time.valid_until.isoformat()
        if time.days or time.start:
            day = [names[d] for d in time.days] or ["ANY"]
            start, end = time.start or "00:00", time.end or "00:00"
            period["schedule"] = [{"day": day, "startTime": f"{start}Z", "endTime": f"{end}Z"}]
        periods.append(period)
    return periods or [{"permanent": "YES"}]
