"""The machine's store of images for embedded clusters: filled from buildah or archives, emptied into nodes."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

from fractus_sim.cluster.commands import run
from fractus_sim.cluster.errors import ClusterError
from fractus_sim.cluster.images.delivery import deliver
from fractus_sim.cluster.images.layout import Image, Layout
from fractus_sim.cluster.images.template import Template
from fractus_sim.cluster.locking import locked
from fractus_sim.cluster.node import Node
from fractus_sim.cluster.nodeconfig import SANDBOX_IMAGE
from fractus_sim.cluster.state import state_root

_LOCK_TIMEOUT_S = 600.0
_COPY_TIMEOUT_S = 300.0

Report = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class ImageStore:
    """A directory with an OCI layout of all images, and templates of nodes that have them unpacked.

    Attributes:
        path: The directory; on the file system of the clusters' state, so that files can be shared by hard links.
        report: Told about progress, a line at a time.
    """

    path: Path
    report: Report

    @classmethod
    def default(cls, *, report: Report) -> ImageStore:
        """Return the store beside the clusters' state."""
        return cls(state_root() / ".images", report)

    @property
    def layout(self) -> Layout:
        """The images."""
        return Layout(self.path / "layout")

    def fetch(self, names: Sequence[str]) -> list[Image]:
        """Take images into the store.

        Args:
            names: Names in buildah's storage, or paths of OCI or Docker archives.

        Raises:
            ClusterError: One does not exist.
        """
        if not names:
            return []
        with self._locked():
            self.layout.create()
            for name in names:
                if Path(name).is_file():
                    raise ClusterError(f"{name}: archives are not supported yet")
                target = f"oci:{self.layout.path}:{name}"
                run(["buildah", "push", "--quiet", "--disable-compression", name, target], timeout_s=_COPY_TIMEOUT_S)
            self.layout.remove_unused()
            return [self.layout.image(name) for name in names]

    def template(self, images: Sequence[Image], pause: Path) -> Template:
        """Return a node's container storage with these images unpacked, made when there is none yet."""
        with self._locked():
            sandbox = self._sandbox(pause)
            wanted = [sandbox, *images]
            digest = hashlib.sha256("\n".join(sorted(f"{i.name} {i.digest}" for i in wanted)).encode()).hexdigest()
            template = Template(self.path / "templates" / digest[:16])
            template.make(self.layout, wanted, report=self.report)
            return template

    def deliver(self, images: Sequence[Image], nodes: Sequence[Node]) -> dict[str, int]:
        """Deliver images of the store to running nodes; return how many were new to each."""
        return deliver(self.layout, images, nodes) if images else {node.name: 0 for node in nodes}

    def _sandbox(self, pause: Path) -> Image:
        self.layout.create()
        return self.layout.add_program(SANDBOX_IMAGE, pause)

    def _locked(self) -> AbstractContextManager[None]:
        return locked(
            self.path / "lock", timeout_s=_LOCK_TIMEOUT_S, what="another process works on images", report=self.report
        )


def image_names(prefix: str) -> list[str]:
    """Return the names of images in buildah's storage that start with a prefix."""
    listed = run(["buildah", "images", "--format", "{{.Name}}:{{.Tag}}"], env=dict(os.environ)).stdout
    return sorted(line for line in listed.splitlines() if line.startswith(prefix))
