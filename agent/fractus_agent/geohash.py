"""Geohash of a place: the label by which fixed nodes are found (base 32, as geohash.org spells it)."""

from __future__ import annotations

_ALPHABET = "0123456789bcdefghjkmnpqrstuvwxyz"


def geohash(lat: float, lon: float, length: int = 6) -> str:
    """Geohash of a place in WGS 84 degrees; 6 characters are a cell of about 1.2 km by 0.6 km."""
    south, north, west, east = -90.0, 90.0, -180.0, 180.0
    text, bits, value, even = "", 0, 0, True
    while len(text) < length:
        if even:
            middle = (west + east) / 2
            west, east = (middle, east) if lon >= middle else (west, middle)
            value = value << 1 | (lon >= middle)
        else:
            middle = (south + north) / 2
            south, north = (middle, north) if lat >= middle else (south, middle)
            value = value << 1 | (lat >= middle)
        even, bits = not even, bits + 1
        if bits == 5:
            text, bits, value = text + _ALPHABET[value], 0, 0
    return text
