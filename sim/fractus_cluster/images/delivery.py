"""Delivery of images to running nodes, as archives with only the missing layers."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import IO

from fractus_cluster.errors import ClusterError
from fractus_cluster.images.layout import Image, Layout
from fractus_cluster.node import Node

_CTR = ("ctr", "--namespace", "k8s.io")
_IMPORT_TIMEOUT_S = 300.0


def deliver(layout: Layout, images: Sequence[Image], nodes: Sequence[Node]) -> dict[str, int]:
    """Import images on nodes. Skip nodes that have all of them.

    Args:
        layout: Layout that contains the images.
        images: Images to deliver.
        nodes: Running nodes.

    Returns:
        Number of new images by node name.

    Raises:
        ClusterError: A node is not running, or its import failed.
    """
    if not images:
        return {node.name: 0 for node in nodes}
    missing = {node.name: _missing(node, images) for node in nodes}
    # Nodes that lack the same layers share an archive.
    groups: dict[tuple[frozenset[str], frozenset[str]], list[Node]] = {}
    for node in nodes:
        if missing[node.name]:
            names = frozenset(image.name for image in missing[node.name])
            needed = {digest for image in missing[node.name] for digest in layout.digests(image)}
            groups.setdefault((names, frozenset(_content(node) & needed)), []).append(node)
    for (names, present), members in groups.items():
        manifests = {image.digest for image in images}
        with tempfile.TemporaryFile() as archive:
            layout.write_archive(
                [image for image in images if image.name in names], without=present - manifests, out=archive
            )
            archive.flush()
            with ThreadPoolExecutor(max_workers=4) as pool:
                list(pool.map(lambda node: _import(node, archive), members))
    return {name: len(images) for name, images in missing.items()}


def _missing(node: Node, images: Sequence[Image]) -> list[Image]:
    listing = node.exec([*_CTR, "images", "list"]).stdout
    known = {fields[0]: fields[2] for line in listing.splitlines()[1:] if len(fields := line.split()) > 2}
    return [image for image in images if known.get(image.name) != image.digest]


def _content(node: Node) -> set[str]:
    return set(node.exec([*_CTR, "content", "list", "--quiet"]).stdout.split())


def _import(node: Node, archive: IO[bytes]) -> None:
    """Import an archive. Try once more if containerd's garbage collector removed a snapshot during the import."""
    error = _attempt(node, archive)
    if error and "snapshot" in error:
        error = _attempt(node, archive)
    if error:
        raise ClusterError(f"node {node.name} cannot import an image: {error[-1000:]}")


def _attempt(node: Node, archive: IO[bytes]) -> str:
    """Import an archive. Return the error message, or an empty string on success."""
    argv = node.exec_command([*_CTR, "images", "import", "-"])
    with open(f"/proc/self/fd/{archive.fileno()}", "rb") as stream:  # noqa: PTH123 - opened again, because each node reads from its own position
        try:
            done = subprocess.run(
                argv, stdin=stream, capture_output=True, text=True, timeout=_IMPORT_TIMEOUT_S, check=False
            )
        except subprocess.TimeoutExpired as error:
            raise ClusterError(f"node {node.name} did not import an image within {_IMPORT_TIMEOUT_S:.0f} s") from error
    return "" if done.returncode == 0 else done.stderr.strip() or f"exit code {done.returncode}"
