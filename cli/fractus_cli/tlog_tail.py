"""Reads the tlogs of a drone while its mobility service writes them. Nothing here writes to anything."""

from __future__ import annotations

import re
import struct
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

import click
from fractus_runtime.mavlink_codec import frame_length

_STAMP = struct.Struct(">Q")
_MAGICS = frozenset({0xFD, 0xFE})
_ONBOARD_COMPUTER = 191
"""MAV_COMPONENT of the service itself: a tlog has both directions of its link."""

_CHAIN = 3
"""This many records in a row are no accident: where reading begins in the middle of a file, one is found by them."""

_NAME = re.compile(r"\d{6,}-\d{8}T\d{6}Z\.tlog")
_LOOK_TIMEOUT_S = 20.0

SYSTEM = "fractus-system"
RECORDINGS = "/var/lib/fractus/recordings/mobility"
"""Where the chart has the mobility service record."""


class Frame(NamedTuple):
    """A MAVLink frame as it was on the link, and when (Unix seconds of the drone)."""

    time_s: float
    data: bytes

    @property
    def of_vehicle(self) -> bool:
        """Whether the vehicle sent it, and not the service."""
        return self.data[6 if self.data[0] == 0xFD else 4] != _ONBOARD_COMPUTER


class Directory(Protocol):
    """The tlogs of a drone; what it has is all that can be done with them."""

    def sizes(self) -> Mapping[str, int]:
        """Bytes of each tlog, by its name."""
        ...

    def read(self, name: str, offset: int) -> bytes:
        """What is in a tlog from an offset on."""
        ...


class Tail:
    """The frames that the vehicle sends from now on, a few seconds late.

    Args:
        directory: which is looked at.
    """

    def __init__(self, directory: Directory) -> None:
        self._directory = directory
        self._offsets: dict[str, int] = {}
        self._rest: dict[str, bytes] = {}
        self._looked = False

    def read(self) -> list[Frame]:
        """What was recorded since the last call; nothing at the first one.

        Raises:
            ClickException: the directory cannot be read.
        """
        found: list[Frame] = []
        for name, size in sorted(self._directory.sizes().items()):
            if not self._looked:
                self._offsets[name] = size
                # Where in a record that is, is not known.
            elif size > self._offsets.get(name, 0):
                found += self._read(name)
        self._looked = True
        return [frame for frame in found if frame.of_vehicle]

    def _read(self, name: str) -> list[Frame]:
        offset = self._offsets.setdefault(name, 0)
        data = self._directory.read(name, offset)
        self._offsets[name] = offset + len(data)
        data = self._rest.get(name, b"") + data
        if offset and name not in self._rest:
            data = data[first_record(data) :]
        frames, rest = split(data)
        self._rest[name] = rest
        return frames


def split(data: bytes) -> tuple[list[Frame], bytes]:
    """The whole records of a part of a tlog, and what is left; damage is passed over."""
    frames: list[Frame] = []
    at = 0
    while at + _STAMP.size + 3 <= len(data):
        begin = at + _STAMP.size
        if data[begin] not in _MAGICS:
            at += max(first_record(data[at:]), 1)
            continue
        end = begin + frame_length(data, begin)
        if end > len(data):
            break
        frames.append(Frame(_STAMP.unpack_from(data, at)[0] / 1e6, data[begin:end]))
        at = end
    return frames, data[at:]


def first_record(data: bytes) -> int:
    """Where in a part of a tlog the first record begins; at its end where none is to be found."""
    return next((at for at in range(len(data)) if _begins(data, at)), len(data))


def _begins(data: bytes, at: int) -> bool:
    for _ in range(_CHAIN):
        begin = at + _STAMP.size
        # The two bytes are those of all times from 1979 to 2058.
        if begin + 3 > len(data) or data[at] or data[at + 1] > 9 or data[begin] not in _MAGICS:
            return False
        at = begin + frame_length(data, begin)
    return True


class Folder:
    """A directory of this machine.

    Args:
        path: what the mobility service was given as --recordings.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def sizes(self) -> Mapping[str, int]:
        """As they are now; the oldest are removed at any time."""
        found: dict[str, int] = {}
        for path in self._path.iterdir():
            try:
                if _NAME.fullmatch(path.name):
                    found[path.name] = path.stat().st_size
            except FileNotFoundError:
                continue
        return found

    def read(self, name: str, offset: int) -> bytes:
        """Opened for reading only."""
        try:
            with (self._path / name).open("rb") as file:
                file.seek(offset)
                return file.read()
        except FileNotFoundError:
            return b""


class Node:
    """The recordings on a drone's node, by `ls` and `tail` in the pod of its mobility service, to which nothing is sent.

    Args:
        kubectl: the program with its options for the cluster.
        drone: name of the node.
    """

    def __init__(self, kubectl: Sequence[str], drone: str) -> None:
        self._kubectl = kubectl
        self._drone = drone

    def sizes(self) -> Mapping[str, int]:
        """As they are now."""
        listed = self._run("ls", "-l", RECORDINGS).decode(errors="replace")
        columns = [line.split() for line in listed.splitlines()]
        return {
            row[-1]: int(row[4]) for row in columns if len(row) > 5 and row[4].isdecimal() and _NAME.fullmatch(row[-1])
        }

    def read(self, name: str, offset: int) -> bytes:
        """From the node's disk."""
        return self._run("tail", "-c", f"+{offset + 1}", f"{RECORDINGS}/{name}")

    def _run(self, *command: str) -> bytes:
        return self._ask("exec", "-n", SYSTEM, self._pod(), "-c", "mobility", "--", *command)

    def _pod(self) -> str:
        """Asked each time: the service may have been replaced."""
        where = f"spec.nodeName={self._drone},status.phase=Running"
        label = "app.kubernetes.io/component=mobility"
        names = self._ask("get", "pods", "-n", SYSTEM, "-l", label, "--field-selector", where, "-o", "name").split()
        if not names:
            raise click.ClickException(f"no mobility service runs on {self._drone}; see kubectl get drones")
        return names[0].decode()

    def _ask(self, *arguments: str) -> bytes:
        """Without standard input (kubectl exec without -i opens none): what the ground says has no way to the node."""
        argv = [*self._kubectl, *arguments]
        try:
            done = subprocess.run(
                argv, stdin=subprocess.DEVNULL, capture_output=True, timeout=_LOOK_TIMEOUT_S, check=False
            )
        except FileNotFoundError:
            raise click.ClickException(f"there is no {argv[0]} on the PATH; install it, or use --recordings") from None
        except subprocess.TimeoutExpired:
            raise click.ClickException(f"no answer from {self._drone} in {_LOOK_TIMEOUT_S:.0f} s") from None
        if done.returncode:
            raise click.ClickException(
                f"{self._drone}: {done.stderr.decode(errors='replace').strip() or 'kubectl failed'}"
            )
        return done.stdout
