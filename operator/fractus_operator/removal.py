"""`python -m fractus_operator.removal`: removes the objects that Fractus created at run time, after it was uninstalled.

These are the certificate authority, the Lease of the operator, the location labels of Nodes, and signing requests. helm does not
know them.
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
"""DaemonSet of the chart that deletes the data of nodes. A pod becomes ready when the data of its node is deleted."""
OPERATOR = "fractus-operator"
"""Deployment of the operator."""

_WIPING_S = 120.0
"""Maximum time in which nodes delete their data, in seconds. The deadline of the chart's Job is 240 s."""
_PERIOD_S = 2.0
_CHECK_TIMEOUT_S = 30.0
"""Maximum time of the check that the operator is uninstalled, in seconds.

The check is repeated while the API server does not respond.
"""


def unwiped(nodes: Sequence[Body], pods: Sequence[Body]) -> list[str]:
    """Return the names of the nodes whose data may still exist.

    Args:
        nodes: All drones and edge nodes.
        pods: Pods of the DaemonSet.
    """
    wiped = {
        pod["spec"].get("nodeName")
        for pod in pods
        if any(c["type"] == "Ready" and c["status"] == "True" for c in pod.get("status", {}).get("conditions") or ())
    }
    return sorted(node["metadata"]["name"] for node in nodes if node["metadata"]["name"] not in wiped)


@contextmanager
def _recording(problems: list[str], subject: str) -> Iterator[None]:
    """Record a refused request in `problems`, so that the removal continues."""
    try:
        yield
    except KubeError as error:
        problems.append(f"{subject}: {error}")


