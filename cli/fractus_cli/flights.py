"""`fractus flights`: order, show, start, watch and end flights as FlightPlans."""

from __future__ import annotations

import json
import pathlib
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Any

import click
from fractus_core.api.flight_plans import application_name
from fractus_runtime.kubernetes import BlockingClient, Conflict, Invalid, KubeError

from fractus_cli import EXIT_INFEASIBLE, EXIT_OK
from fractus_cli.cluster_reader import (
    GROUP,
    Body,
    ClusterReader,
    conditions_of,
    get_flight_plan,
    kubeconfig_option,
    open_client,
    open_cluster,
    table,
)
from fractus_cli.flight_order import (
    flight_plan,
    parse_actions,
    parse_circle,
    parse_contact_lost,
    parse_parameters,
    parse_start,
    parse_waypoint,
    place_of,
)
from fractus_cli.flight_text import flight_lines, headline, state_of
from fractus_cli.output import output_option, printable

DECISION_TIMEOUT_S = 15.0
"""Time to wait for a decision of the operator."""

POLL_S = 0.25
WATCH_INTERVAL_S = 1.0

namespace_option = click.option(
    "-n", "--namespace", default="default", show_default=True, help="Namespace of the flight plan."
)
name_argument = click.argument("name", metavar="PLAN")
_file = click.Path(exists=True, dir_okay=False, path_type=pathlib.Path)


@click.group()
def flights() -> None:
    """Order, start, watch and end flights of approved applications."""


@flights.command()
@click.argument("template")
@click.option(
    "--waypoint", "waypoints", multiple=True, callback=parse_waypoint, metavar="LAT,LON[,ALT]",
    help="Position to visit, with its altitude above home in metres. May be repeated.",
)  # fmt: skip
@click.option("--path", type=_file, help="Waypoints of a file: QGroundControl plan, or GeoJSON with one LineString.")
@click.option("--altitude", type=float, metavar="METRES", help="Altitude above home of waypoints without altitude.")
@click.option("--region", type=_file, help="Area of a file: GeoJSON or KML, or the fence of a QGroundControl plan.")
@click.option("--circle", callback=parse_circle, metavar="LAT,LON,RADIUS", help="Circular area, its radius in metres.")
@click.option("--stay", type=float, metavar="MINUTES", help="Flight time in the region or circle.")
@click.option(
    "--start", required=True, callback=parse_start, metavar="TIME",
    help="Earliest takeoff: an RFC 3339 time such as 2026-12-01T10:00:00Z, now, or +30m, +2h, +1d.",
)  # fmt: skip
@click.option(
    "--duration",
    type=float,
    required=True,
    metavar="MINUTES",
    help="Time from the start until the drone is home again.",
)
@click.option(
    "--parameter", "parameters", multiple=True, callback=parse_parameters, metavar="NAME=VALUE",
    help="Parameter of the template. A VALUE that is not JSON is a string. May be repeated.",
)  # fmt: skip
@click.option(
    "--action", "actions", multiple=True, callback=parse_actions, metavar="POLICY=ACTION[@LAT,LON]",
    help="Repair action for a policy with choices, for abort with a landing place. May be repeated.",
)  # fmt: skip
@click.option(
    "--contact-lost", callback=parse_contact_lost, metavar="ACTION[@LAT,LON]",
    help="Reaction to lost contact: continue, hover, or abort, which may have a landing place.",
)  # fmt: skip
@click.option("--drone", help="Name of the drone.  [default: any suitable drone]")
@click.option(
    "--priority", type=click.Choice(["normal", "elevated", "emergency"]), default="normal", show_default=True,
    help="Priority class. All but normal need a permission.",
)  # fmt: skip
@click.option("--auto-activate", is_flag=True, help="Start the flight at its time without `fractus flights start`.")
@click.option("--name", help="Name of the flight plan.  [default: name of the template and a random suffix]")
@click.option("--check", "--dry-run", "check", is_flag=True, help="Only show the decision. Nothing is reserved.")
@namespace_option
@output_option
@kubeconfig_option
def order(
    template: str,
    namespace: str,
    name: str | None,
    output: str,
    config: str | None,
    *,
    waypoints: list[Body],
    path: pathlib.Path | None,
    altitude: float | None,
    region: pathlib.Path | None,
    circle: Body | None,
    stay: float | None,
    start: str,
    duration: float,
    parameters: dict[str, Any],
    actions: list[Body],
    contact_lost: Body | None,
    drone: str | None,
    priority: str,
    auto_activate: bool,
    check: bool,
) -> int:
    """Order a flight of the ApplicationTemplate TEMPLATE, and show the decision.

    The exit code is 2 if the plan is rejected, or waits for the selection of actions (`fractus flights choose`).
    """
    spec: dict[str, Any] = {
        "template": template,
        **place_of(waypoints, path, region, circle, altitude),
        "stay": stay,
        "window": {"start": start, "duration": duration},
        "parameters": parameters or None,
        "policyActions": actions or None,
        "contactLost": contact_lost,
        "drone": drone,
        "priorityClass": priority,
        "autoActivate": auto_activate or None,
        "dryRun": check or None,
    }
    body = flight_plan(namespace, name, spec)
    with open_client(config) as client:
        plan = _await_decision(client, _create(client, namespace, body))
    return _print(plan, output)


