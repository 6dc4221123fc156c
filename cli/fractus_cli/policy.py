"""`fractus policy`: judge a call with the policy engine, from manifests."""

from __future__ import annotations

import json
import math
import pathlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from typing import Any, TypeVar

import click
from fractus_core.api import Application, Drone, Policy, Resource
from fractus_core.api.grants import ApplicationReference, GrantedLimits, GrantSpec
from fractus_core.api.methods import METHODS_OF
from fractus_core.api.model import InvalidObject
from fractus_core.planning import Settings
from fractus_core.planning.grant_compiler import compile_grants, refresh
from fractus_core.policy.compiled_grant import compile_grant
from fractus_core.policy.decision_types import Airframe, Attitude, Call, Home, Situation, Verdict
from fractus_core.policy.engine import judge
from fractus_core.policy.lenses import bounding_lens

from fractus_cli.call_arguments import parse_call, parse_numbers, parse_time
from fractus_cli.manifests import BadManifest, Manifests, read_manifests
from fractus_cli.offline_planner import plan_all
from fractus_cli.output import output_option

R = TypeVar("R", bound=Resource)

IN_AIR_M = 0.5
"""Altitude above home, in metres, above which the drone counts as flying."""


@click.group()
def policy() -> None:
    """Judge calls with the policy engine."""


@policy.command()
@click.option(
    "--policies", "paths", type=click.Path(exists=True, path_type=pathlib.Path), multiple=True, required=True,
    help="File or directory of Policies and their Zones. May be repeated.",
)  # fmt: skip
@click.option(
    "--drone",
    "drone_file",
    type=click.Path(exists=True, path_type=pathlib.Path),
    required=True,
    help="Manifest of the Drone.",
)
@click.option(
    "--application", "application_file", type=click.Path(exists=True, path_type=pathlib.Path),
    help="Manifest of the Application that makes the call. Without it, the caller has a Grant for all methods.",
)  # fmt: skip
@click.option("--component", help="Component that makes the call. Required with --application.")
@click.option(
    "--method", required=True, help="Called method: Goto, Takeoff, SetSpeed, SetVelocity, Land, Arm, CaptureImage, ..."
)
@click.option(
    "--args",
    "arguments",
    default="{}",
    help='Arguments of the method, such as {"lat": 39.36, "lon": 22.95, "alt": 10}.',
)
@click.option(
    "--at",
    "at",
    callback=parse_numbers("lat", "lon", "alt"),
    metavar="lat,lon,alt",
    required=True,
    help="Position of the drone: degrees, metres above home.",
)
@click.option(
    "--velocity",
    callback=parse_numbers("n", "e", "d"),
    metavar="n,e,d",
    default="0,0,0",
    help="Velocity of the drone north, east and down in m/s.",
)
@click.option(
    "--home", callback=parse_numbers("lat", "lon", "alt"), metavar="lat,lon,alt",
    help="Take-off position: degrees, metres above mean sea level.  [default: home of the Drone, else --at at sea level]",
)  # fmt: skip
@click.option(
    "--time", "time_s", callback=parse_time, metavar="RFC3339", help="Time of the call with time zone.  [default: now]"
)
@click.option(
    "--way-home", type=click.Choice(["straight", "retraced"]), default="straight", show_default=True,
    help="Return flight of the autopilot's failsafe: straight (RTL), or along the path flown (SmartRTL).",
)  # fmt: skip
@click.option("--flat-terrain", is_flag=True, help="Assume that the ground is level with home everywhere.")
@output_option
def check(paths: Sequence[pathlib.Path], drone_file: pathlib.Path, output: str, **options: Any) -> None:
    """Print the verdict on a call and its reason, from the same engine as in flight.

    The drone is on the ground if the altitude in --at is at most 0.5 m, and flies otherwise. It has the motion limits of
    ArduCopter's default parameters, the default position error of the mobility service, and a level camera.

    With --application, the Grant is the one that the operator would create, with its operation area and corridor. Without
    it, all methods are granted everywhere, and policies that select applications do not apply.

    Exit code: 0 for any verdict, 1 for bad input.
    """
    try:
        question = _question(paths, drone_file, options)
    except (BadManifest, InvalidObject) as error:
        raise click.ClickException(str(error)) from None
    compiled = compile_grant(question.grant, flat_terrain=bool(options["flat_terrain"]))
    click.echo(_FORMATS[output](judge(question.call, question.now, compiled)), nl=False)


