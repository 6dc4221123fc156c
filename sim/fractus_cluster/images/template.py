"""Templates of a node's container storage with unpacked images. Nodes get hard links to the files of a template."""

from __future__ import annotations

import ctypes
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from fractus_cluster.commands import run
from fractus_cluster.errors import ClusterError
from fractus_cluster.images.layout import Image, Layout
from fractus_cluster.node import Node

_TEMPLATES_KEPT = 2
_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None, use_errno=True)
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
# ctr unpacks without a lease. Garbage collection would remove layers that other layers need.
[plugins."io.containerd.gc.v1.scheduler"]
  deletion_threshold = 0
  mutation_threshold = 0
  startup_delay = "1h"
"""


@dataclass(frozen=True, slots=True)
class Template:
    """Initial content of a node's /var/lib/containerd.

    Attributes:
        path: Directory. It exists only if the template is complete.
    """

    path: Path

    def create(self, layout: Layout, images: Sequence[Image], *, report: Report) -> None:
        """Create the template unless it exists. A temporary containerd unpacks the images.

        This containerd starts with a copy of the newest template, so that it unpacks only new layers.
        """
        if self.path.exists():
            os.utime(self.path)
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        for left in self.path.parent.glob(".new-*"):
            shutil.rmtree(left)
        started = time.monotonic()
        scratch = self.path.parent / f".new-{self.path.name}"
        scratch.mkdir()
        others = sorted(self.path.parent.glob("[!.]*"), key=lambda path: path.stat().st_mtime, reverse=True)
        if others:
            _copy_storage(others[0], scratch / "root")
        with _daemon(scratch) as ctr:
            _import(layout, images, ctr, scratch)
        (scratch / "root").rename(self.path)
        shutil.rmtree(scratch)
        for old in others[_TEMPLATES_KEPT - 1 :]:
            shutil.rmtree(old)
        report(f"unpacked {len(images)} images in {time.monotonic() - started:.1f} s")

    def copy_to(self, node: Node) -> None:
        """Copy the template to a node that has no container storage yet."""
        target = _storage(node)
        if target.exists():
            return
        scratch = target.with_name(".containerd")
        if scratch.exists():
            shutil.rmtree(scratch)
        scratch.parent.mkdir(parents=True, exist_ok=True)
        _copy_storage(self.path, scratch)
        scratch.rename(target)


def has_storage(node: Node) -> bool:
    """Return True if a node has container storage."""
    return _storage(node).exists()


def _storage(node: Node) -> Path:
    return node.directory / "var-lib" / "containerd"


def _copy_storage(source: Path, target: Path) -> None:
    """Copy the storage of containerd by hard links.

    Copy its databases completely, because containerd changes them.
    """
    linked = run(["cp", "-al", source, target], check=False, timeout_s=_IMPORT_TIMEOUT_S)
    if linked.returncode != 0:  # the target is on another file system
        shutil.rmtree(target, ignore_errors=True)
        run(["cp", "-a", "--reflink=auto", source, target], timeout_s=_IMPORT_TIMEOUT_S)
    for database in source.rglob("*.db"):
        copy = target / database.relative_to(source)
        copy.unlink()
        shutil.copy2(database, copy)


@contextmanager
def _daemon(scratch: Path) -> Iterator[list[str]]:
    """Run containerd with its storage in `scratch/root`, and yield the command line of its client."""
    socket = scratch / "s"
    config = scratch / "config.toml"
    log = scratch / "log"
    config.write_text(_CONFIG.format(root=scratch / "root", state=scratch / "state", socket=socket))
    with log.open("wb") as output:
        daemon = subprocess.Popen(
            ["containerd", "--config", str(config), "--log-level", "warn"],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            preexec_fn=_die_with_parent,  # noqa: PLW1509  (only a system call)
        )
    try:
        deadline = time.monotonic() + _START_TIMEOUT_S
        while run(["ctr", "--address", socket, "version"], check=False, timeout_s=30).returncode != 0:
            if daemon.poll() is not None or time.monotonic() > deadline:
                raise ClusterError(f"containerd did not start: {log.read_text(errors='replace')[-1000:]}")
            time.sleep(_POLL_S)
        yield ["ctr", "--address", str(socket), "--namespace", "k8s.io"]
    finally:
        daemon.terminate()
        try:
            daemon.wait(timeout=10)
        except subprocess.TimeoutExpired:
            daemon.kill()
            daemon.wait()


def _die_with_parent() -> None:
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def _import(layout: Layout, images: Sequence[Image], ctr: list[str], scratch: Path) -> None:
    names = {name for image in images for name in (image.name, image.pinned_name)}
    present = set(run([*ctr, "images", "list", "--quiet"]).stdout.split())
    content = set(run([*ctr, "content", "list", "--quiet"]).stdout.split())
    manifests = {image.digest for image in images}
    archive = scratch / "images.tar"
    with archive.open("wb") as out:
        layout.write_archive(images, without=content - manifests, out=out)
    run([*ctr, "images", "import", str(archive)], timeout_s=_IMPORT_TIMEOUT_S)
    for name in sorted(names):
        run([*ctr, "images", "label", name, _MANAGED], timeout_s=30)
    if present - names:
        run([*ctr, "images", "remove", "--sync", *sorted(present - names)], timeout_s=_IMPORT_TIMEOUT_S)
