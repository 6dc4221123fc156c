"""`fractus policy`: what the policy engine would say, from manifests alone."""

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

from fractus_cli.calls import figures, parse_call, parse_time
from fractus_cli.manifests import BadManifest, Manifests, read_manifests
from fractus_cli.output import output_option
from fractus_cli.planning import plan_all

R = TypeVar("R", bound=Resource)

IN_AIR_M = 0.5


@click.group()
def policy() -> None:
    """Ask the policy engine."""


@policy.command()
@click.option(
    "--policies", "paths", type=click.Path(exists=True, path_type=pathlib.Path), multiple=True, required=True,
    help="A file or a directory of Policies and their Zones; may be repeated.",
)  # fmt: skip
@click.option(
    "--drone", "drone_file", type=click.Path(exists=True, path_type=pathlib.Path), required=True, help="The Drone."
)
@click.option(
    "--application", "application_file", type=click.Path(exists=True, path_type=pathlib.Path),
    help="The Application whose component asks; without it, a caller that may do everything asks.",
)  # fmt: skip
@click.option("--component", help="The component that asks; needed with --application.")
@click.option("--method", required=True, help="Goto, Takeoff, SetSpeed, SetVelocity, Land, Arm, CaptureImage, ...")
@click.option(
    "--args", "arguments", default="{}", help='Its arguments, such as {"lat": 39.36, "lon": 22.95, "alt": 10}.'
)
@click.option(
    "--at",
    "at",
    callback=figures("lat", "lon", "alt"),
    metavar="lat,lon,alt",
    required=True,
    help="The drone: degrees, metres above home.",
)
@click.option(
    "--velocity",
    callback=figures("n", "e", "d"),
    metavar="n,e,d",
    default="0,0,0",
    help="Its velocity north, east, down in m/s.",
)
@click.option(
    "--home", callback=figures("lat", "lon", "alt"), metavar="lat,lon,alt",
    help="Where it took off: degrees, metres above mean sea level. Else that of its manifest, else below --at at sea level.",
)  # fmt: skip
@click.option("--time", "time_s", callback=parse_time, metavar="RFC3339", help="When, with its zone; else now.")
@click.option(
    "--way-home", type=click.Choice(["straight", "retraced"]), default="straight", show_default=True,
    help="How the autopilot's failsafe flies home: straight (RTL), or back as it came (SmartRTL).",
)  # fmt: skip
@click.option("--flat-terrain", is_flag=True, help="Take the ground for as high as home everywhere.")
@output_option
def check(paths: Sequence[pathlib.Path], drone_file: pathlib.Path, output: str, **asked: Any) -> None:
    """What would become of a call, and why: the same engine and the same answer as in flight.

    The drone stands when --at is below half a metre and flies otherwise; its motion is that of ArduCopter's usual
    parameters, its position errors those that the mobility service assumes, and its camera is level.

    With --application the grant is the one that the operator would write, with its operation area and corridor. Without,
    every method is granted everywhere, and policies for particular applications do not hold.

    Exit code: 0 with an answer, whatever it is; 1 if the input is bad.
    """
    try:
        question = _question(paths, drone_file, asked)
    except (BadManifest, InvalidObject) as error:
        raise click.ClickException(str(error)) from None
    compiled = compile_grant(question.grant, flat_terrain=bool(asked["flat_terrain"]))
    click.echo(_FORMATS[output](judge(question.call, question.now, compiled)), nl=False)


@dataclass(frozen=True, slots=True)
class Question:
    """A call, who asks it, and in what situation."""

    call: Call
    now: Situation
    grant: GrantSpec


def _question(paths: Sequence[pathlib.Path], drone_file: pathlib.Path, asked: Mapping[str, Any]) -> Question:
    call = parse_call(asked["method"], asked["arguments"])
    application, component = asked["application_file"], asked["component"]
    if (application is None) != (component is None):
        raise BadManifest("give --application and --component together, or neither")
    files = {path.resolve(): path for path in (*paths, drone_file, application) if path is not None}.values()
    manifests = read_manifests(_apart(list(files)))
    if not manifests.of(Policy):
        click.echo("note: --policies has no Policy, so nothing but the drone's own limits is judged", err=True)
    drone = _drone(manifests, drone_file)
    grant = _anything(manifests, drone) if application is None else _granted(manifests, drone, application, component)
    return Question(call, _situation(drone, asked), grant)


def _apart(paths: list[pathlib.Path]) -> list[pathlib.Path]:
    """The paths that lie in none of the others, for no object may be read twice."""
    directories = [path.resolve() for path in paths if path.is_dir()]
    return [p for p in paths if not any(d in p.resolve().parents for d in directories)]


def _from(manifests: Manifests, path: pathlib.Path, kind: type[R]) -> list[R]:
    """The objects of a kind that were read from a file, or from below a directory."""
    inside = path.resolve()
    return [
        found.resource
        for found in manifests.found.values()
        if isinstance(found.resource, kind) and found.manifest.file.resolve().is_relative_to(inside)
    ]


