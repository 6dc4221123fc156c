"""What `fractus policy` is asked: a call with its arguments, places, velocities and times, as a command line spells them."""

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

_TAKES: dict[str, type[GotoArgs | TakeoffArgs | SetSpeedArgs | VelocityArgs | PointGimbalArgs | CaptureArgs]] = {
    "Goto": GotoArgs,
    "Takeoff": TakeoffArgs,
    "SetSpeed": SetSpeedArgs,
    "SetVelocity": VelocityArgs,
    "PointGimbal": PointGimbalArgs,
    "CaptureImage": CaptureArgs,
}
_NEEDED: dict[str, frozenset[str]] = {
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
"""The callback of an option: turns its text into a value."""


def figures(*names: str) -> Parser:
    """The parser of numbers with commas between them; by their names it knows their bounds."""

    def parse(context: click.Context, option: click.Parameter, text: str | None) -> tuple[float, ...] | None:
        del context, option
        if text is None:
            return None
        try:
            found = tuple(float(part) for part in text.split(","))
        except ValueError:
            found = ()
        if len(found) != len(names) or not all(math.isfinite(figure) for figure in found):
            raise click.BadParameter(f"{text!r} is not {','.join(names)}: {len(names)} numbers with commas")
        for name, figure in zip(names, found, strict=True):
            lower, upper, unit = _BOUNDS[name]
            if not lower <= figure <= upper:
                raise click.BadParameter(f"{name} must be {lower:g} to {upper:g} {unit}, not {figure:g}")
        return found

    return parse


def parse_time(context: click.Context, option: click.Parameter, text: str | None) -> float | None:
    """A moment as RFC 3339 spells it, as seconds since 1970 UTC."""
    del context, option
    if text is None:
        return None
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        moment = None
    if moment is None or moment.tzinfo is None:
        raise click.BadParameter(f"{text!r} is no time with its zone, such as 2026-06-01T12:00:00Z")
    return moment.timestamp()


def parse_call(method: str, text: str) -> Call:
    """The call of a method with arguments as JSON.

    Raises:
        BadManifest: there is no such method, or an argument is missing, unknown or no number.
    """
    if method not in METHODS:
        raise BadManifest(f"--method: there is no method {method} (there are {', '.join(sorted(METHODS))})")
    try:
        given = json.loads(
            text, parse_int=float, object_pairs_hook=_once
        )  # an integer of any length is a number out of range
    except json.JSONDecodeError as error:
        raise BadManifest(f"--args: this is no JSON: {error.msg} at character {error.pos + 1}") from None
    except RecursionError:
        raise BadManifest("--args: this JSON is nested too deeply; give an object of numbers") from None
    if not isinstance(given, dict):
        raise BadManifest('--args: give a JSON object, such as {"lat": 39.36, "lon": 22.95, "alt": 10}')
    takes = _TAKES.get(method)
    if takes is None:
        if given:
            raise BadManifest(f"--args: {method} takes no arguments")
        return Call(method)
    spelled = {_plain(f.name): f.name for f in fields(takes)} | {f.name: f.name for f in fields(takes)}
    if takes is GotoArgs:
        spelled |= {"altitude": "alt", "altitudeReference": "reference"}
    found: dict[str, Any] = {}
    for name, value in given.items():
        field = spelled.get(name)
        if field is None:
            raise BadManifest(f"--args: {method} has no {name} (it takes {', '.join(f.name for f in fields(takes))})")
        if field in found:
            raise BadManifest(f"--args: {name} is there twice under two names; give it once")
        if value is not None:
            found[field] = _value(name, field, value)
    missing = sorted(_NEEDED.get(method, frozenset()) - set(found))
    if missing:
        raise BadManifest(f"--args: {method} needs {' and '.join(missing)}")
    args: Args = takes(**found)
    return Call(method, args)


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in pairs:
        if name in found:
            raise BadManifest(f"--args: {name} is given twice; give it once")
        found[name] = value
    return found


def _plain(name: str) -> str:
    """An argument's name without its unit: speed for speed_mps."""
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
