"""Operational intents of all flight plans, with an index of their volumes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from fractus_core.airspace.lifecycle import RESERVING
from fractus_core.airspace.volumes import TOLERANCE_M, Overlap, Volume4D, outlines_in_frame
from fractus_core.api.flight_plans import PlanState

_INITIAL_SLOTS = 64


@dataclass(frozen=True, slots=True)
class OperationalIntent:
    """A flight plan as other flight plans see it (ASTM F3548).

    Attributes:
        name: Unique name of the plan, such as namespace/name.
        state: State of the plan.
        priority: A plan may overlap plans of lower priority.
        volumes: Volumes in which the flight intends to stay.
        off_nominal: Volumes in which the drone may be because it does not keep to the plan.
    """

    name: str
    state: PlanState
    priority: int = 0
    volumes: tuple[Volume4D, ...] = ()
    off_nominal: tuple[Volume4D, ...] = ()

    @property
    def all_volumes(self) -> tuple[Volume4D, ...]:
        """All volumes, which other plans must avoid."""
        return self.volumes + self.off_nominal


class Airspace:
    """The operational intents that use airspace, with an index of their volumes.

    The index is a table of the bounds of all volumes. Each volume is represented by a sphere around its ground area, so the
    antimeridian and the poles need no special cases. A search compares all rows with numpy and then tests the few
    remaining volumes exactly: O(n) with about 0.1 ms for 10,000 volumes. A tree would have to be built again after each
    accepted plan, which takes longer.
    """

    def __init__(self, intents: Iterable[OperationalIntent] = ()) -> None:
        self._intents: dict[str, OperationalIntent] = {}
        self._slots: dict[str, list[int]] = {}
        self._free: list[int] = []
        self._names: list[str] = []
        self._outlines: NDArray[np.object_] = np.empty(_INITIAL_SLOTS, dtype=object)
        # Rows: begin, end, lower, upper, reach, x, y, z. The NaN of free slots fails every comparison.
        self._bounds: NDArray[np.float64] = np.full((8, _INITIAL_SLOTS), np.nan)
        for intent in intents:
            self.put(intent)

    def __len__(self) -> int:
        """Number of operational intents."""
        return len(self._intents)

    def __getitem__(self, name: str) -> OperationalIntent:
        """Return the operational intent with a name.

        Raises:
            KeyError: No operational intent of this name uses airspace.
        """
        return self._intents[name]

    def put(self, intent: OperationalIntent) -> None:
        """Add an operational intent, or replace the one of the same name. A state that uses no airspace removes it."""
        self.remove(intent.name)
        if intent.state not in RESERVING:
            return
        self._intents[intent.name] = intent
        self._slots[intent.name] = [self._store(intent.name, volume) for volume in intent.all_volumes]

    def remove(self, name: str) -> None:
        """Remove an operational intent. An unknown name is ignored."""
        self._intents.pop(name, None)
        for slot in self._slots.pop(name, ()):
            self._bounds[:, slot] = np.nan
            self._outlines[slot] = None
            self._free.append(slot)

    def overlapping(self, volumes: Sequence[Volume4D], without: str) -> list[OperationalIntent]:
        """Return the operational intents with a volume that overlaps one of the given volumes, in the order of their names.

        Args:
            volumes: Volumes to compare.
            without: Name of the plan that the volumes belong to. Its own earlier version is ignored.
        """
        names: set[str] = set()
        for volume in volumes:
            slots = self._near(volume)
            own = volume.in_frame(volume.frame)
            shapely.prepare(own)
            close = shapely.dwithin(own, outlines_in_frame(volume.frame, self._outlines[slots]), TOLERANCE_M)
            names.update(self._names[slot] for slot in slots[close].tolist())
        return [self._intents[name] for name in sorted(names - {without})]

    def _near(self, volume: Volume4D) -> NDArray[np.int64]:
        """Return the slots of volumes that may overlap a volume."""
        begin, end, lower, upper, reach = self._bounds[:5]
        slots = np.flatnonzero((begin <= volume.end_s) & (end >= volume.begin_s))
        slots = slots[(lower[slots] <= volume.upper_m + TOLERANCE_M) & (upper[slots] >= volume.lower_m - TOLERANCE_M)]
        away = np.linalg.norm(self._bounds[5:, slots] - np.array(volume.center)[:, None], axis=0)
        near: NDArray[np.int64] = slots[away <= reach[slots] + volume.reach_m]
        return near

    def _store(self, name: str, volume: Volume4D) -> int:
        if self._free:
            slot = self._free.pop()
            self._names[slot] = name
        else:
            slot = len(self._names)
            self._names.append(name)
            if slot >= len(self._outlines):
                self._outlines = np.concatenate((self._outlines, np.empty(slot, dtype=object)))
                self._bounds = np.concatenate((self._bounds, np.full((8, slot), np.nan)), axis=1)
        self._outlines[slot] = volume.outline
        self._bounds[:, slot] = (
            volume.begin_s, volume.end_s, volume.lower_m, volume.upper_m, volume.reach_m, *volume.center,
        )  # fmt: skip
        return slot


def first_overlap(volumes: Sequence[Volume4D], others: Sequence[Volume4D]) -> Overlap | None:
    """Return the earliest part that two groups of volumes share, or None if they are apart."""
    shared = [part for volume in volumes for other in others if (part := volume.overlap(other)) is not None]
    return min(shared, key=lambda part: part.begin_s, default=None)
