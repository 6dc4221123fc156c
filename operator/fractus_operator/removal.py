"""`python -m fractus_operator.removal`: after Fractus was uninstalled, removes what it made itself.

The authority, the operator's Lease, the location labels of Nodes, and requests for certificates: helm knows of none of them.
"""

from __future__ import annotations

import argparse
import asyncio
import sys
import time
from collections.abc import Sequence

from fractus_core.api.names import CLASS_LABEL, NODE_SIGNER
from fractus_kube import LEASE

from fractus_operator.cluster.kinds import CONFIG_MAP, DAEMON_SET, NODE, POD, SECRET, SIGNING_REQUEST, Body, Kind
from fractus_operator.cluster.labels import LEASE_NAME, is_location_label
from fractus_operator.cluster.store import KubeError, Store, Unconfigured
from fractus_operator.identity.ca_secret import NAME as AUTHORITY

WIPE = "fractus-wipe"
"""The chart's DaemonSet whose pods are ready once their node's data is gone."""

_WIPING_S = 120.0
"""How long nodes get to remove their data; the chart's Job has 240 s in all."""
_PERIOD_S = 2.0


def unwiped(nodes: Sequence[Body], pods: Sequence[Body]) -> list[str]:
    """Return the names of the nodes whose data is not known to be gone.

    Args:
        nodes: All drones and edge nodes.
        pods: Of the DaemonSet.
    """
    wiped = {
        pod["spec"].get("nodeName")
        for pod in pods
        if any(c["type"] == "Ready" and c["status"] == "True" for c in pod.get("status", {}).get("conditions") or ())
    }
    return sorted(node["metadata"]["name"] for node in nodes if node["metadata"]["name"] not in wiped)


async def remove(store: Store, namespace: str) -> None:
    """Remove what the operator and the agents made in the cluster; what is gone already is no error.

    Raises:
        KubeError: the API server refused, or could not be reached.
    """
    for kind, name in ((SECRET, AUTHORITY), (CONFIG_MAP, AUTHORITY), (LEASE, LEASE_NAME)):
        await _delete(store, kind, (namespace, name))
    # Of an agent that ended while it waited for one.
    for request in await store.list(SIGNING_REQUEST, selectors={"fieldSelector": f"spec.signerName={NODE_SIGNER}"}):
        await _delete(store, SIGNING_REQUEST, ("", request["metadata"]["name"]))
    for node in await store.list(NODE):
        ours = [label for label in node["metadata"].get("labels") or {} if is_location_label(label)]
        if ours:
            name = node["metadata"]["name"]
            await store.label(NODE, name, dict.fromkeys(ours))
            print(f"removed the location labels of the node {name}")


async def _delete(store: Store, kind: Kind, key: tuple[str, str]) -> None:
    await store.delete(kind, key)
    print(f"removed {kind.name} {'/'.join(filter(None, key))}")


async def await_wiped(store: Store, namespace: str, timeout_s: float = _WIPING_S) -> list[str]:
    """Wait until the data of all nodes is gone, and remove the DaemonSet, whatever came of it.

    Returns:
        The names of the nodes whose data is not known to be gone.

    Raises:
        KubeError: the API server refused, or could not be reached.
    """
    end = time.monotonic() + timeout_s
    try:
        while True:
            nodes = await store.list(NODE, selectors={"labelSelector": f"{CLASS_LABEL} in (drone, edge)"})
            ours = {"labelSelector": "app.kubernetes.io/component=wipe"}
            left = unwiped(nodes, (await store.list_whole(POD, namespace=namespace, selectors=ours)).items)
            if not left or time.monotonic() > end:
                return left
            await asyncio.sleep(_PERIOD_S)
    finally:
        await store.delete(DAEMON_SET, (namespace, WIPE))


async def run(namespace: str, wiped: str) -> str:
    """Remove all of it.

    Args:
        namespace: where the system lived.
        wiped: the directory of nodes that is wiped; empty: none is.

    Returns:
        What was not removed and what to do, in a sentence; empty when nothing is left.

    Raises:
        Unconfigured: there are no credentials.
        KubeError: the API server refused, or could not be reached.
    """
    store = await Store.connect()
    try:
        problems = []
        try:
            await remove(store, namespace)
        except KubeError as error:
            problems.append(f"not all that Fractus made in the cluster was removed: {error}")
        left = await await_wiped(store, namespace) if wiped else []
    finally:
        await store.aclose()
    if left:
        problems.append(f"{wiped} was not wiped on {', '.join(left)}: remove it there (rm -rf {wiped})")
    return "; ".join(problems)


def main() -> int:
    """Run the removal as a program; returns its exit code."""
    parser = argparse.ArgumentParser(prog="fractus_operator.removal")
    parser.add_argument("--namespace", required=True)
    parser.add_argument("--wiped", default="", metavar="DIRECTORY", help="wait until nodes have wiped it")
    arguments = parser.parse_args()
    try:
        left = asyncio.run(run(arguments.namespace, arguments.wiped))
    except (Unconfigured, KubeError) as error:
        left = f"what Fractus made was not removed: {error}"
    if left:
        print(left, file=sys.stderr)
    return 1 if left else 0


if __name__ == "__main__":
    sys.exit(main())
