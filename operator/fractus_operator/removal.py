"""`python -m fractus_operator.removal`: after Fractus was uninstalled, removes what it made itself.

The authority, the operator's Lease, the location labels of Nodes, and requests for certificates: helm knows of none of them.
"""

from __future__ import annotations

import argparse
import asyncio
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from http import HTTPStatus

from fractus_core.api.names import CLASS_LABEL, NODE_SIGNER
from fractus_runtime.kubernetes import LEASE

from fractus_operator.ca_secret import NAME as AUTHORITY
from fractus_operator.kinds import (
    CONFIG_MAP,
    DAEMON_SET,
    DEPLOYMENT,
    NODE,
    POD,
    SECRET,
    SIGNING_REQUEST,
    Body,
    Kind,
)
from fractus_operator.labels import LEASE_NAME, is_location_label
from fractus_operator.store import KubeError, NotFound, Store, Unconfigured

WIPE = "fractus-wipe"
"""The chart's DaemonSet whose pods are ready once their node's data is gone."""
OPERATOR = "fractus-operator"
"""The chart's Deployment of the operator."""

_WIPING_S = 120.0
"""How long nodes get to remove their data; the chart's Job has 240 s in all."""
_PERIOD_S = 2.0
_ASKING_S = 30.0
"""How long an API server that does not answer is asked whether the operator is still installed."""


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


@contextmanager
def _noting(problems: list[str], what: str) -> Iterator[None]:
    """Keep what is refused, so that the rest is removed all the same."""
    try:
        yield
    except KubeError as error:
        problems.append(f"{what}: {error}")


async def still_installed(store: Store, namespace: str, timeout_s: float = _ASKING_S) -> str:
    """Return why nothing may be removed, in a sentence; empty once the operator is uninstalled.

    An API server that does not answer, or has no time, is asked again until the end.

    What renders the chart and knows no hooks of helm (helm template, kustomize) makes this Job along with what it would take down.
    """
    try:
        operator = await _operator(store, namespace, timeout_s)
    except NotFound:
        return ""
    except KubeError as error:
        # The right to look comes in one Role with those to remove what this protects.
        if error.status == HTTPStatus.FORBIDDEN:
            return ""
        return f"nothing was removed, for it is not known whether Fractus is still installed ({error})"
    if "deletionTimestamp" in operator["metadata"]:
        return ""
    return (
        f"nothing was removed: Fractus is installed in {namespace}, and this Job is for helm uninstall only; leave hooks out "
        "where you render the chart (helm template --no-hooks)"
    )


async def _operator(store: Store, namespace: str, timeout_s: float) -> Body:
    end = time.monotonic() + timeout_s
    while True:
        try:
            return await store.get(DEPLOYMENT, OPERATOR, namespace)
        except KubeError as error:
            passes = (
                error.status in {0, HTTPStatus.TOO_MANY_REQUESTS} or error.status >= HTTPStatus.INTERNAL_SERVER_ERROR
            )
            if not passes or time.monotonic() > end:
                raise
        await asyncio.sleep(_PERIOD_S)


async def remove(store: Store, namespace: str, *, keep_authority: bool = False) -> list[str]:
    """Remove what the operator and the agents made in the cluster; what is gone already is no error.

    Args:
        store: Kubernetes.
        namespace: Where the system lived.
        keep_authority: Leave its Secret, which was there before.

    Returns:
        What could not be removed, and why.
    """
    problems: list[str] = []

    async def delete(kind: Kind, key: tuple[str, str]) -> None:
        what = f"{kind.name} {'/'.join(filter(None, key))}"
        with _noting(problems, what):
            await store.delete(kind, key)
            print(f"removed {what}")

    if not keep_authority:
        await delete(SECRET, (namespace, AUTHORITY))
    await delete(CONFIG_MAP, (namespace, AUTHORITY))
    await delete(LEASE, (namespace, LEASE_NAME))
    with _noting(problems, "requests for certificates"):
        # Of an agent that ended while it waited for one.
        for request in await store.list(SIGNING_REQUEST, selectors={"fieldSelector": f"spec.signerName={NODE_SIGNER}"}):
            await delete(SIGNING_REQUEST, ("", request["metadata"]["name"]))
    with _noting(problems, "location labels of nodes"):
        for node in await store.list(NODE):
            ours = [label for label in node["metadata"].get("labels") or {} if is_location_label(label)]
            if ours:
                what = f"location labels of the node {node['metadata']['name']}"
                with _noting(problems, what):
                    await store.set_labels(NODE, node["metadata"]["name"], dict.fromkeys(ours))
                    print(f"removed the {what}")
    return problems


