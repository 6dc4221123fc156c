"""`fractus plan`: plan Applications from manifests, with the planner of the operator."""

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
from fractus_cli.call_arguments import parse_time
from fractus_cli.manifests import BadManifest, read_manifests
from fractus_cli.offline_planner import PlanResult, plan_all
from fractus_cli.plan_map import plan_map
from fractus_cli.plan_table import infeasible_table, plan_table

_DEFAULTS = Settings()

INFEASIBLE_ANNOTATION = f"{GROUP}/infeasible"
"""Annotation of an infeasible Application in YAML and JSON output. Its value is REASON: MESSAGE."""


_PATH = click.Path(exists=True, path_type=pathlib.Path)
_SHARE = click.FloatRange(0, 1)
_POSITIVE = click.FloatRange(min=0, min_open=True)
_TUNING: dict[str, tuple[str, click.FloatRange, str]] = {
    "--safety-radius": ("safety_radius_m", _POSITIVE, "Distance by which paths are widened to the operation area, in metres."),
    "--depot-radius": ("depot_radius_m", click.FloatRange(min=0), "Maximum distance of a depot from an open or partial start, in metres."),
    "--coverage": ("coverage_share", _SHARE, "Share of the operation area that direct links must cover."),
    "--cruise-speed": ("cruise_speed_mps", _POSITIVE, "Ground speed assumed for flight times, in m/s."),
    "--battery-reserve": ("battery_reserve", _SHARE, "Share of a full charge that must remain after landing."),
}  # fmt: skip
"""Planning options, each with its setting, bounds and help text."""


def _tunable(command: Callable[..., None]) -> Callable[..., None]:
    for name, (setting, bounds, text) in reversed(_TUNING.items()):
        default = getattr(_DEFAULTS, setting)
        command = click.option(name, setting, type=bounds, default=default, show_default=True, help=text)(command)
    return command


@click.command()
@click.option(
    "-f", "--filename", "paths", type=_PATH, multiple=True, required=True,
    help="File or directory of manifests. May be repeated.",
)  # fmt: skip
@click.argument("more", type=_PATH, nargs=-1)
@click.option(
    "-o", "--output", type=click.Choice(["table", "yaml", "json", "geojson"]), default="table", help="Output format."
)
@_tunable
@click.option(
    "--policy-conflicts", type=click.Choice(["warn", "forbid"]), default="warn", show_default=True,
    help="Warn about a mission whose route policies forbid for every drone, or treat it as infeasible.",
)  # fmt: skip
@click.option(
    "--time", "time_s", callback=parse_time, metavar="RFC3339", help="Start time with time zone.  [default: now]"
)
@click.option("--flat-terrain", is_flag=True, help="Assume that the ground is level with home everywhere.")
@click.option("--ranking", help=f"Plug-in (entry point group {PLUGINS}) that scores drones.")
@click.option("--covering", help=f"Plug-in (entry point group {PLUGINS}) that selects nodes along the route.")
@click.pass_context
def plan(
    context: click.Context, /, paths: Sequence[pathlib.Path], more: Sequence[pathlib.Path], *, output: str,
    ranking: str | None, covering: str | None, **tuned: Any,
) -> None:  # fmt: skip
    """Plan Applications from manifests, without a cluster.

    Reads Applications, Drones, EdgeNodes, Depots, Zones, Policies, Nodes and DeploymentPlans in any combination, and
    ignores all other kinds. Prints the DeploymentPlans that the operator would create. A DeploymentPlan in the input is
    treated as the current plan: placements that are still feasible are kept.

    Nodes specify resources (status.allocatable) and readiness. Nodes with the label fractus.dev/class=cloud or
    fractus.dev/cloud=true form the cloud. If there is no Node object, each Drone and EdgeNode has a Node with unlimited
    resources, and there is a cloud. A Drone without a Ready condition is assumed to be Ready, and fully charged if it has
    no battery status.

    Applications are planned one after the other: first Applications with a driver, then the others, each by name. A planned
    Application claims its drone and its resources.

    The Policies and Zones at --time and at the end of the mission apply to the route of each drone. The plan lists the legs that
    are denied, corrected or replaced by a detour.

    Exit code: 0 if all Applications are feasible, 2 if one is infeasible, 1 for bad input. In yaml and json, an infeasible
    Application has the annotation fractus.dev/infeasible, no placements, and the rejected nodes. The operator creates no
    such plan.
    """
    try:
        manifests = read_manifests([*paths, *more])
        score = _plugin(ranking, "--ranking")
        cover = _plugin(covering, "--covering")
        tuned["time_s"] = time.time() if tuned["time_s"] is None else tuned["time_s"]
        settings = Settings(**tuned, score_drone=score, cover=cover)
        results = plan_all(manifests, settings)
    except BadManifest as error:
        raise click.ClickException(str(error)) from None
    text = _FORMATS[output](results) if output in _FORMATS else _as_geojson(results, manifests.inventory(), settings)
    click.echo(text, nl=False)
    for note in manifests.notes():
        click.echo(f"note: {note}", err=True)
    for result in results:
        if result.refusal is not None and output != "table":
            click.echo(f"{'/'.join(result.application.key)}: {result.refusal.reason}: {result.refusal}", err=True)
    if any(result.refusal is not None for result in results):
        context.exit(EXIT_INFEASIBLE)