@flights.command("list")
@click.option("-n", "--namespace", default="", help="Only flight plans of this namespace.  [default: all]")
@click.option("--drone", help="Only flight plans for this drone.")
@click.option("--policy", help="Only flight plans to which this policy applies.")
@output_option
@kubeconfig_option
def list_(namespace: str, drone: str | None, policy: str | None, output: str, config: str | None) -> None:
    """List flight plans by the start of their windows.

    Users with permissions in one namespace must specify --namespace.
    """
    scope = f"/namespaces/{namespace}" if namespace else ""
    with open_cluster(config) as cluster:
        bodies = cluster.list_permitted(f"{GROUP}{scope}/flightplans")
    if bodies is None:
        where = f"namespace {namespace}" if namespace else "all namespaces"
        remedy = "check your permissions there" if namespace else "specify a namespace with --namespace"
        raise click.ClickException(f"not permitted to list the FlightPlans of {where}; {remedy}")
    plans = sorted((b for b in bodies if _selected(b, drone, policy)), key=lambda b: str(b["spec"]["window"]["start"]))
    if output == "json":
        click.echo(json.dumps({"flightPlans": [_summary(body) for body in plans]}))
        return
    rows = []
    for body in plans:
        status = body.get("status") or {}
        window = body["spec"]["window"]
        rows.append(
            (
                f"{body['metadata']['namespace']}/{body['metadata']['name']}", body["spec"]["template"], state_of(body),
                status.get("drone"), window["start"], window["duration"], status.get("message"),
            )
        )  # fmt: skip
    head = ("PLAN", "TEMPLATE", "STATE", "DRONE", "START", "MINUTES", "MESSAGE")
    click.echo("\n".join(map(printable, table(head, rows))))


def _selected(body: Body, drone: str | None, policy: str | None) -> bool:
    status = body.get("status") or {}
    if drone is not None and drone not in {status.get("drone"), body["spec"].get("drone")}:
        return False
    return policy is None or any(each["policy"] == policy for each in status.get("restrictions") or ())


@flights.command()
@name_argument
@namespace_option
@output_option
@kubeconfig_option
def show(name: str, namespace: str, output: str, config: str | None) -> int:
    """Show the decision on a flight plan: drone, volumes, reasons, policies and actions that are still to be selected.

    The exit code is 2 if the plan or its last change is refused, or needs the selection of actions.
    """
    with open_cluster(config) as cluster:
        plan = get_flight_plan(cluster, namespace, name)
    return _print(plan, output)


@flights.command()
@name_argument
@click.argument("actions", nargs=-1, required=True, callback=parse_actions, metavar="POLICY=ACTION[@LAT,LON]...")
@namespace_option
@output_option
@kubeconfig_option
def choose(name: str, actions: list[Body], namespace: str, output: str, config: str | None) -> int:
    """Select repair actions for policies with choices, and show the decision."""
    with open_client(config) as client:
        plan = get_flight_plan(ClusterReader(client), namespace, name)
        for action in actions:
            _check_choice(plan, action)
        selected = {each["policy"]: each for each in (*(plan["spec"].get("policyActions") or ()), *actions)}
        plan = _await_decision(client, _change(client, plan, {"policyActions": list(selected.values())}))
    return _print(plan, output)


