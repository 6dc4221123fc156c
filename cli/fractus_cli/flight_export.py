"""Export audit logs as GeoJSON, KML, CSV and MCAP."""

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
from fractus_core.geo import cut_path
from fractus_core.geo.formats.kml import kml_document, zone_placemark
from fractus_services.recording.map_features import Feature, to_feature
from fractus_services.recording.messages import (
    audit_records,
    component_of,
    controller_of,
    finite_number,
    location,
    sentence,
    zones,
)
from fractus_services.recording.segment_writer import McapWriter

from fractus_cli.audit_logs import Entry, actor, is_decision

GAP_NS = 10_000_000_000
"""A path ends if no state entry follows within this time.

While the motors run, the audit log has two state entries per second.
"""

_COLUMNS = (
    "time", "node", "log", "kind", "lat", "lon", "alt_m", "amsl_m", "speed_mps", "battery", "mode", "controller", "component",
    "method", "action", "code", "reason", "policies", "seq", "hash",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Areas:
    """Zones and areas to export with the flight.

    Attributes:
        shapes: Shapes, each with its kind and its component. The component is an empty string for zones.
    """

    shapes: Sequence[tuple[Zone, str, str]] = ()

    def features(self) -> list[Feature]:
        """Return GeoJSON features with the properties `kind` and, for areas of a component, `component`."""
        return [
            to_feature(zone, kind, **({"component": component} if component else {}))
            for zone, kind, component in self.shapes
        ]


@dataclass(frozen=True, slots=True)
class Export:
    """Data to export.

    Attributes:
        entries: Entries in time order, see `audit_logs.entries`.
        areas: Zones and areas.
        problems: Problems of the hash chains. Empty if they are sound.
    """

    entries: Iterable[Entry]
    areas: Areas
    problems: Sequence[str]


@dataclass(slots=True)
class _Path:
    """Path of one flight, from motor start to motor stop."""

    node: str
    times: list[int] = field(default_factory=list)
    points: list[tuple[float, float, float]] = field(default_factory=list)

    def parts(self) -> list[list[tuple[float, ...]]]:
        """Return the lines between crossings of the antimeridian.

        A point consists of longitude, latitude, altitude, and the time since the first point in nanoseconds.
        """
        # Times are relative to the first point, because nanoseconds since 1970 exceed the precision of floats.
        after_ns = [float(time_ns - self.times[0]) for time_ns in self.times]
        parts = cut_path([(*point, time_ns) for point, time_ns in zip(self.points, after_ns, strict=True)])
        # If a path begins or ends at the antimeridian, its first or last part is a single point. Omit such parts.
        return [part for part in parts if len(part) > 1] or parts[:1]


@dataclass(slots=True)
class _DroneFlights:
    """Paths and decisions of a drone. Positions are longitude and latitude in degrees, and metres above mean sea level."""

    paths: list[_Path] = field(default_factory=list)
    decisions: list[tuple[Entry, tuple[float, float, float] | None]] = field(default_factory=list)
    last: tuple[float, float, float] | None = None
    home_m: float = 0.0

    def add(self, entry: Entry) -> None:
        """Process the next entry of the drone."""
        lat = finite_number(entry.get("lat"))
        lon = finite_number(entry.get("lon"))
        alt = finite_number(entry.get("alt")) or 0.0
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
        elif is_decision(entry):
            # Entries of the monitor have no position, so use the last recorded position.
            at = (lon, lat, self.home_m + alt) if lat is not None and lon is not None else self.last
            self.decisions.append((entry, at))


def _flights_by_node(entries: Iterable[Entry]) -> dict[str, _DroneFlights]:
    """Return paths and decisions by node. Omit nodes that have neither paths nor decisions."""
    by_node: dict[str, _DroneFlights] = {}
    for entry in entries:
        by_node.setdefault(entry["node"], _DroneFlights()).add(entry)
    return {node: flights for node, flights in sorted(by_node.items()) if flights.paths or flights.decisions}


def write_geojson(export: Export, out: IO[bytes]) -> None:
    """Write a FeatureCollection (RFC 7946) with paths, decisions and areas. Altitudes are metres above mean sea level."""
    features: list[Feature] = []
    by_node = _flights_by_node(export.entries)
    for path in (path for flights in by_node.values() for path in flights.paths):
        line, times = _path_geometry(path)
        features.append({
            "type": "Feature",
            "properties": {
                "kind": "path", "node": path.node, "begin": _iso(path.times[0]), "end": _iso(path.times[-1]), "times": times,
            },
            "geometry": line,
        })  # fmt: skip
    for entry, at in (decision for flights in by_node.values() for decision in flights.decisions):
        geometry = {"type": "Point", "coordinates": list(at)} if at is not None else None
        features.append({"type": "Feature", "properties": _decision_properties(entry), "geometry": geometry})
    features += export.areas.features()
    document: dict[str, Any] = {"type": "FeatureCollection", "verified": not export.problems, "features": features}
    out.write(json.dumps(document, ensure_ascii=False, indent=1).encode() + b"\n")


def _path_geometry(path: _Path) -> tuple[dict[str, Any], list[Any]]:
    """Return the geometry of a path and the times of its positions.

    A path across the antimeridian has a list of times per line.
    """
    parts = path.parts()
    lines = [[list(point[:3]) for point in part] for part in parts]
    times = [[_iso(path.times[0] + round(point[3])) for point in part] for part in parts]
    if len(lines) > 1:
        return {"type": "MultiLineString", "coordinates": lines}, times
    if len(lines[0]) > 1:
        return {"type": "LineString", "coordinates": lines[0]}, times[0]
    return {"type": "Point", "coordinates": lines[0][0]}, times[0]


def _decision_properties(entry: Entry) -> dict[str, Any]:
    optional = {key: entry[key] for key in ("action", "code", "reason", "policies", "method", "mode") if entry.get(key)}
    return {
        "kind": entry["kind"],
        "node": entry["node"],
        "time": _iso(entry["time_ns"]),
        "component": actor(entry),
    } | optional


def write_kml(export: Export, out: IO[bytes]) -> None:
    """Write a KML document (OGC 07-147r2): a folder for each drone with flight lines and decision points, and the areas."""
    elements = [f"<description>{escape(' '.join(export.problems))}</description>\n"] if export.problems else []
    elements += [_folder(node, flights) for node, flights in _flights_by_node(export.entries).items()]
    elements += [zone_placemark(zone, []) for zone, _, _ in export.areas.shapes]
    out.write(kml_document(elements).encode())


def _folder(node: str, flights: _DroneFlights) -> str:
    points = (_point(entry, at) for entry, at in flights.decisions if at is not None)
    return f"<Folder><name>{escape(node)}</name>\n{''.join((*map(_line, flights.paths), *points))}</Folder>\n"


def _line(path: _Path) -> str:
    begin = _iso(path.times[0])
    end = _iso(path.times[-1])
    parts = path.parts()
    lines = "".join(
        f"<LineString><altitudeMode>absolute</altitudeMode><coordinates>{' '.join(map(_coordinates, part))}</coordinates>"
        "</LineString>"
        for part in parts
    )
    return (
        f"<Placemark><name>flight {begin}</name><TimeSpan><begin>{begin}</begin><end>{end}</end></TimeSpan>"
        f"{lines if len(parts) == 1 else f'<MultiGeometry>{lines}</MultiGeometry>'}</Placemark>\n"
    )


def _point(entry: Entry, at: tuple[float, float, float]) -> str:
    name = f"{entry.get('action') or entry['kind']} {entry.get('code') or entry.get('method') or ''}".strip()
    return (
        f"<Placemark><name>{escape(name)}</name><description>{escape(sentence(entry))}</description>"
        f"<TimeStamp><when>{_iso(entry['time_ns'])}</when></TimeStamp>"
        f"<Point><altitudeMode>absolute</altitudeMode><coordinates>{_coordinates(at)}</coordinates></Point></Placemark>\n"
    )


def _coordinates(point: tuple[float, ...]) -> str:
    lon, lat, amsl, *_ = point
    return f"{lon!r},{lat!r},{amsl:.2f}"


def write_csv(export: Export, out: IO[bytes]) -> None:
    """Write one row for each entry (RFC 4180), with its sequence number and hash."""
    text = io.TextIOWrapper(out, encoding="utf-8", newline="", write_through=True)
    writer = csv.DictWriter(text, _COLUMNS, extrasaction="ignore")
    writer.writeheader()
    for entry in export.entries:
        policies = entry.get("policies")
        renamed = {"alt_m": entry.get("alt"), "amsl_m": entry.get("amsl"), "speed_mps": entry.get("speed")}
        names = " ".join(map(str, policies)) if isinstance(policies, list) else ""
        computed = {
            "component": component_of(entry),
            "controller": controller_of(entry),
            "policies": names,
            "time": _iso(entry["time_ns"]),
        }
        writer.writerow({key: value for key, value in (entry | renamed | computed).items() if _is_scalar(value)})
    text.detach()


def _is_scalar(value: object) -> bool:
    return isinstance(value, str | int | float)


def write_mcap(export: Export, out: IO[bytes]) -> None:
    """Write a file for Foxglove: location, state, decisions and log of each node, and the areas as GeoJSON."""
    # McapWriter calls tell(), which a pipe does not support.
    file = McapWriter(cast(IO[bytes], _CountingWriter(out)))
    file.add_metadata("audit", {"verified": "no" if export.problems else "yes", "problems": "\n".join(export.problems)})
    features = export.areas.features()
    for entry in export.entries:
        time_ns = entry["time_ns"]
        node = entry["node"]
        records = list(audit_records(entry, node))
        if entry.get("kind") == "state":
            records += _location(entry, node)
        if features:
            records.append(zones(time_ns, features))
            features = []
        for record in records:
            file.write(f"/{node}/{record.topic}", record.schema, record.time_ns, record.content)
    file.close()


class _CountingWriter:
    """Output stream that counts its bytes."""

    def __init__(self, out: IO[bytes]) -> None:
        self._out = out
        self._position = 0

    def write(self, data: bytes) -> int:
        self._position += len(data)
        return self._out.write(data)

    def tell(self) -> int:
        return self._position

    def flush(self) -> None:
        self._out.flush()


def _location(entry: Entry, node: str) -> Iterator[Any]:
    lat = finite_number(entry.get("lat"))
    lon = finite_number(entry.get("lon"))
    amsl = finite_number(entry.get("amsl"))
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