def _plugin(name: str | None, option: str) -> Any:
    try:
        return load_plugin(name)
    except UnknownPlugin as error:
        raise click.ClickException(f"{option}: {error}") from None


# -- output --


def _bodies(results: Sequence[PlanResult]) -> list[dict[str, Any]]:
    """Return the DeploymentPlans that the operator would create, or the reason why an Application is infeasible."""
    bodies = []
    for result in results:
        namespace, name = result.application.key
        metadata: dict[str, Any] = {"name": name, "namespace": namespace}
        if result.refusal is not None:
            reason = f"{result.refusal.reason}: {result.refusal.message}"
            metadata["annotations"] = {INFEASIBLE_ANNOTATION: reason}
        spec = (result.plan or _without_placements(result)).to_dict()
        bodies.append({"apiVersion": API_VERSION, "kind": DeploymentPlan.KIND, "metadata": metadata, "spec": spec})
    return bodies


def _without_placements(result: PlanResult) -> DeploymentPlanSpec:
    """Return the plan of an infeasible Application for YAML and JSON output."""
    rejected = result.refusal.rejected if result.refusal is not None else ()
    omitted = result.refusal.omitted if result.refusal is not None else 0
    omitted += max(len(rejected) - _DEFAULTS.rejections_listed, 0)
    return DeploymentPlanSpec(
        application=result.application.name,
        rejected=rejected[: _DEFAULTS.rejections_listed],
        rejected_omitted=omitted or None,
    )


def _as_yaml(results: Sequence[PlanResult]) -> str:
    return dump_documents(_bodies(results))


def _as_json(results: Sequence[PlanResult]) -> str:
    bodies = _bodies(results)
    document = bodies[0] if len(bodies) == 1 else {"apiVersion": "v1", "kind": "List", "items": bodies}
    return json.dumps(document, indent=2) + "\n"


def _as_geojson(results: Sequence[PlanResult], inventory: Inventory, settings: Settings) -> str:
    features = [f for a in results if a.plan is not None for f in plan_map(a.application, a.plan, inventory, settings)]
    return json.dumps({"type": "FeatureCollection", "features": features}, indent=1) + "\n"


def _as_table(results: Sequence[PlanResult]) -> str:
    parts = []
    for result in results:
        if result.plan is not None:
            parts.append(plan_table(result.application, result.plan, result.links))
        elif result.refusal is not None:
            parts.append(infeasible_table(result.application, result.refusal))
    return "\n".join(parts)


_FORMATS: dict[str, Callable[[Sequence[PlanResult]], str]] = {"table": _as_table, "yaml": _as_yaml, "json": _as_json}
