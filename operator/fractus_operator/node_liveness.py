"""Detects drones and edge nodes that stopped reporting, and marks their state as unknown."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from datetime import datetime
from typing import Any

from fractus_core.api import Drone, EdgeNode
from fractus_core.api.conditions import ConditionUpdate
from fractus_core.api.nodes import DRONE_REPORT_S, EDGE_REPORT_S, FLIGHT_REPORT_S, GROUNDED, ON_MISSION
from fractus_core.planning.candidates import readiness
from pydantic import TypeAdapter, ValidationError

from fractus_operator.cache import ClusterCache
from fractus_operator.node_conditions import NodeConditionWriter
from fractus_operator.work_queue import skip_failed_node

log = logging.getLogger(__name__)

AGENT_SILENT = "AgentSilent"
LIVENESS_PERIOD_S = 1.0
_TIME = TypeAdapter(datetime)
_MISSED_REPORTS = 3
"""Number of missed reports after which a node is stale."""
_RECONNECT_S = 15.0
"""Longest pause of an agent before it reconnects after an outage of the API server."""
_MAX_STEP_S = 3 * LIVENESS_PERIOD_S
"""Longest step that counts as observation time, in seconds. A longer step means that this process and its informers were delayed."""


class ObservationClock:
    """Counts the seconds in which reports could be received.

    The clock stops while the API server is out of reach, and afterwards until agents have reconnected.

    Args:
        monotonic: Monotonic seconds.
        is_connected: Returns True if reports to the API server reach this process.
    """

    def __init__(self, monotonic: Callable[[], float], is_connected: Callable[[], bool]) -> None:
        self._monotonic = monotonic
        self._is_connected = is_connected
        self._last_s = monotonic()
        self._stopped_until_s = float("-inf")
        self._observed_s = 0.0
        self._began = False

    def now_s(self) -> float:
        """Return the observed seconds. Must be called about once every LIVENESS_PERIOD_S."""
        now_s = self._monotonic()
        if self._is_connected():
            self._began = True
        elif self._began:
            self._stopped_until_s = now_s + _RECONNECT_S
        if now_s > self._stopped_until_s:
            self._observed_s += min(now_s - self._last_s, _MAX_STEP_S)
        self._last_s = now_s
        return self._observed_s


def report_timeout_s(node: Drone | EdgeNode) -> float:
    """Return the seconds without a report after which a node is stale."""
    if isinstance(node, EdgeNode):
        return _MISSED_REPORTS * EDGE_REPORT_S
    return _MISSED_REPORTS * (FLIGHT_REPORT_S if node.in_air else DRONE_REPORT_S)


def displayed_flight_state(drone: Drone) -> str:
    """Return a drone's flight state for metrics. The state is unknown only if the drone may be in the air.

    The state is offline if the drone never reported, or if it was on the ground at its last report and no Application
    may fly it.
    """
    status = drone.status
    if status is not None and status.flight_state != "unknown":
        return status.flight_state
    if status is None or status.last_seen is None:
        return "offline"
    mission = next((each for each in status.conditions if each.type == ON_MISSION), None)
    parked = status.last_flight_state in GROUNDED and (mission is None or mission.status == "False")
    return "offline" if parked else "unknown"


class StaleNodeDetector:
    """Measures the age of each node's last report with the clock of this process.

    Clocks of nodes may differ from the clock of this process.
    """

    def __init__(self) -> None:
        self._last_reports: dict[tuple[str, str], tuple[datetime, float]] = {}

    def stale_nodes(self, nodes: Iterable[Drone | EdgeNode], now_s: float) -> list[Drone | EdgeNode]:
        """Return the nodes whose last report is too old.

        A node that never reported is not stale, because its status contains no outdated state.

        Args:
            nodes: All nodes.
            now_s: Current reading of an ObservationClock.
        """
        stale = []
        last_reports: dict[tuple[str, str], tuple[datetime, float]] = {}
        for node in nodes:
            last_seen = node.status.last_seen if node.status is not None else None
            if last_seen is None:
                continue
            key = (node.KIND, node.name)
            known = self._last_reports.get(key)
            last_reports[key] = known if known is not None and known[0] == last_seen else (last_seen, now_s)
            if now_s - last_reports[key][1] > report_timeout_s(node):
                stale.append(node)
        self._last_reports = last_reports
        return stale


class NodeLivenessController:
    """Marks stale nodes: their state is unknown and they are not ready."""

    def __init__(self, cache: ClusterCache, conditions: NodeConditionWriter, now_s: Callable[[], float]) -> None:
        self._cache = cache
        self._conditions = conditions
        self._now_s = now_s
        self._detector = StaleNodeDetector()

    async def step(self) -> None:
        """Check all nodes once.

        Raises:
            KubeError: The API server cannot be reached.
        """
        await self._cache.synced()
        nodes = [n for n in (*self._cache.drones.values(), *self._cache.edge_nodes.values()) if n is not None]
        for node in self._detector.stale_nodes(nodes, self._now_s()):
            ready = readiness(node.status)
            if ready is None or ready.reason != AGENT_SILENT:
                with skip_failed_node("node liveness", node.name):
                    await self._mark(node)

    async def _mark(self, node: Drone | EdgeNode) -> None:
        last_seen = node.status.last_seen if node.status is not None else None
        message = f"its agent last reported at {last_seen:%Y-%m-%d %H:%M:%S} UTC"
        if isinstance(node, Drone) and node.status is not None:
            last = node.status.last_flight_state or node.status.flight_state
            message += f", when the drone was {last}; its current state is unknown"

        def change(status: dict[str, Any]) -> bool:
            # The cache may be outdated, so the state at the API server decides.
            if last_seen is None or _parse_time(status.get("lastSeen")) != last_seen:
                return False
            log.warning("node liveness: agent stopped reporting (node=%s)", node.name)
            if isinstance(node, Drone):
                if status.get("flightState", "unknown") != "unknown":
                    status["lastFlightState"] = status["flightState"]
                status["flightState"] = "unknown"
                status.pop("controller", None)
            return True

        await self._conditions.write(node.name, ConditionUpdate("Ready", "Unknown", AGENT_SILENT, message), change)


def _parse_time(value: object) -> datetime | None:
    """Parse a time as the models do. Return None if it is invalid."""
    try:
        return _TIME.validate_python(value)
    except ValidationError:
        return None
