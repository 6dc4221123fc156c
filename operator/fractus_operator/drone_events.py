"""Events of Drones about their flights: takeoff, mission, control authority with the reason, and landing.

A takeover is also an Event of the Applications that the drone flies.
"""

from __future__ import annotations

import asyncio
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from datetime import datetime, timedelta

from fractus_core.api import Drone
from fractus_core.api.names import CONTROL_TAKEN
from fractus_core.api.nodes import DRONE_REPORT_S

from fractus_operator.cache import ClusterCache
from fractus_operator.kinds import APPLICATION, DRONE, Body, Key
from fractus_operator.store import Store
from fractus_operator.work_queue import WorkQueue

EVENT_BURST = 20
"""Maximum number of Events of one drone without a pause. This number is sufficient for several flights."""
EVENT_PERIOD_S = 60.0
"""Seconds until one more Event is allowed after a burst. The changes during this pause are summarised."""
_TAKEOVERS = frozenset({"SystemTookControl", "PilotTookControl"})
"""Reasons of Events that are also Events of the Applications that the drone flies."""

MAX_LATE = timedelta(seconds=60)
"""Maximum age of a report, relative to the report before, that counts as late.

An even older time means that the drone's clock was set back.
"""
_PAUSE = timedelta(seconds=2 * DRONE_REPORT_S)
"""Minimum pause between two reports for which an Event states the times of both reports.

The change happened at an unknown time in the pause.
"""


@dataclass(frozen=True, slots=True)
class FlightReport:
    """The part of the reported state of a drone on which Events depend.

    Attributes:
        uid: Uid of the Drone.
        time: Time of the report by the drone's clock.
        in_air: True if the drone is in the air.
        controller: Holder of the control authority, or an empty string if unknown.
        reason: Why no driver has the control authority, or an empty string if unknown.
        interval: Times of the reports before and after a takeoff or landing if there was a pause, else an empty string.
        missions: Applications that have a Grant for the drone and have flown it under this Grant.
    """

    uid: str
    time: datetime | None
    in_air: bool
    controller: str
    reason: str
    interval: str = ""
    missions: tuple[str, ...] = ()


def parse_flight_report(drone: Drone, before: FlightReport | None) -> FlightReport | None:
    """Return the report of a drone, or None if the report is not newer than `before` or its state is unknown."""
    status = drone.status
    if status is None or status.flight_state == "unknown":
        return None
    reason = next((c.message for c in status.conditions if c.type == CONTROL_TAKEN and c.status == "True"), "")
    time = status.last_seen
    uid = drone.metadata.uid or ""
    report = FlightReport(uid, time, status.in_air, status.controller or "", reason)
    if before is None or before.uid != uid:
        return report
    if time is None or before.time is None:
        return report
    if timedelta() < before.time - time <= MAX_LATE:
        return None
    if report.in_air == before.in_air:
        return replace(report, interval=before.interval)
    paused = time - before.time > _PAUSE
    return replace(report, interval=f", between {before.time:%H:%M:%S} and {time:%H:%M:%S} UTC" if paused else "")


def flight_events(
    name: str, posted: FlightReport, current: FlightReport, outcome: Callable[[str], str]
) -> Iterator[tuple[str, str, FlightReport]]:
    """Return the Events for the changes since the last Events, in the order in which the changes happened.

    Args:
        name: Name of the drone.
        posted: State of the drone at the last Events.
        current: Current state of the drone.
        outcome: Returns the outcome of the mission of an Application, or an empty string if unknown.

    Yields:
        Reason and message of an Event, and the state of the drone at this Event.
    """
    for application in posted.missions:
        if application not in current.missions:
            message = f"{application} no longer flies {name}"
            ended = outcome(application)
            if ended:
                message += f": {ended}"
            posted = replace(posted, missions=tuple(m for m in posted.missions if m != application))
            yield "MissionOver", message, posted
    if current.in_air and not posted.in_air:
        flown_by = f", flown by {current.controller}" if current.controller else ""
        posted = replace(posted, in_air=True, controller=current.controller)
        yield "TookOff", f"{name} took off{flown_by}{current.interval}", posted
    for application in current.missions:
        if application not in posted.missions:
            posted = replace(posted, missions=(*posted.missions, application))
            yield "MissionBegun", f"{application} flies {name}", posted
    if current.in_air and current.controller and current.controller != posted.controller:
        reason, message = _control_event(name, posted.controller, current)
        posted = replace(posted, controller=current.controller)
        yield reason, message, posted
    if posted.in_air and not current.in_air:
        yield "Landed", f"{name} landed{current.interval}", replace(posted, in_air=False)


def _control_event(name: str, before: str, current: FlightReport) -> tuple[str, str]:
    """Return reason and message of the Event about a change of the control authority."""
    if current.controller not in {"system", "pilot"}:
        return "ControlGranted", f"{current.controller} has control of {name}"
    instead = f" instead of {before}" if before else ""
    because = f": {current.reason}" if current.reason else ""
    if current.controller == "pilot":
        return "PilotTookControl", f"a pilot has control of {name}{instead}{because}"
    return "SystemTookControl", f"the system has control of {name}{instead}{because}"