@dataclass(frozen=True, slots=True)
class Question:
    """Call, situation of the drone, and Grant of the caller."""

    call: Call
    now: Situation
    grant: GrantSpec


def _question(paths: Sequence[pathlib.Path], drone_file: pathlib.Path, options: Mapping[str, Any]) -> Question:
    call = parse_call(options["method"], options["arguments"])
    application = options["application_file"]
    component = options["component"]
    if (application is None) != (component is None):
        raise BadManifest("specify --application and --component together")
    files = {path.resolve(): path for path in (*paths, drone_file, application) if path is not None}.values()
    manifests = read_manifests(_without_nested(list(files)))
    if not manifests.of(Policy):
        click.echo("note: --policies contains no Policy, so only the limits of the drone apply", err=True)
    drone = _drone(manifests, drone_file)
    if application is None:
        grant = _unrestricted_grant(manifests, drone)
    else:
        grant = _planned_grant(manifests, drone, application, component)
    return Question(call, _situation(drone, options), grant)


def _without_nested(paths: list[pathlib.Path]) -> list[pathlib.Path]:
    """Return the paths that are not inside another path, so that each object is read only once."""
    directories = [path.resolve() for path in paths if path.is_dir()]
    return [p for p in paths if not any(d in p.resolve().parents for d in directories)]


def _objects_in(manifests: Manifests, path: pathlib.Path, kind: type[R]) -> list[R]:
    """Return the objects of a kind that were read from a file or directory."""
    root = path.resolve()
    return [
        loaded.resource
        for loaded in manifests.objects.values()
        if isinstance(loaded.resource, kind) and loaded.manifest.file.resolve().is_relative_to(root)
    ]


def _drone(manifests: Manifests, file: pathlib.Path) -> Drone:
    drones = _objects_in(manifests, file, Drone)
    if len(drones) != 1:
        names = ", ".join(sorted(drone.name for drone in drones)) or "none"
        raise BadManifest(f"{file}: --drone must contain exactly one Drone, not {len(drones)} ({names})")
    return drones[0]


def _planned_grant(manifests: Manifests, drone: Drone, file: pathlib.Path, component: str) -> GrantSpec:
    """Return the Grant that the operator would create for a component.

    Raises:
        BadManifest: The component does not exist, or there is no plan that places it on the drone.
    """
    applications = _objects_in(manifests, file, Application)
    if len(applications) != 1:
        raise BadManifest(f"{file}: --application must contain exactly one Application, not {len(applications)}")
    application = applications[0]
    # Plan only this application, and only on this drone.
    for key, loaded in list(manifests.objects.items()):
        if isinstance(loaded.resource, Application | Drone) and loaded.resource not in (application, drone):
            del manifests.objects[key]
    known = [c.name for c in application.spec.components]
    if component not in known:
        raise BadManifest(f"Application {application.name} has no component {component} (it has {', '.join(known)})")
    settings = Settings()
    result = plan_all(manifests, settings)[0]
    if result.plan is None:
        raise BadManifest(f"Application {application.name} cannot be planned: {result.refusal}")
    inventory = manifests.inventory()
    for grant in compile_grants(application, result.plan, inventory, settings):
        if grant.component == component and grant.node == drone.name:
            return grant
    raise BadManifest(f"component {component} has no Grant on {drone.name}; add services and a placement on the drone")