def _drone(manifests: Manifests, file: pathlib.Path) -> Drone:
    drones = _from(manifests, file, Drone)
    if len(drones) != 1:
        names = ", ".join(sorted(drone.name for drone in drones)) or "none"
        raise BadManifest(f"{file}: --drone takes a manifest of one Drone, not of {len(drones)} ({names})")
    return drones[0]


def _granted(manifests: Manifests, drone: Drone, file: pathlib.Path, component: str) -> GrantSpec:
    """The grant that the operator would write for a component.

    Raises:
        BadManifest: there is no such component, or no plan puts it on the drone.
    """
    applications = _from(manifests, file, Application)
    if len(applications) != 1:
        raise BadManifest(f"{file}: --application takes a manifest of one Application, not of {len(applications)}")
    application = applications[0]
    # No other application is to be planned, and on no other drone.
    for key, found in list(manifests.found.items()):
        if isinstance(found.resource, Application | Drone) and found.resource not in (application, drone):
            del manifests.found[key]
    known = [c.name for c in application.spec.components]
    if component not in known:
        raise BadManifest(f"Application {application.name} has no component {component} (it has {', '.join(known)})")
    settings = Settings()
    answer = plan_all(manifests, settings)[0]
    if answer.plan is None:
        raise BadManifest(f"Application {application.name} cannot be planned: {answer.refusal}")
    inventory = manifests.inventory()
    for grant in compile_grants(application, answer.plan, inventory, settings):
        if grant.component == component and grant.node == drone.name:
            return grant
    raise BadManifest(
        f"component {component} is not granted anything on {drone.name}: give it services, and a placement on the drone"
    )


def _anything(manifests: Manifests, drone: Drone) -> GrantSpec:
    """A grant of everything, under the policies that hold for every flight of the drone."""
    features = drone.spec.services.mobility
    depots = manifests.inventory().depots
    depot = depots.get(drone.spec.depot or "")
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
            "limits": GrantedLimits(max_altitude=features.max_altitude, max_speed=features.max_speed)
            if features
            else None,
        }
    )
    return refresh(grant, manifests.inventory())


def _situation(drone: Drone, asked: Mapping[str, Any]) -> Situation:
    lat, lon, alt = asked["at"]
    north, east, down = asked["velocity"]
    time_s = asked["time_s"] if asked["time_s"] is not None else datetime.now(tz=UTC).timestamp()
    flying = alt > IN_AIR_M
    camera = drone.spec.services.camera
    moved = camera is not None and camera.mount is not None and camera.mount.gimbal
    return Situation(
        time_s=time_s,
        lat=lat,
        lon=lon,
        altitude_m=alt,
        north_mps=north,
        east_mps=east,
        down_mps=down,
        home=_home(drone, asked),
        armed=flying,
        in_air=flying,
        airframe=Airframe(retraces=asked["way_home"] == "retraced"),
        # Where a gimbal points is measured in flight; before, it may be anywhere.
        attitude=None if moved else Attitude(0.0, 0.0, math.degrees(math.atan2(east, north))),
        lens=bounding_lens(camera),
    )


def _home(drone: Drone, asked: Mapping[str, Any]) -> Home:
    if asked["home"] is not None:
        return Home(*asked["home"])
    stated = drone.spec.home
    if stated is None:
        return Home(asked["at"][0], asked["at"][1], 0.0)
    known = stated.alt is not None and stated.altitude_reference == "amsl"
    return Home(stated.lat, stated.lon, stated.alt if known and stated.alt is not None else 0.0)


# -- output --


def _spelled(verdict: Verdict) -> dict[str, Any] | None:
    if verdict.args is None or not verdict.permits:
        return None
    return {name: value for name, value in asdict(verdict.args).items() if value is not None}


def _as_json(verdict: Verdict) -> str:
    whole = {
        "action": verdict.action,
        "takeover": verdict.takeover,
        "args": _spelled(verdict),
        "reason": verdict.reason,
        "policies": list(verdict.policies),
        "code": verdict.code,
        "brakeFirst": verdict.brake_first,
        "filters": [f.action for f in verdict.filters],
    }
    return json.dumps(whole, indent=2) + "\n"


def _as_text(verdict: Verdict) -> str:
    args = (_spelled(verdict) or {}).items()
    lines = {
        "action:   ": verdict.action,
        "takeover: ": verdict.takeover,
        "args:     ": ", ".join(
            f"{k}={v:g}" if isinstance(v, float) and k not in {"lat", "lon"} else f"{k}={v}" for k, v in args
        ),
        "reason:   ": verdict.reason + (f" ({verdict.code})" if verdict.reason and verdict.code else ""),
        "policies: ": ", ".join(verdict.policies),
        "filters:  ": ", ".join(f.action for f in verdict.filters),
        "first:    ": "the drone is brought to a stop" if verdict.brake_first else "",
    }
    return "".join(f"{title}{text}\n" for title, text in lines.items() if text)


_FORMATS: dict[str, Callable[[Verdict], str]] = {"text": _as_text, "json": _as_json}
