"""`python -m fractus_sim.demo`: fly the traffic monitoring example and write a report."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path

import click
from fractus_cluster.errors import ClusterError
from rich.console import Console
from rich.markdown import Markdown

from fractus_sim.demo.demo_clusters import CurrentCluster, EmbeddedCluster
from fractus_sim.demo.demo_run import Demo, Teller, report_again
from fractus_sim.demo.live_view import replay_command
from fractus_sim.errors import ExperimentError
from fractus_sim.interruption import break_off_on_signals


def _assignments(_context: click.Context, _option: click.Parameter, texts: tuple[str, ...]) -> Mapping[str, str]:
    found: dict[str, str] = {}
    for text in texts:
        example, equals, node = text.partition("=")
        if not equals or not node or example not in {"drone-1", "edge-1", "edge-2", "edge-3", "cloud-1"}:
            raise click.BadParameter(f"{text!r}: expected drone-1=NODE, edge-1=NODE, ..., cloud-1=NODE")
        found[example] = node
    return found


@click.command()
@click.option(
    "--cluster",
    type=click.Choice(["embedded", "current"]),
    default="embedded",
    show_default=True,
    help="embedded: a new cluster on this machine (Linux, root). current: the cluster of KUBECONFIG (k3s, kind) with loaded images.",
)
@click.option(
    "--out", type=click.Path(path_type=Path, file_okay=False), default=Path("out/demo"), show_default=True,
    help="Output folder of the report.",
)  # fmt: skip
@click.option("--keep", is_flag=True, help="Do not remove cluster, Fractus and application at the end.")
@click.option(
    "--assign", multiple=True, callback=_assignments, metavar="NAME=NODE",
    help="With --cluster current: node to use as drone-1, edge-1, ..., cloud-1 (repeatable).",
)  # fmt: skip
@click.option(
    "--timeout", "timeout_s", default=480.0, show_default=True, help="Maximum duration of the mission, seconds."
)
@click.option("--report-only", is_flag=True, help="Only write the report in OUT again from the data of an earlier run.")
def demo(
    *, cluster: str, out: Path, keep: bool, assign: Mapping[str, str], timeout_s: float, report_only: bool
) -> None:
    """Deploy the traffic monitoring example, observe its flight, and write a report."""
    console = Console()
    break_off_on_signals()
    try:
        if report_only:
            report_again(out)
            fine = True
        else:
            tell = Teller(console)
            chosen = EmbeddedCluster(tell) if cluster == "embedded" else CurrentCluster(tell, assign)
            fine = Demo(chosen, out, keep, timeout_s, tell).run()
    except (ExperimentError, ClusterError) as error:
        click.echo(f"demo: {error}", err=True)
        sys.exit(1)
    except KeyboardInterrupt:
        click.echo("demo: interrupted", err=True)
        sys.exit(130)
    console.print(Markdown((out / "summary.md").read_text()))
    click.echo(
        f"report: {out}/summary.md, map.png, altitude.png, flight.geojson, plan.yaml, audit/, pictures/, recordings/"
    )
    if (replay := replay_command(out)) is not None:
        click.echo(f"replay: {replay}")
    sys.exit(0 if fine else 1)


if __name__ == "__main__":
    demo(prog_name="python -m fractus_sim.demo")
