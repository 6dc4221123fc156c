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

_name_option = click.option("--name", help="Name of the cluster. Not needed if there is only one.")

_output_option = click.option(
    "-o", "--output", type=click.Choice(["text", "json"]), default="text", help="Output format."
)

_EXIT_UNHEALTHY = 2


@click.group()
def cluster() -> None:
    """Run a real Kubernetes cluster of several nodes on this machine, without Docker. Needs Linux and root."""


@cluster.command()
@click.argument("file", type=click.Path(path_type=Path, dir_okay=False, exists=True))
@click.option("--name", help="Name of the cluster instead of the one in the file.")
@click.option(
    "--image",
    "images",
    multiple=True,
    help="Image to load on every node before pods start. Can be given several times.",
)
def up(file: Path, name: str | None, images: tuple[str, ...]) -> None:
    """Start the cluster that FILE describes, or update it if it exists."""
    Cluster.load(file, name=name, report=print_report).up(images=images)


@cluster.command()
@_name_option
@click.option("--all", "every", is_flag=True, help="Remove all clusters of this machine.")
def down(name: str | None, every: bool) -> None:
    """Remove the cluster and all its resources on the machine."""
    check_root()
    # A cluster whose state directory was deleted is missing in `known_clusters`. It still has a claim.
    names = sorted({*known_clusters(), *(other for other, path in holders().items() if path.parent == state_root())})
    if name is None and len(names) > 1 and not every:
        raise ClusterError(f"several clusters: {', '.join(names)}; select one with --name, or remove all with --all")
    for each in [name] if name is not None else names:
        Cluster.bare(each, report=print_report).down()


@cluster.command()
@_name_option
@_output_option
def status(name: str | None, output: str) -> None:
    """Show the status of the cluster's nodes.

    The exit status is 2 if a part does not work.
    """
    chosen = Cluster.existing(name)
    states = chosen.status()
    radio = chosen.radio.running
    well = chosen.running and radio is not False and all(map(_is_well, states))
    if output == "json":
        nodes = [asdict(node) for node in states]
        click.echo(
            json.dumps({"name": chosen.name, "well": well, "running": chosen.running, "radio": radio, "nodes": nodes})
        )
    else:
        radio_state = {True: ", radio running", False: ", radio stopped", None: ""}[radio]
        click.echo(f"cluster {chosen.name}: control plane {'running' if chosen.running else 'stopped'}{radio_state}")
        for node in states:
            click.echo(f"  {node.name:<20} {node.node_class:<6} {node.address:<15} {_describe(node)}")
    if not well:
        sys.exit(_EXIT_UNHEALTHY)


def _is_well(node: NodeStatus) -> bool:
    hardware = node.vehicle_running is not False and node.camera_running is not False
    return node.powered and node.linked and node.ready is True and hardware


def _describe(node: NodeStatus) -> str:
    ready = {True: "Ready", False: "NotReady", None: "API server unavailable"}[node.ready]
    words = [ready if node.powered else "off"]
    if not node.linked:
        words.append("link cut")
    if node.vehicle_running is not None:
        words.append("vehicle running" if node.vehicle_running else "vehicle stopped")
    if node.camera_running is not None:
        words.append("camera running" if node.camera_running else "camera stopped")
    return ", ".join(words)


@cluster.command()
@_name_option
@click.option("--path", "only_path", is_flag=True, help="Print the path of the kubeconfig file instead of its content.")
def kubeconfig(name: str | None, only_path: bool) -> None:
    """Print the administrator's kubeconfig."""
    file = Cluster.existing(name).kubeconfig
    if not file.exists():
        raise ClusterError(
            "the cluster has no kubeconfig, because its start did not finish; run `fractus cluster up FILE` again"
        )
    click.echo(str(file) if only_path else file.read_text(), nl=only_path)


@cluster.command()
@_name_option
def env(name: str | None) -> None:
    """Print shell commands that set KUBECONFIG and PATH. Use them with eval "$(fractus cluster env)"."""
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
    help="Checkout of Fractus with the Dockerfile and the charts.",
)
def install_(name: str | None, source: Path | None) -> None:
    """Build the images, install or upgrade the charts of Fractus, and wait until the drones are ready."""
    install(Cluster.existing(name, report=print_report), source or find_source(), report=print_report)


