"""Site of the scenario: drone, edge nodes and waypoints, read from the files of the example."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fractus_cluster.spec import ClusterSpec, NodeSpec, WifiHardware, load_spec
from fractus_core.geo import LocalFrame
from fractus_core.linking import LocalPosition, PathMetrics, Peer

from fractus_sim.testbeds.embedded_cluster import ROOT, read_objects

EXAMPLE = ROOT / "examples" / "links"
DRONE = "drone-1"
UPLINK_MBPS = 8.0
UPLINK_MS = 60.0
WIFI_MBPS = 12.0
"""TCP throughput of the simulated radio within the range of a station, Mbit/s."""

WIFI_MS = 2.0


@dataclass(frozen=True)
class Site:
    """Positions of the scenario, in metres east and north of the drone's home and above it.

    Attributes:
        cluster: Cluster specification with actual ranges.
        peers: Edge nodes with WiFi and their declared ranges.
        edges: All edge nodes.
        path: Waypoints.
        factor: Actual range divided by declared range.
        frame: Local frame with its origin at the drone's home.
        ground_m: Altitude of the home above mean sea level.
    """

    cluster: ClusterSpec
    peers: tuple[Peer, ...]
    edges: dict[str, LocalPosition]
    path: tuple[LocalPosition, ...]
    factor: float
    frame: LocalFrame
    ground_m: float

    def position(self, lat: float, lon: float, alt: float) -> LocalPosition:
        """Convert degrees and metres above mean sea level to a local position."""
        east, north = self.frame.xy(lat, lon)
        return east, north, alt - self.ground_m

    @property
    def cloud(self) -> PathMetrics:
        """Path over the drone's mobile uplink."""
        return PathMetrics(UPLINK_MBPS, UPLINK_MBPS, UPLINK_MS, UPLINK_MS)


def read_site(factor: float = 1.0, folder: Path = EXAMPLE) -> Site:
    """Read the example.

    Args:
        factor: Actual radio range divided by declared range.
        folder: Folder of the example.
    """
    spec = load_spec(folder / "cluster.yaml")
    spec = spec.model_copy(update={"nodes": tuple(_with_range_factor(node, factor) for node in spec.nodes)})
    drone = next(node for node in spec.nodes if node.name == DRONE)
    home = drone.place()
    assert home is not None
    frame = LocalFrame(home.lat, home.lon)
    edges = {}
    peers = []
    for node in spec.nodes:
        place = node.place()
        if node.node_class != "edge" or place is None:
            continue
        east, north = frame.xy(place.lat, place.lon)
        edges[node.name] = (east, north, place.alt - home.alt)
        wifi = node.wifi()
        if wifi is not None:
            offers = PathMetrics(WIFI_MBPS, WIFI_MBPS, WIFI_MS, WIFI_MS, direct=True)
            peers.append(Peer(node.name, edges[node.name], wifi[1] / factor, offers))
    (application,) = read_objects(folder / "application.yaml")
    path = tuple((*frame.xy(point["lat"], point["lon"]), float(point["alt"])) for point in _waypoints(application))
    return Site(spec, tuple(peers), edges, path, factor, frame, home.alt)


def _with_range_factor(node: NodeSpec, factor: float) -> NodeSpec:
    """Return the node with its radio range scaled by the factor."""
    wifi = node.wifi()
    if wifi is None:
        return node
    hardware = node.hardware.model_copy(update={"wifi": WifiHardware(device=wifi[0], range=wifi[1] * factor)})
    return node.model_copy(update={"hardware": hardware})


def _waypoints(application: dict[str, Any]) -> list[dict[str, float]]:
    driver = next(c for c in application["spec"]["components"] if c.get("class") == "driver")
    return [point for task in driver["controlPoints"] for point in task["path"]]