def _unrestricted_grant(manifests: Manifests, drone: Drone) -> GrantSpec:
    """Return a Grant for all methods, limited by the policies that apply to all flights of the drone."""
    features = drone.spec.services.mobility
    depots = manifests.inventory().depots
    depot = depots.get(drone.spec.depot or "")
    limits = None
    if features:
        limits = GrantedLimits(max_altitude=features.max_altitude, max_speed=features.max_speed)
    grant = GrantSpec.model_validate(
        {
            "node": drone.name,
            "application": ApplicationReference(namespace="", name="", uid=""),
            "component": "",
            "instance": "",
            "class": "driver",
            "control": "full",
            "services": [{"service": service, "methods": sorted(methods)} for service, methods in METHODS_OF.items()],
            "depot": depot.spec.location if depot is not None else None,
            "home": drone.spec.home,
            "limits": limits,
        }
    )
    return refresh(grant, manifests.inventory())


def _situation(drone: Drone, options: Mapping[str, Any]) -> Situation:
    lat, lon, alt = options["at"]
    north, east, down = options["velocity"]
    time_s = options["time_s"] if options["time_s"] is not None else datetime.now(tz=UTC).timestamp()
    flying = alt > IN_AIR_M
    camera = drone.spec.services.camera
    has_gimbal = camera is not None and camera.mount is not None and camera.mount.gimbal
    return Situation(
        time_s=time_s,
        lat=lat,
        lon=lon,
        altitude_m=alt,
        north_mps=north,
        east_mps=east,
        down_mps=down,
        home=_home(drone, options),
        armed=flying,
        in_air=flying,
        airframe=Airframe(retraces=options["way_home"] == "retraced"),
        # The attitude of a gimbal is unknown, because it is measured only in flight.
        attitude=None if has_gimbal else Attitude(0.0, 0.0, math.degrees(math.atan2(east, north))),
        lens=bounding_lens(camera),
    )


def _home(drone: Drone, options: Mapping[str, Any]) -> Home:
    if options["home"] is not None:
        return Home(*options["home"])
    home = drone.spec.home
    if home is None:
        return Home(options["at"][0], options["at"][1], 0.0)
    amsl_m = home.alt if home.altitude_reference == "amsl" else None
    return Home(home.lat, home.lon, amsl_m or 0.0)


# -- output --


def _arguments_of(verdict: Verdict) -> dict[str, Any] | None:
    if verdict.args is None or not verdict.permits:
        return None
    return {name: value for name, value in asdict(verdict.args).items() if value is not None}


def _as_json(verdict: Verdict) -> str:
    document = {
        "action": verdict.action,
        "takeover": verdict.takeover,
        "args": _arguments_of(verdict),
        "reason": verdict.reason,
        "policies": list(verdict.policies),
        "code": verdict.code,
        "brakeFirst": verdict.brake_first,
        "filters": [f.action for f in verdict.filters],
    }
    return json.dumps(document, indent=2) + "\n"


def _as_text(verdict: Verdict) -> str:
    args = (_arguments_of(verdict) or {}).items()
    lines = {
        "action:   ": verdict.action,
        "takeover: ": verdict.takeover,
        "args:     ": ", ".join(
            f"{k}={v:g}" if isinstance(v, float) and k not in {"lat", "lon"} else f"{k}={v}" for k, v in args
        ),
        "reason:   ": verdict.reason + (f" ({verdict.code})" if verdict.reason and verdict.code else ""),
        "policies: ": ", ".join(verdict.policies),
        "filters:  ": ", ".join(f.action for f in verdict.filters),
        "first:    ": "the drone is stopped before the call is executed" if verdict.brake_first else "",
    }
    return "".join(f"{title}{text}\n" for title, text in lines.items() if text)


_FORMATS: dict[str, Callable[[Verdict], str]] = {"text": _as_text, "json": _as_json}
