"""Audit logs in the formats of others: GeoJSON, KML, CSV and MCAP."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import IO, Any, cast
from xml.sax.saxutils import escape

from fractus_core.api import Zone
from fractus_core.geo.formats.kml import kml_document, zone_placemark
from fractus_services.recording.map_features import Feature, to_feature
from fractus_services.recording.messages import audit_records, component_of, finite_number, location, sentence, zones
from fractus_services.recording.segment_writer import McapWriter

from fractus_cli.audit_logs import Entry, decided, who

GAP_NS = 10_000_000_000
"""A path ends where the flight recorder, which writes twice a second while the motors run, is silent for longer."""

_COLUMNS = (
    "time", "node", "log", "kind", "lat", "lon", "alt_m", "amsl_m", "speed_mps", "battery", "mode", "controller", "component",
    "method", "action", "code", "reason", "policies", "seq", "hash",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Places:
    """What is drawn besides the flight, with a feature for each: `kind` of its properties says what it is."""

    areas: Sequence[tuple[Zone, str, str]] = ()
    """A shape, its kind, and the component that it is for."""

    def features(self) -> list[Feature]:
        """As GeoJSON."""
        return [to_feature(zone, kind, **({"component": owner} if owner else {})) for zone, kind, owner in self.areas]


@dataclass(frozen=True, slots=True)
class Export:
    """What is written.

    Attributes:
        entries: in the order of their times, as `audit_logs.entries` gives them.
        places: zones and areas.
        problems: why the entries prove nothing; empty when the chains are sound.
    """

    entries: Iterable[Entry]
    places: Places
    problems: Sequence[str]


@dataclass(slots=True)
class _Path:
    """One flight of a drone: from the motors' start to their stop."""

    node: str
    times: list[int] = field(default_factory=list)
    points: list[tuple[float, float, float]] = field(default_factory=list)


@dataclass(slots=True)
class _Flown:
    """The paths of a drone and what was decided on them, with where it was: lon, lat, metres above sea level."""

    paths: list[_Path] = field(default_factory=list)
    decisions: list[tuple[Entry, tuple[float, float, float] | None]] = field(default_factory=list)
    last: tuple[float, float, float] | None = None
    home_m: float = 0.0

    def add(self, entry: Entry) -> None:
        """Take the drone's next entry."""
        lat, lon, alt = (
            finite_number(entry.get("lat")),
            finite_number(entry.get("lon")),
            finite_number(entry.get("alt")) or 0.0,
        )
        if entry.get("kind") == "state":
            if lat is None or lon is None:
                return
            amsl = finite_number(entry.get("amsl"))
            self.home_m = amsl - alt if amsl is not None else self.home_m
            self.last = (lon, lat, self.home_m + alt)
            if not self.paths or entry["time_ns"] - self.paths[-1].times[-1] > GAP_NS:
                self.paths.append(_Path(entry["node"]))
            self.paths[-1].times.append(entry["time_ns"])
            self.paths[-1].points.append(self.last)
        elif decided(entry):
            # The monitor's entries do not say where: the recorder does, twice a second.
            at = (lon, lat, self.home_m + alt) if lat is not None and lon is not None else self.last
            self.decisions.append((entry, at))


def _flown(entries: Iterable[Entry]) -> dict[str, _Flown]:
    """What each node did, by its name; nodes that neither flew nor decided are left out."""
    flown: dict[str, _Flown] = {}
    for entry in entries:
        flown.setdefault(entry["node"], _Flown()).add(entry)
    return {node: one for node, one in sorted(flown.items()) if one.paths or one.decisions}


def write_geojson(export: Export, out: IO[bytes]) -> None:
    """A FeatureCollection (RFC 7946): paths, decisions and areas; heights are metres above sea level."""
    features: list[Feature] = []
    flown = _flown(export.entries)
    for path in (path for one in flown.values() for path in one.paths):
        spots = [list(point) for point in path.points]
        line = len(spots) > 1
        features.append({
            "type": "Feature",
            "properties": {"kind": "path", "node": path.node, "begin": _iso(path.times[0]), "end": _iso(path.times[-1])}
            | ({"times": [_iso(time_ns) for time_ns in path.times]}),
            "geometry": {"type": "LineString" if line else "Point", "coordinates": spots if line else spots[0]},
        })  # fmt: skip
    for entry, at in (decision for one in flown.values() for decision in one.decisions):
        geometry = {"type": "Point", "coordinates": list(at)} if at is not None else None
        features.append({"type": "Feature", "properties": _told(entry), "geometry": geometry})
    features += export.places.features()
    whole: dict[str, Any] = {"type": "FeatureCollection", "verified": not export.problems, "features": features}
    out.write(json.dumps(whole, ensure_ascii=False, indent=1).encode() + b"\n")


