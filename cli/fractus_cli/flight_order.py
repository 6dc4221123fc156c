"""FlightPlan from the options of `fractus flights order`: place, window, parameters and actions."""

from __future__ import annotations

import json
import pathlib
import re
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime, timedelta
from typing import Any

import click
import fractus
from fractus_core.api import API_VERSION, FlightPlan, InvalidObject
from fractus_core.geo import formats
from fractus_core.geo.formats.zone_builder import object_list, optional_object, parse_json, parse_point

from fractus_cli.cluster_reader import Body
from fractus_cli.manifests import BadManifest, read_file
from fractus_cli.output import printable

_OPTIONS = {
    "metadata.name": "--name",
    "metadata.namespace": "--namespace",
    "spec.template": "TEMPLATE",
    "spec.parameters": "--parameter",
    "spec.waypoints": "waypoints",
    "spec.region": "region",
    "spec.stay": "--stay",
    "spec.window.start": "--start",
    "spec.window.duration": "--duration",
    "spec.drone": "--drone",
    "spec.priorityClass": "--priority",
    "spec.policyActions": "--action",
    "spec.contactLost": "--contact-lost",
}
"""Option of each field of a FlightPlan."""

_REGION_READERS: dict[str, Callable[[str], formats.Imported]] = {
    ".geojson": formats.read_geojson,
    ".json": formats.read_geojson,
    ".kml": formats.read_kml,
    ".plan": formats.read_qgc_plan,
}

_UNITS = {"m": "minutes", "h": "hours", "d": "days"}


# -- options --


def parse_waypoint(context: click.Context, option: click.Parameter, texts: Sequence[str]) -> list[Body]:
    """Parse LAT,LON or LAT,LON,ALT."""
    del context, option
    return [_position(text) for text in texts]


def _position(text: str) -> Body:
    numbers = _numbers(text, 2, 3, "LAT,LON,ALT, such as 39.36,22.93,25")
    return dict(zip(("lat", "lon", "alt"), numbers, strict=False))


def parse_circle(context: click.Context, option: click.Parameter, text: str | None) -> Body | None:
    """Parse LAT,LON,RADIUS."""
    del context, option
    if text is None:
        return None
    lat, lon, radius = _numbers(text, 3, 3, "LAT,LON,RADIUS with the radius in metres, such as 39.36,22.93,100")
    return {"circle": {"center": {"lat": lat, "lon": lon}, "radius": radius}}


def parse_actions(context: click.Context, option: click.Parameter, texts: Sequence[str]) -> list[Body]:
    """Parse POLICY=ACTION or POLICY=ACTION@LAT,LON."""
    del context, option
    actions: list[Body] = []
    for text in texts:
        policy, equals, rest = text.partition("=")
        if not (policy and equals and rest):
            raise click.BadParameter(f"{text!r} is not POLICY=ACTION, such as school=hover or school=abort@39.36,22.93")
        actions.append({"policy": policy, **_action(rest)})
    return actions


def parse_contact_lost(context: click.Context, option: click.Parameter, text: str | None) -> Body | None:
    """Parse ACTION or ACTION@LAT,LON."""
    del context, option
    return None if text is None else _action(text)


def _action(text: str) -> Body:
    action, at, place = text.partition("@")
    if not at:
        return {"action": action}
    lat, lon = _numbers(place, 2, 2, "LAT,LON of the landing place after @, such as abort@39.36,22.93")
    return {"action": action, "landAt": {"lat": lat, "lon": lon}}


def _numbers(text: str, least: int, most: int, form: str) -> list[float]:
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if not least <= len(numbers) <= most or not all(abs(number) < 1e9 for number in numbers):
        raise click.BadParameter(f"{text!r} is not {form}")
    return numbers


def parse_start(context: click.Context, option: click.Parameter, text: str) -> str:
    """Return an RFC 3339 time. `now` and `+30m` count from now."""
    del context, option
    after = re.fullmatch(r"\+(\d{1,5})([mhd])", text)
    if text != "now" and after is None:
        return text
    delay = timedelta(**{_UNITS[after[2]]: int(after[1])}) if after is not None else timedelta()
    return (datetime.now(UTC) + delay).strftime("%Y-%m-%dT%H:%M:%SZ")


def parse_parameters(context: click.Context, option: click.Parameter, texts: Sequence[str]) -> dict[str, Any]:
    """Parse NAME=VALUE. A value that is not JSON is a string."""
    del context, option
    parameters: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not (name and equals):
            raise click.BadParameter(f"{text!r} is not NAME=VALUE, such as speed=5")
        if name in parameters:
            raise click.BadParameter(f"{name} is specified twice; remove one of them")
        try:
            parameters[name] = json.loads(value, parse_constant=_no_constant)
        except (ValueError, RecursionError):
            parameters[name] = value
    return parameters


def _no_constant(name: str) -> float:
    raise ValueError(name)  # NaN and Infinity are not JSON, so they stay strings.


# -- place --


