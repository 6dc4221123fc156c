"""`fractus plan`: what the operator would decide, from manifests alone."""

from __future__ import annotations

import json
import pathlib
import time
from collections.abc import Callable, Sequence
from typing import Any

import click
from fractus_core.api import API_VERSION, GROUP, DeploymentPlan
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.documents import dump_documents
from fractus_core.planning import Inventory, Settings
from fractus_core.planning.plugins import GROUP as PLUGINS
from fractus_core.planning.plugins import UnknownPlugin, load_plugin

from fractus_cli import EXIT_INFEASIBLE
from fractus_cli.calls import parse_time
from fractus_cli.manifests import BadManifest, read_manifests
from fractus_cli.plan_map import plan_map
from fractus_cli.plan_table import infeasible_table, plan_table
from fractus_cli.planning import Decided, plan_all

_DEFAULTS = Settings()

INFEASIBLE_ANNOTATION = f"{GROUP}/infeasible"
"""On what is printed of an application that no plan fits: REASON: MESSAGE."""


_PATH = click.Path(exists=True, path_type=pathlib.Path)
_SHARE = click.FloatRange(0, 1)
_POSITIVE = click.FloatRange(min=0, min_open=True)
_TUNING: dict[str, tuple[str, click.FloatRange, str]] = {
    "--safety-radius": ("safety_radius_m", _POSITIVE, "How far paths are dilated, in metres."),
    "--depot-radius": ("depot_radius_m", click.FloatRange(min=0), "How far a depot may be from an open or partial start, in metres."),
    "--coverage": ("coverage_share", _SHARE, "Share of the operation area to reach with direct links."),
    "--cruise-speed": ("cruise_speed_mps", _POSITIVE, "Ground speed assumed for flight times, in m/s."),
    "--battery-reserve": ("battery_reserve", _SHARE, "Share of a full charge to be left after landing."),
}  # fmt: skip
"""Which option sets what of the planning, and within which bounds."""


def _tunable(command: Callable[..., None]) -> Callable[..., None]:
    for name, (setting, bounds, text) in reversed(_TUNING.items()):
        default = getattr(_DEFAULTS, setting)
        command = click.option(name, setting, type=bounds, default=default, show_default=True, help=text)(command)
    return command


@click.command()
@click.option(
    "-f", "--filename", "paths", type=_PATH, multiple=True, required=True,
    help="A file of manifests, or a directory of them; may be repeated.",
)  # fmt: skip
@click.argument("more", type=_PATH, nargs=-1)
@click.option("-o", "--output", type=click.Choice(["table", "yaml", "json", "geojson"]), default="table")
@_tunable
@click.option(
    "--policy-conflicts", type=click.Choice(["warn", "forbid"]), default="warn", show_default=True,
    help="What becomes of a mission whose way policies do not let be flown, where no drone has another one.",
)  # fmt: skip
@click.option(
    "--time", "time_s", callback=parse_time, metavar="RFC3339", help="When it begins, with its zone; else now."
)
@click.option("--flat-terrain", is_flag=True, help="Take the ground for as high as home everywhere.")
@click.option("--ranking", help=f"Name of a plug-in (entry point group {PLUGINS}) that scores drones.")
@click.option("--covering", help=f"Name of a plug-in (entry point group {PLUGINS}) that chooses nodes along the way.")
@click.pass_context
def plan(
    context: click.Context, /, paths: Sequence[pathlib.Path], more: Sequence[pathlib.Path], *, output: str,
    ranking: str | None, covering: str | None, **tuned: Any,
) -> None:  # fmt: skip
    """Plan the Applications in some manifests, without a cluster.

    Reads Applications, Drones, EdgeNodes, Depots, Zones, Policies, DeploymentPlans (in force: what still fits stays)
    and Nodes, in any mix, and passes over all other kinds. Prints the DeploymentPlans that the operator would write.

    Nodes give resources (status.allocatable), readiness and, by the label fractus.dev/class=cloud or fractus.dev/cloud=true,
    the cloud. Without any Node object, every Drone and EdgeNode has a Node of unlimited resources, and there is a cloud.
    A Drone whose manifest has no Ready condition counts as Ready, and as full if it has no battery status.

    Several Applications are planned one after the other, those with a driver first, then by name; each takes its drone
    and its resources.

    Exit code: 0 if all are feasible, 2 if one is not, 1 if the input is bad. In yaml and json, what is infeasible has the
    annotation fractus.dev/infeasible, no placements, and the nodes that were rejected; the operator writes no such plan.

    The way of each drone is judged by the policies and zones among the manifests, as they hold at --time and when the
    mission ends: the plan says which legs they deny, correct or lead around.
    """
    try:
        manifests = read_manifests([*paths, *more])
        score, cover = _plugin(ranking, "--ranking"), _plugin(covering, "--covering")
        tuned["time_s"] = time.time() if tuned["time_s"] is None else tuned["time_s"]
        settings = Settings(**tuned, score_drone=score, cover=cover)
        decided = plan_all(manifests, settings)
    except BadManifest as error:
        raise click.ClickException(str(error)) from None
    text = _FORMATS[output](decided) if output in _FORMATS else _as_geojson(decided, manifests.inventory(), settings)
    click.echo(text, nl=False)
    for answer in decided:
        if answer.refusal is not None and output != "table":
            click.echo(f"{'/'.join(answer.application.key)}: {answer.refusal.reason}: {answer.refusal}", err=True)
    if any(answer.refusal is not None for answer in decided):
        context.exit(EXIT_INFEASIBLE)


