"""Parse calls, positions, velocities and times from the command line."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from dataclasses import fields
from datetime import datetime
from typing import Any, get_args

import click
from fractus_core.api.methods import Method
from fractus_core.policy.decision_types import (
    Args,
    Call,
    CaptureArgs,
    GotoArgs,
    PointGimbalArgs,
    SetSpeedArgs,
    TakeoffArgs,
    VelocityArgs,
)

from fractus_cli.manifests import BadManifest

METHODS: tuple[str, ...] = get_args(Method)

_ARGUMENT_TYPES: dict[
    str, type[GotoArgs | TakeoffArgs | SetSpeedArgs | VelocityArgs | PointGimbalArgs | CaptureArgs]
] = {
    "Goto": GotoArgs,
    "Takeoff": TakeoffArgs,
    "SetSpeed": SetSpeedArgs,
    "SetVelocity": VelocityArgs,
    "PointGimbal": PointGimbalArgs,
    "CaptureImage": CaptureArgs,
}
_REQUIRED: dict[str, frozenset[str]] = {
    "Goto": frozenset({"lat", "lon"}),
    "Takeoff": frozenset({"altitude_m"}),
    "SetSpeed": frozenset({"speed_mps"}),
    "SetVelocity": frozenset({"north_mps", "east_mps"}),
    "PointGimbal": frozenset({"pitch_deg"}),
}


_BOUNDS: dict[str, tuple[float, float, str]] = {
    "lat": (-90.0, 90.0, "degrees"),
    "lon": (-180.0, 180.0, "degrees"),
    "alt": (-1000.0, 20_000.0, "m"),
    "n": (-100.0, 100.0, "m/s"),
    "e": (-100.0, 100.0, "m/s"),
    "d": (-100.0, 100.0, "m/s"),
}


Parser = Callable[[click.Context, click.Parameter, str | None], Any]
"""Callback of a click option. The callback converts the text of the option to a value."""


def parse_numbers(*names: str) -> Parser:
    """Return a parser of comma-separated numbers, one number for each name.

    The bounds of a number depend on its name.
    """

    def parse(context: click.Context, option: click.Parameter, text: str | None) -> tuple[float, ...] | None:
        del context, option
        if text is None:
            return None
        try:
            numbers = tuple(float(part) for part in text.split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != len(names) or not all(math.isfinite(number) for number in numbers):
            raise click.BadParameter(f"{text!r} is not {','.join(names)} ({len(names)} comma-separated numbers)")
        for name, number in zip(names, numbers, strict=True):
            lower, upper, unit = _BOUNDS[name]
            if not lower <= number <= upper:
                raise click.BadParameter(f"{name} must be {lower:g} to {upper:g} {unit}, not {number:g}")
        return numbers

    return parse


def parse_time(context: click.Context, option: click.Parameter, text: str | None) -> float | None:
    """Parse an RFC 3339 time to Unix time in seconds."""
    del context, option
    if text is None:
        return None
    try:
        time = datetime.fromisoformat(text)
    except ValueError:
        time = None
    if time is None or time.tzinfo is None:
        raise click.BadParameter(f"{text!r} is not a time with a time zone, such as 2026-06-01T12:00:00Z")
    return time.timestamp()


def parse_call(method: str, text: str) -> Call:
    """Parse a call: a method and its arguments as JSON.

    Raises:
        BadManifest: The method is unknown, or an argument is missing, unknown or invalid.
    """
    if method not in METHODS:
        raise BadManifest(f"--method: unknown method {method}; use one of: {', '.join(sorted(METHODS))}")
    try:
        # Parse integers as floats, because the JSON parser fails on very long integers. Such an integer becomes a float
        # that is out of range.
        values = json.loads(text, parse_int=float, object_pairs_hook=_reject_duplicates)
    except json.JSONDecodeError as error:
        raise BadManifest(f"--args: invalid JSON: {error.msg} at character {error.pos + 1}") from None
    except RecursionError:
        raise BadManifest("--args: the JSON is nested too deeply; use an object with numbers") from None
    if not isinstance(values, dict):
        raise BadManifest('--args: use a JSON object, such as {"lat": 39.36, "lon": 22.95, "alt": 10}')
    argument_type = _ARGUMENT_TYPES.get(method)
    if argument_type is None:
        if values:
            raise BadManifest(f"--args: {method} takes no arguments")
        return Call(method)
    names = {_plain(f.name): f.name for f in fields(argument_type)} | {f.name: f.name for f in fields(argument_type)}
    if argument_type is GotoArgs:
        names |= {"altitude": "alt", "altitudeReference": "reference"}
    arguments: dict[str, Any] = {}
    for name, value in values.items():
        field = names.get(name)
        if field is None:
            raise BadManifest(
                f"--args: {method} has no {name} (it takes {', '.join(f.name for f in fields(argument_type))})"
            )
        if field in arguments:
            raise BadManifest(f"--args: {name} is specified twice under two names; specify it once")
        if value is not None:
            arguments[field] = _value(name, field, value)
    missing = sorted(_REQUIRED.get(method, frozenset()) - set(arguments))
    if missing:
        raise BadManifest(f"--args: {method} requires {' and '.join(missing)}")
    args: Args = argument_type(**arguments)
    return Call(method, args)


def _reject_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    arguments: dict[str, Any] = {}
    for name, value in pairs:
        if name in arguments:
            raise BadManifest(f"--args: {name} is specified twice; specify it once")
        arguments[name] = value
    return arguments


def _plain(name: str) -> str:
    """Return the name of an argument without its unit, for example speed for speed_mps."""
    return re.sub(r"_(mps|m|deg|s)$", "", name)


def _value(name: str, field: str, value: Any) -> Any:
    if field == "reference":
        if value not in ("home", "amsl", "terrain"):
            raise BadManifest(f"--args: {name} must be home, amsl or terrain, not {value!r}")
        return value
    if not isinstance(value, float):
        raise BadManifest(f"--args: {name} must be a number, not {value!r}")
    if field not in {"width", "height"}:
        return value
    if not value.is_integer():
        raise BadManifest(f"--args: {name} must be a whole number of pixels, not {value!r}")
    return int(value)
