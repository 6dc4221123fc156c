"""Builds of the container images whose sources changed since their last build."""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import MappingProxyType

from fractus_cluster.binaries import cache_directory
from fractus_cluster.commands import run
from fractus_cluster.errors import ClusterError, PrerequisiteError
from fractus_cluster.images.store import image_ids
from fractus_cluster.ledger import read_ledger, write_ledger
from fractus_cluster.locking import locked
from fractus_cluster.prerequisites import check_root

PREFIX = "localhost/fractus"
BASE_IMAGE = f"{PREFIX}/base:trixie"

_SOURCES = (
    "Dockerfile", ".dockerignore", "pyproject.toml", "uv.lock", "sim/pyproject.toml", "README.md", "LICENSE",
    "core", "runtime", "operator", "agent", "services", "cli", "view/fractus_view", "management", "sdk", "proto",
)  # fmt: skip
"""Sources of every image, because each image contains the whole distribution fractus-drones."""
_MORE_SOURCES: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "component": (),
        "operator": (),
        "agent": (),
        "mobility": (),
        "camera": (),
        "view": (),
        "management": (),
        "sim": ("sim",),
        "example-traffic-monitoring": ("examples/traffic-monitoring",),
        "example-field": ("examples/field",),
        "example-links": ("examples/links",),
    }
)
TARGETS = tuple(_MORE_SOURCES)
"""Targets of the Dockerfile that are images."""
_NOT_IN_SLIM = (
    "usr/share/locale", "usr/share/man", "var/cache/apt/archives", "var/cache/debconf", "var/lib/apt/lists", "var/log",
)  # fmt: skip
"""Directories that are emptied in the base image, as in debian:trixie-slim, which it replaces without a registry."""
_BUILD_TIMEOUT_S = 1800.0
_LOCK_TIMEOUT_S = 1800.0
_HOST_CA = Path("/etc/ssl/certs/ca-certificates.crt")
_CA_IN_BUILD = "/run/host-ca.crt"

Report = Callable[[str], None]


def find_source(start: Path | None = None) -> Path:
    """Return the checkout with the Dockerfile: the working directory or one of its parents.

    Raises:
        ClusterError: No such directory has a Dockerfile.
    """
    directory = (start or Path.cwd()).resolve()
    for folder in (directory, *directory.parents):
        if all((folder / name).is_file() for name in ("Dockerfile", "pyproject.toml", "uv.lock")):
            return folder
    raise ClusterError(f"no Dockerfile of Fractus in {directory} or above; set the checkout with --source")


def image_name(target: str, tag: str = "dev") -> str:
    """Return the full name of a target's image."""
    return f"{PREFIX}/{target}:{tag}"


def build_images(
    source: Path,
    *,
    targets: Sequence[str] = TARGETS,
    tag: str = "dev",
    force: bool = False,
    report: Report,
) -> list[str]:
    """Build targets of the Dockerfile with buildah and return the images' names.

    Args:
        source: Checkout of Fractus.
        targets: Images to build. A target whose sources did not change since its last build is skipped.
        tag: Tag of the images.
        force: Build targets even if their sources did not change.
        report: Called with each line of progress.

    Raises:
        PrerequisiteError: buildah or debootstrap is missing, or the process is not root.
        ClusterError: A build failed. The message ends with the output of buildah.
    """
    unknown = sorted(set(targets) - set(TARGETS))
    if unknown:
        raise ClusterError(f"unknown image {', '.join(unknown)}; the images are {', '.join(TARGETS)}")
    check_root()
    if shutil.which("buildah") is None:
        raise PrerequisiteError("buildah is missing; install it: apt-get install buildah")
    names = [image_name(target, tag) for target in targets]
    ledger = cache_directory() / "images.json"
    with locked(
        cache_directory() / "images.lock",
        timeout_s=_LOCK_TIMEOUT_S,
        what="another process is building images",
        report=report,
    ):
        digests = {image_name(target, tag): source_digest(source, target) for target in targets}
        built = read_ledger(ledger)
        present = image_ids()
        stale = [
            target
            for target, name in zip(targets, names, strict=True)
            if force or name not in present or built.get(name) != f"{digests[name]} {present[name]}"
        ]
        if stale:
            ensure_base(report=report)
            _build_stale(source, stale, tag, report)
            before = present
            present = image_ids()
            _remove_replaced(before[name] for name in names if name in before and before[name] != present[name])
            built.update({name: f"{digests[name]} {present[name]}" for name in names})
            write_ledger(ledger, built)
    return names


