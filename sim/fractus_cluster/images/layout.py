"""OCI image layout on disk, and archives of images without the layers that a node has."""

from __future__ import annotations

import hashlib
import io
import json
import os
import tarfile
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from fractus_runtime.files import write_file

from fractus_cluster.errors import ClusterError

Json = dict[str, Any]

_INDEX_TYPE = "application/vnd.oci.image.index.v1+json"
MANIFEST_TYPE = "application/vnd.oci.image.manifest.v1+json"
CONFIG_TYPE = "application/vnd.oci.image.config.v1+json"
LAYER_TYPE = "application/vnd.oci.image.layer.v1.tar"
_REF_ANNOTATION = "org.opencontainers.image.ref.name"
_NAME_ANNOTATION = "io.containerd.image.name"
_EPOCH = "1970-01-01T00:00:00Z"


@dataclass(frozen=True, slots=True)
class Image:
    """An image of a layout.

    Attributes:
        name: Full name, such as `localhost/fractus/agent:dev`.
        digest: Digest of the manifest, which identifies the content.
        size_bytes: Size of the manifest.
        media_type: Media type of the manifest.
    """

    name: str
    digest: str
    size_bytes: int
    media_type: str

    @property
    def pinned_name(self) -> str:
        """Name with the digest in place of the tag, as approved templates of flights use it."""
        return f"{self.name.rpartition(':')[0]}@{self.digest}"


