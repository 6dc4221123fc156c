"""The service behind Applications: observe, decide, apply the difference; report it, and take it all down at the end."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta

from fractus_core.api import Application, InvalidObject
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.identity.authority import Authority
from fractus_core.identity.grant_signer import GrantSigner
from fractus_core.planning.inventory import Inventory, Settings
from fractus_core.planning.planner import Infeasible
from fractus_core.validation import check_application

from fractus_operator.cluster import kinds
from fractus_operator.cluster.kinds import Key
from fractus_operator.cluster.labels import FINALIZER
from fractus_operator.cluster.pods import refusals
from fractus_operator.cluster.reading import SETTLED, Submitted
from fractus_operator.cluster.store import Backoff, KubeError, Store
from fractus_operator.inventory.live import LiveInventory
from fractus_operator.inventory.observed import Observed
from fractus_operator.metrics import phase as timed
from fractus_operator.metrics import reconciling
from fractus_operator.reconcile import status
from fractus_operator.reconcile.children import Children, NameTaken
from fractus_operator.reconcile.contention import planning_input
from fractus_operator.reconcile.finished_pods import FinishedPods
from fractus_operator.reconcile.flight_status import flight
from fractus_operator.reconcile.grants import REFUSALS, ApplicationGrants
from fractus_operator.reconcile.missions import mission_outcome
from fractus_operator.reconcile.replanning import (
    choose_plan,
    flown_generation,
    mission_changed,
    present_plan,
    stuck_nodes,
    waits_for_landing,
)
from fractus_operator.reconcile.reporting import StatusReporter
from fractus_operator.reconcile.rollout import Rollout
from fractus_operator.reconcile.shared_flights import shared_flight_outcome
from fractus_operator.reconcile.status import Blocked, Phase, StatusUpdate
from fractus_operator.reconcile.way_notes import WayNotes

logger = logging.getLogger(__name__)

RESYNC_S = 30.0
_BACKOFF_S = (1.0, 30.0)
_MAX_REST_S = 1.0
_REST_FACTOR = 2.0
"""After a reconcile the next one waits this many times as long as that took: where many are busy, each runs less often."""

EXCLUSION = timedelta(minutes=5)
"""How long a node that the scheduler refused is left out of an application's plans."""

_RIGHTS = (kinds.GRANT, kinds.DIRECT_LINK)
_BESIDE_PODS = (
    kinds.DISRUPTION_BUDGET,
    kinds.ENDPOINT_SLICE,
    kinds.NETWORK_POLICY,
    kinds.SERVICE,
)
"""What is removed when a mission is over: first rights, then what runs, then the rest. The plan stays, as its record."""


class BeingDeleted(Exception):
    """The application is being deleted: there is nothing more to reconcile."""


@dataclass
class _Memory:
    """What is remembered of one application between reconciles; all of it can be lost."""

    lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    excluded: dict[str, tuple[datetime, str]] = field(default_factory=dict)
    checked: tuple[object, ...] = ()

    def check(self, application: Application, inventory: Inventory, rules: int) -> None:
        """Check an application, once for each of its generations and each revision of the rules, depots included.

        Raises:
            InvalidObject: it names unknown depots, or has broken regions.
        """
        revision = (application.metadata.uid, application.metadata.generation, rules)
        if self.checked != revision:
            check_application(application, inventory.depots)
            self.checked = revision

    def exclude(self, stuck: dict[str, str], now: datetime) -> dict[str, str]:
        """Leave nodes out of plans for a while; returns all that are, with the reason."""
        self.excluded = {node: (until, why) for node, (until, why) in self.excluded.items() if until > now}
        self.excluded |= {node: (now + EXCLUSION, why) for node, why in stuck.items()}
        return {node: why for node, (_, why) in self.excluded.items()}


