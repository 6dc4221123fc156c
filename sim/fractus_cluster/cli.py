"""`fractus cluster`: the embedded cluster on the command line."""

from __future__ import annotations

import json
import os
import shlex
import sys
from dataclasses import asdict
from pathlib import Path

import click

from fractus_cluster.binaries import CLUSTER_PROGRAMS, DEFAULT_KUBERNETES, PROGRAMS, ensure_binaries
from fractus_cluster.cluster import Cluster, NodeStatus, print_report
from fractus_cluster.errors import ClusterError
from fractus_cluster.images.build import find_source
from fractus_cluster.install import install
from fractus_cluster.machine import holders
from fractus_cluster.prerequisites import check_root
from fractus_cluster.state import known_clusters, state_root

_name_option = click.option("--name", help="The cluster; may be left out when there is only one.")

_output_option = click.option(
    "-o", "--output", type=click.Choice(["text", "json"]), default="text", help="text for people, json for programs."
)

_NOT_WELL = 2


@click.group()
def cluster() -> None:
    """A real Kubernetes of several nodes on this machine, without Docker (Linux, root)."""


@cluster.command()
@click.argument("file", type=click.Path(path_type=Path, dir_okay=False, exists=True))
@click.option("--name", help="Name of the cluster instead of the one in the file.")
@click.option("--image", "images", multiple=True, help="Image that every node gets before pods start; repeatable.")
def up(file: Path, name: str | None, images: tuple[str, ...]) -> None:
    """Make the cluster be as FILE describes, whatever state it is in."""
    Cluster.load(file, name=name, report=print_report).up(images=images)


@cluster.command()
@_name_option
@click.option("--all", "every", is_flag=True, help="All clusters of this machine.")
def down(name: str | None, every: bool) -> None:
    """Take the cluster away with everything that it put on the machine."""
    check_root()
    # A cluster whose state directory was deleted is still in the machine's ledger.
    ours = sorted({*known_clusters(), *(held for held, at in holders().items() if at.parent == state_root())})
    if name is None and len(ours) > 1 and not every:
        raise ClusterError(f"several clusters: {', '.join(ours)}; select one with --name, or remove all with --all")
    for each in [name] if name is not None else ours:
        Cluster.bare(each, report=print_report).down()


@cluster.command()
@_name_option
@_output_option
def status(name: str | None, output: str) -> None:
    """Show how the cluster's nodes are.

    Exits with 2 unless all are well.
    """
    found = Cluster.existing(name)
    states = found.status()
    radio = found.radio.running
    well = found.running and radio is not False and all(map(_well, states))
    if output == "json":
        nodes = [asdict(node) for node in states]
        click.echo(
            json.dumps({"name": found.name, "well": well, "running": found.running, "radio": radio, "nodes": nodes})
        )
    else:
        radio_words = {True: ", radio runs", False: ", radio dead", None: ""}[radio]
        click.echo(f"cluster {found.name}: control plane {'running' if found.running else 'down'}{radio_words}")
        for node in states:
            click.echo(f"  {node.name:<20} {node.node_class:<6} {node.address:<15} {_words(node)}")
    if not well:
        sys.exit(_NOT_WELL)


def _well(node: NodeStatus) -> bool:
    hardware = node.vehicle_running is not False and node.camera_running is not False
    return node.powered and node.linked and node.ready is True and hardware


def _words(node: NodeStatus) -> str:
    ready = {True: "Ready", False: "NotReady", None: "API server not in reach"}[node.ready]
    words = [ready if node.powered else "off"]
    if not node.linked:
        words.append("link cut")
    if node.vehicle_running is not None:
        words.append("vehicle runs" if node.vehicle_running else "vehicle dead")
    if node.camera_running is not None:
        words.append("camera runs" if node.camera_running else "camera dead")
    return ", ".join(words)


@cluster.command()
@_name_option
@click.option("--path", "only_path", is_flag=True, help="Print where it is instead of its content.")
def kubeconfig(name: str | None, only_path: bool) -> None:
    """Print the administrator's kubeconfig."""
    file = Cluster.existing(name).kubeconfig
    if not file.exists():
        raise ClusterError("the cluster has not come up yet; run `fractus cluster up FILE` again")
    click.echo(str(file) if only_path else file.read_text(), nl=only_path)


@cluster.command()
@_name_option
def env(name: str | None) -> None:
    """Print what a shell evaluates to reach the cluster: eval "$(fractus cluster env)"."""
    file = Cluster.existing(name).kubeconfig
    programs = ensure_binaries(("kubectl", "helm"), report=print_report)
    folders = dict.fromkeys(str(programs[program].parent) for program in ("kubectl", "helm"))
    click.echo(f"export KUBECONFIG={shlex.quote(str(file))}")
    click.echo(f'export PATH={shlex.quote(":".join(folders))}:"$PATH"')