class DroneEventRecorder:
    """Creates the Events. The state at the start of the operator has no Event, because the previous operator posted it.

    Args:
        store: The API server.
        cache: The cluster.
        granted_applications: Returns the Applications with a Grant for a drone, as NAMESPACE/NAME.
        clock: Returns the current time.

    Attributes:
        work_queue: Queue of drones with pending Events. The caller runs it.
    """

    def __init__(
        self,
        store: Store,
        cache: ClusterCache,
        granted_applications: Callable[[str], Iterable[str]],
        clock: Callable[[], datetime],
    ) -> None:
        self.work_queue = WorkQueue("drone event", self.reconcile, after=cache.synced)
        self._store = store
        self._cache = cache
        self._granted_applications = granted_applications
        self._clock = clock
        self._current: dict[str, FlightReport] = {}
        self._posted: dict[str, FlightReport] = {}
        self._budgets: dict[str, tuple[float, float]] = {}
        """By drone, the number of allowed Events, and the time at which it was computed, in seconds."""

    def changed(self, key: Key) -> None:
        """Handle a report of a drone."""
        name = key[1]
        drone = self._cache.drone(name)
        if drone is None:
            self._current.pop(name, None)
            self._posted.pop(name, None)
            self._budgets.pop(name, None)
            return
        report = parse_flight_report(drone, self._current.get(name))
        if report is not None:
            self._current[name] = report
            self.work_queue.add(key)

    async def reconcile(self, key: Key) -> None:
        """Create the pending Events of a drone, or schedule them for when they are allowed.

        Raises:
            KubeError: The API server refused an Event, or could not be reached. Created Events are not repeated.
        """
        name = key[1]
        current = self._current.get(name)
        posted = self._posted.get(name)
        if current is None:
            return
        # A mission lasts from the takeoff until the Grant is deleted. A Grant under which the drone never flies causes no Event.
        flown = posted.missions if posted is not None else ()
        missions = tuple(m for m in self._granted_applications(name) if current.in_air or m in flown)
        current = replace(current, missions=missions)
        if posted is None or posted.uid != current.uid:
            self._posted[name] = current
            return
        events = list(flight_events(name, posted, current, self._outcome))
        wait_s = self._wait_s(name, len(events))
        if wait_s > 0:
            asyncio.get_running_loop().call_later(wait_s, self.work_queue.add, key)
            return
        for reason, message, state in events:
            await self._post(DRONE.header(name, uid=current.uid), current, reason, message)
            if reason in _TAKEOVERS:
                for regarding in self._applications(state.missions):
                    await self._post(regarding, current, reason, message)
            self._posted[name] = state
        self._posted[name] = replace(current, controller=current.controller or posted.controller)

    def _applications(self, names: Iterable[str]) -> Iterator[Body]:
        """Yield the objects of Applications, given as NAMESPACE/NAME."""
        for application in names:
            namespace, _, name = application.partition("/")
            submitted = self._cache.applications.get((namespace, name))
            if submitted is not None:
                yield APPLICATION.header(name, namespace, uid=submitted.body["metadata"].get("uid", ""))

    async def _post(self, regarding: Body, report: FlightReport, reason: str, message: str) -> None:
        now = self._clock()
        # The time of the report is part of the name, so that the same Event is not created twice.
        stamp = int((report.time or now).timestamp())
        name = regarding["metadata"]["name"]
        await self._store.create_event(
            regarding,
            reason=reason,
            message=message,
            warning=False,
            name=f"{name}.{stamp:x}.{reason.lower()}.{zlib.crc32(message.encode()):x}",
            now=now,
        )

    def _wait_s(self, name: str, events: int) -> float:
        """Return the seconds until a number of Events of a drone is allowed. If the result is 0, the Events count as created."""
        now_s = asyncio.get_running_loop().time()
        allowed, counted_s = self._budgets.get(name, (float(EVENT_BURST), now_s))
        allowed = min(allowed + (now_s - counted_s) / EVENT_PERIOD_S, EVENT_BURST)
        missing = min(events, EVENT_BURST) - allowed
        self._budgets[name] = (allowed if missing > 0 else allowed - events, now_s)
        return max(missing, 0.0) * EVENT_PERIOD_S

    def _outcome(self, application: str) -> str:
        namespace, _, name = application.partition("/")
        submitted = self._cache.applications.get((namespace, name))
        if submitted is None:
            return "it was deleted"
        conditions = (submitted.body.get("status") or {}).get("conditions") or ()
        ended = (c for c in conditions if c["type"] == "MissionComplete" and c["reason"] != "MissionBegun")
        return next((c.get("message") or "" for c in ended), "")