def _check_choice(plan: Body, action: Body) -> None:
    """Raise ClickException if the flight has no such choice."""
    restrictions = (plan.get("status") or {}).get("restrictions") or ()
    choices = {each["policy"]: each["choices"] for each in restrictions if each.get("choices")}
    if action["policy"] not in choices:
        known = f"choose for: {', '.join(choices)}" if choices else "no policy of this flight has choices"
        raise click.ClickException(f"policy {action['policy']} has no choices for this flight; {known}")
    if action["action"] not in choices[action["policy"]]:
        raise click.ClickException(
            f"policy {action['policy']} has no action {action['action']}; choose one of: {', '.join(choices[action['policy']])}"
        )


@flights.command()
@name_argument
@namespace_option
@output_option
@kubeconfig_option
def start(name: str, namespace: str, output: str, config: str | None) -> int:
    """Permit the takeoff in the window of an accepted flight plan.

    The exit code is 2 if the flight cannot start.
    """
    with open_client(config) as client:
        plan = get_flight_plan(ClusterReader(client), namespace, name)
        state = state_of(plan)
        if state in {"Rejected", "Ended"} or plan["spec"].get("use") == "Closed":
            raise click.ClickException(f"the flight plan is {state} and cannot start; order another flight")
        if state == "Draft" and conditions_of(plan).get("ActionNeeded"):
            raise click.ClickException("the flight plan needs actions; select them with `fractus flights choose`")
        plan = _await_decision(client, _change(client, plan, {"use": "InUse"}))
    return _print(plan, output)


@flights.command()
@name_argument
@namespace_option
@output_option
@kubeconfig_option
def end(name: str, namespace: str, output: str, config: str | None) -> None:
    """End a flight plan. A drone in the air returns home, and the plan keeps its airspace until the landing."""
    with open_client(config) as client:
        plan = get_flight_plan(ClusterReader(client), namespace, name)
        plan = _await_decision(client, _change(client, plan, {"use": "Closed"}))
    _print(plan, output)


@flights.command()
@name_argument
@namespace_option
@kubeconfig_option
def watch(name: str, namespace: str, config: str | None) -> int:
    """Print each change of state until the flight plan has ended.

    The exit code is 0 if the mission was flown to its end, and 2 if the plan was rejected, or ended in another way.
    """
    last = ""
    with open_client(config) as client:
        cluster = ClusterReader(client)
        plan = get_flight_plan(cluster, namespace, name)
        for body in _versions(cluster, plan):
            plan = body
            line = headline(plan)
            if line != last:
                click.echo(printable(f"{datetime.now(UTC):%H:%M:%S} {line}"))
                last = line
            if state_of(plan) in {"Rejected", "Ended"}:
                break
        else:
            raise click.ClickException(f"the FlightPlan {namespace}/{name} was deleted")
        return EXIT_OK if _completed(cluster, plan) else EXIT_INFEASIBLE


def _versions(cluster: ClusterReader, plan: Body) -> Iterator[Body]:
    """Yield the present version of a plan repeatedly until the plan is deleted. Report a lost connection once, and connect again."""
    metadata = plan["metadata"]
    path = f"{GROUP}/namespaces/{metadata['namespace']}/flightplans/{metadata['name']}"
    connected = True
    current: Body | None = plan
    while current is not None and current["metadata"]["uid"] == metadata["uid"]:
        yield current
        time.sleep(WATCH_INTERVAL_S)
        try:
            current = cluster.get(path)
            connected = True
        except KubeError as error:
            if error.status:
                raise
            if connected:
                click.echo(printable(f"fractus: {error}; the connection is tried again"), err=True)
            connected = False


def _completed(cluster: ClusterReader, plan: Body) -> bool:
    """Return True if the mission of an ended plan was flown to its end."""
    if state_of(plan) != "Ended":
        return False
    metadata = plan["metadata"]
    deployments = cluster.list(f"{GROUP}/namespaces/{metadata['namespace']}/deploymentplans")
    flown = application_name(metadata["uid"])
    return any(
        (each["spec"].get("flown") or {}).get("outcome") == "Complete"
        for each in deployments
        if each["spec"]["application"] == flown
    )


