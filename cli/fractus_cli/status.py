"""`fractus status`: drones, edge nodes and Applications of a cluster."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from typing import Any

import click

from fractus_cli.cluster_reader import GROUP, Body, ClusterReader, conditions_of, kubeconfig_option, open_cluster, table
from fractus_cli.output import output_option, printable

WATCH_INTERVAL_S = 2.0


@click.command()
@click.option("-n", "--namespace", default="", help="Only Applications of this namespace.")
@click.option("-w", "--watch", is_flag=True, help="Repeat every two seconds until interrupted.")
@output_option
@kubeconfig_option
def status(namespace: str, watch: bool, output: str, config: str | None) -> None:
    """Show the drones, edge nodes and Applications of a cluster.

    Users with permissions in one namespace must specify --namespace. The output then contains only Applications.
    """
    with open_cluster(config) as cluster:
        while True:
            summary = collect(cluster, namespace)
            if watch and output == "text":
                click.clear()
            click.echo(json.dumps(summary) if output == "json" else "\n".join(map(printable, lines(summary))))
            if not watch:
                return
            time.sleep(WATCH_INTERVAL_S)


def collect(cluster: ClusterReader, namespace: str) -> dict[str, Any]:
    """Return drones, edge nodes and Applications by name, and the names of collections that the user is not permitted to list.

    Raises:
        ClickException: The user is not permitted to list the Applications of the namespace.
    """
    scope = f"/namespaces/{namespace}" if namespace else ""
    applications = cluster.list_permitted(f"{GROUP}{scope}/applications")
    if applications is None:
        scope_name = f"namespace {namespace}" if namespace else "all namespaces"
        remedy = "check your permissions there" if namespace else "specify a namespace with --namespace"
        raise click.ClickException(f"not permitted to list the Applications of {scope_name}; {remedy}")
    drones = cluster.list_permitted(f"{GROUP}/drones")
    edge_nodes = cluster.list_permitted(f"{GROUP}/edgenodes")
    return {
        "drones": [_drone(body) for body in _by_name(drones or ())],
        "edgeNodes": [_node(body) for body in _by_name(edge_nodes or ())],
        "applications": [_application(body) for body in _by_name(applications)],
        "forbidden": [name for name, listed in (("drones", drones), ("edgeNodes", edge_nodes)) if listed is None],
    }


def lines(summary: dict[str, Any]) -> list[str]:
    """Format a summary as text."""
    drones = [
        (d["name"], d["state"], d["controller"], d["battery"], d["ready"], d["services"], d["lastSeen"], d["message"])
        for d in summary["drones"]
    ]
    edges = [(e["name"], e["ready"], e["services"], e["lastSeen"], e["message"]) for e in summary["edgeNodes"]]
    applications = [
        (f"{a['namespace']}/{a['name']}", a["phase"], a["drone"], a["pods"], a["message"])
        for a in summary["applications"]
    ]
    application_table = table(("APPLICATION", "PHASE", "DRONE", "PODS", "MESSAGE"), applications)
    if summary["forbidden"]:
        return [
            *application_table,
            "",
            f"You are not permitted to list {' and '.join(summary['forbidden'])} of this cluster.",
        ]
    return [
        *table(("DRONE", "STATE", "CONTROLLER", "BATTERY", "READY", "SERVICES", "LAST SEEN", "MESSAGE"), drones),
        "",
        *table(("EDGE NODE", "READY", "SERVICES", "LAST SEEN", "MESSAGE"), edges),
        "",
        *application_table,
    ]


def _by_name(bodies: Sequence[Body]) -> list[Body]:
    return sorted(bodies, key=lambda body: (body["metadata"].get("namespace", ""), body["metadata"]["name"]))


def _node(body: Body) -> dict[str, Any]:
    conditions = conditions_of(body)
    ready = conditions.get("Ready", {})
    current = conditions.get("ServicesCurrent", {})
    return {
        "name": body["metadata"]["name"],
        "ready": ready.get("status", "Unknown"),
        "reason": ready.get("reason"),
        "message": ready.get("message", "") if ready.get("status") != "True" else "",
        "services": current.get("reason", "Current"),
        "lastSeen": (body.get("status") or {}).get("lastSeen"),
    }


def _drone(body: Body) -> dict[str, Any]:
    status = body.get("status") or {}
    remaining = (status.get("battery") or {}).get("remaining")
    return {
        **_node(body),
        "state": status.get("flightState", "unknown"),
        "lastState": status.get("lastFlightState"),
        "controller": status.get("controller"),
        "battery": f"{remaining:.0%}" if remaining is not None else None,
        "position": status.get("position"),
        "onMission": conditions_of(body).get("OnMission", {}).get("status", "False"),
    }


def _application(body: Body) -> dict[str, Any]:
    status = body.get("status") or {}
    return {
        "namespace": body["metadata"]["namespace"],
        "name": body["metadata"]["name"],
        "phase": status.get("phase", "Pending"),
        "drone": status.get("drone"),
        "pods": status.get("pods"),
        "message": status.get("message", "not processed by the operator yet"),
    }
