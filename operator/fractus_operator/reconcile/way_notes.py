"""What policies say of the ways of plans in force, worked out in a thread: with many zones it takes a second each."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timedelta
from typing import NamedTuple

from fractus_core.api import Application, InvalidObject
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.planning.inventory import Inventory, Settings
from fractus_core.planning.legality import with_legality

from fractus_operator.cluster.kinds import Key
from fractus_operator.metrics import ERRORS, phase

logger = logging.getLogger(__name__)

JUDGED_AGAIN = timedelta(minutes=1)
"""How old it may be what the policies say of a way: zones and policies begin and end by the clock, too."""


class _Judged(NamedTuple):
    plan: DeploymentPlanSpec
    rules: int
    time: datetime
    noted: DeploymentPlanSpec


class WayNotes:
    """The newest notes of each application's plan; all of it can be lost.

    One thread works, and each application has at most one plan in its queue, so no tenant keeps the event loop from others.

    Args:
        wake: Called with the key of an application whose plan has new notes.
        clock: Wall-clock time.
    """

    def __init__(self, wake: Callable[[Key], None], clock: Callable[[], datetime]) -> None:
        self._wake = wake
        self._clock = clock
        self._judged: dict[Key, _Judged] = {}
        self._working: dict[Key, asyncio.Task[None]] = {}
        self._turn = asyncio.Semaphore(1)

    def noted(
        self,
        key: Key,
        application: Application,
        plan: DeploymentPlanSpec,
        *,
        rules: int,
        inventory: Inventory,
        settings: Settings,
    ) -> DeploymentPlanSpec:
        """A plan with what the policies say of its way, as far as that is known by now; what is not is worked out.

        Args:
            key: Namespace and name of the application.
            application: Whose plan it is.
            plan: In force.
            rules: The revision of what it is judged by: notes that were made by another one count for nothing.
            inventory: As of now.
            settings: Of the planning, with the time.
        """
        known = self._judged.get(key)
        if known is not None and known.rules == rules and (plan is known.plan or plan is known.noted):
            plan = known.noted
            if abs(self._clock() - known.time) < JUDGED_AGAIN:
                return plan
        if key not in self._working:
            arguments = (application, plan, _frozen(inventory, plan), settings)
            task = asyncio.create_task(self._work(key, rules, arguments))
            self._working[key] = task
            task.add_done_callback(lambda done: self._ended(key, done))
        return plan

    def put(self, key: Key, plan: DeploymentPlanSpec, rules: int) -> None:
        """Note a plan that was just made: what the policies say of its way is in it."""
        self._judged[key] = _Judged(plan, rules, self._clock(), plan)

    def forget(self, key: Key) -> None:
        """Drop what is known of an application that is gone."""
        self._judged.pop(key, None)
        task = self._working.pop(key, None)
        if task is not None:
            task.cancel()

    def _ended(self, key: Key, task: asyncio.Task[None]) -> None:
        if self._working.get(key) is task:
            del self._working[key]

    async def _work(
        self, key: Key, rules: int, arguments: tuple[Application, DeploymentPlanSpec, Inventory, Settings]
    ) -> None:
        plan, before = arguments[1], self._judged.get(key)
        async with self._turn:
            try:
                with phase("ways"):
                    noted = await asyncio.to_thread(with_legality, *arguments)
            except InvalidObject as error:
                # The application contradicts itself: planning says so.
                logger.info("way notes: not judged (application=%s/%s): %s", *key, error)
                noted = plan
            except Exception:
                # Noted, too: what failed is tried again when notes are due, not at each reconcile.
                ERRORS.count("ways", "Bug")
                logger.exception("way notes: not judged (application=%s/%s)", *key)
                noted = plan
        if self._judged.get(key) is not before:
            return  # another plan was made meanwhile
        self._judged[key] = _Judged(plan, rules, self._clock(), noted)
        if noted is not plan:
            self._wake(key)


def _frozen(inventory: Inventory, plan: DeploymentPlanSpec) -> Inventory:
    """What a way is judged by, copied: the inventory itself is good only until something is awaited."""
    node = plan.drone.node if plan.drone is not None else ""
    drone = inventory.drones.get(node)
    return replace(
        inventory,
        hosts={},
        drones={node: drone} if drone is not None else {},
        edge_nodes={},
        depots=dict(inventory.depots.items()),
        claimed={},
        flights={},
        locations=None,
    )
