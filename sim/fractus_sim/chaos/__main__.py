"""`python -m fractus_sim.chaos`: fly missions on an embedded cluster while faults are injected."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import click
from fractus_cluster.cluster import Cluster
from fractus_cluster.errors import ClusterError
from fractus_cluster.images.build import build_images
from fractus_cluster.spec import ClusterSpec, DiskHardware, NodeSpec, load_spec

from fractus_sim.chaos import clock_faults
from fractus_sim.chaos.chaos_cluster import Stage, Watch
from fractus_sim.chaos.chaos_faults import BALLAST, FAULTS
from fractus_sim.chaos.chaos_report import page
from fractus_sim.chaos.chaos_run import Run, Task, fly
from fractus_sim.demo.demo_clusters import ROOT, TARGETS, install_fractus, kube_of, surroundings
from fractus_sim.errors import ExperimentError
from fractus_sim.interruption import break_off_on_signals, uninterrupted
from fractus_sim.report.report_files import write_page
from fractus_sim.testbeds.mission_watch import wait_ready

CLUSTER = "chaos"
DRONE = "drone-1"
VEHICLE_PORT = 5760
DISK = "1Gi"
"""Recordings use at most half of the disk and leave 200 MB for audit logs, which grow by a few megabytes per hour."""

READY_TIMEOUT_S = 180.0


def say(line: str) -> None:
    """Print a progress line."""
    click.echo(line, err=True)


def with_disk(spec: ClusterSpec) -> ClusterSpec:
    """Return the cluster specification with a disk for the drone."""

    def furnished(node: NodeSpec) -> NodeSpec:
        hardware = node.hardware.model_copy(update={"disk": DiskHardware(size=DISK)})
        return node.model_copy(update={"hardware": hardware}) if node.name == DRONE else node

    return spec.model_copy(update={"nodes": tuple(map(furnished, spec.nodes))})


@contextmanager
def embedded(keep: bool) -> Iterator[Stage]:
    """Provide a separate cluster with Fractus and a ready drone. It is removed at the end unless `keep` is set.

    Raises:
        ClusterError: The cluster did not start.
        ExperimentError: Fractus did not start.
    """
    images = build_images(ROOT, targets=TARGETS, report=say)
    cluster = Cluster.load(with_disk(load_spec(ROOT / "examples" / "clusters" / "demo.yaml")), name=CLUSTER, report=say)
    try:
        cluster.up(images=images)
        kube = kube_of(cluster, say)
        stage = Stage(cluster, kube, DRONE)
        # Remove the ballast file of a run that was killed.
        (stage.state / BALLAST).unlink(missing_ok=True)
        clock_faults.furnish(node.own_state for node in cluster.nodes if node.spec.node_class != "cloud")
        install_fractus(kube, clock_faults.chart_values())
        kube.apply(surroundings())
        wait_ready(kube, READY_TIMEOUT_S, lambda _line: None)
        yield stage
    finally:
        if not keep:
            with uninterrupted():
                cluster.down()


@click.command()
@click.option("--seeds", default=1, show_default=True, help="Number of runs.")
@click.option(
    "--first-seed", default=1, show_default=True, help="Seed of the first run. Each further run uses the next seed."
)
@click.option("--minutes", default=5.0, show_default=True, help="Minutes of fault injection per run.")
@click.option(
    "--fault",
    "kinds",
    multiple=True,
    type=click.Choice(sorted(FAULTS)),
    help="Inject only this fault (repeatable). Default: all faults.",
)
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=Path("out/chaos"), show_default=True)
@click.option("--keep", is_flag=True, help="Do not remove the cluster at the end.")
def chaos(*, seeds: int, first_seed: int, minutes: float, kinds: tuple[str, ...], out: Path, keep: bool) -> None:
    """Fly missions while faults are injected by a seeded schedule, and check the invariants."""
    break_off_on_signals()
    out.mkdir(parents=True, exist_ok=True)
    runs: list[Run] = []
    try:
        with embedded(keep) as stage:
            namespace = stage.node.wiring.namespace_path(DRONE)
            with Watch(namespace, VEHICLE_PORT, stage.state / "grants") as watch:
                for seed in range(first_seed, first_seed + seeds):
                    runs.append(fly(stage, watch, Task(seed, minutes * 60, kinds or sorted(FAULTS)), say))
                    write_page(out, page(runs, minutes * 60))
    except (ClusterError, ExperimentError) as error:
        click.echo(f"chaos: {error}", err=True)
        sys.exit(1)
    broken = [(run.seed, each) for run in runs for each in run.broken]
    for seed, each in broken:
        click.echo(f"seed {seed}: {each.invariant}: {each.found}")
    click.echo(f"{len(runs)} runs, {len(broken)} invariant violations; report: {out}/summary.md")
    sys.exit(1 if broken else 0)


if __name__ == "__main__":
    chaos(prog_name="python -m fractus_sim.chaos")
