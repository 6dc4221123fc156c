"""Radio section of a cluster file, and the layout of the radio process derived from it."""

from __future__ import annotations

import copy
import json
from ipaddress import IPv4Network
from pathlib import Path
from typing import Any

import pytest
from fractus_cluster.addressing import Addressing
from fractus_cluster.cgroups import cluster_branch
from fractus_cluster.errors import ClusterError
from fractus_cluster.hardware import RADIO_LINK, vehicle_command
from fractus_cluster.network import Wiring
from fractus_cluster.node import Node
from fractus_cluster.radio import radio_layout
from fractus_cluster.spec import ClusterSpec, parse_spec
from fractus_cluster.state import state_of
from fractus_radio.layout import Layout

WIFI = {"technology": "WiFi", "device": "wlan0", "range": 120, "pairing": {"mode": "adhoc", "networkId": "net"}}
CONTENT: dict[str, Any] = {
    "name": "radio",
    "air": {"fading": 4, "seed": 3},
    "nodes": [
        {
            "name": "drone-1",
            "class": "drone",
            "hardware": {"vehicle": {"home": {"lat": 50, "lon": 4, "alt": 25}}, "wifi": {}, "uplink": {"delay": 30}},
            "description": {"interfaces": [{"technology": "4G"}, WIFI]},
        },
        {
            "name": "edge-1",
            "class": "edge",
            "hardware": {"wifi": {"range": 96}},
            "description": {"location": {"lat": 50.001, "lon": 4, "alt": 20}, "interfaces": [WIFI]},
        },
        {"name": "cloud-1", "class": "cloud"},
    ],
}


def layout(content: dict[str, Any]) -> Layout | None:
    spec: ClusterSpec = parse_spec(content, source="x")
    wiring = Wiring("radio", Addressing(IPv4Network("10.200.0.0/16")), Path("/none"))
    state = state_of("radio")
    branch = cluster_branch("radio")
    nodes = [Node(node, index, wiring, state, branch) for index, node in enumerate(spec.nodes)]
    text = radio_layout(nodes, spec.air, Path("/none/control"))
    return None if text is None else Layout.model_validate_json(text)


def without(*path: str | int) -> dict[str, Any]:
    content = copy.deepcopy(CONTENT)
    parent: Any = content
    for part in path[:-1]:
        parent = parent[part]
    del parent[path[-1]]
    return content


def test_radio_range_is_declared_or_taken_from_hardware() -> None:
    radio = layout(CONTENT)
    assert radio is not None
    assert [(station.name, station.device, station.range_m) for station in radio.stations] == [
        ("drone-1", "wlan0", 120.0),
        ("edge-1", "wlan0", 96.0),
    ]
    assert [station.vehicle for station in radio.stations] == [RADIO_LINK, None]
    assert (radio.fading, radio.seed, radio.origin.lat) == (4.0, 3, 50.0)
    (uplink,) = radio.uplinks
    assert (uplink.near.device, uplink.far.device) == ("eth0", "node0")
    assert (uplink.rate_bps, uplink.delay_s) == (8e6, 0.03)


def test_vehicle_gets_link_for_radio_follower(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fractus_cluster.hardware.program", lambda name: name)
    drone = parse_spec(CONTENT, source="x").nodes[0]
    command = vehicle_command(drone)
    assert command is not None
    assert command[1:5] == ["--listen", "tcp:127.0.0.1:5760", "--listen", RADIO_LINK]


def test_wired_cluster_has_no_radio() -> None:
    content = without("nodes", 0, "hardware", "wifi")
    del content["nodes"][0]["hardware"]["uplink"], content["nodes"][1]["hardware"]
    assert layout(content) is None


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (without("nodes", 0, "description", "interfaces"), "hardware.wifi has no range"),
        (without("nodes", 1, "description", "location"), "needs a vehicle or description.location"),
        (json.loads(json.dumps(CONTENT).replace('"fading": 4', '"fading": 0.1')), "air.fading"),
    ],
)
def test_invalid_radio_configuration_is_refused(content: dict[str, Any], message: str) -> None:
    with pytest.raises(ClusterError, match=message):
        parse_spec(content, source="x")
