"""Tells of flights in Events of their Drone: it took off, for which Application, who has control by now and why, it landed."""

from __future__ import annotations

import asyncio
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from datetime import datetime, timedelta

from fractus_core.api import Drone
from fractus_core.api.names import CONTROL_TAKEN
from fractus_core.api.nodes import DRONE_REPORT_S

from fractus_operator.cluster.kinds import DRONE, Key
from fractus_operator.cluster.store import Store
from fractus_operator.inventory.live import LiveInventory
from fractus_operator.reconcile.flight_status import pilot_of
from fractus_operator.reconcile.worklist import Worklist

BURST = 20
"""Events that are posted of one drone one after the other: those of some flights."""
PERIOD_S = 60.0
"""Seconds until one more may be, from then on: of a drone that flaps, only what is left by then is told."""
LATE = timedelta(seconds=60)
"""A report that is older than one before it by up to this came late; by more, the drone's clock was set back."""
_UNHEARD = timedelta(seconds=2 * DRONE_REPORT_S)
"""After a pause of this length between two reports, what changed between them may have changed at any time."""


@dataclass(frozen=True, slots=True)
class FlightReport:
    """What is known of a drone, as far as Events tell of it.

    Attributes:
        uid: of the Drone.
        seen: when its agent wrote this, by the drone's clock.
        in_air: whether it flies.
        controller: who has control; empty while that is not known.
        why: why a driver has not; empty where that is not known.
        unheard: between which reports it took off or landed, where there was a pause; else empty.
        missions: Applications that have flown it since they may.
    """

    uid: str
    seen: datetime | None
    in_air: bool
    controller: str
    why: str
    unheard: str = ""
    missions: tuple[str, ...] = ()


def read_report(drone: Drone, before: FlightReport | None) -> FlightReport | None:
    """What a Drone tells, given what it told before; None where that is nothing new, or not known."""
    status = drone.status
    if status is None or status.flight_state == "unknown":
        return None
    why = next((c.message for c in status.conditions if c.type == CONTROL_TAKEN and c.status == "True"), "")
    seen, uid = status.last_seen, drone.metadata.uid or ""
    report = FlightReport(uid, seen, status.in_air, status.controller or "", why)
    if before is None or before.uid != uid:
        return report
    if seen is None or before.seen is None:
        return report
    if timedelta() < before.seen - seen <= LATE:
        return None
    if report.in_air == before.in_air:
        return replace(report, unheard=before.unheard)
    paused = seen - before.seen > _UNHEARD
    return replace(report, unheard=f", between {before.seen:%H:%M:%S} and {seen:%H:%M:%S} UTC" if paused else "")


def news(
    name: str, told: FlightReport, now: FlightReport, outcome: Callable[[str], str]
) -> Iterator[tuple[str, str, FlightReport]]:
    """What leads from what was told of a drone to how it is now, in the order of what happened.

    Args:
        name: of the drone.
        told: what was told.
        now: how it is.
        outcome: how the mission of an Application ended; empty where that is not known.

    Yields:
        Reason and sentence of an Event, and what is told once it is posted.
    """
    for application in told.missions:
        if application not in now.missions:
            ended = outcome(application)
            told = replace(told, missions=tuple(m for m in told.missions if m != application))
            yield "MissionOver", f"{application} does not fly {name} any more{f': {ended}' if ended else ''}", told
    if now.in_air and not told.in_air:
        by = f", flown by {pilot_of(now.controller)}" if now.controller else ""
        told = replace(told, in_air=True, controller=now.controller)
        yield "TookOff", f"{name} took off{by}{now.unheard}", told
    for application in now.missions:
        if application not in told.missions:
            told = replace(told, missions=(*told.missions, application))
            yield "MissionBegun", f"{application} flies {name}", told
    if now.in_air and now.controller and now.controller != told.controller:
        reason, sentence = _control(name, told.controller, now)
        told = replace(told, controller=now.controller)
        yield reason, sentence, told
    if told.in_air and not now.in_air:
        yield "Landed", f"{name} landed{now.unheard}", replace(told, in_air=False)


