"""Flight of the links scenario: the example's application on an embedded cluster with a simulated radio."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fractus_cluster.hardware import RADIO_LINK
from fractus_core.linking import LocalPosition
from fractus_radio.follower import Follower, parse_address

from fractus_sim.errors import ExperimentError
from fractus_sim.progress import Progress
from fractus_sim.scenarios.links.links_evidence import (
    AGENT,
    CHECKER,
    VIEWER,
    Evidence,
    LogLine,
    PodLogFollower,
    read_evidence,
)
from fractus_sim.scenarios.links.links_site import DRONE, EXAMPLE, Site
from fractus_sim.testbeds.embedded_cluster import FractusCluster, install_fractus, read_objects
from fractus_sim.testbeds.kube_commands import Kube
from fractus_sim.testbeds.mission_watch import Mission, follow_mission

EXAMPLE_IMAGE = "example-links"
READY_TIMEOUT_S = 240.0
MISSION_TIMEOUT_S = 600.0
POD_LOGS = "lines.jsonl"
TRACK = "track.json"
DIRECT_LINKS = "links.json"
_RECORDED_CONTAINERS = frozenset({VIEWER, CHECKER, AGENT, "navigator"})


def fly(site: Site, out: Path, report: Callable[[str], None]) -> Evidence:
    """Start the cluster, fly, and read the evidence. The cluster is removed at the end unless it was already running.

    Raises:
        ExperimentError: A part did not start, or the mission did not complete before the timeout.
    """
    fractus = FractusCluster(site.cluster, report)
    fractus.build_images([EXAMPLE_IMAGE])
    try:
        kube = fractus.start()
        install_fractus(kube, read_objects(EXAMPLE / "depot.yaml"), timeout_s=READY_TIMEOUT_S)
        return _fly_mission(site, fractus, kube, out, report)
    finally:
        fractus.remove_if_started()


def _fly_mission(site: Site, fractus: FractusCluster, kube: Kube, out: Path, report: Callable[[str], None]) -> Evidence:
    track: list[tuple[float, LocalPosition]] = []
    links: list[dict[str, Any]] = []

    def record_position(lat: float, lon: float, alt: float) -> None:
        track.append((time.time(), site.position(lat, lon, alt)))

    drone = fractus.cluster.node(DRONE)
    Follower(drone.wiring.namespace_path(DRONE), parse_address(RADIO_LINK), record_position).start()
    nodes = {node.name: node.directory for node in fractus.cluster.nodes}
    pod_logs = PodLogFollower(nodes, _RECORDED_CONTAINERS)
    pod_logs.start()
    application = read_objects(EXAMPLE / "application.yaml")
    mission = Mission(application[0]["metadata"]["name"], {"applied": time.time()})
    kube.apply(application)
    progress = Progress(report, lambda _line: _record_links(kube, links))
    try:
        follow_mission(kube, mission, out / "components.log", progress, timeout_s=MISSION_TIMEOUT_S)
    finally:
        lines = pod_logs.close()
        (out / POD_LOGS).write_text("".join(line.to_json() + "\n" for line in lines))
        (out / DIRECT_LINKS).write_text(json.dumps(links, indent=1) + "\n")
        (out / TRACK).write_text(json.dumps(track) + "\n")
    if mission.phase != "Completed":
        raise ExperimentError(f"the mission ended as {mission.phase or 'unknown'}: {mission.message}")
    return read_evidence(lines, track, DRONE)


def read_earlier_run(out: Path) -> Evidence:
    """Read the evidence of an earlier run from its output folder.

    Raises:
        OSError: The folder contains no data of a run.
    """
    lines = [LogLine(*json.loads(line)) for line in (out / POD_LOGS).read_text().splitlines()]
    track = [(time_s, (p[0], p[1], p[2])) for time_s, p in json.loads((out / TRACK).read_text())]
    return read_evidence(lines, track, DRONE)


def _record_links(kube: Kube, links: list[dict[str, Any]]) -> None:
    """Replace the content of the list by the current DirectLinks.

    Keep the list if all DirectLinks have been deleted.
    """
    bodies = {body["metadata"]["name"]: body for body in kube.objects("directlinks")}
    if bodies:
        links[:] = [
            {"metadata": {"name": name}, "spec": body["spec"], "status": body.get("status")}
            for name, body in bodies.items()
        ]
