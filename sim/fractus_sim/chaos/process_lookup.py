"""Lookup of local processes by pod, or by program of the embedded cluster."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterable, Iterator
from pathlib import Path


def of_pod(uid: str) -> list[int]:
    """Return the processes of a pod's containers, without its pause process."""
    pod_ids = (uid, uid.replace("-", "_"))
    return [
        pid
        for pid, folder, command in _processes()
        if not command.endswith(b"pause") and any(pod_id in _read_text(folder / "cgroup") for pod_id in pod_ids)
    ]


def of_program(name: str, namespace: Path) -> list[int]:
    """Return the processes of a program in a network namespace, such as the kubelet of a node."""
    inode = namespace.stat().st_ino
    pids = []
    for pid, folder, command in _processes():
        if command.rpartition(b"/")[2].decode(errors="replace") == name:
            try:
                namespace_inode = (folder / "ns" / "net").stat().st_ino
            except OSError:
                continue
            if namespace_inode == inode:
                pids.append(pid)
    return pids


def send_signal(pids: Iterable[int], number: signal.Signals) -> int:
    """Send a signal. Return the number of processes that received it."""
    count = 0
    for pid in pids:
        try:
            os.kill(pid, number)
        except ProcessLookupError:
            continue
        count += 1
    return count


def _processes() -> Iterator[tuple[int, Path, bytes]]:
    """Yield each process with its /proc folder and its program."""
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                command = (folder / "cmdline").read_bytes().split(b"\0")[0]
            except OSError:
                continue
            if command:
                yield int(folder.name), folder, command


def _read_text(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:
        return ""