async def await_wiped(store: Store, namespace: str, timeout_s: float = _WIPING_S) -> list[str]:
    """Wait until the data of all nodes is gone; an API server that does not answer is asked again until the end.

    Returns:
        The names of the nodes whose data is not known to be gone.

    Raises:
        KubeError: the API server did not answer at the end either.
    """
    end = time.monotonic() + timeout_s
    while True:
        late = time.monotonic() > end
        try:
            nodes = await store.list(NODE, selectors={"labelSelector": f"{CLASS_LABEL} in (drone, edge)"})
            ours = {"labelSelector": "app.kubernetes.io/component=wipe"}
            left = unwiped(nodes, (await store.list_whole(POD, namespace=namespace, selectors=ours)).items)
            if late or not left:
                return left
        except KubeError:
            if late:
                raise
        await asyncio.sleep(_PERIOD_S)


async def _removed(store: Store, namespace: str, wiped: str, keep_authority: bool, timeout_s: float) -> list[str]:
    problems: list[str] = []
    refused = await remove(store, namespace, keep_authority=keep_authority)
    if refused:
        problems.append(f"not all that Fractus made in the cluster was removed: {', '.join(refused)}")
    if wiped:
        try:
            left = await await_wiped(store, namespace, timeout_s)
        except KubeError as error:
            problems.append(
                f"it is not known on which nodes {wiped} was wiped ({error}): see to it there (rm -rf {wiped})"
            )
        else:
            if left:
                problems.append(f"{wiped} was not wiped on {', '.join(left)}: remove it there (rm -rf {wiped})")
    return problems


async def run(namespace: str, wiped: str, *, keep_authority: bool = False, timeout_s: float = _WIPING_S) -> str:
    """Remove all of it. The DaemonSet that wipes goes in any case: it would wipe what is installed next.

    Args:
        namespace: where the system lived.
        wiped: the directory of nodes that is wiped; empty: none is.
        keep_authority: leave the Secret of the authority, which was there before.
        timeout_s: how long nodes get.

    Returns:
        What was not removed and what to do, in a sentence; empty when nothing is left.

    Raises:
        Unconfigured: there are no credentials.
    """
    store = await Store.connect()
    problems: list[str] = []
    try:
        installed = await still_installed(store, namespace, min(_ASKING_S, timeout_s))
        problems += [installed] if installed else await _removed(store, namespace, wiped, keep_authority, timeout_s)
    finally:
        if wiped:
            with _noting(problems, f"kubectl -n {namespace} delete daemonset {WIPE}, before anything is installed"):
                await store.delete(DAEMON_SET, (namespace, WIPE))
        await store.aclose()
    return "; ".join(problems)


def main() -> int:
    """Run the removal as a program; returns its exit code."""
    parser = argparse.ArgumentParser(prog="fractus_operator.removal")
    parser.add_argument("--namespace", required=True)
    parser.add_argument("--wiped", default="", metavar="DIRECTORY", help="wait until nodes have wiped it")
    parser.add_argument("--keep-authority", action="store_true", help="leave the Secret of the authority")
    arguments = parser.parse_args()
    # The Job's deadline, or a drained node.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("ended before all was removed"))
    try:
        left = asyncio.run(run(arguments.namespace, arguments.wiped, keep_authority=arguments.keep_authority))
    except Unconfigured as error:
        left = f"what Fractus made was not removed: {error}"
    if left:
        print(left, file=sys.stderr)
    return 1 if left else 0


if __name__ == "__main__":
    sys.exit(main())