def _control(name: str, before: str, now: FlightReport) -> tuple[str, str]:
    """Reason and sentence of the Event that another has control."""
    if now.controller not in {"system", "pilot"}:
        return "ControlGranted", f"{pilot_of(now.controller)} has control of {name}"
    instead = f" instead of {pilot_of(before)}" if before else ""
    because = f": {now.why}" if now.why else ""
    reason = "PilotTookControl" if now.controller == "pilot" else "SystemTookControl"
    return reason, f"{'a pilot' if now.controller == 'pilot' else 'the system'} has control of {name}{instead}{because}"


class DroneEvents:
    """Posts the Events; what an operator finds when it starts was told by the one before.

    Args:
        store: where to.
        live: with the Drones and Applications.
        holders: the Applications that may fly a drone, as NAMESPACE/NAME.
        clock: the time, for Events.

    Attributes:
        worklist: posts what is due; run it.
    """

    def __init__(
        self,
        store: Store,
        live: LiveInventory,
        holders: Callable[[str], Iterable[str]],
        clock: Callable[[], datetime],
    ) -> None:
        self.worklist = Worklist("drone event", self.tell, after=live.synced)
        self._store = store
        self._live = live
        self._holders = holders
        self._clock = clock
        self._now: dict[str, FlightReport] = {}
        self._told: dict[str, FlightReport] = {}
        self._left: dict[str, tuple[float, float]] = {}

    def changed(self, key: Key) -> None:
        """Take what a drone's agent reports."""
        name, drone = key[1], self._live.drone(key[1])
        if drone is None:
            for known in (self._now, self._told, self._left):
                known.pop(name, None)
            return
        report = read_report(drone, self._now.get(name))
        if report is not None:
            self._now[name] = report
            self.worklist.add(key)

    async def tell(self, key: Key) -> None:
        """Post what is new of a drone, or see to it that it is posted once it may be.

        Raises:
            KubeError: the API server refused it, or cannot be reached; what is posted already is not posted again.
        """
        name = key[1]
        now, told = self._now.get(name), self._told.get(name)
        if now is None:
            return
        # An Application has flown a drone from its takeoff on, until it may no more: what does not fly has no Event.
        may = self._holders(name)
        flown = told.missions if told is not None else ()
        now = replace(now, missions=tuple(m for m in may if now.in_air or m in flown))
        if told is None or told.uid != now.uid:
            self._told[name] = now
            return
        due = list(news(name, told, now, self._outcome))
        wait_s = self._wait_s(name, len(due))
        if wait_s > 0:
            asyncio.get_running_loop().call_later(wait_s, self.worklist.add, key)
            return
        for reason, sentence, posted in due:
            await self._post(name, now, reason, sentence)
            self._told[name] = posted
        self._told[name] = replace(now, controller=now.controller or told.controller)

    async def _post(self, name: str, report: FlightReport, reason: str, sentence: str) -> None:
        moment = self._clock()
        # Named by the report that it is of: the same one is not told twice.
        stamp = int((report.seen or moment).timestamp())
        await self._store.record_event(
            DRONE.header(name, uid=report.uid),
            reason=reason,
            message=sentence,
            warning=False,
            name=f"{name}.{stamp:x}.{reason.lower()}.{zlib.crc32(sentence.encode()):x}",
            now=moment,
        )

    def _wait_s(self, name: str, events: int) -> float:
        """Seconds until a number of Events may be posted of a drone; 0 where they may be, and are counted."""
        now_s = asyncio.get_running_loop().time()
        left, at_s = self._left.get(name, (float(BURST), now_s))
        left = min(left + (now_s - at_s) / PERIOD_S, BURST)
        missing = min(events, BURST) - left
        self._left[name] = (left if missing > 0 else left - events, now_s)
        return max(missing, 0.0) * PERIOD_S

    def _outcome(self, application: str) -> str:
        namespace, _, name = application.partition("/")
        submitted = self._live.applications.get((namespace, name))
        if submitted is None:
            return "it was deleted"
        conditions = (submitted.body.get("status") or {}).get("conditions") or ()
        ended = (c for c in conditions if c["type"] == "MissionComplete" and c["reason"] != "MissionBegun")
        return next((c.get("message") or "" for c in ended), "")
