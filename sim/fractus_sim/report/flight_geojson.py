"""GeoJSON building blocks of the reports. Coordinates are longitude, latitude, and metres above home."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

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
    """Return a track as a LineString Feature. A property contains the time of each point."""
    line = {"type": "LineString", "coordinates": [lonlat(s.place) for s in track.samples]}
    times = [round(s.time_s, 3) for s in track.samples]
    return feature(line, what="path", drone=track.name, times=times, **properties)
