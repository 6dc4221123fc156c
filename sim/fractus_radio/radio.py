"""Radio process: connects the TAP devices of all nodes by the simulated air, uplinks and networks, and executes commands.

A command is a JSON object in one datagram on a Unix socket. This command changes attributes of a station:
`{"station": "drone-1", "position": [0, 0, 20], "off": false, "silent": false, "loss_db": 0, "network": "fleet"}`
This command changes both directions of an uplink:
`{"uplink": "drone-1", "off": true, "rate_bps": 8e6, "delay_s": 0.06}`
Attributes that are not in the command stay unchanged.
"""

from __future__ import annotations

import json
import logging
import math
import selectors
import socket
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from fractus_radio.medium import Medium, Station
from fractus_radio.shared_network import SharedNetwork
from fractus_radio.taps import Tap
from fractus_radio.uplink import Uplink

log = logging.getLogger(__name__)

COMMAND_BYTES = 8192
FRAMES_PER_TURN = 32
"""Maximum number of frames read from one device before the other devices are served."""

_NUMBER = (int, float)
_STATION = {"position": list, "off": bool, "silent": bool, "loss_db": _NUMBER, "reach": _NUMBER, "network": str}
_UPLINK = {"off": bool, "rate_bps": _NUMBER, "delay_s": _NUMBER}


class BadCommand(ValueError):
    """An invalid command."""


@dataclass(frozen=True, slots=True)
class Wire:
    """Ends and directions of an uplink."""

    ends: tuple[Tap, Tap]
    directions: tuple[Uplink, Uplink]


class Radio:
    """Carries frames between devices.

    Args:
        medium: Model of the air.
        control: Path of the command socket, in an existing directory.
        clock: Monotonic clock in seconds.
    """

    def __init__(self, medium: Medium, control: Path, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._medium = medium
        self._clock = clock
        self._taps: dict[str, Tap] = {}
        self._wires: dict[str, Wire] = {}
        self._networks: list[tuple[SharedNetwork, Mapping[str, Tap]]] = []
        self._selector = selectors.DefaultSelector()
        self._control = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        control.unlink(missing_ok=True)
        self._control.bind(str(control))
        self._selector.register(self._control, selectors.EVENT_READ, self._receive_command)

    def add_station(self, name: str, tap: Tap, station: Station) -> None:
        """Add a station with its device."""
        self._medium.add(name, station)
        self._taps[name] = tap
        self._forward_from(tap, lambda frame, now_s: self._medium.offer(name, frame, now_s))

    def add_uplink(self, name: str, ends: tuple[Tap, Tap], directions: tuple[Uplink, Uplink]) -> None:
        """Connect two devices by an uplink. The first direction leads from the first to the second device."""
        self._wires[name] = Wire(ends, directions)
        for tap, uplink in zip(ends, directions, strict=True):
            self._forward_from(tap, uplink.offer)

    def add_network(self, network: SharedNetwork, taps: Mapping[str, Tap]) -> None:
        """Add a simple network with the device of each member."""
        self._networks.append((network, taps))
        for name, tap in taps.items():
            self._forward_from(tap, partial(network.offer, name))

    def step(self, max_wait_s: float = 0.5) -> None:
        """Wait for the next event and handle all due events."""
        due_s = min(
            (
                self._medium.next_s,
                *(uplink.next_s for wire in self._wires.values() for uplink in wire.directions),
                *(network.next_s for network, _ in self._networks),
            ),
            default=math.inf,
        )
        wait_s = min(max(due_s - self._clock(), 0.0), max_wait_s)
        for key, _ in self._selector.select(wait_s):
            key.data(self._clock())
        now_s = self._clock()
        for arrival in self._medium.advance(now_s):
            self._taps[arrival.station].write(arrival.frame)
        for wire in self._wires.values():
            for uplink, end in zip(wire.directions, reversed(wire.ends), strict=True):
                for frame in uplink.advance(now_s):
                    end.write(frame)
        for network, taps in self._networks:
            for arrival in network.advance(now_s):
                taps[arrival.station].write(arrival.frame)

    def _forward_from(self, tap: Tap, offer: Callable[[bytes, float], None]) -> None:
        """Pass the frames of a device to `offer` until the device is removed. Other devices are not affected."""

        def forward(now_s: float) -> None:
            try:
                for _ in range(FRAMES_PER_TURN):
                    frame = tap.read()
                    if frame is None:
                        return
                    offer(frame, now_s)
            except OSError as error:
                log.warning("radio: device removed (device=%s error=%s)", tap.device, error)
                self._selector.unregister(tap)

        self._selector.register(tap, selectors.EVENT_READ, forward)

    def _receive_command(self, _now_s: float) -> None:
        try:
            self.command(json.loads(self._control.recv(COMMAND_BYTES)))
        except (BadCommand, ValueError, RecursionError) as error:
            log.warning("radio: command refused (error=%s)", error)

    def command(self, command: Mapping[str, Any]) -> None:
        """Change a station or an uplink.

        Raises:
            BadCommand: The command names an unknown object or has an invalid value. Nothing was changed.
        """
        if not isinstance(command, dict):
            raise BadCommand("a command must be a JSON object")
        if name := command.get("station"):
            station = self._medium.stations.get(name) if isinstance(name, str) else None
            if station is None:
                raise BadCommand(f"unknown station {name}; known stations: {', '.join(self._medium.stations)}")
            changes = _checked(command, "station", _STATION)
            if "position" in changes:
                changes["position"] = _position(changes["position"])
            for field, value in changes.items():
                setattr(station, field, value)
        elif name := command.get("uplink"):
            wire = self._wires.get(name) if isinstance(name, str) else None
            if wire is None:
                raise BadCommand(f"unknown uplink {name}; known uplinks: {', '.join(self._wires) or 'none'}")
            for field, value in _checked(command, "uplink", _UPLINK).items():
                for uplink in wire.directions:
                    setattr(uplink, field, value)
        else:
            raise BadCommand("a command must name a station or an uplink")

    def close(self) -> None:
        """Remove all devices."""
        wired = [tap for wire in self._wires.values() for tap in wire.ends]
        members = [tap for _, taps in self._networks for tap in taps.values()]
        for tap in (*self._taps.values(), *wired, *members):
            tap.close()
        self._control.close()
        self._selector.close()


def _checked(command: Mapping[str, Any], subject: str, known: Mapping[str, Any]) -> dict[str, Any]:
    changes = {field: value for field, value in command.items() if field != subject}
    for field, value in changes.items():
        if field not in known:
            raise BadCommand(f"unknown attribute {field} of a {subject}; known attributes: {', '.join(known)}")
        if not isinstance(value, known[field]) or (isinstance(value, bool) and known[field] is not bool):
            raise BadCommand(f"{field} has the wrong type: {str(value)[:80]}")
        if known[field] == _NUMBER:
            changes[field] = _number(field, value)
    if min(changes.get("rate_bps", 1.0), changes.get("reach", 1.0)) <= 0.0 or changes.get("delay_s", 0.0) < 0.0:
        raise BadCommand("rate_bps and reach must be positive, and delay_s must not be negative")
    return changes


def _number(field: str, value: Any) -> float:
    try:
        number = float(value)
    except (OverflowError, TypeError, ValueError):
        number = math.nan
    if isinstance(value, bool) or not math.isfinite(number):
        raise BadCommand(f"{field}: {str(value)[:80]} is not a finite number")
    return number


def _position(value: list[Any]) -> tuple[float, float, float]:
    if len(value) != 3:
        raise BadCommand("position must be three numbers: east, north and up in metres")
    east, north, up = (_number("position", each) for each in value)
    return east, north, up
