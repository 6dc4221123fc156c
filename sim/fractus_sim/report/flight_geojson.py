"""GeoJSON building blocks of the reports. Coordinates are longitude, latitude, and metres above home."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from fractus_core.geo import cut_path

from fractus_sim.report.track import Place, Track


def lonlat(place: Place) -> list[float]:
    """Return the GeoJSON coordinates of a place."""
    return [round(place.lon, 7), round(place.lat, 7), round(place.alt_m, 2)]


def point(coordinates: list[float]) -> dict[str, Any]:
    """Return a Point."""
    return {"type": "Point", "coordinates": coordinates}


def feature(geometry: dict[str, Any], **properties: Any) -> dict[str, Any]:
    """Return a Feature."""
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def feature_collection(features: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return a FeatureCollection."""
    return {"type": "FeatureCollection", "features": list(features)}


def path_feature(track: Track, **properties: Any) -> dict[str, Any]:
    """Return a track as a LineString Feature with the time of each point.

    A track that crosses the antimeridian is a MultiLineString, cut there, and has a list of times for each line.
    """
    parts = cut_path([(*lonlat(s.place), s.time_s) for s in track.samples]) or [[]]
    lines = [[[lon, lat, round(alt_m, 2)] for lon, lat, alt_m, _ in part] for part in parts]
    times = [[round(time_s, 3) for *_, time_s in part] for part in parts]
    if len(parts) == 1:
        line = {"type": "LineString", "coordinates": lines[0]}
        return feature(line, what="path", drone=track.name, times=times[0], **properties)
    geometry = {"type": "MultiLineString", "coordinates": lines}
    return feature(geometry, what="path", drone=track.name, times=times, **properties)