def place_of(
    waypoints: list[Body],
    path: pathlib.Path | None,
    region: pathlib.Path | None,
    circle: Body | None,
    altitude: float | None,
) -> Body:
    """Return the waypoints or the region of a FlightPlan.

    Args:
        waypoints: Waypoints of --waypoint.
        path: QGroundControl plan or GeoJSON file with waypoints.
        region: File with one area.
        circle: Area of --circle.
        altitude: Altitude above home of waypoints without one, in metres.

    Raises:
        ClickException: There is not exactly one place, a file is invalid, or a waypoint has no altitude.
    """
    given = [bool(waypoints), path is not None, region is not None, circle is not None]
    if given.count(True) != 1:
        raise click.UsageError("specify the place of the flight by one of --waypoint, --path, --region and --circle")
    if circle is not None:
        return {"region": circle}
    if region is not None:
        return {"region": _read_region(region)}
    source = "--waypoint" if path is None else f"--path {path}"
    positions = waypoints if path is None else _read_path(path)
    for number, position in enumerate(positions, start=1):
        if "alt" not in position and altitude is None:
            raise click.UsageError(f"{source}: waypoint {number} has no altitude; add --altitude METRES")
    return {"waypoints": [{"alt": altitude, **position} for position in positions]}


def _read_path(file: pathlib.Path) -> list[Body]:
    if file.suffix == ".plan":
        return list(_read_qgc_waypoints(file))
    if file.suffix not in {".geojson", ".json"}:
        raise click.UsageError(
            f"--path {file}: unknown format; specify a .plan file of QGroundControl or a .geojson file"
        )
    try:
        return list(_line_of(parse_json(_text(file, "--path"))))
    except InvalidObject as error:
        raise click.ClickException(f"--path {file}: {error}") from None


def _read_qgc_waypoints(file: pathlib.Path) -> Iterator[Body]:
    try:
        waypoints = fractus.read_plan(file)
    except fractus.InvalidRequest as error:
        raise click.ClickException(f"--path {error}") from None
    if any(each.speed_mps or each.yaw_deg is not None or each.stay_s for each in waypoints):
        click.echo(
            printable(f"note: {file}: speeds, headings and stays are ignored, because a FlightPlan has none"), err=True
        )
    for each in waypoints:
        position = each.position
        yield {
            "lat": position.lat,
            "lon": position.lon,
            "alt": position.alt,
            "altitudeReference": position.reference.name.lower(),
        }


def _line_of(document: Body) -> Iterator[Body]:
    """Yield the positions of the only LineString of a GeoJSON document.

    Raises:
        InvalidObject: The document has another number of lines, or a position is invalid or has a height.
    """
    features = object_list(document.get("features"), "features") if "features" in document else [document]
    geometries = [
        each if each.get("type") == "LineString" else optional_object(each.get("geometry"), "geometry")
        for each in features
    ]
    lines = [each for each in geometries if each.get("type") == "LineString"]
    if len(lines) != 1:
        raise InvalidObject("", f"the file has {len(lines)} LineStrings; draw the path as one LineString")
    coordinates = lines[0].get("coordinates")
    if not isinstance(coordinates, list) or not coordinates:
        raise InvalidObject("coordinates", "must be a list of positions")
    for i, position in enumerate(coordinates):
        if isinstance(position, list) and any(position[2:]):
            raise InvalidObject(
                f"coordinates[{i}]",
                "has a height above the ellipsoid, which is not the altitude of a flight; remove the heights and add --altitude",
            )
        point = parse_point(position, f"coordinates[{i}]")
        yield {"lat": point.lat, "lon": point.lon}


def _read_region(file: pathlib.Path) -> Body:
    read = _REGION_READERS.get(file.suffix)
    if read is None:
        raise click.UsageError(f"--region {file}: unknown format; specify a .geojson, .kml or .plan file")
    try:
        zones = read(_text(file, "--region")).zones
    except InvalidObject as error:
        raise click.ClickException(f"--region {file}: {error}") from None
    if len(zones) != 1:
        raise click.ClickException(
            f"--region {file}: the file has {len(zones)} areas; keep exactly one polygon or circle"
        )
    spec = zones[0].spec
    if spec.altitude is not None or spec.schedule:
        raise click.ClickException(
            f"--region {file}: the area has an altitude or a schedule; remove them, because the template limits the altitude"
            " and --start and --duration the time"
        )
    return spec.area.to_dict()


def _text(file: pathlib.Path, option: str) -> str:
    try:
        return read_file(file).decode("utf-8-sig")
    except BadManifest as error:
        raise click.ClickException(f"{option} {error}") from None
    except UnicodeDecodeError:
        raise click.ClickException(f"{option} {file}: not a UTF-8 text file; convert it to UTF-8") from None


# -- flight plan --


def flight_plan(namespace: str, name: str | None, spec: Body) -> dict[str, Any]:
    """Return a FlightPlan to create. Without a name, the API server adds a random suffix to the name of the template.

    Args:
        namespace: Namespace of the plan.
        name: Name of the plan, or None.
        spec: Specification. Fields with the value None are left out.

    Raises:
        ClickException: The plan is invalid. The message names the option.
    """
    body: dict[str, Any] = {
        "apiVersion": API_VERSION,
        "kind": FlightPlan.KIND,
        "metadata": {"namespace": namespace, "name": name or "unnamed"},
        "spec": {key: value for key, value in spec.items() if value is not None},
    }
    try:
        FlightPlan.from_body(body)
    except InvalidObject as error:
        raise click.UsageError(_option_sentence(error)) from None
    if name is None:
        body["metadata"] = {"namespace": namespace, "generateName": f"{spec['template']}-"}
    return body


def _option_sentence(error: InvalidObject) -> str:
    for field, option in _OPTIONS.items():
        if error.field.startswith(field):
            return f"{option}{error.field.removeprefix(field)}: {error.problem}"
    return str(error)