@cluster.command("install")
@_name_option
@click.option(
    "--source",
    type=click.Path(path_type=Path, file_okay=False, exists=True),
    help="Checkout with Dockerfile and charts.",
)
def install_(name: str | None, source: Path | None) -> None:
    """Install or upgrade Fractus: images, charts, until the drones are ready."""
    install(Cluster.existing(name, report=print_report), source or find_source(), report=print_report)


@cluster.command("load-image")
@click.argument("images", nargs=-1, required=True, metavar="IMAGE...")
@_name_option
@_output_option
def load_image(images: tuple[str, ...], name: str | None, output: str) -> None:
    """Deliver images to all nodes: names in buildah's storage, or OCI or Docker archives."""
    delivered = Cluster.existing(name, report=print_report).load_images(images)
    if output == "json":
        click.echo(json.dumps(delivered))
        return
    for node, count in delivered.items():
        click.echo(f"{node}: {count} new")


@cluster.command()
@click.argument("state", type=click.Choice(["on", "off"]))
@click.argument("node")
@_name_option
def power(state: str, node: str, name: str | None) -> None:
    """Pull a node's power, or give it back; its vehicle keeps its own."""
    Cluster.existing(name, report=print_report).set_power(node, on=state == "on")


@cluster.command()
@click.argument("state", type=click.Choice(["cut", "heal"]))
@click.argument("node")
@_name_option
def link(state: str, node: str, name: str | None) -> None:
    """Cut a node's uplink, or restore it."""
    target = Cluster.existing(name).node(node)
    if state == "cut":
        target.cut_link()
    else:
        target.heal_link()


@cluster.command()
@click.argument("node")
@click.option("--wifi", type=click.Choice(["on", "off", "silent"]), help="silent: hears, but sends nothing.")
@click.option("--fade", type=float, metavar="DB", help="Loss between it and all others beyond that of the way.")
@click.option("--uplink", type=click.Choice(["on", "off"]), help="Its mobile uplink.")
@_name_option
def radio(node: str, wifi: str | None, fade: float | None, uplink: str | None, name: str | None) -> None:
    """Disturb a node's simulated WiFi or mobile uplink, or restore it."""
    found = Cluster.existing(name)
    hardware = found.node(node).spec.hardware
    if (wifi is not None or fade is not None) and hardware.wifi is None:
        raise ClusterError(f"node {node} has no simulated WiFi; add hardware.wifi to the cluster file")
    if uplink is not None and hardware.uplink is None:
        raise ClusterError(f"node {node} has no mobile uplink; `fractus cluster link cut {node}` cuts its wire")
    if wifi is not None:
        found.radio.command(station=node, off=wifi == "off", silent=wifi == "silent")
    if fade is not None:
        found.radio.command(station=node, loss_db=fade)
    if uplink is not None:
        found.radio.command(uplink=node, off=uplink == "off")


@cluster.command("exec", context_settings={"ignore_unknown_options": True})
@click.argument("node")
@click.argument("command", nargs=-1, required=True, type=click.UNPROCESSED)
@_name_option
def exec_(node: str, command: tuple[str, ...], name: str | None) -> None:
    """Run a command on a node, as root."""
    argv = Cluster.existing(name).node(node).exec_command(command)
    os.execvp(argv[0], argv)  # noqa: S606  (no shell wanted)


@cluster.command()
@click.argument("program")
@click.argument("node", required=False)
@click.option("--lines", default=100, show_default=True, help="How many of the last lines.")
@_name_option
def logs(program: str, node: str | None, lines: int, name: str | None) -> None:
    """Print the log of PROGRAM (kubelet, containerd, etcd, ...) on NODE, or of the control plane's."""
    folder = Cluster.existing(name).logs / (node or "control-plane")
    file = folder / f"{program}.log"
    if not file.is_file():
        there = ", ".join(sorted(path.stem for path in folder.glob("*.log"))) if folder.is_dir() else "nothing"
        raise ClusterError(f"no log {file}; available: {there}")
    for line in file.read_text(errors="replace").splitlines()[-lines:]:
        click.echo(line)


_EXTRA_PROGRAMS = sorted(set(PROGRAMS[DEFAULT_KUBERNETES]) - set(CLUSTER_PROGRAMS))


@cluster.command()
@click.option("--with", "extra", multiple=True, type=click.Choice(_EXTRA_PROGRAMS))
@_output_option
def binaries(extra: tuple[str, ...], output: str) -> None:
    """Provide the Kubernetes programs, building those that are missing, and print where they are."""
    found = ensure_binaries((*CLUSTER_PROGRAMS, *extra), report=print_report)
    if output == "json":
        click.echo(json.dumps({program: str(path) for program, path in found.paths.items()}, sort_keys=True))
        return
    for program, path in sorted(found.paths.items()):
        click.echo(f"{program} {path}")