def source_digest(source: Path, target: str) -> str:
    """Return a digest of all source files of a target's image."""
    digest = hashlib.sha256()
    for path in _files(source, (*_SOURCES, *_MORE_SOURCES[target])):
        digest.update(f"{path.relative_to(source)}\0".encode() + path.read_bytes() + b"\0")
    return digest.hexdigest()


def _files(source: Path, names: Iterable[str]) -> Iterator[Path]:
    for name in names:
        place = source / name
        if place.is_file():
            yield place
        for path in sorted(place.rglob("*")) if place.is_dir() else ():
            if path.is_file() and "__pycache__" not in path.parts:
                yield path


def _build_stale(source: Path, targets: Sequence[str], tag: str, report: Report) -> None:
    """Build one target before all others, which then take most steps from the cache."""

    def build_one(target: str) -> None:
        started = time.monotonic()
        _build(source, target, tag)
        report(f"built {image_name(target, tag)} in {time.monotonic() - started:.1f} s")

    report(f"building images: {', '.join(targets)}")
    build_one(targets[0])
    with ThreadPoolExecutor(max_workers=2) as pool:
        list(pool.map(build_one, targets[1:]))


def _remove_replaced(identities: Iterable[str]) -> None:
    """Remove images that newer builds have replaced, so that they do not fill the disk. Images in use are kept."""
    for identity in identities:
        run(["buildah", "rmi", identity], check=False)


def _build(source: Path, target: str, tag: str) -> None:
    argv = ["buildah", "build", "--quiet", "--layers", "--timestamp", "0", "--build-arg", f"BASE={BASE_IMAGE}"]
    if _HOST_CA.is_file():
        # The package index may be behind a proxy whose CA only this machine trusts. The CA bundle is mounted during the
        # build only.
        argv += ["--volume", f"{_HOST_CA}:{_CA_IN_BUILD}:ro", "--build-arg", f"SSL_CERT_FILE={_CA_IN_BUILD}"]
    argv += ["--target", target, "--tag", image_name(target, tag), str(source)]
    run(argv, timeout_s=_BUILD_TIMEOUT_S, env={**os.environ, "BUILDAH_ISOLATION": "chroot"})


def ensure_base(*, report: Report) -> None:
    """Create the Debian base image with debootstrap if buildah's storage has none.

    Raises:
        PrerequisiteError: debootstrap is missing.
    """
    if BASE_IMAGE in image_ids():
        return
    if shutil.which("debootstrap") is None:
        raise PrerequisiteError(
            "debootstrap is missing; it creates the base image; install it: apt-get install debootstrap"
        )
    started = time.monotonic()
    report("creating the Debian base image (once)")
    with tempfile.TemporaryDirectory(prefix="fractus-base-") as scratch:
        root = Path(scratch) / "root"
        run(["debootstrap", "--variant=minbase", "trixie", root], timeout_s=_BUILD_TIMEOUT_S)
        for folder in _NOT_IN_SLIM:
            shutil.rmtree(root / folder)
            (root / folder).mkdir()
        container = run(["buildah", "from", "scratch"]).stdout.strip()
        try:
            run(["buildah", "add", "--quiet", container, root, "/"], timeout_s=_BUILD_TIMEOUT_S)
            run(["buildah", "commit", "--quiet", container, BASE_IMAGE], timeout_s=_BUILD_TIMEOUT_S)
        finally:
            run(["buildah", "rm", container], check=False)
    report(f"created the Debian base image in {time.monotonic() - started:.0f} s")
