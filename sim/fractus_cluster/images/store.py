"""Image store of the machine: it takes images from buildah or archives and delivers them to nodes."""

from __future__ import annotations

import hashlib
import tarfile
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

from fractus_cluster.commands import run
from fractus_cluster.errors import ClusterError
from fractus_cluster.images.delivery import deliver
from fractus_cluster.images.layout import Image, Layout
from fractus_cluster.images.receiver import receiving
from fractus_cluster.images.template import Template
from fractus_cluster.locking import locked
from fractus_cluster.node import Node
from fractus_cluster.nodeconfig import SANDBOX_IMAGE
from fractus_cluster.state import state_root

_LOCK_TIMEOUT_S = 600.0
_COPY_TIMEOUT_S = 300.0
_LISTINGS = 5
_LISTING_PAUSE_S = 1.0

Report = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class ImageStore:
    """A directory with images in an OCI layout, and templates of nodes with unpacked images.

    Attributes:
        path: Directory. Hard links to its files need it on the file system of the clusters' state.
        report: Called with progress lines.
    """

    path: Path
    report: Report

    @classmethod
    def default(cls, *, report: Report) -> ImageStore:
        """Return the store in the state directory of all clusters."""
        return cls(state_root() / ".images", report)

    @property
    def layout(self) -> Layout:
        """Layout with the images."""
        return Layout(self.path / "layout")

    def fetch(self, names: Sequence[str]) -> list[Image]:
        """Copy new and changed images into the store, and return all of them.

        Args:
            names: Names in buildah's storage, or paths of OCI or Docker archives.

        Raises:
            ClusterError: An image does not exist.
        """
        if not names:
            return []
        with self._locked():
            self.layout.create()
            full_names = list(dict.fromkeys(name for entry in names for name in _names_of(entry)))
            ids = image_ids()
            missing = [name for name in full_names if name not in ids]
            if missing:
                raise ClusterError(
                    f"no image {', '.join(missing)} in buildah's storage; available images: {', '.join(ids)}"
                )
            stored = {name: self.layout.image_id(image) for name, image in self.layout.images().items()}
            stale = [name for name in full_names if stored.get(name) != ids[name]]
            if stale:
                self._receive(stale)
                self.layout.remove_unused()
            return [self.layout.image(name) for name in full_names]

    def _receive(self, names: Sequence[str]) -> None:
        with receiving(self.layout) as address:
            for name in names:
                argv = ["buildah", "push", "--quiet", "--compression-level=1", "--tls-verify=false", name]
                run([*argv, f"docker://{address}/{name}"], timeout_s=_COPY_TIMEOUT_S)

    def template(self, images: Sequence[Image], pause: Path) -> Template:
        """Return a template of a node's container storage that contains the images.

        Create the template if it is missing.
        """
        with self._locked():
            sandbox = self._sandbox(pause)
            contents = [sandbox, *images]
            digest = hashlib.sha256(
                "\n".join(sorted(f"{i.name} {i.pinned_name}" for i in contents)).encode()
            ).hexdigest()
            template = Template(self.path / "templates" / digest[:16])
            template.create(self.layout, contents, report=self.report)
            return template

    def deliver(self, images: Sequence[Image], nodes: Sequence[Node]) -> dict[str, int]:
        """Deliver images of the store to running nodes. Return the number of new images by node name."""
        return deliver(self.layout, images, nodes)

    def _sandbox(self, pause: Path) -> Image:
        self.layout.create()
        return self.layout.add_program(SANDBOX_IMAGE, pause)

    def _locked(self) -> AbstractContextManager[None]:
        return locked(
            self.path / "lock", timeout_s=_LOCK_TIMEOUT_S, what="another process is changing images", report=self.report
        )


def image_ids() -> dict[str, str]:
    """Return the ids of all images in buildah's storage, by name.

    The listing is repeated because it fails if another process removes an image at the same time.
    """
    argv = ["buildah", "images", "--no-trunc", "--format", "{{.Name}}:{{.Tag}} {{.ID}}"]
    for _ in range(_LISTINGS):
        listed = run(argv, check=False)
        if listed.returncode == 0:
            break
        time.sleep(_LISTING_PAUSE_S)
    else:
        listed = run(argv)
    pairs = (line.split() for line in listed.stdout.splitlines())
    return {pair[0]: pair[1].removeprefix("sha256:") for pair in pairs if len(pair) == 2 and "<none>" not in pair[0]}


def _names_of(entry: str) -> list[str]:
    """Return the image names of an entry. The entry is an image name, or the path of an archive to pull."""
    if not Path(entry).is_file():
        return [entry]
    with tarfile.open(entry) as archive:
        members = {name.removeprefix("./") for name in archive.getnames()}
    kind = "oci-archive" if "oci-layout" in members else "docker-archive"
    before = image_ids()
    identity = run(["buildah", "pull", "--quiet", f"{kind}:{entry}"], timeout_s=_COPY_TIMEOUT_S).stdout.strip()
    after = image_ids()
    names = [name for name, other in after.items() if other == identity]
    new = [name for name in names if before.get(name) != identity]
    if not names:
        raise ClusterError(f"{entry}: the archive contains no name for its image")
    return new or names
