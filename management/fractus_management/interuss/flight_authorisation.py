"""Check of a U-space flight authorisation request (Implementing Regulation (EU) 2021/664, annex IV)."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any
from urllib.parse import urlsplit

_ALPHANUMERIC = "0123456789abcdefghijklmnopqrstuvwxyz"
_CHOICES = {
    "operation_mode": ("Undeclared", "Vlos", "Bvlos"),
    "operation_category": ("Unknown", "Open", "Specific", "Certified"),
    "uas_class": ("Other", "C0", "C1", "C2", "C3", "C4", "C5", "C6"),
}
_UNDECLARED = {"operation_mode": "Undeclared", "operation_category": "Unknown"}
_SERIAL = re.compile(r"[0-9A-HJ-NP-Z]{4}([1-9A-F])([0-9A-HJ-NP-Z]+)")
_OPERATOR = re.compile(r"[A-Z]{3}([0-9a-z]{12})([0-9a-z])-([0-9a-z]{3})")


def authorisation_problems(data: Mapping[str, Any]) -> Iterator[str]:
    """Yield a sentence for each problem of a flight authorisation request."""
    if not is_serial_number(data.get("uas_serial_number")):
        yield "uas_serial_number must be a serial number of ANSI/CTA-2063-A"
    for field, choices in _CHOICES.items():
        value = data.get(field)
        if value not in choices:
            yield f"{field} must be one of {', '.join(choices)}"
        elif value == _UNDECLARED.get(field):
            yield f"{field} must be declared"
    if data.get("uas_class") == "Other" and not data.get("uas_type_certificate"):
        yield "uas_type_certificate is required for the uas_class Other"
    for field in ("identification_technologies", "connectivity_methods"):
        values = data.get(field)
        if not isinstance(values, list) or not values or not all(isinstance(each, str) and each for each in values):
            yield f"{field} must name at least one"
    endurance = data.get("endurance_minutes")
    if not isinstance(endurance, int) or isinstance(endurance, bool) or endurance < 1:
        yield "endurance_minutes must be at least 1"
    if not _is_url(data.get("emergency_procedure_url")):
        yield "emergency_procedure_url must be an http or https URL"
    if not is_operator_number(data.get("operator_id")):
        yield "operator_id must be an operator registration number of EN 4709-02 with its checksum and final characters"


def is_serial_number(value: Any) -> bool:
    """Return True for a serial number of ANSI/CTA-2063-A: manufacturer code, length code, and as many characters."""
    match = _SERIAL.fullmatch(value) if isinstance(value, str) else None
    return match is not None and len(match[2]) == int(match[1], 16)


def is_operator_number(value: Any) -> bool:
    """Return True for an operator registration number of EN 4709-02, such as CHEo5kut30e0mt01-qwe.

    The sixteenth character is the Luhn checksum (modulo 36) of the twelve characters before it and the three at the end.
    """
    match = _OPERATOR.fullmatch(value) if isinstance(value, str) else None
    if match is None:
        return False
    total = 0
    for i, character in enumerate(match[1] + match[3]):
        doubled = _ALPHANUMERIC.index(character) * (2 - i % 2)
        total += doubled // 36 + doubled % 36
    return _ALPHANUMERIC[-total % 36] == match[2]


def _is_url(value: Any) -> bool:
    try:
        parts = urlsplit(value) if isinstance(value, str) else None
    except ValueError:
        return False
    return parts is not None and parts.scheme in {"http", "https"} and bool(parts.hostname)