async def still_installed(store: Store, namespace: str, timeout_s: float = _CHECK_TIMEOUT_S) -> str:
    """Return why nothing may be removed, as a sentence, or an empty string if the operator is uninstalled.

    The request is repeated until the timeout if the API server does not respond or is overloaded.

    Tools that render the chart but do not support helm hooks (helm template, kustomize) create this Job together with the
    installation that it would remove.
    """
    try:
        operator = await _operator(store, namespace, timeout_s)
    except NotFound:
        return ""
    except KubeError as error:
        # One Role permits this request and the removal. If the request is forbidden, the removal is forbidden as well.
        if error.status == HTTPStatus.FORBIDDEN:
            return ""
        return f"nothing was removed, because it is unknown whether Fractus is still installed ({error})"
    if "deletionTimestamp" in operator["metadata"]:
        return ""
    return (
        f"nothing was removed: Fractus is installed in {namespace}, and this Job is for helm uninstall only; omit hooks if "
        "you render the chart (helm template --no-hooks)"
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
    """Remove the objects that the operator and the agents created. A missing object is not an error.

    Args:
        store: The API server.
        namespace: Namespace of the Fractus services.
        keep_authority: Keep the Secret of the authority, which existed before the installation.

    Returns:
        The objects that could not be removed, with the error.
    """
    problems: list[str] = []

    async def delete(kind: Kind, key: tuple[str, str]) -> None:
        subject = f"{kind.name} {'/'.join(filter(None, key))}"
        with _recording(problems, subject):
            await store.delete(kind, key)
            print(f"removed {subject}")

    if not keep_authority:
        await delete(SECRET, (namespace, AUTHORITY))
    await delete(CONFIG_MAP, (namespace, AUTHORITY))
    await delete(LEASE, (namespace, LEASE_NAME))
    with _recording(problems, "requests for certificates"):
        # Requests of agents that ended before they got a certificate.
        for request in await store.list(SIGNING_REQUEST, selectors={"fieldSelector": f"spec.signerName={NODE_SIGNER}"}):
            await delete(SIGNING_REQUEST, ("", request["metadata"]["name"]))
    with _recording(problems, "location labels of nodes"):
        for node in await store.list(NODE):
            labels = [label for label in node["metadata"].get("labels") or {} if is_location_label(label)]
            if labels:
                subject = f"location labels of the node {node['metadata']['name']}"
                with _recording(problems, subject):
                    await store.set_labels(NODE, node["metadata"]["name"], dict.fromkeys(labels))
                    print(f"removed the {subject}")
    return problems


async def await_wiped(store: Store, namespace: str, timeout_s: float = _WIPING_S) -> list[str]:
    """Wait until the data of all nodes is deleted. Requests without a response are repeated until the timeout.

    Returns:
        The names of the nodes whose data may still exist.

    Raises:
        KubeError: The last request failed as well.
    """
    end = time.monotonic() + timeout_s
    while True:
        late = time.monotonic() > end
        try:
            nodes = await store.list(NODE, selectors={"labelSelector": f"{CLASS_LABEL} in (drone, edge)"})
            selectors = {"labelSelector": "app.kubernetes.io/component=wipe"}
            remaining = unwiped(nodes, (await store.list_whole(POD, namespace=namespace, selectors=selectors)).items)
            if late or not remaining:
                return remaining
        except KubeError:
            if late:
                raise
        await asyncio.sleep(_PERIOD_S)


async def _removed(store: Store, namespace: str, wiped: str, keep_authority: bool, timeout_s: float) -> list[str]:
    problems: list[str] = []
    refused = await remove(store, namespace, keep_authority=keep_authority)
    if refused:
        problems.append(f"some objects of Fractus were not removed: {', '.join(refused)}")
    if wiped:
        try:
            remaining = await await_wiped(store, namespace, timeout_s)
        except KubeError as error:
            problems.append(f"it is unknown on which nodes {wiped} was wiped ({error}): check them (rm -rf {wiped})")
        else:
            if remaining:
                problems.append(
                    f"{wiped} was not wiped on {', '.join(remaining)}: remove it on these nodes (rm -rf {wiped})"
                )
    return problems


async def run(namespace: str, wiped: str, *, keep_authority: bool = False, timeout_s: float = _WIPING_S) -> str:
    """Remove all objects. The DaemonSet that wipes nodes is deleted in any case, because it would wipe the next installation.

    Args:
        namespace: Namespace of the Fractus services.
        wiped: Directory of nodes that is wiped. Empty: none.
        keep_authority: Keep the Secret of the authority, which existed before the installation.
        timeout_s: Maximum time in which nodes delete their data, in seconds.

    Returns:
        A sentence about the objects that were not removed and how to remove them, or an empty string.

    Raises:
        Unconfigured: There are no credentials.
    """
    store = await Store.connect()
    problems: list[str] = []
    try:
        installed = await still_installed(store, namespace, min(_CHECK_TIMEOUT_S, timeout_s))
        problems += [installed] if installed else await _removed(store, namespace, wiped, keep_authority, timeout_s)
    finally:
        if wiped:
            with _recording(problems, f"kubectl -n {namespace} delete daemonset {WIPE}, before anything is installed"):
                await store.delete(DAEMON_SET, (namespace, WIPE))
        await store.aclose()
    return "; ".join(problems)


def main() -> int:
    """Run the removal as a program. Return its exit code."""
    parser = argparse.ArgumentParser(prog="fractus_operator.removal")
    parser.add_argument("--namespace", required=True)
    parser.add_argument("--wiped", default="", metavar="DIRECTORY", help="wait until nodes have wiped it")
    parser.add_argument("--keep-authority", action="store_true", help="leave the Secret of the authority")
    arguments = parser.parse_args()
    # Sent at the deadline of the Job, or when its node is drained.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("ended before all was removed"))
    try:
        problem = asyncio.run(run(arguments.namespace, arguments.wiped, keep_authority=arguments.keep_authority))
    except Unconfigured as error:
        problem = f"the objects of Fractus were not removed: {error}"
    if problem:
        print(problem, file=sys.stderr)
    return 1 if problem else 0


if __name__ == "__main__":
    sys.exit(main())