def _told(entry: Entry) -> dict[str, Any]:
    told = {key: entry[key] for key in ("action", "code", "reason", "policies", "method", "mode") if entry.get(key)}
    return {
        "kind": entry["kind"],
        "node": entry["node"],
        "time": _iso(entry["time_ns"]),
        "component": who(entry),
    } | told


def write_kml(export: Export, out: IO[bytes]) -> None:
    """A document (OGC 07-147r2): a folder for each drone, with a line for each flight and a point for each decision; and the areas."""
    flown = _flown(export.entries)
    marks = [f"<description>{escape(one)}</description>\n" for one in (" ".join(export.problems),) if one]
    marks += [_folder(node, one) for node, one in flown.items()]
    marks += [zone_placemark(zone, []) for zone, _, _ in export.places.areas]
    out.write(kml_document(marks).encode())


def _folder(node: str, flown: _Flown) -> str:
    points = (_point(entry, at) for entry, at in flown.decisions if at is not None)
    return f"<Folder><name>{escape(node)}</name>\n{''.join((*map(_line, flown.paths), *points))}</Folder>\n"


def _line(path: _Path) -> str:
    begin, end = _iso(path.times[0]), _iso(path.times[-1])
    return (
        f"<Placemark><name>flight {begin}</name><TimeSpan><begin>{begin}</begin><end>{end}</end></TimeSpan>"
        f"<LineString><altitudeMode>absolute</altitudeMode><coordinates>{' '.join(map(_spot, path.points))}</coordinates>"
        "</LineString></Placemark>\n"
    )


def _point(entry: Entry, at: tuple[float, float, float]) -> str:
    name = f"{entry.get('action') or entry['kind']} {entry.get('code') or entry.get('method') or ''}".strip()
    return (
        f"<Placemark><name>{escape(name)}</name><description>{escape(sentence(entry))}</description>"
        f"<TimeStamp><when>{_iso(entry['time_ns'])}</when></TimeStamp>"
        f"<Point><altitudeMode>absolute</altitudeMode><coordinates>{_spot(at)}</coordinates></Point></Placemark>\n"
    )


def _spot(point: tuple[float, float, float]) -> str:
    lon, lat, amsl = point
    return f"{lon!r},{lat!r},{amsl:.2f}"


def write_csv(export: Export, out: IO[bytes]) -> None:
    """A row for each entry (RFC 4180), with the number and the hash that it has in its log."""
    text = io.TextIOWrapper(out, encoding="utf-8", newline="", write_through=True)
    writer = csv.DictWriter(text, _COLUMNS, extrasaction="ignore")
    writer.writeheader()
    for entry in export.entries:
        policies = entry.get("policies")
        renamed = {"alt_m": entry.get("alt"), "amsl_m": entry.get("amsl"), "speed_mps": entry.get("speed")}
        names = " ".join(map(str, policies)) if isinstance(policies, list) else ""
        told = {"component": component_of(entry), "policies": names, "time": _iso(entry["time_ns"])}
        writer.writerow({key: value for key, value in (entry | renamed | told).items() if _plain(value)})
    text.detach()


def _plain(value: object) -> bool:
    return isinstance(value, str | int | float)


def write_mcap(export: Export, out: IO[bytes]) -> None:
    """A file for Foxglove: location, state, decisions and log of each node, and the areas as GeoJSON."""
    # The writer asks how far it is, which a pipe cannot say.
    file = McapWriter(cast(IO[bytes], _Counted(out)))
    file.add_metadata("audit", {"verified": "no" if export.problems else "yes", "problems": "\n".join(export.problems)})
    features = export.places.features()
    for entry in export.entries:
        time_ns, node = entry["time_ns"], entry["node"]
        records = list(audit_records(entry, node))
        if entry.get("kind") == "state":
            records += _located(entry, node)
        if features:
            records.append(zones(time_ns, features))
            features = []
        for record in records:
            file.write(f"/{node}/{record.topic}", record.schema, record.time_ns, record.content)
    file.close()


class _Counted:
    """A file that is only written to, from its beginning to its end."""

    def __init__(self, out: IO[bytes]) -> None:
        self._out = out
        self._at = 0

    def write(self, data: bytes) -> int:
        self._at += len(data)
        return self._out.write(data)

    def tell(self) -> int:
        return self._at

    def flush(self) -> None:
        self._out.flush()


def _located(entry: Entry, node: str) -> Iterator[Any]:
    lat, lon, amsl = finite_number(entry.get("lat")), finite_number(entry.get("lon")), finite_number(entry.get("amsl"))
    if lat is not None and lon is not None:
        yield location(entry["time_ns"], node, lat, lon, amsl if amsl is not None else 0.0)


def _iso(time_ns: int) -> str:
    return datetime.fromtimestamp(time_ns / 1e9, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


WRITERS: dict[str, Callable[[Export, IO[bytes]], None]] = {
    "csv": write_csv,
    "geojson": write_geojson,
    "kml": write_kml,
    "mcap": write_mcap,
}
