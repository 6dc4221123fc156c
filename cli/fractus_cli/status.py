"""`fractus status`: the fleet and the applications of a cluster."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from typing import Any

import click

from fractus_cli.output import output_option, printable
from fractus_cli.reading import GROUP, Body, Cluster, cluster, conditions_of, kubeconfig_option, table

PERIOD_S = 2.0


@click.command()
@click.option("-n", "--namespace", default="", help="Only the applications of this namespace.")
@click.option("-w", "--watch", is_flag=True, help="Print it again every two seconds until interrupted.")
@output_option
@kubeconfig_option
def status(namespace: str, watch: bool, output: str, config: str | None) -> None:
    """Show the drones, edge nodes and applications of a cluster.

    Who has rights in one namespace only sees its applications (--namespace).
    """
    with cluster(config) as found:
        while True:
            seen = look(found, namespace)
            if watch and output == "text":
                click.clear()
            click.echo(json.dumps(seen) if output == "json" else "\n".join(map(printable, lines(seen))))
            if not watch:
                return
            time.sleep(PERIOD_S)


def look(found: Cluster, namespace: str) -> dict[str, Any]:
    """What is shown of a cluster: drones, edge nodes and applications, each by name, and what the user may not list.

    Raises:
        ClickException: the user may not list these Applications.
    """
    scope = f"/namespaces/{namespace}" if namespace else ""
    applications = found.list_permitted(f"{GROUP}{scope}/applications")
    if applications is None:
        remedy = "check your permissions there" if namespace else "give one with --namespace"
        raise click.ClickException(f"you may not list the Applications of {namespace or 'all namespaces'}; {remedy}")
    drones = found.list_permitted(f"{GROUP}/drones")
    edge_nodes = found.list_permitted(f"{GROUP}/edgenodes")
    return {
        "drones": [_drone(body) for body in _by_name(drones or ())],
        "edgeNodes": [_node(body) for body in _by_name(edge_nodes or ())],
        "applications": [_application(body) for body in _by_name(applications)],
        "forbidden": [name for name, listed in (("drones", drones), ("edgeNodes", edge_nodes)) if listed is None],
    }


def lines(seen: dict[str, Any]) -> list[str]:
    """The same for people."""
    drones = [
        (d["name"], d["state"], d["controller"], d["battery"], d["ready"], d["services"], d["lastSeen"], d["message"])
        for d in seen["drones"]
    ]
    edges = [(e["name"], e["ready"], e["services"], e["lastSeen"], e["message"]) for e in seen["edgeNodes"]]
    applications = [
        (f"{a['namespace']}/{a['name']}", a["phase"], a["drone"], a["pods"], a["message"]) for a in seen["applications"]
    ]
    shown = table(("APPLICATION", "PHASE", "DRONE", "PODS", "MESSAGE"), applications)
    if seen["forbidden"]:
        return [*shown, "", f"You may not list {' and '.join(seen['forbidden'])} of this cluster."]
    return [
        *table(("DRONE", "STATE", "CONTROLLER", "BATTERY", "READY", "SERVICES", "LAST SEEN", "MESSAGE"), drones),
        "",
        *table(("EDGE NODE", "READY", "SERVICES", "LAST SEEN", "MESSAGE"), edges),
        "",
        *shown,
    ]


def _by_name(bodies: Sequence[Body]) -> list[Body]:
    return sorted(bodies, key=lambda body: (body["metadata"].get("namespace", ""), body["metadata"]["name"]))


def _node(body: Body) -> dict[str, Any]:
    conditions = conditions_of(body)
    ready, current = conditions.get("Ready", {}), conditions.get("ServicesCurrent", {})
    return {
        "name": body["metadata"]["name"],
        "ready": ready.get("status", "Unknown"),
        "reason": ready.get("reason"),
        "message": ready.get("message", "") if ready.get("status") != "True" else "",
        "services": current.get("reason", "Current"),
        "lastSeen": (body.get("status") or {}).get("lastSeen"),
    }


def _drone(body: Body) -> dict[str, Any]:
    known = body.get("status") or {}
    remaining = (known.get("battery") or {}).get("remaining")
    return {
        **_node(body),
        "state": known.get("flightState", "unknown"),
        "lastState": known.get("lastFlightState"),
        "controller": known.get("controller"),
        "battery": f"{remaining:.0%}" if remaining is not None else None,
        "position": known.get("position"),
        "onMission": conditions_of(body).get("OnMission", {}).get("status", "False"),
    }


def _application(body: Body) -> dict[str, Any]:
    known = body.get("status") or {}
    return {
        "namespace": body["metadata"]["namespace"],
        "name": body["metadata"]["name"],
        "phase": known.get("phase", "Pending"),
        "drone": known.get("drone"),
        "pods": known.get("pods"),
        "message": known.get("message", "the operator has not seen it yet"),
    }
