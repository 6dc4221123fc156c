"""Simulated radio of a cluster: WiFi devices of its nodes on one channel, and mobile uplinks that replace wires.

The radio runs as a separate process. This module writes its layout and controls it.
"""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fractus_core.api.geometry import VehicleHome

from fractus_cluster import network
from fractus_cluster.cgroups import cluster_branch
from fractus_cluster.errors import ClusterError
from fractus_cluster.hardware import RADIO_LINK, hardware_environment, program
from fractus_cluster.node import Node
from fractus_cluster.processes import kill_recorded, running, spawn, write_record
from fractus_cluster.spec import AirSpec
from fractus_cluster.state import StateDirectory

PROCESS = "radio"
_START_TIMEOUT_S = 60.0
_POLL_S = 0.1


@dataclass(frozen=True, slots=True)
class Radio:
    """Radio of a cluster.

    Attributes:
        cluster: Name of the cluster.
        state: State directory of the cluster.
    """

    cluster: str
    state: StateDirectory

    @property
    def running(self) -> bool | None:
        """True if the radio is running. None for a cluster without radio."""
        if not self._layout.exists():
            return None
        return running(self._record) is not None

    def start(self, nodes: Sequence[Node], air: AirSpec) -> None:
        """Start the radio of the nodes. Restart it if its layout changed, and stop it if no node has a radio device.

        Raises:
            ClusterError: The radio did not start.
        """
        layout = radio_layout(nodes, air, self._control)
        if layout is not None and self.running and self._layout.read_text() == layout:
            return
        kill_recorded(self._record)
        for path in (self._record, self._control, self._layout):
            path.unlink(missing_ok=True)
        if layout is None:
            return
        self.state.radio.mkdir(parents=True, exist_ok=True)
        self._layout.write_text(layout)
        log = self.state.logs / "radio.log"
        cgroup = cluster_branch(self.cluster).below(PROCESS)
        command = [program("fractus-radio"), str(self._layout)]
        write_record(self._record, spawn(command, log=log, cgroup_files=cgroup.create(), env=hardware_environment()))
        deadline = time.monotonic() + _START_TIMEOUT_S
        while not self._control.exists():
            if not self.running or time.monotonic() > deadline:
                raise ClusterError(f"the radio did not start; see {log}")
            time.sleep(_POLL_S)

    def command(self, **command: object) -> None:
        """Change a station or an uplink, for example `station="drone-1", off=True`. The radio logs an invalid command.

        Raises:
            ClusterError: The radio is not running.
        """
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
            try:
                sender.sendto(json.dumps(command).encode(), str(self._control))
            except OSError as error:
                raise ClusterError(
                    f"the radio is not running ({error.strerror}); run `fractus cluster up` again"
                ) from error

    @property
    def _record(self) -> Path:
        return self.state.process(PROCESS)

    @property
    def _layout(self) -> Path:
        return self.state.radio / "layout.json"

    @property
    def _control(self) -> Path:
        return self.state.radio / "control"


def radio_layout(nodes: Sequence[Node], air: AirSpec, control: Path) -> str | None:
    """Return the radio's layout file, or None for a cluster without radio.

    Args:
        nodes: Nodes of the cluster.
        air: Settings shared by all stations.
        control: Path of the radio's control socket.
    """
    stations = [entry for node in nodes if (entry := _station(node)) is not None]
    uplinks = [entry for node in nodes if (entry := _uplink(node)) is not None]
    if not stations and not uplinks:
        return None
    content = {"control": str(control), "fading": air.fading, "seed": air.seed, "stations": stations}
    if stations:
        content["origin"] = stations[0]["place"]
    return json.dumps(content | {"uplinks": uplinks}, indent=1)


def _station(node: Node) -> dict[str, Any] | None:
    interface = node.spec.wifi()
    place = node.spec.place()
    if interface is None or place is None:
        return None
    return {
        "name": node.name,
        "namespace": str(node.wiring.namespace_path(node.name)),
        "device": interface[0],
        "range_m": interface[1],
        "place": _place(place),
        "vehicle": RADIO_LINK if node.spec.vehicle() is not None else None,
    }


def _place(home: VehicleHome) -> dict[str, float]:
    return {"lat": home.lat, "lon": home.lon, "alt": home.alt}


def _uplink(node: Node) -> dict[str, Any] | None:
    uplink = node.spec.hardware.uplink
    if uplink is None:
        return None
    wiring = node.wiring
    return {
        "name": node.name,
        "near": {"namespace": str(wiring.namespace_path(node.name)), "device": network.UPLINK},
        "far": {"namespace": str(wiring.namespace_path()), "device": network.port(node.index)},
        "rate_bps": uplink.rate * 1e6,
        "delay_s": uplink.delay / 1e3,
    }