@cluster.command("load-image")
@click.argument("images", nargs=-1, required=True, metavar="IMAGE...")
@_name_option
@_output_option
def load_image(images: tuple[str, ...], name: str | None, output: str) -> None:
    """Load images on all nodes. IMAGE is a name in buildah's storage, or an OCI or Docker archive."""
    delivered = Cluster.existing(name, report=print_report).load_images(images)
    if output == "json":
        click.echo(json.dumps(delivered))
        return
    for node, count in delivered.items():
        click.echo(f"{node}: {count} new images")


@cluster.command()
@click.argument("state", type=click.Choice(["on", "off"]))
@click.argument("node")
@_name_option
def power(state: str, node: str, name: str | None) -> None:
    """Power a node on or off. Its vehicle keeps running."""
    Cluster.existing(name, report=print_report).set_power(node, on=state == "on")


@cluster.command()
@click.argument("drone")
@_name_option
def charge(drone: str, name: str | None) -> None:
    """Fill the battery of a landed drone at once, as if it was swapped."""
    Cluster.existing(name, report=print_report).charge(drone)
    click.echo(f"{drone}: the battery is full")


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
@click.option("--wifi", type=click.Choice(["on", "off", "silent"]), help="silent: receives, but sends nothing.")
@click.option("--fade", type=float, metavar="DB", help="Additional path loss to all other stations.")
@click.option("--uplink", type=click.Choice(["on", "off"]), help="Mobile uplink of the node.")
@_name_option
def radio(node: str, wifi: str | None, fade: float | None, uplink: str | None, name: str | None) -> None:
    """Disturb a node's simulated WiFi or mobile uplink, or restore it."""
    chosen = Cluster.existing(name)
    hardware = chosen.node(node).spec.hardware
    if (wifi is not None or fade is not None) and hardware.wifi is None:
        raise ClusterError(f"node {node} has no simulated WiFi; add hardware.wifi to the cluster file")
    if uplink is not None and hardware.uplink is None:
        raise ClusterError(f"node {node} has no mobile uplink; cut its wire with `fractus cluster link cut {node}`")
    if wifi is not None:
        chosen.radio.command(station=node, off=wifi == "off", silent=wifi == "silent")
    if fade is not None:
        chosen.radio.command(station=node, loss_db=fade)
    if uplink is not None:
        chosen.radio.command(uplink=node, off=uplink == "off")


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
@click.option("--lines", default=100, show_default=True, help="Number of lines, counted from the end.")
@_name_option
def logs(program: str, node: str | None, lines: int, name: str | None) -> None:
    """Print the log of PROGRAM (kubelet, containerd, etcd, ...) on NODE, by default on the control plane."""
    folder = Cluster.existing(name).logs / (node or "control-plane")
    file = folder / f"{program}.log"
    if not file.is_file():
        available = ", ".join(sorted(path.stem for path in folder.glob("*.log"))) or "none"
        raise ClusterError(f"no log {file}; available logs: {available}")
    for line in file.read_text(errors="replace").splitlines()[-lines:]:
        click.echo(line)


_EXTRA_PROGRAMS = sorted(set(PROGRAMS[DEFAULT_KUBERNETES]) - set(CLUSTER_PROGRAMS))


@cluster.command()
@click.option(
    "--with",
    "extra",
    multiple=True,
    type=click.Choice(_EXTRA_PROGRAMS),
    help="Additional program to build and list. Can be given several times.",
)
@_output_option
def binaries(extra: tuple[str, ...], output: str) -> None:
    """Print the paths of the Kubernetes programs that a cluster needs. Missing programs are built first."""
    programs = ensure_binaries((*CLUSTER_PROGRAMS, *extra), report=print_report)
    if output == "json":
        click.echo(json.dumps({program: str(path) for program, path in programs.paths.items()}, sort_keys=True))
        return
    for program, path in sorted(programs.paths.items()):
        click.echo(f"{program} {path}")