@dataclass(frozen=True, slots=True)
class Layout:
    """An OCI image layout.

    Attributes:
        path: Directory of the layout.
    """

    path: Path

    def create(self) -> None:
        """Create an empty layout if the directory has none."""
        (self.path / "blobs" / "sha256").mkdir(parents=True, exist_ok=True)
        if not (self.path / "oci-layout").exists():
            (self.path / "oci-layout").write_text('{"imageLayoutVersion": "1.0.0"}')
        if not (self.path / "index.json").exists():
            self._write_index([])

    def images(self) -> dict[str, Image]:
        """Return the images by name."""
        images: dict[str, Image] = {}
        for entry in self._index():
            name = entry.get("annotations", {}).get(_REF_ANNOTATION)
            if name:
                images[name] = Image(name, entry["digest"], entry["size"], entry.get("mediaType", MANIFEST_TYPE))
        return images

    def image(self, name: str) -> Image:
        """Return an image by its name.

        Raises:
            ClusterError: The layout has no such image.
        """
        try:
            return self.images()[name]
        except KeyError:
            raise ClusterError(f"no image {name} in {self.path}") from None

    def blob(self, digest: str) -> Path:
        """Return the file of a blob."""
        algorithm, _, value = digest.partition(":")
        return self.path / "blobs" / algorithm / value

    def digests(self, image: Image) -> list[str]:
        """Return the digests of an image's blobs: layers, configuration, manifest."""
        manifest = json.loads(self.blob(image.digest).read_text())
        return [*(layer["digest"] for layer in manifest["layers"]), manifest["config"]["digest"], image.digest]

    def image_id(self, image: Image) -> str:
        """Return the digest of an image's configuration, which is buildah's image id."""
        manifest = json.loads(self.blob(image.digest).read_text())
        return str(manifest["config"]["digest"]).removeprefix("sha256:")

    def remove_unused(self) -> None:
        """Remove blobs that no image refers to."""
        used = {digest for image in self.images().values() for digest in self.digests(image)}
        for path in (self.path / "blobs" / "sha256").iterdir():
            if f"sha256:{path.name}" not in used:
                path.unlink()

    def add_program(self, name: str, program: Path) -> Image:
        """Add an image that contains only a static program, which is its entry point."""
        self.create()
        layer = _layer_with(program)
        layer_digest = self._add_blob(layer)
        config = {
            "architecture": _architecture(),
            "os": "linux",
            "created": _EPOCH,
            "config": {"Entrypoint": [f"/{program.name}"], "User": "65535:65535"},
            "rootfs": {"type": "layers", "diff_ids": [layer_digest]},
            "history": [{"created": _EPOCH, "created_by": program.name}],
        }
        config_bytes = json.dumps(config, sort_keys=True).encode()
        manifest = {
            "schemaVersion": 2,
            "mediaType": MANIFEST_TYPE,
            "config": _descriptor(CONFIG_TYPE, self._add_blob(config_bytes), len(config_bytes)),
            "layers": [_descriptor(LAYER_TYPE, layer_digest, len(layer))],
        }
        self.add_manifest(name, manifest)
        return self.image(name)

    def add_manifest(self, name: str, manifest: Json) -> None:
        """Add a manifest under a name. The layout must have its layers."""
        content = json.dumps(manifest, sort_keys=True).encode()
        entry = _descriptor(MANIFEST_TYPE, self._add_blob(content), len(content))
        entry["annotations"] = {_REF_ANNOTATION: name}
        others = [other for other in self._index() if other.get("annotations", {}).get(_REF_ANNOTATION) != name]
        self._write_index([*others, entry])

    def write_archive(self, images: Iterable[Image], *, without: Collection[str], out: IO[bytes]) -> None:
        """Write an archive that `ctr images import` reads. Each image gets its name and its `pinned_name`.

        Args:
            images: Images to write.
            without: Digests of blobs to omit, because the receiver has them.
            out: Binary stream for the archive.
        """
        images = list(images)
        digests = {digest: None for image in images for digest in self.digests(image) if digest not in without}
        manifests = []
        for image in images:
            for name in (image.name, image.pinned_name):
                entry = _descriptor(image.media_type, image.digest, image.size_bytes)
                entry["annotations"] = {_NAME_ANNOTATION: name, _REF_ANNOTATION: name.rpartition(":")[2]}
                entry["platform"] = {"architecture": _architecture(), "os": "linux"}
                manifests.append(entry)
        index = {"schemaVersion": 2, "mediaType": _INDEX_TYPE, "manifests": manifests}
        with tarfile.open(fileobj=out, mode="w|", format=tarfile.GNU_FORMAT) as archive:
            _add_bytes(archive, "oci-layout", b'{"imageLayoutVersion": "1.0.0"}')
            _add_bytes(archive, "index.json", json.dumps(index).encode())
            for digest in digests:
                member = tarfile.TarInfo(f"blobs/{digest.replace(':', '/')}")
                with self.blob(digest).open("rb") as content:
                    member.size = os.fstat(content.fileno()).st_size
                    archive.addfile(member, content)

    def _index(self) -> list[Json]:
        try:
            content = json.loads((self.path / "index.json").read_text())
        except FileNotFoundError:
            return []
        return list(content["manifests"])

    def _write_index(self, manifests: list[Json]) -> None:
        index = {"schemaVersion": 2, "mediaType": _INDEX_TYPE, "manifests": manifests}
        write_file(self.path / "index.json", json.dumps(index).encode(), 0o644, durable=False)

    def _add_blob(self, content: bytes) -> str:
        digest = "sha256:" + hashlib.sha256(content).hexdigest()
        path = self.blob(digest)
        if not path.exists():
            write_file(path, content, 0o644, durable=False)
        return digest


def _descriptor(media_type: str, digest: str, size_bytes: int) -> Json:
    return {"mediaType": media_type, "digest": digest, "size": size_bytes}


def _layer_with(program: Path) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.GNU_FORMAT) as archive:
        _add_bytes(archive, program.name, program.read_bytes(), mode=0o755)
    return buffer.getvalue()


def _add_bytes(archive: tarfile.TarFile, name: str, content: bytes, *, mode: int = 0o644) -> None:
    member = tarfile.TarInfo(name)
    member.size = len(content)
    member.mode = mode
    archive.addfile(member, io.BytesIO(content))


def _architecture() -> str:
    machines: Mapping[str, str] = {"x86_64": "amd64", "aarch64": "arm64"}
    machine = os.uname().machine
    return machines.get(machine, machine)
