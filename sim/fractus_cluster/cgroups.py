"""Control groups of a cluster: one group per node, in version 1 hierarchies or the unified version 2 hierarchy."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from fractus_cluster.errors import ClusterError, PrerequisiteError

TOP = "fractus-sim"
_NEEDED_V1 = ("cpu", "cpuacct", "cpuset", "memory", "devices", "freezer", "pids")
_NEEDED_V2 = ("cpu", "cpuset", "memory", "pids")
_DELEGATED_V2 = (*_NEEDED_V2, "io", "hugetlb")
_DAEMONS = "daemons"
_WEIGHT = 20
"""CPU weight of all clusters, as a multiple of the default weight. It is high because vehicles fly in real time."""
_ONE_V1 = 1024
_ONE_V2 = 100
_POLL_S = 0.02


@dataclass(frozen=True, slots=True)
class Hierarchies:
    """Mounted control group hierarchies.

    Attributes:
        version: 1 (also for hybrid layouts with controllers in version 1 hierarchies) or 2.
        roots: Mount points. Version 2 has one.
    """

    version: int
    roots: tuple[Path, ...]


def find_hierarchies(mounts: str | None = None) -> Hierarchies:
    """Read the mounted control groups from /proc/self/mounts.

    Args:
        mounts: Text in the format of /proc/self/mounts. None: read the file.

    Raises:
        PrerequisiteError: No control groups are mounted, or a required controller is missing.
    """
    text = Path("/proc/self/mounts").read_text() if mounts is None else mounts
    old: dict[Path, set[str]] = {}
    new: list[Path] = []
    for line in text.splitlines():
        _, point, kind, options = line.split(" ")[:4]
        if kind == "cgroup":
            old[Path(point)] = set(options.split(","))
        elif kind == "cgroup2":
            new.append(Path(point))
    if old:
        missing = [name for name in _NEEDED_V1 if not any(name in options for options in old.values())]
        if missing:
            raise PrerequisiteError(f"the kernel's control groups lack {', '.join(missing)}; Kubernetes needs them")
        # In a hybrid layout, the version 2 hierarchy is included, because container runtimes also create groups in it.
        return Hierarchies(1, (*old, *new))
    if not new:
        raise PrerequisiteError("no control groups are mounted at /sys/fs/cgroup; Kubernetes needs them")
    return Hierarchies(2, (new[0],))


@dataclass(frozen=True, slots=True)
class Branch:
    """A control group of a cluster or of one of its nodes.

    Attributes:
        hierarchies: Mounted hierarchies.
        path: Path below the mount points, such as `fractus-sim/demo/drone-1`.
    """

    hierarchies: Hierarchies
    path: str

    def below(self, name: str) -> Branch:
        """Return the child group `name`."""
        return Branch(self.hierarchies, f"{self.path}/{name}")

    @property
    def directories(self) -> list[Path]:
        """Directories of the group in all hierarchies."""
        return [root / self.path for root in self.hierarchies.roots]

    def create(self) -> list[Path]:
        """Create the group if it is missing. Return its `cgroup.procs` files, which add processes to the group."""
        if self.hierarchies.version == 2:
            return [self._create_v2()]
        for root in self.hierarchies.roots:
            directory = root
            for part in Path(self.path).parts:
                above = directory
                directory = directory / part
                directory.mkdir(exist_ok=True)
                _fill_cpuset(above, directory)
            _weigh(root / TOP)
        return [directory / "cgroup.procs" for directory in self.directories]

    def _create_v2(self) -> Path:
        # Version 2 allows processes only in leaf groups, so the daemons have a leaf group beside that of the pods.
        directory = self.hierarchies.roots[0]
        for part in (*Path(self.path).parts, _DAEMONS):
            _delegate(directory)
            directory /= part
            directory.mkdir(exist_ok=True)
        _weigh(self.hierarchies.roots[0] / TOP)
        return directory / "cgroup.procs"

    def process_ids(self) -> set[int]:
        """Return the processes of the group and its descendants."""
        pids: set[int] = set()
        for directory in self.directories:
            for folder in _walk(directory):
                try:
                    pids.update(int(word) for word in (folder / "cgroup.procs").read_text().split())
                except (FileNotFoundError, OSError):
                    continue  # removed in the meantime
        return pids - {0}

    def kill_all(self, *, timeout_s: float = 20.0) -> None:
        """Kill all processes of the group and wait until they have ended.

        Raises:
            ClusterError: A process did not end before the timeout.
        """
        deadline = time.monotonic() + timeout_s
        while pids := self.process_ids():
            if time.monotonic() > deadline:
                raise ClusterError(
                    f"processes {sorted(pids)} in control group {self.path} did not end within {timeout_s:.0f} s"
                )
            for pid in pids:
                try:
                    os.kill(pid, signal.SIGKILL)
                    os.waitpid(pid, os.WNOHANG)
                except (ProcessLookupError, ChildProcessError):
                    continue
            time.sleep(_POLL_S)

    def remove(self, *, timeout_s: float = 10.0) -> None:
        """Remove the group and its descendants. Their processes must have ended.

        Raises:
            ClusterError: The kernel reports a busy group after the timeout.
        """
        deadline = time.monotonic() + timeout_s
        for directory in self.directories:
            while directory.exists():
                busy = _remove_tree(directory)
                if busy is None:
                    break
                if time.monotonic() > deadline:
                    raise ClusterError(f"control group {directory} cannot be removed: {busy.strerror}")
                time.sleep(_POLL_S)


def cluster_branch(name: str) -> Branch:
    """Return the control group of a cluster."""
    return Branch(find_hierarchies(), f"{TOP}/{name}")


def remove_top() -> None:
    """Remove the parent group of all clusters if it is empty."""
    for root in find_hierarchies().roots:
        try:
            (root / TOP).rmdir()
        except (FileNotFoundError, OSError):
            continue  # missing, or used by another cluster


def _walk(directory: Path) -> Iterator[Path]:
    """Yield the directory and its subdirectories, deepest first. Disappearing directories are skipped."""
    try:
        with os.scandir(directory) as entries:
            below = [Path(entry.path) for entry in entries if entry.is_dir(follow_symlinks=False)]
    except FileNotFoundError:
        return
    for folder in below:
        yield from _walk(folder)
    yield directory


def _remove_tree(directory: Path) -> OSError | None:
    """Remove a group and its descendants. Return the error of a group that could not be removed."""
    last: OSError | None = None
    for folder in _walk(directory):
        try:
            folder.rmdir()
        except FileNotFoundError:
            continue
        except OSError as error:
            last = error
    return last


def _fill_cpuset(above: Path, directory: Path) -> None:
    """Copy the CPUs and memory nodes of the parent group to a new group. Version 1 creates a group without CPUs and memory nodes."""
    for name in ("cpuset.cpus", "cpuset.mems"):
        file = directory / name
        if file.exists() and not file.read_text().strip():
            file.write_text((above / name).read_text())


def _weigh(directory: Path) -> None:
    """Set the CPU weight of the group of all clusters."""
    for name, one in (("cpu.shares", _ONE_V1), ("cpu.weight", _ONE_V2)):
        if (directory / name).exists():
            (directory / name).write_text(str(_WEIGHT * one))


def _delegate(directory: Path) -> None:
    """Make the controllers of a version 2 group available to its child groups."""
    available = set((directory / "cgroup.controllers").read_text().split())
    missing = [name for name in _NEEDED_V2 if name not in available]
    if missing:
        raise PrerequisiteError(f"the control groups at {directory} lack {', '.join(missing)}; Kubernetes needs them")
    enabled = set((directory / "cgroup.subtree_control").read_text().split())
    for name in _DELEGATED_V2:
        if name in available and name not in enabled:
            try:
                (directory / "cgroup.subtree_control").write_text(f"+{name}")
            except OSError as error:
                raise PrerequisiteError(
                    f"cannot delegate controller {name} of control group {directory} ({error.strerror}); "
                    "the embedded cluster does not run in a container without its own control groups"
                ) from error
