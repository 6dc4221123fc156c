"""Cache of route checks: the policy engine judges the routes of active plans in a worker thread.

With many zones one check takes about a second and would block the event loop
(docs/decisions/0023-route-checks-in-a-worker-thread.md).
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timedelta
from functools import partial
from typing import NamedTuple

from fractus_core.api import Application, InvalidObject
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.planning.inventory import Inventory, Settings
from fractus_core.planning.legality import with_legality

from fractus_operator.kinds import Key
from fractus_operator.operator_metrics import ERRORS, phase

log = logging.getLogger(__name__)

MAX_AGE = timedelta(minutes=1)
"""Maximum age of a check. Zones and policies also begin and end at certain times."""


class _Check(NamedTuple):
    plan: DeploymentPlanSpec
    rules: int
    time: datetime
    result: DeploymentPlanSpec


class RouteCheckCache:
    """The latest check of each Application's plan. It may be lost, for example in a restart.

    One check runs at a time, and each Application has at most one waiting, so no tenant blocks the event loop.

    Args:
        wake: Called with the key of an Application whose plan has a new result.
        clock: Returns the current time.
    """

    def __init__(self, wake: Callable[[Key], None], clock: Callable[[], datetime]) -> None:
        self._wake = wake
        self._clock = clock
        self._checks: dict[Key, _Check] = {}
        self._running: dict[Key, asyncio.Task[None]] = {}
        self._one_check = asyncio.Semaphore(1)

    def checked(
        self,
        key: Key,
        application: Application,
        plan: DeploymentPlanSpec,
        *,
        rules: int,
        inventory: Inventory,
        settings: Settings,
    ) -> DeploymentPlanSpec:
        """Return a plan with the latest result of its check. If there is no result or it is too old, start a check.

        Args:
            key: Key of the Application.
            application: The Application.
            plan: Its active plan.
            rules: Revision of the rules. Results of another revision are not used.
            inventory: The current inventory.
            settings: Settings of planning, with the current time.
        """
        known = self._checks.get(key)
        if known is not None and known.rules == rules and (plan is known.plan or plan is known.result):
            plan = known.result
            if abs(self._clock() - known.time) < MAX_AGE:
                return plan
        if key not in self._running:
            check = partial(with_legality, application, plan, _copied(inventory, plan), settings)
            task = asyncio.create_task(self._check(key, rules, plan, check))
            self._running[key] = task
            task.add_done_callback(lambda done: self._ended(key, done))
        return plan

    def put(self, key: Key, plan: DeploymentPlanSpec, rules: int) -> None:
        """Add a new plan, which planning has just checked."""
        self._checks[key] = _Check(plan, rules, self._clock(), plan)

    def forget(self, key: Key) -> None:
        """Drop the result of a deleted Application."""
        self._checks.pop(key, None)
        task = self._running.pop(key, None)
        if task is not None:
            task.cancel()

    def _ended(self, key: Key, task: asyncio.Task[None]) -> None:
        if self._running.get(key) is task:
            del self._running[key]

    async def _check(
        self,
        key: Key,
        rules: int,
        plan: DeploymentPlanSpec,
        check: Callable[[], DeploymentPlanSpec],
    ) -> None:
        before = self._checks.get(key)
        async with self._one_check:
            try:
                with phase("routes"):
                    result = await asyncio.to_thread(check)
            except InvalidObject as error:
                # The plan stays unchecked. Planning reports the error in the status of the Application.
                log.info("route checks: route not checked (application=%s/%s error=%s)", *key, error)
                result = plan
            except Exception:
                # The failure is cached as well, so that the check is repeated after MAX_AGE and not at once.
                ERRORS.labels("routes", "Bug").inc()
                log.exception("route checks: check failed (application=%s/%s)", *key)
                result = plan
        if self._checks.get(key) is not before:
            return  # the check of a newer plan was stored meanwhile
        self._checks[key] = _Check(plan, rules, self._clock(), result)
        if result is not plan:
            self._wake(key)


def _copied(inventory: Inventory, plan: DeploymentPlanSpec) -> Inventory:
    """Copy the inputs of a check for the thread. The inventory itself is valid only until the next await."""
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
