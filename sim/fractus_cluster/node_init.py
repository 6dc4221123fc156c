"""First program of a node: builds the node's mount tree, then supervises its daemons.

The program runs as root in new mount, uts, ipc and pid namespaces and in the network namespace of the node. It changes
nothing outside of these namespaces. It imports no large library, because it must start fast.
"""

from __future__ import annotations

import ctypes
import json
import os
import socket
import sys
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from fractus_cluster.supervisor import Unit, supervise

_LIBC = ctypes.CDLL(None, use_errno=True)
_MS_NOSUID = 2
_MS_NODEV = 4
_MS_NOEXEC = 8
_MS_BIND = 4096
_MS_REC = 16384
_MS_SHARED = 1 << 20
_MNT_DETACH = 2

RUN = Path("/run/fractus")
"""Directory on a node with the configuration (config/), the programs (bin/) and the logs (logs/)."""


@dataclass(frozen=True, slots=True)
class NodeView:
    """Contents of a node's mount tree.

    Attributes:
        hostname: Host name. None for the control plane, whose mount tree is not changed.
        files: Directory with the node's etc/, etc-work/, var-lib/, var-log/ and config/.
        logs: Directory of the daemons' logs.
        programs: Paths on the machine by program name.
        sysctls: Values that the node's daemons see for kernel settings of the machine. The real values do not change.
    """

    hostname: str | None
    files: str
    logs: str
    programs: dict[str, str]
    sysctls: dict[str, str]


def main(argument: str) -> None:
    """Build the mount tree of a node and supervise its daemons, according to a JSON file with `view` and `units`."""
    content = json.loads(Path(argument).read_text())
    view = NodeView(**content["view"])
    units = [Unit(**entry) for entry in content["units"]]
    release_namespaces()
    if view.hostname is not None:
        socket.sethostname(view.hostname)
        prepare(view)
    supervise(units)


def release_namespaces() -> None:
    """Unmount all network namespaces in this mount tree. Otherwise the machine could not delete them."""
    for line in Path("/proc/self/mountinfo").read_text().splitlines():
        before, _, after = line.partition(" - ")
        if after.split(" ", 1)[0] == "nsfs":
            _umount(before.split(" ")[4].replace("\\040", " "))


def prepare(view: NodeView) -> None:
    """Build the node's mount tree."""
    with ExitStack() as stack:
        # The later mounts hide the original paths. Open file descriptors stay valid.
        source = {name: _handle(Path(view.files) / name, stack) for name in ("etc", "etc-work", "var-lib", "var-log")}
        source["config"] = _handle(Path(view.files) / "config", stack)
        source["logs"] = _handle(Path(view.logs), stack)
        programs = {name: _handle(Path(path), stack) for name, path in view.programs.items()}
        _mount("tmpfs", "/run", "tmpfs", _MS_NOSUID | _MS_NODEV, "mode=755,size=256m")
        for name in ("config", "logs"):
            (RUN / name).mkdir(parents=True)
            _bind(source[name], RUN / name)
        (RUN / "bin").mkdir()
        for name, handle in programs.items():
            (RUN / "bin" / name).touch()
            _bind(handle, RUN / "bin" / name)
        _fresh_sysfs()
        layers = f"lowerdir=/etc,upperdir={source['etc']},workdir={source['etc-work']}"
        _mount("overlay", "/etc", "overlay", 0, layers)
        _bind(source["var-log"], Path("/var/log"))
        # The bind mount is recursive, so that it includes the separate disk of the node.
        _mount(source["var-lib"], "/var/lib", None, _MS_BIND | _MS_REC, None)
    _settings(view.sysctls)
    _mount("none", "/", None, _MS_SHARED | _MS_REC, None)


def _fresh_sysfs() -> None:
    """Mount a new sysfs, which contains the node's network devices, and mount the control groups below it again."""
    aside = Path("/run/.cgroup")
    aside.mkdir()
    _mount("/sys/fs/cgroup", str(aside), None, _MS_BIND | _MS_REC, None)
    _mount("sysfs", "/sys", "sysfs", _MS_NOSUID | _MS_NODEV | _MS_NOEXEC, None)
    _mount(str(aside), "/sys/fs/cgroup", None, _MS_BIND | _MS_REC, None)
    _umount(str(aside))
    aside.rmdir()


def _settings(shown: dict[str, str]) -> None:
    Path("/proc/sys/net/ipv4/ip_forward").write_text("1")
    folder = RUN / "sysctl"
    folder.mkdir()
    for name, value in shown.items():
        target = Path("/proc/sys") / name.replace(".", "/")
        if target.exists():
            copy = folder / name
            copy.write_text(value + "\n")
            _bind(str(copy), target)


def _handle(path: Path, stack: ExitStack) -> str:
    handle = os.open(path, os.O_PATH | os.O_CLOEXEC)
    stack.callback(os.close, handle)
    return f"/proc/self/fd/{handle}"


def _bind(source: str, target: Path) -> None:
    _mount(source, str(target), None, _MS_BIND, None)


def _mount(source: str, target: str, kind: str | None, flags: int, options: str | None) -> None:
    done = _LIBC.mount(
        source.encode(),
        target.encode(),
        kind.encode() if kind else None,
        ctypes.c_ulong(flags),
        options.encode() if options else None,
    )
    if done != 0:
        code = ctypes.get_errno()
        raise OSError(code, f"mount {source} on {target}: {os.strerror(code)}")


def _umount(target: str) -> None:
    if _LIBC.umount2(target.encode(), _MNT_DETACH) != 0:
        code = ctypes.get_errno()
        raise OSError(code, f"unmount {target}: {os.strerror(code)}")


if __name__ == "__main__":
    main(sys.argv[1])
