"""Reads a cluster for commands: what is in it, as the API server gives it."""

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
    help="Which cluster; else KUBECONFIG, then ~/.kube/config.",
)


class Cluster:
    """A cluster that is only read."""

    def __init__(self, client: BlockingClient) -> None:
        self._client = client

    def get(self, path: str) -> Body | None:
        """An object; None where there is none.

        Raises:
            KubeError: the API server refused it, or could not be reached.
        """
        return self._client.get(path)

    def list(self, path: str, **selectors: str) -> Sequence[Body]:
        """A collection; empty where there is no such kind.

        Raises:
            KubeError: the API server refused it, or could not be reached.
        """
        try:
            return self._client.list(path, **selectors)
        except NotFound:
            return ()

    def list_permitted(self, path: str) -> Sequence[Body] | None:
        """A collection; None where the user may not list it, as those of no namespace with rights in one only.

        Raises:
            KubeError: the API server could not be reached, or failed.
        """
        try:
            return self.list(path)
        except KubeError as error:
            if error.status != HTTPStatus.FORBIDDEN:
                raise
            return None


@contextmanager
def cluster(config: str | None) -> Iterator[Cluster]:
    """Open the cluster of a kubeconfig, or the one that kubectl would take.

    Raises:
        Unconfigured: there are no credentials.
        ClickException: the API server refused what the command asked for, or could not be reached.
    """
    with refusals_explained(), BlockingClient(asyncio.run(access_to(config)), "fractus", trust_env=True) as client:
        yield Cluster(client)


async def access_to(config: str | None) -> Access:
    """Access to the cluster of a kubeconfig, or the one that kubectl would take.

    Raises:
        Unconfigured: there are no credentials.
    """
    return await (kubeconfig(config) if config is not None else from_environment())


@contextmanager
def refusals_explained() -> Iterator[None]:
    """Refusals and silence of the API server as the one line that the user sees.

    Raises:
        ClickException: the API server refused what the command asked for, or could not be reached.
    """
    try:
        yield
    except (KubeError, ExceptionGroup) as error:
        first: Exception = error
        while isinstance(first, ExceptionGroup):
            first = first.exceptions[0]  # what failed first is the cause; the others were cancelled by it
        if not isinstance(first, KubeError):
            raise
        remedy = "check your permissions" if first.status else "check the cluster and --kubeconfig"
        raise click.ClickException(f"{first}; {remedy}") from first


def application(found: Cluster, namespace: str, name: str) -> Body:
    """An Application.

    Raises:
        ClickException: there is none of that name; it names the nearest.
    """
    body = found.get(f"{GROUP}/namespaces/{namespace}/applications/{name}")
    if body is not None:
        return body
    there = [b["metadata"]["name"] for b in found.list_permitted(f"{GROUP}/namespaces/{namespace}/applications") or ()]
    near = difflib.get_close_matches(name, there, n=1)
    hint = f"did you mean {near[0]}?" if near else "see fractus status"
    raise click.ClickException(f"there is no Application {namespace}/{name}; {hint}")


def conditions_of(body: Body) -> dict[str, Body]:
    """The conditions of an object by type."""
    return {c["type"]: c for c in (body.get("status") or {}).get("conditions") or ()}


def table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> list[str]:
    """Lines of a table whose columns are as wide as they need to be."""
    cells = [[str(cell) if cell not in {None, ""} else "-" for cell in row] for row in (head, *rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(head))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in cells]
