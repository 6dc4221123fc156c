"""Resources shared by all clusters of a machine: names, addresses, and kernel settings to restore at the end."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from ipaddress import IPv4Network
from pathlib import Path

from fractus_runtime.files import write_file

from fractus_cluster.addressing import choose_block
from fractus_cluster.cgroups import find_hierarchies, remove_top
from fractus_cluster.commands import run
from fractus_cluster.errors import ClusterError
from fractus_cluster.locking import locked
from fractus_cluster.network import NETNS_DIRECTORY, networks_in_use

# In /run, because a reboot removes the networks of clusters and resets the kernel settings.
DIRECTORY = Path("/run/fractus-sim")
_LEDGER = DIRECTORY / "machine.json"
_LOCK = DIRECTORY / "lock"
_LOCK_TIMEOUT_S = 60.0
_RAISED_SYSCTLS = {"fs.inotify.max_user_instances": 8192, "fs.inotify.max_user_watches": 524288}

Report = Callable[[str], None]


@dataclass(slots=True)
class _Claim:
    """Name and addresses that a cluster holds: its state directory and its address block."""

    state: str
    block: str


@dataclass(slots=True)
class _Ledger:
    """Claims by cluster name, and the settings that the machine had before the first claim."""

    sysctls: dict[str, str] = field(default_factory=dict)
    controllers: list[str] = field(default_factory=list)
    netns_mounted: bool = False
    netns_existed: bool = False
    claims: dict[str, _Claim] = field(default_factory=dict)


def cluster_lock(name: str) -> Path:
    """Return the lock file of a cluster."""
    return DIRECTORY / f"cluster.{name}.lock"


def claim(name: str, state: Path, block: IPv4Network | None) -> IPv4Network:
    """Claim a name and addresses for a cluster. The first claim also changes kernel settings of the machine.

    Args:
        name: Name of the cluster.
        state: Its state directory.
        block: Its existing addresses. None: allocate free addresses.

    Returns:
        Addresses of the cluster.

    Raises:
        ClusterError: The name is used by a cluster with a different state directory, or the addresses are in use.
    """
    with locked(_LOCK, timeout_s=_LOCK_TIMEOUT_S, what="another cluster is being started or removed"):
        ledger = _read()
        held = ledger.claims.get(name)
        if held is not None:
            if held.state != str(state):
                raise ClusterError(f"cluster {name} already exists, with its state in {held.state}")
            return IPv4Network(held.block)
        others = [IPv4Network(entry.block) for entry in ledger.claims.values()]
        if block is None:
            block = choose_block([*networks_in_use(), *others])
        elif any(block.overlaps(other) for other in (*networks_in_use(), *others)):
            raise ClusterError(f"{name}: its addresses {block} are used by another network; remove the cluster first")
        if not ledger.claims:
            _record_settings(ledger)
        ledger.claims[name] = _Claim(str(state), str(block))
        # The claim is written before the machine is changed, so that an interrupted start can be undone.
        _write(ledger)
        _raise_sysctls(ledger)
        return block


def holders() -> dict[str, Path]:
    """Return the state directory of each cluster with a claim, by cluster name."""
    if not _LEDGER.exists():
        return {}
    with locked(_LOCK, timeout_s=_LOCK_TIMEOUT_S, what="another cluster is being started or removed"):
        return {name: Path(held.state) for name, held in _read().claims.items()}


def holder(name: str) -> Path | None:
    """Return the state directory of the cluster that has claimed a name, or None."""
    return holders().get(name)


def release(name: str) -> None:
    """Release the claim of a cluster. After the last release, restore the settings of the machine."""
    with locked(_LOCK, timeout_s=_LOCK_TIMEOUT_S, what="another cluster is being started or removed", remove=True):
        ledger = _read()
        ledger.claims.pop(name, None)
        if ledger.claims:
            _write(ledger)
            return
        remove_top()
        _restore(ledger)
        _LEDGER.unlink(missing_ok=True)


def remove_directory() -> None:
    """Remove the directory of claims and locks if it is empty."""
    try:
        DIRECTORY.rmdir()
    except OSError:
        return  # used by another cluster


def _record_settings(ledger: _Ledger) -> None:
    ledger.netns_mounted = _mounted(NETNS_DIRECTORY)
    ledger.netns_existed = NETNS_DIRECTORY.exists()
    hierarchies = find_hierarchies()
    if hierarchies.version == 2:
        ledger.controllers = (hierarchies.roots[0] / "cgroup.subtree_control").read_text().split()


def _raise_sysctls(ledger: _Ledger) -> None:
    for name, minimum in _RAISED_SYSCTLS.items():
        path = _sysctl(name)
        present = path.read_text().strip()
        if int(present) < minimum:
            ledger.sysctls.setdefault(name, present)
            _write(ledger)
            path.write_text(str(minimum))


def _restore(ledger: _Ledger) -> None:
    for name, value in ledger.sysctls.items():
        path = _sysctl(name)
        # Another program may have set a different value in the meantime. That value must stay.
        if path.read_text().strip() == str(_RAISED_SYSCTLS.get(name)):
            path.write_text(value)
    # The first `ip netns add` creates a bind mount of this directory on itself. Remove the mount.
    if NETNS_DIRECTORY.is_dir() and not any(NETNS_DIRECTORY.iterdir()):
        if not ledger.netns_mounted and _mounted(NETNS_DIRECTORY):
            run(["umount", str(NETNS_DIRECTORY)], check=False)
        if not ledger.netns_existed:
            NETNS_DIRECTORY.rmdir()
    hierarchies = find_hierarchies()
    if hierarchies.version == 2 and ledger.controllers:
        control = hierarchies.roots[0] / "cgroup.subtree_control"
        for name in set(control.read_text().split()) - set(ledger.controllers):
            try:
                control.write_text(f"-{name}")
            except OSError:
                continue  # in use by another program


def _mounted(path: Path) -> bool:
    lines = Path("/proc/self/mountinfo").read_text().splitlines()
    return any(line.split(" ")[4] == str(path) for line in lines)


def _sysctl(name: str) -> Path:
    return Path("/proc/sys") / name.replace(".", "/")


def _read() -> _Ledger:
    try:
        content = json.loads(_LEDGER.read_text())
    except FileNotFoundError:
        return _Ledger()
    claims = {name: _Claim(**entry) for name, entry in content.pop("claims").items()}
    return _Ledger(claims=claims, **content)


def _write(ledger: _Ledger) -> None:
    write_file(_LEDGER, json.dumps(asdict(ledger), indent=1).encode(), 0o644, durable=False)
