"""`fractus logs`: what the pods of an application, and the parts of Fractus beside them, print."""

from __future__ import annotations

import asyncio
import difflib
import json
from collections.abc import Sequence
from contextlib import aclosing
from dataclasses import dataclass
from datetime import timedelta
from http import HTTPStatus

import click
from fractus_runtime.kubernetes import POD, Client, KubeError

from fractus_cli.log_follower import Follower, Place
from fractus_cli.log_reader import Extent, LogReader, Problems
from fractus_cli.log_sources import COMPONENT, Line, Source, duration, sources
from fractus_cli.output import output_option, printable
from fractus_cli.reading import (
    EXIT_PROBLEM,
    GROUP,
    SYSTEM,
    Body,
    Cluster,
    access_to,
    application,
    cluster,
    kubeconfig_option,
    refusals_explained,
)

_PARTS = "app.kubernetes.io/name=fractus,app.kubernetes.io/component in (agent,camera,mobility,operator)"
_OPERATOR = "fractus-operator"


def _since(_context: click.Context, _option: click.Parameter, text: str | None) -> timedelta | None:
    found = duration(text) if text is not None else None
    if text is not None and found is None:
        raise click.BadParameter(f"{text!r} is no length of time, such as 90s, 10m or 1h30m")
    return found


@click.command()
@click.argument("name", metavar="APPLICATION")
@click.option("-n", "--namespace", default="default", show_default=True, help="Of the application.")
@click.option(
    "--component", "components", multiple=True, metavar="NAME", help="Only this one; may be given repeatedly."
)
@click.option("-f", "--follow", is_flag=True, help="Go on with what comes, also of new pods, until interrupted.")
@click.option(
    "--tail", type=click.IntRange(-1), default=-1, metavar="N", help="Only the last N lines of each container."
)
@click.option("--since", callback=_since, metavar="TIME", help="Only what is younger than that, such as 10m.")
@click.option("--system", is_flag=True, help="Also agent, mobility and camera of its nodes, and the operator.")
@output_option
@kubeconfig_option
def logs(
    *,
    name: str,
    namespace: str,
    components: tuple[str, ...],
    follow: bool,
    tail: int,
    since: timedelta | None,
    system: bool,
    output: str,
    config: str | None,
) -> int:
    """Show what the pods of APPLICATION print, by the clocks of their nodes.

    A container that restarted is shown with the one before it. Lines begin with component and node; those of parts of
    Fractus (--system) go back to when APPLICATION was made.

    Exits with 2 where a log cannot be read, such as those of a node out of reach, and where there are no pods.
    """
    with cluster(config) as found:
        scope = look(found, namespace, name, components)
    extent = Extent(None if tail < 0 else tail, since, scope.made)
    places = [scope.place, *([Place(SYSTEM, _PARTS)] if system else ())]
    with refusals_explained():
        return asyncio.run(_show(config, scope, extent, places, output, follow=follow))


@dataclass(frozen=True, slots=True)
class Scope:
    """Which logs belong to an application.

    Attributes:
        title: how it is called.
        place: its pods.
        made: when it was made, in RFC 3339.
        nodes: where its plan puts it.
        state: its phase, and what is said of it.
    """

    title: str
    place: Place
    made: str
    nodes: frozenset[str]
    state: str

    def chosen(self, found: Sequence[Source]) -> list[Source]:
        """Its own containers, the operator's, and those of parts of Fractus on its nodes."""
        nodes = self.nodes | {source.node for source in found if not source.system}
        return [s for s in found if not s.system or s.part == _OPERATOR or s.node in nodes]


def look(found: Cluster, namespace: str, name: str, components: Sequence[str]) -> Scope:
    """Find an application, and where it is.

    Raises:
        ClickException: there is no such application, or it has no such component.
    """
    body = application(found, namespace, name)
    there = [component["name"] for component in body["spec"]["components"]]
    for component in components:
        if component not in there:
            near = difflib.get_close_matches(component, there, n=1)
            hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(there)}"
            raise click.ClickException(f"{namespace}/{name} has no component {component}; {hint}")
    plans = found.list_permitted(f"{GROUP}/namespaces/{namespace}/deploymentplans") or ()
    status: Body = body.get("status") or {}
    selector = f"fractus.dev/application={name}"
    if components:
        selector += f",{COMPONENT} in ({','.join(components)})"
    placed = [p for plan in plans if plan["spec"]["application"] == name for p in plan["spec"].get("placements") or ()]
    return Scope(
        f"{namespace}/{name}",
        Place(namespace, selector),
        body["metadata"]["creationTimestamp"],
        frozenset(filter(None, (status.get("drone"), *(p.get("node") for p in placed)))),
        f"{status.get('phase', 'Pending')}: {status.get('message', 'the operator has not seen it yet')}",
    )


async def _show(
    config: str | None, scope: Scope, extent: Extent, places: list[Place], output: str, *, follow: bool
) -> int:
    problems = Problems(_say)

    def show(line: Line) -> None:
        click.echo(_document(line) if output == "json" else _text(line))

    async with aclosing(Client(await access_to(config), "fractus")) as client:
        readable, found = await _pods(client, places, problems)
        if not any(not source.system for source in found):
            problems.tell("pods", f"{scope.title} has no pods ({scope.state})")
        chosen = scope.chosen(found)
        for source in chosen:
            if not source.run:
                _say(f"{source.label} has not started: {source.waits_for}")
        reader = LogReader(client, extent, problems)
        for line in await reader.history(chosen):
            show(line)
        if follow:
            await Follower(client, reader, show, scope.chosen, problems).run(readable)
    return EXIT_PROBLEM if problems.any else 0


async def _pods(client: Client, places: list[Place], problems: Problems) -> tuple[list[Place], list[Source]]:
    """The places that may be read, and the containers there."""
    readable, found = [], []
    for place in places:
        try:
            page = await client.list_whole(POD, namespace=place.namespace, selectors=place.selectors)
        except KubeError as error:
            if error.status != HTTPStatus.FORBIDDEN or place is places[0]:
                raise
            problems.tell(f"{place.namespace}/", f"{error}; without the lines of Fractus")
            continue
        readable.append(place)
        found += [source for pod in page.items for source in sources(pod)]
    return readable, found


def _say(sentence: str) -> None:
    click.echo(printable(f"fractus: {' '.join(sentence.split())}"), err=True)


def _text(line: Line) -> str:
    return printable(f"{line.source.label} | {line.text.expandtabs()}")


def _document(line: Line) -> str:
    source = line.source
    return json.dumps(
        {
            "time": line.time or None,
            "component": source.part,
            "system": source.system,
            "node": source.node or None,
            "namespace": source.namespace,
            "pod": source.pod,
            "container": source.container,
            "message": line.text,
        }
    )
