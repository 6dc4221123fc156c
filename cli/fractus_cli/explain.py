"""`fractus explain`: reasons for the placement of an Application, rejected nodes, and effects of policies."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from typing import Any

import click
from fractus_core.api import InvalidObject, Policy
from fractus_core.api.applications import ApplicationSpec
from fractus_core.api.components import default_lifetime
from fractus_core.api.grants import ApplicationReference
from fractus_core.policy.selectors import policy_applies

from fractus_cli.cluster_reader import (
    EXIT_PROBLEM,
    GROUP,
    Body,
    ClusterReader,
    conditions_of,
    get_application,
    kubeconfig_option,
    open_cluster,
)
from fractus_cli.output import output_option, printable

_LISTED = 5
_AFTER_FLIGHT_S: int = ApplicationSpec.model_fields["after_flight"].default


@click.command()
@click.argument("name", metavar="APPLICATION")
@click.option("-n", "--namespace", default="default", show_default=True, help="Namespace of the Application.")
@click.option("--all", "list_all", is_flag=True, help="List all rejected nodes and events instead of five.")
@output_option
@kubeconfig_option
def explain(name: str, namespace: str, list_all: bool, output: str, config: str | None) -> int:
    """Explain where APPLICATION runs, why other nodes were rejected, and how policies changed the mission.

    The exit code is 2 if there is no plan, or if policies forbid the mission as planned.
    """
    with open_cluster(config) as cluster:
        summary = collect(cluster, namespace, name)
    if output == "json":
        click.echo(json.dumps(summary))
    else:
        click.echo("\n".join(map(printable, lines(summary, None if list_all else _LISTED))))
    conflict = (summary["drone"] or {}).get("policyConflict")
    return EXIT_PROBLEM if not summary["placements"] or conflict else 0


def collect(cluster: ClusterReader, namespace: str, name: str) -> dict[str, Any]:
    """Return status, plan, granted policies and events of an Application.

    Raises:
        ClickException: The Application does not exist.
    """
    scope = f"{GROUP}/namespaces/{namespace}"
    body = get_application(cluster, namespace, name)
    plans = [p for p in cluster.list(f"{scope}/deploymentplans") if p["spec"]["application"] == name]
    plan: Body = plans[0]["spec"] if plans else {}
    listed = cluster.list_permitted(f"{GROUP}/grants")
    grants = [
        grant["spec"]
        for grant in listed or ()
        if (grant["spec"]["application"]["namespace"], grant["spec"]["application"]["name"]) == (namespace, name)
    ]
    policies = cluster.list_permitted(f"{GROUP}/policies")
    events = cluster.list(
        f"/api/v1/namespaces/{namespace}/events",
        fieldSelector=f"involvedObject.kind=Application,involvedObject.name={name}",
    )
    status = body.get("status") or {}
    return {
        "namespace": namespace,
        "name": name,
        "phase": status.get("phase", "Pending"),
        "message": status.get("message", "not processed by the operator yet"),
        "conditions": list(status.get("conditions") or ()),
        "drone": plan.get("drone"),
        "lifetimes": _lifetimes(body.get("spec") or {}),
        "placements": list(plan.get("placements") or ()),
        "rejected": list(plan.get("rejected") or ()),
        "rejectedOmitted": plan.get("rejectedOmitted", 0),
        "awaits": [component for grant in grants for component in grant.get("awaits") or ()],
        "policies": {
            grant["instance"]: [
                {
                    "name": p["name"],
                    "type": p["spec"]["type"],
                    "zones": [z["name"] for z in p.get("zones") or ()],
                    "action": p["spec"].get("action"),
                    "selected": bool(p.get("selected")),
                    "landAt": p["spec"].get("landAt"),
                }
                for p in grant.get("policies") or ()
            ]
            for grant in sorted(grants, key=lambda grant: str(grant["instance"]))
        },
        "notes": list(_notes(body, policies or ())),
        "contactLost": (body.get("spec") or {}).get("contactLost"),
        "forbidden": [kind for kind, known in (("grants", listed), ("policies", policies)) if known is None],
        "events": [
            {k: event.get(k) for k in ("lastTimestamp", "type", "reason", "message")}
            for event in sorted(events, key=lambda event: str(event.get("lastTimestamp")), reverse=True)
        ],
    }


def lines(summary: dict[str, Any], limit: int | None) -> Iterator[str]:
    """Format a summary as text.

    Args:
        summary: Result of `collect`.
        limit: Maximum number of rejected nodes of each component and of events, or None for all.
    """
    yield f"{summary['namespace']}/{summary['name']}: {summary['phase']}: {summary['message']}"
    for c in summary["conditions"]:
        yield f"  {c['type']}={c['status']} {c['reason']}: {c.get('message', '')}".rstrip(": ")
    if not summary["placements"]:
        yield "There is no plan."
    if summary["drone"]:
        yield from _drone(summary["drone"])
    if summary["awaits"]:
        yield f"Takeoff: when all components are ready (start: whenReady); not ready: {', '.join(summary['awaits'])}"
    for placement in summary["placements"]:
        yield from _placement(placement)
    yield from _ends(summary["lifetimes"])
    yield from _rejections(summary, limit)
    yield from _policies(summary["policies"])
    yield from summary["notes"]
    if summary["contactLost"]:
        yield _contact_lost(summary["contactLost"])
    if summary["forbidden"]:
        yield f"You are not permitted to list {' and '.join(summary['forbidden'])} of this cluster, so the applied policies are unknown."
    if summary["events"]:
        yield "Events, newest first:"
        for event in summary["events"][:limit]:
            yield f"  {event['lastTimestamp']} {event['type']} {event['reason']}: {event['message']}"


def _drone(drone: Body) -> Iterator[str]:
    shared = f", flown by {drone['sharedWith']}" if drone.get("sharedWith") else ""
    alternatives = ", ".join(f"{a['node']} ({a['score']:.3g})" for a in drone.get("alternatives") or ())
    score = f" (score {drone['score']:.3g})" if drone.get("score") is not None else ""
    yield f"Drone: {drone['node']}{score}{shared}" + (
        f"; next best: {alternatives}" if alternatives else "; no other drone is suitable"
    )
    mission = drone.get("mission")
    if mission:
        yield (
            f"  {mission['distance']:.0f} m in {mission['duration']:.1f} min; available without the reserve: {mission['available']:.1f}"
            " min"
        )
    for leg in drone.get("legality") or ():
        to = f"{leg['end']['lat']:.6f}, {leg['end']['lon']:.6f}"
        by = ", ".join(leg.get("policies") or ()) or "no policy"
        yield f"  leg to {to}: {leg['outcome']} by {by}: {leg['message']}"
    if drone.get("legalityOmitted"):
        yield f"  and {drone['legalityOmitted']} more legs"
    if drone.get("policyConflict"):
        yield f"  Conflict: {drone['policyConflict']}"


def _placement(placement: Body) -> Iterator[str]:
    reason = {
        "drone": "on the selected drone",
        "static": f"for location {placement.get('location', 0)}",
        "hybrid-edge": "covers part of the operation area",
        "hybrid-drone": "on the drone, next to the component that it serves",
        "cloud": "any cloud node",
    }.get(placement["role"], placement["role"])
    coverage = f", {placement['coverage']:.0%} of it" if placement.get("coverage") else ""
    yield f"{placement['component']}: {placement.get('node') or 'cloud'} ({reason}{coverage})"


def _lifetimes(spec: Body) -> dict[str, Any]:
    """Return the components that end with the flight, the components that continue to run, and the time after the landing in seconds."""
    ends: dict[str, list[str]] = {"flight": [], "application": []}
    for component in spec.get("components") or ():
        ends[component.get("endsWith") or default_lifetime(component["placement"])].append(component["name"])
    return {"afterFlight": spec.get("afterFlight", _AFTER_FLIGHT_S), **ends}


def _ends(lifetimes: dict[str, Any]) -> Iterator[str]:
    if lifetimes["flight"]:
        yield f"Until {lifetimes['afterFlight']} s after the landing (spec.afterFlight): {', '.join(lifetimes['flight'])}"
    if lifetimes["application"]:
        yield f"Until the Application is deleted (endsWith: application): {', '.join(lifetimes['application'])}"


def _rejections(summary: dict[str, Any], limit: int | None) -> Iterator[str]:
    by_component: dict[str, list[Body]] = {}
    for rejected in summary["rejected"]:
        by_component.setdefault(rejected["component"], []).append(rejected)
    for component, rejections in by_component.items():
        yield f"Rejected for {component}:"
        for rejected in rejections[:limit]:
            yield f"  {rejected['node']}: {rejected['reason']}: {rejected['message']}"
        if limit is not None and len(rejections) > limit:
            yield f"  and {len(rejections) - limit} more (--all)"
    if summary["rejectedOmitted"]:
        yield f"{summary['rejectedOmitted']} more rejected nodes are not listed in the plan; most of them are out of range"


def _policies(policies: dict[str, Sequence[Body]]) -> Iterator[str]:
    for instance, granted in policies.items():
        yield f"Policies for {instance}: " + (
            "; ".join(f"{p['name']} ({p['type']}{_scope(p['zones'])}{_action(p)})" for p in granted) or "none"
        )


def _notes(application: Body, policies: Sequence[Body]) -> Iterator[str]:
    """Yield a sentence for each policy of an application whose zones are far from every depot."""
    for policy in policies:
        far = conditions_of(policy).get("FarFromDepots")
        if far is not None and _selects(policy, application):
            yield f"Policy {policy['metadata']['name']}: {far.get('message')}"


def _selects(policy: Body, application: Body) -> bool:
    metadata = application["metadata"]
    owner = ApplicationReference(name=metadata["name"], namespace=metadata["namespace"], uid=metadata.get("uid", ""))
    try:
        spec = Policy.from_body(policy).spec
    except InvalidObject:  # its condition Ready reports the problem
        return False
    return any(policy_applies(spec, owner, component["name"], {}) for component in application["spec"]["components"])


def _action(policy: Body) -> str:
    """Return the repair action of a granted policy; empty for the default action."""
    if not policy["action"]:
        return ""
    by = ", selected by the application" if policy["selected"] else ""
    return f": {policy['action']}{_place(policy['landAt'])}{by}"


def _place(place: Body | None) -> str:
    return f" and land at {place['lat']:.6f}, {place['lon']:.6f}" if place else ""


def _contact_lost(demand: Body) -> str:
    action = demand.get("action", "continue")
    return (
        f"Without contact with the API server for {demand.get('after', 30)} s: {action}{_place(demand.get('landAt'))}"
    )


def _scope(zones: Sequence[str]) -> str:
    return f" in {', '.join(zones)}" if zones else ", everywhere"
