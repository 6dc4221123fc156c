"""Reservations of all flight plans: their airspace, and their drones in time.

The index contains what the status of each plan reports. A decision is added before its status is written, so that the next
decision considers it.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from fractus_core.airspace import Airspace, OperationalIntent, Volume4D
from fractus_core.airspace.lifecycle import RESERVING
from fractus_core.airspace.plan_status import intent_of
from fractus_core.airspace.volumes import MAX_TIME_S
from fractus_core.api import FlightPlan, InvalidObject, Zone
from fractus_core.planning.inventory import Reservation

from fractus_operator.kinds import Key
from fractus_operator.parsing import Submitted

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ReservedFlight:
    """What a flight plan reserves.

    Attributes:
        uid: Uid of the plan.
        intent: Its state and volumes.
        drone: Its drone.
    """

    uid: str
    intent: OperationalIntent
    drone: str

    @property
    def begin_s(self) -> float:
        """Start of the reservation in seconds since 1970 UTC."""
        return min(volume.begin_s for volume in self.intent.all_volumes)

    @property
    def end_s(self) -> float:
        """End of the reservation in seconds since 1970 UTC."""
        return max(volume.end_s for volume in self.intent.all_volumes)

    def merged(self, other: ReservedFlight) -> ReservedFlight:
        """Return a reservation that also has the volumes of another version of the same plan."""
        mine = self.intent
        theirs = other.intent
        intent = replace(
            mine,
            volumes=mine.volumes + tuple(each for each in theirs.volumes if each not in mine.volumes),
            off_nominal=mine.off_nominal + tuple(each for each in theirs.off_nominal if each not in mine.off_nominal),
        )
        return replace(self, intent=intent)


def reserved_flight(plan: FlightPlan) -> ReservedFlight | None:
    """Return what a plan reserves according to its status, or None.

    Raises:
        InvalidObject: A volume of the status is invalid.
    """
    status = plan.status
    if status is None or status.state not in RESERVING or status.drone is None:
        return None
    if plan.spec.dry_run and status.state == "Accepted":
        return None
    intent = intent_of(plan)
    return ReservedFlight(plan.metadata.uid or "", intent, status.drone) if intent.all_volumes else None


class FlightPlanIndex:
    """Reservations of flight plans by name, drone and uid.

    Args:
        on_change: Called with the key of each plan whose reservation changed, and its volumes before and after the change.

    Attributes:
        airspace: Operational intents of all plans.
    """

    def __init__(self, on_change: Callable[[Key, Sequence[Volume4D]], None] = lambda _key, _volumes: None) -> None:
        self.airspace = Airspace()
        self._on_change = on_change
        self._observed: dict[Key, ReservedFlight] = {}
        self._decided: dict[Key, ReservedFlight] = {}
        self._present: dict[Key, ReservedFlight] = {}
        self._by_drone: dict[str, dict[Key, tuple[str, Reservation]]] = {}
        """Uid and reservation of each plan, by drone."""
        self._keys: dict[tuple[str, str], Key] = {}
        """Keys of plans by namespace and uid."""
        self._uids: dict[Key, str] = {}

    def plan_changed(self, key: Key, plan: FlightPlan | None) -> None:
        """Handle a change of a plan. A plan is None if it was deleted."""
        before = self._observed.pop(key, None)
        self._keys.pop((key[0], self._uids.pop(key, "")), None)
        uid = plan.metadata.uid or "" if plan is not None else ""
        decided = self._decided.get(key)
        if decided is not None and decided.uid != uid:
            del self._decided[key]
        if plan is not None:
            self._keys[key[0], uid] = key
            self._uids[key] = uid
            try:
                reserved = reserved_flight(plan)
            except InvalidObject as error:
                log.warning(
                    "flight plans: invalid status, the last reservation stays (plan=%s/%s error=%s)", *key, error
                )
                reserved = before
            if reserved is not None:
                self._observed[key] = reserved
        self._update(key)

    def decide(self, key: Key, decided: ReservedFlight) -> None:
        """Reserve for a decision whose status is written next. Until `settle`, the observed reservation stays as well."""
        self._decided[key] = decided
        self._update(key)

    def settle(self, key: Key) -> None:
        """Drop the decision of a plan, because its status was stored or will never be."""
        if self._decided.pop(key, None) is not None:
            self._update(key)

    def get(self, key: Key) -> ReservedFlight | None:
        """Return what a plan reserves, or None."""
        return self._present.get(key)

    def key_of(self, namespace: str, uid: str) -> Key | None:
        """Return the key of the plan with a uid, or None."""
        return self._keys.get((namespace, uid))

    def of_application(self, application: Submitted) -> ReservedFlight | None:
        """Return what the flight plan of an Application reserves, or None for other Applications."""
        return self._present.get(self._keys.get((application.key[0], application.flight_plan_uid), ("", "")))

    def overlapping(self, key: Key, volumes: Sequence[Volume4D]) -> list[Key]:
        """Return the keys of other plans that overlap volumes of a plan."""
        return [_key(other.name) for other in self.airspace.overlapping(volumes, without="/".join(key))]

    def in_zones(self, zones: Iterable[Zone]) -> list[Key]:
        """Return the keys of the plans whose ground area overlaps one of some zones at any time and altitude."""
        try:
            volumes = [
                Volume4D.of_area(zone.spec.area, lower_m=-math.inf, upper_m=math.inf, begin_s=0.0, end_s=MAX_TIME_S)
                for zone in zones
            ]
        except InvalidObject:
            # An invalid or very large zone may concern every plan.
            return list(self._present)
        return [_key(other.name) for other in self.airspace.overlapping(volumes, without="")]

    def keys(self) -> list[Key]:
        """Return the keys of all plans with a reservation."""
        return list(self._present)

    def on_drone(self, drone: str) -> Iterator[tuple[Key, ReservedFlight]]:
        """Iterate over the reservations of a drone."""
        for key in sorted(self._by_drone.get(drone, ())):
            yield key, self._present[key]

    def reservations(self, without: str | None) -> Reservations:
        """Return the reservations by drone, without those of the plan with a uid. The result is valid until the next change."""
        return Reservations(self, without)

    def reservations_of(self, drone: str, without: str | None) -> list[Reservation]:
        """Return the reservations of a drone, without those of the plan with a uid.

        Raises:
            KeyError: No flight plan has reserved the drone.
        """
        return [reservation for uid, reservation in self._by_drone[drone].values() if uid != without]

    def reserved_drones(self) -> Collection[str]:
        """Return the names of the reserved drones."""
        return self._by_drone.keys()

    def _update(self, key: Key) -> None:
        observed = self._observed.get(key)
        new = self._decided.get(key, observed)
        if new is not None and observed is not None and new is not observed and new.uid == observed.uid:
            new = new.merged(observed)
        old = self._present.pop(key, None)
        if new is not None:
            self._present[key] = new
        if old == new:
            return
        name = "/".join(key)
        if old is not None:
            del self._by_drone[old.drone][key]
            if not self._by_drone[old.drone]:
                del self._by_drone[old.drone]
            self.airspace.remove(name)
        if new is not None:
            reservation = Reservation(name, new.begin_s, new.end_s)
            self._by_drone.setdefault(new.drone, {})[key] = new.uid, reservation
            self.airspace.put(new.intent)
        volumes = [volume for each in (old, new) if each is not None for volume in each.intent.all_volumes]
        self._on_change(key, volumes)


class Reservations(Mapping[str, Sequence[Reservation]]):
    """The reservations by drone, as one Application or flight plan sees them."""

    def __init__(self, index: FlightPlanIndex, without: str | None) -> None:
        self._index = index
        self._without = without

    def __getitem__(self, drone: str) -> Sequence[Reservation]:
        """Return the reservations of a drone.

        Raises:
            KeyError: No flight plan has reserved the drone.
        """
        return self._index.reservations_of(drone, self._without)

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names of the reserved drones."""
        return iter(self._index.reserved_drones())

    def __len__(self) -> int:
        """Return the number of reserved drones."""
        return len(self._index.reserved_drones())


def _key(name: str) -> Key:
    namespace, _, plan = name.partition("/")
    return namespace, plan
