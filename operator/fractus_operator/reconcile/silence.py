"""Notices drones and edge nodes that are not heard of any more, and says so: what they did last is not what they do."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from datetime import datetime
from typing import Any

from fractus_core.api import Drone, EdgeNode
from fractus_core.api.nodes import DRONE_REPORT_S, EDGE_REPORT_S, FLIGHT_REPORT_S, GROUNDED, ON_MISSION
from fractus_core.planning.candidates import readiness
from pydantic import TypeAdapter, ValidationError

from fractus_operator.inventory.live import LiveInventory
from fractus_operator.reconcile.conditions import ConditionUpdate
from fractus_operator.reconcile.node_reports import NodeReports
from fractus_operator.reconcile.worklist import one_of_many

logger = logging.getLogger(__name__)

SILENT = "AgentSilent"
PERIOD_S = 1.0
_TIME = TypeAdapter(datetime)
_MISSED = 3
"""Reports that are missed before a node counts as silent."""
_COMES_BACK_S = 15.0
"""How long after an outage of the API server an agent may pause before it tries again."""
_MAX_STEP_S = 3 * PERIOD_S
"""A step that comes later was held up, and so was what reflectors had to read."""


class HearingClock:
    """Seconds in which nodes could be heard: it stands still while the API server is out of reach, and until agents are back.

    Args:
        monotonic: Seconds that never jump.
        hears: Whether reports that reach the API server are heard of here.
    """

    def __init__(self, monotonic: Callable[[], float], hears: Callable[[], bool]) -> None:
        self._monotonic = monotonic
        self._hears = hears
        self._last_s = monotonic()
        self._deaf_until_s = float("-inf")
        self._heard_s = 0.0
        self._began = False

    def now_s(self) -> float:
        """Its reading; asked for about once every PERIOD_S."""
        now_s = self._monotonic()
        if self._hears():
            self._began = True
        elif self._began:
            self._deaf_until_s = now_s + _COMES_BACK_S
        if now_s > self._deaf_until_s:
            self._heard_s += min(now_s - self._last_s, _MAX_STEP_S)
        self._last_s = now_s
        return self._heard_s


def patience_s(node: Drone | EdgeNode) -> float:
    """Seconds without a report after which a node is silent."""
    if isinstance(node, EdgeNode):
        return _MISSED * EDGE_REPORT_S
    return _MISSED * (FLIGHT_REPORT_S if node.in_air else DRONE_REPORT_S)


def shown_state(drone: Drone) -> str:
    """A drone's flight state for figures: unknown only where it may be in the air.

    Offline: it never reported, or it was on the ground when it was last heard of, and no application may fly it since.
    """
    status = drone.status
    if status is not None and status.flight_state != "unknown":
        return status.flight_state
    if status is None or status.last_seen is None:
        return "offline"
    mission = next((each for each in status.conditions if each.type == ON_MISSION), None)
    parked = status.last_flight_state in GROUNDED and (mission is None or mission.status == "False")
    return "offline" if parked else "unknown"


class Silence:
    """Since when each node's last report is known, by this process's clock: clocks of nodes need not agree with it."""

    def __init__(self) -> None:
        self._heard: dict[tuple[str, str], tuple[datetime, float]] = {}

    def silent(self, nodes: Iterable[Drone | EdgeNode], now_s: float) -> list[Drone | EdgeNode]:
        """The nodes that are not heard of any more, at a moment by a HearingClock.

        One that never reported is not silent: nothing is shown of it that could be old.
        """
        found = []
        heard: dict[tuple[str, str], tuple[datetime, float]] = {}
        for node in nodes:
            seen = node.status.last_seen if node.status is not None else None
            if seen is None:
                continue
            key = (node.KIND, node.name)
            known = self._heard.get(key)
            heard[key] = known if known is not None and known[0] == seen else (seen, now_s)
            if now_s - heard[key][1] > patience_s(node):
                found.append(node)
        self._heard = heard
        return found


class SilenceWatch:
    """Marks silent nodes: their state is unknown, and they are ready for nothing."""

    def __init__(self, live: LiveInventory, reports: NodeReports, now_s: Callable[[], float]) -> None:
        self._live = live
        self._reports = reports
        self._now_s = now_s
        self._silence = Silence()

    async def step(self) -> None:
        """Look once.

        Raises:
            KubeError: the API server cannot be reached.
        """
        await self._live.synced()
        nodes = [n for n in (*self._live.drones.values(), *self._live.edge_nodes.values()) if n is not None]
        for node in self._silence.silent(nodes, self._now_s()):
            ready = readiness(node.status)
            if ready is None or ready.reason != SILENT:
                with one_of_many("silence", node.name):
                    await self._mark(node)

    async def _mark(self, node: Drone | EdgeNode) -> None:
        seen = node.status.last_seen if node.status is not None else None
        said = f"its agent was last heard of at {seen:%Y-%m-%d %H:%M:%S} UTC"
        if isinstance(node, Drone) and node.status is not None:
            last = node.status.last_flight_state or node.status.flight_state
            said += f", when the drone was {last}; what it does now is not known"

        def change(status: dict[str, Any]) -> bool:
            # The watch may be behind: what counts is what the API server has.
            if seen is None or _time(status.get("lastSeen")) != seen:
                return False
            logger.warning("silence: agent is not heard of any more (node=%s)", node.name)
            if isinstance(node, Drone):
                if status.get("flightState", "unknown") != "unknown":
                    status["lastFlightState"] = status["flightState"]
                status["flightState"] = "unknown"
                status.pop("controller", None)
            return True

        await self._reports.say(node.name, ConditionUpdate("Ready", "Unknown", SILENT, said), change)


def _time(value: object) -> datetime | None:
    """A time as the models read it; None for what is none."""
    try:
        return _TIME.validate_python(value)
    except ValidationError:
        return None
