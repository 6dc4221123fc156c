"""`python -m fractus_sim.demo`: fly the traffic monitoring example and write a report."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path

import click
from fractus_cluster.spec import load_spec
from rich.console import Console
from rich.markdown import Markdown

from fractus_sim.command_line import command_errors
from fractus_sim.demo.demo_clusters import EXAMPLE_NODES, CurrentCluster
from fractus_sim.demo.demo_run import ConsoleProgress, Demo, replay_command, rewrite_report
from fractus_sim.report.report_files import PAGE
from fractus_sim.testbeds.embedded_cluster import DEMO_CLUSTER_FILE, FractusCluster


def _parse_assignments(_context: click.Context, _option: click.Parameter, texts: tuple[str, ...]) -> Mapping[str, str]:
    assignments: dict[str, str] = {}
    for text in texts:
        example, _, node = text.partition("=")
        if not node or example not in EXAMPLE_NODES:
            raise click.BadParameter(f"{text!r}: expected drone-1=NODE, edge-1=NODE, ..., cloud-1=NODE")
        assignments[example] = node
    return assignments


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
    "--assign", multiple=True, callback=_parse_assignments, metavar="NAME=NODE",
    help="With --cluster current: node to use as drone-1, edge-1, ..., cloud-1 (repeatable).",
)  # fmt: skip
@click.option(
    "--timeout", "timeout_s", default=480.0, show_default=True, help="Maximum duration of the mission, seconds."
)
@click.option("--report-only", is_flag=True, help="Only write the report in OUT again from the data of an earlier run.")
def demo(
    *, cluster: str, out: Path, keep: bool, assign: Mapping[str, str], timeout_s: float, report_only: bool
) -> None:
    """Deploy the traffic monitoring example, observe its flight, and write a report.

    Exit code: 0 if the mission completed as expected, 1 otherwise, 130 if interrupted.
    """
    console = Console()
    try:
        with command_errors():
            as_expected = True
            if report_only:
                rewrite_report(out)
            else:
                progress = ConsoleProgress(console)
                selected: FractusCluster | CurrentCluster = CurrentCluster(progress.report, assign)
                if cluster == "embedded":
                    selected = FractusCluster(load_spec(DEMO_CLUSTER_FILE), progress.report)
                as_expected = Demo(selected, out, keep, timeout_s, progress).run()
    except KeyboardInterrupt:
        click.echo("demo: interrupted", err=True)
        sys.exit(130)
    console.print(Markdown((out / PAGE).read_text()))
    click.echo(
        f"report: {out / PAGE}, map.png, altitude.png, flight.geojson, plan.yaml, audit/, pictures/, recordings/"
    )
    if (replay := replay_command(out)) is not None:
        click.echo(f"replay: {replay}")
    sys.exit(0 if as_expected else 1)


if __name__ == "__main__":
    demo(prog_name="python -m fractus_sim.demo")