@flights.command()
@click.argument("template")
@click.option("--yes", is_flag=True, help="Approve without a question.")
@click.option("--note", default="", help="Remark of the authority.")
@kubeconfig_option
def approve(template: str, yes: bool, note: str, config: str | None) -> None:
    """Approve the present generation of the ApplicationTemplate TEMPLATE, after a question that shows altitudes, images and methods.

    A template that is changed later must be approved again.
    """
    path = f"{GROUP}/applicationtemplates/{template}"
    with open_client(config) as client:
        body = client.get(path)
        if body is None:
            raise click.ClickException(f"there is no ApplicationTemplate {template}")
        generation = body["metadata"]["generation"]
        click.echo("\n".join(map(printable, _template_lines(body["spec"]))))
        if not yes:
            click.confirm(f"Approve generation {generation} of {template}?", abort=True)
        review = {"apiVersion": "authentication.k8s.io/v1", "kind": "SelfSubjectReview"}
        user = client.call("POST", "/apis/authentication.k8s.io/v1/selfsubjectreviews", review)
        approval = {
            "generation": generation,
            "by": user["status"]["userInfo"]["username"],
            "at": f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}",
            "note": note,
        }
        client.merge(f"{path}/status", {"status": {"approval": approval}})
    click.echo(f"generation {generation} of {template} is approved by {approval['by']}")


def _template_lines(spec: Body) -> Iterator[str]:
    """Yield what an authority approves: altitudes, and image and methods of each component."""
    altitudes = spec["altitudes"]
    yield f"altitudes: {altitudes.get('lower', 0):g} to {altitudes['upper']:g} m"
    for component in spec["template"]["components"]:
        yield f"{component['name']} ({component['placement']}): {component['container']['image']}"
        for service in component.get("services") or ():
            yield f"  {service['service']}: {', '.join(service['methods'])}"


# -- requests --


def _create(client: BlockingClient, namespace: str, body: Body) -> Body:
    path = f"{GROUP}/namespaces/{namespace}/flightplans"
    name = body["metadata"].get("name")
    try:
        return client.call("POST", path, dict(body))
    except Conflict as error:
        raise click.ClickException(f"{error}; specify another --name, or end and delete FlightPlan {name}") from error
    except Invalid as error:
        raise click.ClickException(f"the API server refused the flight plan: {error}") from error


def _change(client: BlockingClient, plan: Body, spec: Body) -> Body:
    """Change fields of the specification of a plan that was read before."""
    metadata = plan["metadata"]
    path = f"{GROUP}/namespaces/{metadata['namespace']}/flightplans/{metadata['name']}"
    try:
        return client.merge(path, {"metadata": {"resourceVersion": metadata["resourceVersion"]}, "spec": spec})
    except Conflict as error:
        raise click.ClickException("the flight plan was changed at the same time; repeat the command") from error
    except Invalid as error:
        raise click.ClickException(f"the API server refused the change: {error}") from error


def _await_decision(client: BlockingClient, plan: Body) -> Body:
    """Return a plan when the operator has decided on its present version.

    Raises:
        ClickException: There was no decision in time.
    """
    metadata = plan["metadata"]
    path = f"{GROUP}/namespaces/{metadata['namespace']}/flightplans/{metadata['name']}"
    deadline = time.monotonic() + DECISION_TIMEOUT_S
    current: Body | None = plan
    while current is not None and not _considered(current, metadata["generation"]):
        if time.monotonic() > deadline:
            raise click.ClickException(
                f"no decision on FlightPlan {metadata['namespace']}/{metadata['name']} after {DECISION_TIMEOUT_S:.0f} s; check the"
                " operator with `fractus doctor`, then see `fractus flights show`"
            )
        time.sleep(POLL_S)
        current = client.get(path)
    if current is None:
        raise click.ClickException(f"the FlightPlan {metadata['namespace']}/{metadata['name']} was deleted")
    return current


def _considered(plan: Body, generation: int) -> bool:
    """Return True if the operator has considered a generation of a plan."""
    conditions = conditions_of(plan).values()
    seen = [(plan.get("status") or {}).get("observedGeneration"), *(c.get("observedGeneration") for c in conditions)]
    return max((each or 0 for each in seen), default=0) >= generation


# -- output --


def _print(plan: Body, output: str) -> int:
    """Print a plan and return the exit code of its decision."""
    if output == "json":
        click.echo(json.dumps(_summary(plan)))
    else:
        click.echo("\n".join(map(printable, flight_lines(plan))))
    conditions = conditions_of(plan)
    refused = any(conditions.get(name, {}).get("status") == "True" for name in ("ActionNeeded", "ChangeRefused"))
    startable = conditions.get("Startable", {}).get("status") != "False"
    return EXIT_OK if startable and not refused and state_of(plan) != "Rejected" else EXIT_INFEASIBLE


def _summary(plan: Body) -> Body:
    metadata = plan["metadata"]
    return {
        "namespace": metadata["namespace"],
        "name": metadata["name"],
        "spec": plan["spec"],
        "status": plan.get("status") or {},
    }
