"""Program lookup in KUBEBUILDER_ASSETS, the cache and PATH, and build of missing programs."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from fractus_cluster.binaries.build import build, module_digest, reported_version
from fractus_cluster.binaries.catalog import (
    CLUSTER_PROGRAMS,
    DEFAULT_KUBERNETES,
    KUBERNETES_VERSIONS,
    MODULES,
    PROGRAMS,
    Program,
)
from fractus_cluster.errors import ClusterError
from fractus_cluster.ledger import read_ledger, write_ledger
from fractus_cluster.locking import locked

_LOCK_TIMEOUT_S = 3600.0

Report = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Binaries:
    """Paths of programs that are installed or built."""

    paths: Mapping[str, Path]

    def __getitem__(self, name: str) -> Path:
        """Return the path of a program.

        Raises:
            ClusterError: The program was not provided.
        """
        try:
            return self.paths[name]
        except KeyError:
            raise ClusterError(f"{name} was not provided; run `fractus cluster binaries --with {name}`") from None

    def builds(self, *names: str) -> dict[str, int]:
        """Return the modification time of each program in nanoseconds. It changes when a program is rebuilt."""
        return {name: self[name].stat().st_mtime_ns for name in names}


def cache_directory() -> Path:
    """Return the cache directory of built programs: FRACTUS_CACHE, or `fractus` in the user's cache directory."""
    chosen = os.environ.get("FRACTUS_CACHE")
    if chosen:
        return Path(chosen)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "fractus"


def chosen_kubernetes() -> str:
    """Return the minor version of Kubernetes to use: FRACTUS_KUBERNETES, or the default.

    Raises:
        ClusterError: The version is not supported.
    """
    chosen = os.environ.get("FRACTUS_KUBERNETES") or DEFAULT_KUBERNETES
    if chosen not in KUBERNETES_VERSIONS:
        raise ClusterError(
            f"Kubernetes {chosen} is not supported; set FRACTUS_KUBERNETES to {' or '.join(KUBERNETES_VERSIONS)}"
        )
    return chosen


def ensure_binaries(names: Iterable[str] = CLUSTER_PROGRAMS, *, report: Report) -> Binaries:
    """Return the paths of programs. Missing programs are built.

    Args:
        names: Names from the catalog.
        report: Called with progress lines.

    Raises:
        ClusterError: A name or the selected version is unknown, or a build failed.
        PrerequisiteError: A build is required and Go is missing or too old.
    """
    minor = chosen_kubernetes()
    programs = [_program(minor, name) for name in names]
    directory = cache_directory() / f"v{KUBERNETES_VERSIONS[minor]}"
    paths = _present(programs, directory)
    if len(paths) < len(programs):
        with locked(
            directory / "lock", timeout_s=_LOCK_TIMEOUT_S, what="another process is building binaries", report=report
        ):
            paths = _present(programs, directory)
            missing = [program for program in programs if program.name not in paths]
            for name in dict.fromkeys(program.module for program in missing):
                group = [program for program in missing if program.module == name]
                build(group, directory / "bin", report=report)
                _stamp(group, directory)
        paths = _present(programs, directory)
    return Binaries(paths)


def _program(minor: str, name: str) -> Program:
    try:
        return PROGRAMS[minor][name]
    except KeyError:
        raise ClusterError(f"unknown program {name}; the programs are {', '.join(sorted(PROGRAMS[minor]))}") from None


def _present(programs: Iterable[Program], directory: Path) -> dict[str, Path]:
    assets = os.environ.get("KUBEBUILDER_ASSETS")
    stamps = read_ledger(directory / "built.json")
    versions = _Versions(directory / "found.json")
    paths: dict[str, Path] = {}
    for program in programs:
        built = directory / "bin" / program.name
        asset = Path(assets) / program.name if assets else None
        installed = shutil.which(program.name)
        if asset is not None and versions.acceptable(asset, program):
            paths[program.name] = asset
        elif built.is_file() and stamps.get(program.name) == module_digest(MODULES[program.module]):
            paths[program.name] = built
        elif installed is not None and versions.acceptable(Path(installed), program):
            paths[program.name] = Path(installed)
    versions.save()
    return paths


def _stamp(programs: Iterable[Program], directory: Path) -> None:
    stamps = read_ledger(directory / "built.json")
    stamps.update({program.name: module_digest(MODULES[program.module]) for program in programs})
    write_ledger(directory / "built.json", stamps)


class _Versions:
    """Versions of programs by path, size and modification time, cached so that each program is run only once."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._known = read_ledger(file)
        self._changed = False

    def acceptable(self, path: Path, program: Program) -> bool:
        if program.accepts is None or not os.access(path, os.X_OK):
            return False
        facts = path.stat()
        key = f"{path}:{facts.st_size}:{facts.st_mtime_ns}"
        if key not in self._known:
            self._known[key] = reported_version(path, program) or ""
            self._changed = True
        return self._known[key].startswith(program.accepts)

    def save(self) -> None:
        if self._changed:
            write_ledger(self._file, self._known)
