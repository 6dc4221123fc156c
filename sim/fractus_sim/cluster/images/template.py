"""Templates: the container storage of a node with images unpacked, made once and hard-linked into every node."""

from __future__ import annotations

import shutil
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from fractus_sim.cluster.commands import run
from fractus_sim.cluster.errors import ClusterError
from fractus_sim.cluster.images.layout import Image, Layout
from fractus_sim.cluster.node import Node

_START_TIMEOUT_S = 20.0
_IMPORT_TIMEOUT_S = 300.0
_POLL_S = 0.02
_MANAGED = "io.cri-containerd.image=managed"

Report = Callable[[str], None]

_CONFIG = """\
version = 2
root = "{root}"
state = "{state}"
disabled_plugins = ["io.containerd.grpc.v1.cri", "io.containerd.internal.v1.opt",
  "io.containerd.snapshotter.v1.aufs", "io.containerd.snapshotter.v1.btrfs",
  "io.containerd.snapshotter.v1.devmapper", "io.containerd.snapshotter.v1.zfs"]
[grpc]
  address = "{socket}"
"""


@dataclass(frozen=True, slots=True)
class Template:
    """A directory that holds what /var/lib/containerd of a node is to be.

    Attributes:
        path: The directory; complete when it exists.
    """

    path: Path

    def make(self, layout: Layout, images: Sequence[Image], *, report: Report) -> None:
        """Unpack the images with a container daemon of its own; a no-op when that was done before."""
        if self.path.exists():
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        for left in self.path.parent.glob(".making-*"):
            shutil.rmtree(left)
        started = time.monotonic()
        scratch = self.path.parent / f".making-{self.path.name}"
        root = scratch / "root"
        root.mkdir(parents=True)
        socket, config = scratch / "s", scratch / "config.toml"
        config.write_text(_CONFIG.format(root=root, state=scratch / "state", socket=socket))
        with (scratch / "log").open("wb") as log:
            daemon = subprocess.Popen(
                ["containerd", "--config", str(config), "--log-level", "warn"],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
            )
        try:
            _wait_for(socket, daemon, scratch / "log")
            _import(layout, images, socket, scratch)
        finally:
            daemon.terminate()
            try:
                daemon.wait(timeout=10)
            except subprocess.TimeoutExpired:
                daemon.kill()
                daemon.wait()
        root.rename(self.path)
        shutil.rmtree(scratch)
        report(f"unpacked {len(images)} images in {time.monotonic() - started:.1f} s")

    def furnish(self, node: Node) -> None:
        """Give a node that never ran this template as its container storage; other nodes are left alone."""
        target = _storage(node)
        if target.exists():
            return
        scratch = node.directory / "var-lib" / ".containerd"
        if scratch.exists():
            shutil.rmtree(scratch)
        scratch.parent.mkdir(parents=True, exist_ok=True)
        linked = run(["cp", "-al", self.path, scratch], check=False)
        if linked.returncode != 0:  # another file system
            shutil.rmtree(scratch, ignore_errors=True)
            run(["cp", "-a", "--reflink=auto", self.path, scratch], timeout_s=_IMPORT_TIMEOUT_S)
        for database in self.path.rglob("*.db"):
            copy = scratch / database.relative_to(self.path)
            copy.unlink()
            shutil.copy2(database, copy)
        scratch.rename(target)


def has_storage(node: Node) -> bool:
    """Whether a node has container storage already."""
    return _storage(node).exists()


def _storage(node: Node) -> Path:
    return node.directory / "var-lib" / "containerd"


def _wait_for(socket: Path, daemon: subprocess.Popen[bytes], log: Path) -> None:
    deadline = time.monotonic() + _START_TIMEOUT_S
    while run(["ctr", "--address", socket, "version"], check=False, timeout_s=30).returncode != 0:
        if daemon.poll() is not None or time.monotonic() > deadline:
            raise ClusterError(f"containerd did not start: {log.read_text()[-1000:]}")
        time.sleep(_POLL_S)


def _import(layout: Layout, images: Sequence[Image], socket: Path, scratch: Path) -> None:
    archive = scratch / "images.tar"
    with archive.open("wb") as out:
        layout.write_archive(images, without=(), out=out)
    ctr = ["ctr", "--address", str(socket), "--namespace", "k8s.io", "images"]
    run([*ctr, "import", str(archive)], timeout_s=_IMPORT_TIMEOUT_S)
    for image in images:
        run([*ctr, "label", image.name, _MANAGED], timeout_s=30)