class Applications:
    """Brings every Application to where its spec, the inventory and its mission want it."""

    def __init__(
        self,
        store: Store,
        live: LiveInventory,
        authority: Authority,
        clock: Callable[[], datetime],
        settings: Settings | None = None,
    ) -> None:
        self._live = live
        self._clock = clock
        self._settings = settings or Settings()
        signer = GrantSigner(authority, clock)
        self._children = Children(store, live.children, signer)
        self._grants = ApplicationGrants(live, self._children, signer, self._settings)
        self._finished_pods = FinishedPods(store, live, self._children, clock)
        self._rollout = Rollout(self._children, live, authority, clock)
        self._reporter = StatusReporter(store, live.applications, clock)
        self._notes = WayNotes(live.subscriptions.wake, clock)
        self._memories: dict[Key, _Memory] = {}

    async def follow(self, key: Key, stopped: Callable[[], bool]) -> None:
        """Reconcile an application whenever one of its inputs changes, until it is deleted."""
        backoff = Backoff(*_BACKOFF_S)
        loop = asyncio.get_running_loop()
        await self._live.synced()
        with self._live.subscriptions.subscribe(key) as inputs:
            while not stopped():
                started = loop.time()
                try:
                    with reconciling("application"):
                        try:
                            next_s = await self.reconcile(key)
                        except BeingDeleted:
                            return  # inside: this is no failure to count
                    backoff.succeeded()
                except KubeError as error:
                    next_s = backoff.delay_s()
                    logger.warning(
                        "applications: reconcile failed (application=%s/%s retry_s=%.1f): %s", *key, next_s, error
                    )
                    await self._reporter.failed(self._live.applications.get(key), backoff.attempts, error)
                took_s = loop.time() - started
                if await inputs.changed(next_s):
                    # Changes come in bursts, such as the pods of a plan: one reconcile for all. What a user applies does not wait.
                    await inputs.rest(min(_REST_FACTOR * took_s, _MAX_REST_S))

    async def reconcile(self, key: Key) -> float:
        """Go one step towards the desired state; safe to be killed at any point and to run again.

        Returns:
            In how many seconds to run again if nothing changes before.

        Raises:
            BeingDeleted: the application is being deleted.
            KubeError: the API server refused a write, or could not be reached.
        """
        submitted = self._live.applications.get(key)
        if submitted is None:
            return RESYNC_S
        metadata = submitted.metadata
        if metadata.deletion_timestamp:
            raise BeingDeleted
        # Without the finalizer nothing is made: a deletion now would leave grants behind.
        if FINALIZER not in metadata.finalizers:
            return RESYNC_S
        memory = self._memories.setdefault(key, _Memory())
        async with memory.lock:
            if metadata.uid == self._live.torn_down.get(key):
                raise BeingDeleted
            return min(await self._advance(self._live.observe(submitted), memory), RESYNC_S)

    async def teardown(self, key: Key, uid: str) -> None:
        """Revoke every grant of an application that is being deleted, then remove what was made for it.

        The drone is brought home by its own services once its grant is gone. What a stale watch hides
        here, the garbage collector finds by its owner; pods that have none are looked for.

        Raises:
            KubeError: the API server refused a delete, or could not be reached.
        """
        await self._live.synced()
        self._live.torn_down[key] = uid
        memory = self._memories.setdefault(key, _Memory())
        async with memory.lock:
            await self._children.revoke(key)
            await self._finished_pods.tear_down(key)
        self._memories.pop(key, None)
        for part in (self._grants, self._notes, self._reporter, self._rollout, self._live):
            part.forget(key)

    # -- steps --

    async def _advance(self, seen: Observed, memory: _Memory) -> float:
        """One step; returns when to run again."""
        submitted = seen.submitted
        self._live.subscriptions.placed(seen.key, placed=False)
        again_s = await self._settle(seen)
        if again_s is not None:
            return again_s
        outcome = mission_outcome(seen.uid, seen.grants) or shared_flight_outcome(seen.plan, *seen.host)
        if outcome is not None:
            # Reported before anything is removed: the grants are the only other record of it.
            flown = seen.plan.drone if seen.plan is not None else None
            name = flown.node if flown is not None else self._reporter.last(submitted).get("drone")
            drone = self._live.drone(name) if name is not None else None
            update = status.finished(outcome, name, drone, seen.pods)
            await self._reporter.report(submitted, update, flown_generation(submitted.application, seen.plan))
            await self._finish(submitted)
            return RESYNC_S
        present = self._present(seen)
        try:
            await self._grants.refresh(seen)
            update, again_s = await self._deploy(self._live.observe(submitted), memory)
        except Blocked as blocked:
            # Before anything is awaited: what another application leaves from now on is a reason to look again.
            self._live.subscriptions.placed(seen.key, placed=False, full=blocked.full)
            await self._reporter.report(submitted, status.blocked(blocked, present))
            if seen.plan is not None:
                await self._rollout.keep_running(seen.key, submitted.application, seen.plan, seen.pods)
            return blocked.retry_s
        await self._reporter.report(submitted, update)
        return again_s

    async def _settle(self, seen: Observed) -> float | None:
        """Where the mission is over, remove what is left of it; returns when to run again, None to go on with a new one."""
        reported = self._reporter.last(seen.submitted)
        if reported.get("phase") not in SETTLED:
            return None
        submitted, application = seen.submitted, seen.submitted.application
        known = reported.get("observedGeneration") == submitted.metadata.generation
        flown = self._live.plans.last(seen.key, seen.uid)
        # What cannot be read says of no other mission: the record of this one stays until something can be.
        same = seen.plan is None and (application is None or not mission_changed(application, flown))
        if known or same:
            again_s = await self._finish(submitted) if seen.plan is None else RESYNC_S
            if known and seen.plan is None and application is not None and flown is not None:
                await self._rollout.keep(application, flown)
            if reported["phase"] == "Returning" or not known:
                # A drone that has come home may fly for another by now.
                drone = self._live.drone(reported.get("drone") or "") if reported["phase"] == "Returning" else None
                await self._reporter.report(submitted, status.still_over(reported, drone))
            return again_s
        if seen.plan is not None:
            return None
        # An old plan neither claims its drone for the next mission nor excuses it from any check.
        left_over = await self._begin_again(seen.key)
        return 1.0 if left_over else None  # The last mission's grants must be gone before a new one begins.

    async def _deploy(self, seen: Observed, memory: _Memory) -> tuple[StatusUpdate, float]:
        """Plan, compile and roll out; nothing is awaited between reading the inventory and the decision.

        So two applications never get one drone.

        Raises:
            Blocked: it cannot go on for now.
            KubeError: the API server cannot be reached.
        """
        with timed("observe"):
            inventory, lost = planning_input(self._live, seen, self._settings.safety_radius_m)
        if lost is not None:
            await self._begin_again(seen.key)
            raise Blocked("Queued", "Planned", *lost, retry_s=1.0)
        application = seen.submitted.application
        if application is None:
            raise Blocked("Invalid", "Planned", "Invalid", str(seen.submitted.error))
        if seen.plan is not None and waits_for_landing(application, seen.plan, seen.in_flight):
            await self._rollout.renew_certificates(application, seen.plan, seen.pods)
            await self._rollout.follow_pods(seen.key, seen.plan, seen.pods)
            return status.waiting(self._deployed(seen, seen.plan, len(seen.grants)), seen.in_flight or ""), RESYNC_S
        try:
            memory.check(application, inventory, seen.rules)
            with timed("plan"):
                plan, again_s = self._plan(application, seen, inventory, memory)
        except InvalidObject as error:
            raise Blocked("Invalid", "Planned", "Invalid", str(error)) from error
        except Infeasible as none:
            phase: Phase = "Queued" if none.reason == "DroneBusy" else "Pending"
            raise Blocked(phase, "Planned", none.reason, none.message, full=none.full) from none
        try:
            with timed("grants"):
                grants = self._grants.compile(application, plan, seen, inventory)
        except InvalidObject as error:
            raise Blocked("Pending", "Granted", "PolicyInvalid", str(error)) from error
        await self._reporter.planned(seen.submitted, plan, self._rollout.under_way)
        try:
            with timed("rollout"):
                complete = await self._rollout.carry_out(application, plan, grants, seen.pods, seen.rules)
        except NameTaken as error:
            raise Blocked("Pending", "Deployed", "NameTaken", str(error), retry_s=2.0) from error
        except KubeError as error:
            if error.status not in REFUSALS:
                raise
            raise Blocked("Pending", "Deployed", error.reason, str(error), retry_s=10.0) from error
        return self._deployed(seen, plan, len(grants)), again_s if complete else 0.0

    def _plan(
        self, application: Application, seen: Observed, inventory: Inventory, memory: _Memory
    ) -> tuple[DeploymentPlanSpec, float]:
        """The plan to deploy, noted at once where it is new; and when to run again."""
        now = self._clock()
        stuck, recheck_s = stuck_nodes(seen.plan, seen.pods, now)
        stuck = {node: why for node, why in stuck.items() if node != seen.in_flight}
        settings = replace(self._settings, excluded=memory.exclude(stuck, now), time_s=now.timestamp())
        present = known = present_plan(application, seen.plan)
        if present is not None:
            present = self._notes.noted(
                seen.key, application, present, rules=seen.rules, inventory=inventory, settings=settings
            )
        choice = choose_plan(application, present, inventory, settings, stuck=stuck, in_flight=seen.in_flight)
        self._live.subscriptions.placed(seen.key, placed=choice.suits, full=choice.full)
        drone = choice.plan.drone
        if choice.plan is not seen.plan:
            self._live.plans.decide(seen.key, seen.uid, choice.plan)
        if choice.plan is not known:
            why, node = choice.reason or "PoliciesChanged", drone.node if drone is not None else "none"
            logger.info("applications: planned (application=%s/%s reason=%s drone=%s)", *seen.key, why, node)
        if choice.reason is not None:
            self._notes.put(seen.key, choice.plan, seen.rules)
        return choice.plan, (recheck_s or RESYNC_S) if choice.fits else RESYNC_S

    async def _begin_again(self, key: Key) -> bool:
        """Remove all that was made for an application, with its plan; True if there was anything."""
        removed = await self._children.remove(key, *_RIGHTS, kinds.DEPLOYMENT, *_BESIDE_PODS, kinds.DEPLOYMENT_PLAN)
        pods = await self._finished_pods.remove(key)
        self._live.forget(key)
        return removed or pods

    async def _finish(self, submitted: Submitted) -> float:
        """Remove what a mission leaves, but the plan, and its pods for as long as they are kept; returns when to run again."""
        key = submitted.key
        removed = await self._children.remove(key, *_RIGHTS) | await self._finished_pods.stop(submitted)
        if removed | await self._children.remove(key, *_BESIDE_PODS):
            self._live.forget(key)
        return min(await self._finished_pods.expire(submitted), RESYNC_S)

    def _present(self, seen: Observed) -> StatusUpdate | None:
        """What is deployed by the plan in force, if anything."""
        if seen.plan is None or not self._children.of(seen.key, kinds.DEPLOYMENT):
            return None
        return self._deployed(seen, seen.plan, 0)

    def _deployed(self, seen: Observed, plan: DeploymentPlanSpec, granted: int) -> StatusUpdate:
        node = plan.drone.node if plan.drone is not None else None
        reported = self._reporter.last(seen.submitted)
        flown = flight(node, self._live.drone(node), reported) if node is not None else None
        return status.deployed(plan, seen.pods, granted, flown, refusals(self._children.of(seen.key, kinds.DEPLOYMENT)))
