"""`fractus explain`: why an application is where it is, why it is not elsewhere, and what policies did."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from typing import Any

import click

from fractus_cli.output import output_option, printable
from fractus_cli.reading import EXIT_PROBLEM, GROUP, Body, Cluster, application, cluster, kubeconfig_option

_LISTED = 5


@click.command()
@click.argument("name", metavar="APPLICATION")
@click.option("-n", "--namespace", default="default", show_default=True, help="Of the application.")
@click.option("--all", "everything", is_flag=True, help="List every rejected node and event, not the first five.")
@output_option
@kubeconfig_option
def explain(name: str, namespace: str, everything: bool, output: str, config: str | None) -> int:
    """Say why APPLICATION runs where it runs, why not elsewhere, and which policy did what.

    Exits with 2 where it has no plan, or where policies do not let its mission be flown as planned.
    """
    with cluster(config) as found:
        seen = look(found, namespace, name)
    shown = map(printable, lines(seen, None if everything else _LISTED))
    click.echo(json.dumps(seen) if output == "json" else "\n".join(shown))
    conflict = (seen["drone"] or {}).get("policyConflict")
    return EXIT_PROBLEM if not seen["placements"] or conflict else 0


def look(found: Cluster, namespace: str, name: str) -> dict[str, Any]:
    """What is known of an application: its status, its plan, the policies of its grants, and its events.

    Raises:
        ClickException: there is no such application.
    """
    scope = f"{GROUP}/namespaces/{namespace}"
    body = application(found, namespace, name)
    plans = [p for p in found.list(f"{scope}/deploymentplans") if p["spec"]["application"] == name]
    plan: Body = plans[0]["spec"] if plans else {}
    listed = found.list_permitted(f"{GROUP}/grants")
    grants = [
        grant["spec"]
        for grant in listed or ()
        if (grant["spec"]["application"]["namespace"], grant["spec"]["application"]["name"]) == (namespace, name)
    ]
    events = found.list(
        f"/api/v1/namespaces/{namespace}/events",
        fieldSelector=f"involvedObject.kind=Application,involvedObject.name={name}",
    )
    status = body.get("status") or {}
    return {
        "namespace": namespace,
        "name": name,
        "phase": status.get("phase", "Pending"),
        "message": status.get("message", "the operator has not seen it yet"),
        "conditions": list(status.get("conditions") or ()),
        "drone": plan.get("drone"),
        "placements": list(plan.get("placements") or ()),
        "rejected": list(plan.get("rejected") or ()),
        "rejectedOmitted": plan.get("rejectedOmitted", 0),
        "policies": {
            grant["instance"]: [
                {"name": p["name"], "type": p["spec"]["type"], "zones": [z["name"] for z in p.get("zones") or ()]}
                for p in grant.get("policies") or ()
            ]
            for grant in sorted(grants, key=lambda grant: str(grant["instance"]))
        },
        "forbidden": ["grants"] if listed is None else [],
        "events": [
            {k: event.get(k) for k in ("lastTimestamp", "type", "reason", "message")}
            for event in sorted(events, key=lambda event: str(event.get("lastTimestamp")), reverse=True)
        ],
    }


def lines(seen: dict[str, Any], most: int | None) -> Iterator[str]:
    """The same for people.

    Args:
        seen: As `look` gave it.
        most: How many rejected nodes of a component, and events, are listed; None: all.
    """
    yield f"{seen['namespace']}/{seen['name']}: {seen['phase']}: {seen['message']}"
    for c in seen["conditions"]:
        yield f"  {c['type']}={c['status']} {c['reason']}: {c.get('message', '')}".rstrip(": ")
    if not seen["placements"]:
        yield "There is no plan."
    if seen["drone"]:
        yield from _drone(seen["drone"])
    for placed in seen["placements"]:
        yield from _placement(placed)
    yield from _rejections(seen, most)
    yield from _policies(seen["policies"])
    if seen["forbidden"]:
        yield f"You may not list {' and '.join(seen['forbidden'])} of this cluster: which policies hold is in them."
    if seen["events"]:
        yield "Events, the newest first:"
        for event in seen["events"][:most]:
            yield f"  {event['lastTimestamp']} {event['type']} {event['reason']}: {event['message']}"


def _drone(drone: Body) -> Iterator[str]:
    shared = f", which {drone['sharedWith']} flies" if drone.get("sharedWith") else ""
    others = ", ".join(f"{a['node']} ({a['score']:.3g})" for a in drone.get("alternatives") or ())
    score = f" (score {drone['score']:.3g})" if drone.get("score") is not None else ""
    yield f"Drone: {drone['node']}{score}{shared}" + (f"; next best: {others}" if others else "; no other could fly it")
    mission = drone.get("mission")
    if mission:
        yield (
            f"  {mission['distance']:.0f} m in {mission['duration']:.1f} min; it can fly {mission['available']:.1f} min with its"
            " reserve kept"
        )
    for leg in drone.get("legality") or ():
        to = f"{leg['end']['lat']:.6f}, {leg['end']['lon']:.6f}"
        by = ", ".join(leg.get("policies") or ()) or "no policy"
        yield f"  leg to {to}: {leg['outcome']} by {by}: {leg['message']}"
    if drone.get("legalityOmitted"):
        yield f"  and {drone['legalityOmitted']} more legs"
    if drone.get("policyConflict"):
        yield f"  Conflict: {drone['policyConflict']}"


def _placement(placed: Body) -> Iterator[str]:
    why = {
        "drone": "on the drone that flies",
        "static": f"for location {placed.get('location', 0)}",
        "hybrid-edge": "covers a part of the operation area",
        "hybrid-drone": "on the drone, beside what it serves",
        "cloud": "any cloud node",
    }.get(placed["role"], placed["role"])
    coverage = f", {placed['coverage']:.0%} of it" if placed.get("coverage") else ""
    yield f"{placed['component']}: {placed.get('node') or 'cloud'} ({why}{coverage})"


def _rejections(seen: dict[str, Any], most: int | None) -> Iterator[str]:
    by_component: dict[str, list[Body]] = {}
    for rejected in seen["rejected"]:
        by_component.setdefault(rejected["component"], []).append(rejected)
    for component, rejections in by_component.items():
        yield f"Not for {component}:"
        for rejected in rejections[:most]:
            yield f"  {rejected['node']}: {rejected['reason']}: {rejected['message']}"
        if most is not None and len(rejections) > most:
            yield f"  and {len(rejections) - most} more (--all)"
    if seen["rejectedOmitted"]:
        yield f"{seen['rejectedOmitted']} more rejected nodes are not in the plan: most of them too far away"


def _policies(policies: dict[str, Sequence[Body]]) -> Iterator[str]:
    for instance, granted in policies.items():
        yield f"Policies for {instance}: " + (
            "; ".join(f"{p['name']} ({p['type']}{_in(p['zones'])})" for p in granted) or "none"
        )


def _in(zones: Sequence[str]) -> str:
    return f" in {', '.join(zones)}" if zones else ", everywhere"