def _plugin(name: str | None, option: str) -> Any:
    try:
        return load_plugin(name)
    except UnknownPlugin as error:
        raise click.ClickException(f"{option}: {error}") from None


# -- output --


def _bodies(decided: Sequence[Decided]) -> list[dict[str, Any]]:
    """The DeploymentPlans that the operator would write; where there is no plan, why not."""
    bodies = []
    for answer in decided:
        namespace, name = answer.application.key
        metadata: dict[str, Any] = {"name": name, "namespace": namespace}
        if answer.refusal is not None:
            why = f"{answer.refusal.reason}: {answer.refusal.message}"
            metadata["annotations"] = {INFEASIBLE_ANNOTATION: why}
        spec = (answer.plan or _without_placements(answer)).to_dict()
        bodies.append({"apiVersion": API_VERSION, "kind": DeploymentPlan.KIND, "metadata": metadata, "spec": spec})
    return bodies


def _without_placements(answer: Decided) -> DeploymentPlanSpec:
    """What yaml and json say of an application that is infeasible."""
    rejected, far = (answer.refusal.rejected, answer.refusal.omitted) if answer.refusal is not None else ((), 0)
    omitted = max(len(rejected) - _DEFAULTS.rejections_listed, 0) + far
    return DeploymentPlanSpec(
        application=answer.application.name,
        rejected=rejected[: _DEFAULTS.rejections_listed],
        rejected_omitted=omitted or None,
    )


def _as_yaml(decided: Sequence[Decided]) -> str:
    return dump_documents(_bodies(decided))


def _as_json(decided: Sequence[Decided]) -> str:
    bodies = _bodies(decided)
    whole = bodies[0] if len(bodies) == 1 else {"apiVersion": "v1", "kind": "List", "items": bodies}
    return json.dumps(whole, indent=2) + "\n"


def _as_geojson(decided: Sequence[Decided], stock: Inventory, settings: Settings) -> str:
    features = [f for a in decided if a.plan is not None for f in plan_map(a.application, a.plan, stock, settings)]
    return json.dumps({"type": "FeatureCollection", "features": features}, indent=1) + "\n"


def _as_table(decided: Sequence[Decided]) -> str:
    parts = []
    for answer in decided:
        if answer.plan is not None:
            parts.append(plan_table(answer.application, answer.plan, answer.links))
        elif answer.refusal is not None:
            parts.append(infeasible_table(answer.application, answer.refusal))
    return "\n".join(parts)


_FORMATS: dict[str, Callable[[Sequence[Decided]], str]] = {"table": _as_table, "yaml": _as_yaml, "json": _as_json}
