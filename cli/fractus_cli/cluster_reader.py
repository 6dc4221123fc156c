"""Read-only access of commands to a cluster, with errors that contain a remedy."""

from __future__ import annotations

import asyncio
import difflib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any

import click
from fractus_runtime.kubernetes import Access, BlockingClient, KubeError, NotFound, from_environment, kubeconfig

Body = Mapping[str, Any]

GROUP = "/apis/fractus.dev/v1alpha1"
SYSTEM = "fractus-system"
EXIT_PROBLEM = 2

kubeconfig_option = click.option(
    "--kubeconfig",
    "config",
    type=click.Path(exists=True, dir_okay=False),
    help="Kubeconfig of the cluster.  [default: KUBECONFIG, then ~/.kube/config]",
)


class ClusterReader:
    """Read-only view of a cluster."""

    def __init__(self, client: BlockingClient) -> None:
        self._client = client

    def get(self, path: str) -> Body | None:
        """Return an object, or None if it does not exist.

        Raises:
            KubeError: The API server rejected the request or is unreachable.
        """
        return self._client.get(path)

    def list(self, path: str, **selectors: str) -> Sequence[Body]:
        """Return a collection, or an empty list if the kind does not exist.

        Raises:
            KubeError: The API server rejected the request or is unreachable.
        """
        try:
            return self._client.list(path, **selectors)
        except NotFound:
            return ()

    def list_permitted(self, path: str) -> Sequence[Body] | None:
        """Return a collection, or None if the user may not list it, for example with rights in one namespace only.

        Raises:
            KubeError: The API server failed or is unreachable.
        """
        try:
            return self.list(path)
        except KubeError as error:
            if error.status != HTTPStatus.FORBIDDEN:
                raise
            return None


@contextmanager
def open_cluster(config: str | None) -> Iterator[ClusterReader]:
    """Open the cluster of a kubeconfig, or the default cluster of kubectl.

    Raises:
        Unconfigured: There are no credentials.
        ClickException: The API server rejected a request or is unreachable.
    """
    with open_client(config) as client:
        yield ClusterReader(client)


@contextmanager
def open_client(config: str | None) -> Iterator[BlockingClient]:
    """Open a client for the cluster of a kubeconfig, or for the default cluster of kubectl.

    Raises:
        Unconfigured: There are no credentials.
        ClickException: The API server rejected a request or is unreachable.
    """
    with kube_errors_explained(), BlockingClient(asyncio.run(access_to(config)), "fractus", trust_env=True) as client:
        yield client


async def access_to(config: str | None) -> Access:
    """Return access to the cluster of a kubeconfig, or to the default cluster of kubectl.

    Raises:
        Unconfigured: There are no credentials.
    """
    return await (kubeconfig(config) if config is not None else from_environment())


@contextmanager
def kube_errors_explained() -> Iterator[None]:
    """Convert errors of the API server to errors with a remedy.

    Raises:
        ClickException: The API server rejected a request or is unreachable.
    """
    try:
        yield
    except (KubeError, ExceptionGroup) as error:
        first: Exception = error
        while isinstance(first, ExceptionGroup):
            first = first.exceptions[0]  # Report only the first failure, because it cancelled the other tasks.
        if not isinstance(first, KubeError):
            raise
        if first.status == HTTPStatus.UNAUTHORIZED:
            remedy = "the credentials are invalid or expired: log in again, or use another --kubeconfig"
        elif first.status:
            remedy = "check your permissions"
        else:
            remedy = "check the cluster and --kubeconfig"
        raise click.ClickException(f"{first}; {remedy}") from first


def get_application(cluster: ClusterReader, namespace: str, name: str) -> Body:
    """Return an Application.

    Raises:
        ClickException: The Application does not exist. The message suggests the closest name.
    """
    return _get_named(cluster, "Application", namespace, name, "`fractus status` lists Applications")


def get_flight_plan(cluster: ClusterReader, namespace: str, name: str) -> Body:
    """Return a FlightPlan.

    Raises:
        ClickException: The FlightPlan does not exist. The message suggests the closest name.
    """
    return _get_named(cluster, "FlightPlan", namespace, name, "`fractus flights list` lists FlightPlans")


def _get_named(cluster: ClusterReader, kind: str, namespace: str, name: str, remedy: str) -> Body:
    collection = f"{GROUP}/namespaces/{namespace}/{kind.lower()}s"
    body = cluster.get(f"{collection}/{name}")
    if body is not None:
        return body
    bodies = cluster.list_permitted(collection) or ()
    similar = difflib.get_close_matches(name, [b["metadata"]["name"] for b in bodies], n=1)
    hint = f"did you mean {similar[0]}?" if similar else remedy
    raise click.ClickException(f"{kind} {namespace}/{name} not found; {hint}")


def conditions_of(body: Body) -> dict[str, Body]:
    """Return the conditions of an object by type."""
    return {c["type"]: c for c in (body.get("status") or {}).get("conditions") or ()}


def table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> list[str]:
    """Format a table, with columns as wide as their longest cell."""
    cells = [[str(cell) if cell not in {None, ""} else "-" for cell in row] for row in (head, *rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(head))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in cells]
