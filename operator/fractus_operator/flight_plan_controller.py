"""Controller of FlightPlans: carries out their steps one after another, and reports their status."""

from __future__ import annotations

import asyncio
import logging
import math
import random
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime

from fractus_core.api import Application, Drone, FlightPlan
from fractus_core.api.conditions import ConditionUpdate, merge_conditions
from fractus_core.api.flight_plans import FlightPlanStatus, application_name
from fractus_core.api.plans import MissionRecord
from fractus_core.planning.inventory import Settings

from fractus_operator import kinds
from fractus_operator.cache import ClusterCache
from fractus_operator.flight_matching import SOON_S
from fractus_operator.flight_plan_index import reserved_flight
from fractus_operator.flight_plan_steps import FLYING, RECHECK_S, STARTED, PlanSituation, PlanStep, plan_step
from fractus_operator.flight_progress import FlownMission
from fractus_operator.kinds import Body, Key
from fractus_operator.labels import FINALIZER, LANDING_FINALIZER
from fractus_operator.parsing import Submitted, Unreadable, parse_application, parse_object
from fractus_operator.status_reporter import create_events, transition_events
from fractus_operator.store import Conflict, ContentType, KubeError, NotFound, Store
from fractus_operator.work_queue import WorkQueue

log = logging.getLogger(__name__)

DRY_RUN_S = 60.0
"""Seconds for which a dry run is kept."""

LATER_S = 3600.0
"""Seconds until the window of an accepted plan from which other plans come first. It is much longer than the steps of 10,000
plans, so no plan starts late."""


class FlightPlanController:
    """Decides FlightPlans one after another, creates and deletes their Applications, and follows their flights.

    There is no await between reading the inventory and the airspace, the decision, and its reservation. Everything is derived
    from observed objects, so an operator that was killed between two writes continues:

    1. The status Activated is stored. It reserves drone and airspace.
    2. The Application is created. Its name contains the uid of the plan, so it exists at most once.
    3. The condition Started is stored. Afterwards the Application is never created again.

    Attributes:
        work_queue: Queue of plans. The caller runs it.
    """

    def __init__(
        self, store: Store, cache: ClusterCache, clock: Callable[[], datetime], settings: Settings | None = None
    ) -> None:
        self.work_queue = WorkQueue("flight plan", self.reconcile, after=cache.synced)
        self._store = store
        self._cache = cache
        self._clock = clock
        self._settings = settings or Settings()
        self._timers: dict[Key, asyncio.TimerHandle] = {}
        self._seen: set[str] = set()
        """Uids of plans whose Applications this process has observed."""
        self._judge_at: dict[Key, float] = {}
        """Monotonic time at which the policies of an accepted plan are judged again; infinite: when they change."""

    # -- changes of inputs --

    def changed(self, key: Key) -> None:
        """Handle a change of a plan, or of a plan that overlaps it."""
        self._queue(key)

    def rules_changed(self, key: Key) -> None:
        """Handle a change of policies or zones at the place of a plan."""
        # Many policies may change before a plan is judged.
        if self._judge_at.get(key) != 0.0:
            self._judge_at[key] = 0.0
            self._queue(key)

    def application_changed(self, key: Key) -> None:
        """Handle a change of an Application or of its DeploymentPlan."""
        submitted = self._cache.applications.get(key)
        uid = key[1].removeprefix(application_name(""))
        if submitted is not None and _owned_by(submitted, uid):
            self._seen.add(uid)
        plan = self._cache.flights.key_of(key[0], uid)
        if plan is not None:
            self.work_queue.add(plan)

    def drone_changed(self, key: Key) -> None:
        """Handle a change of a drone. Plans that begin later are only matched again if the drone was deleted."""
        now_s = self._clock().timestamp()
        missing = self._cache.drone(key[1]) is None
        for plan, reserved in self._cache.flights.on_drone(key[1]):
            if missing or reserved.intent.state in FLYING or reserved.begin_s - SOON_S <= now_s:
                self.work_queue.add(plan)

    def _queue(self, key: Key) -> None:
        self.work_queue.add(key, can_wait=self._can_wait(key))

    def _can_wait(self, key: Key) -> bool:
        """Return True if other plans come first: the plan is decided and unchanged, and flies later or not at all."""
        plan = self._cache.flight_plans.get(key)
        if not isinstance(plan, FlightPlan) or plan.status is None or plan.spec.use == "Closed":
            return False
        if plan.metadata.deletion_timestamp is not None or plan.status.observed_generation != plan.metadata.generation:
            return False
        later = plan.spec.window.begin_s - LATER_S > self._clock().timestamp()
        return plan.status.state in {"Rejected", "Ended"} or (plan.status.state == "Accepted" and later)

    # -- steps --

    async def reconcile(self, key: Key) -> None:
        """Take the next step of one plan. If the operator is killed at any point, the step can be repeated.

        Raises:
            KubeError: The API server refused a write, or could not be reached.
        """
        timer = self._timers.pop(key, None)
        if timer is not None:
            timer.cancel()
        plan = self._cache.flight_plans.get(key)
        if plan is None or isinstance(plan, Unreadable):
            self._judge_at.pop(key, None)
            return
        now = self._clock()
        if plan.spec.dry_run and await self._expire(plan, now):
            return
        loop = asyncio.get_running_loop()
        # Policies may have changed while no operator ran. Plans are judged again one by one, so that new plans need not wait.
        spread_s = random.uniform(0, RECHECK_S)  # noqa: S311 (a time, not a secret)
        judge_at_s = self._judge_at.setdefault(key, loop.time() + spread_s)
        judge = judge_at_s <= loop.time()
        if judge:
            # Before the first await, so that a change during the writes is judged by the next step.
            self._judge_at[key] = math.inf
        try:
            await self._carry_out(key, plan, now, judge=judge)
        except BaseException:
            self._judge_at[key] = min(judge_at_s, self._judge_at.get(key, math.inf))
            raise

    async def _carry_out(self, key: Key, plan: FlightPlan, now: datetime, *, judge: bool) -> None:
        """Take the next step of a plan, and start the timer of the step after it.

        Raises:
            KubeError: The API server refused a write, or could not be reached.
        """
        step = plan_step(self._situation(plan, now, rules_changed=judge))
        reserved = reserved_flight(plan.model_copy(update={"status": step.status}))
        if reserved is not None:
            self._cache.flights.decide(key, reserved)
        try:
            if step.status.state in FLYING:
                await self._set_finalizer(plan, wanted=True)
            await self._report(plan, step, now)
        except KubeError as error:
            if 400 <= error.status < 500:
                self._cache.flights.settle(key)
            raise
        self._cache.flights.settle(key)
        if step.start is not None:
            await self._start(plan, step.start)
        if step.end:
            await self._store.delete(kinds.APPLICATION, (key[0], application_name(plan.metadata.uid or "")))
        if step.status.state not in FLYING:
            await self._set_finalizer(plan, wanted=False)
        loop = asyncio.get_running_loop()
        wait_s = min(step.next_s, max(self._judge_at.get(key, math.inf) - loop.time(), 0.0))
        if plan.spec.dry_run:
            wait_s = min(wait_s, DRY_RUN_S)
        self._timers[key] = loop.call_later(wait_s, self._queue, key)

    def _situation(self, plan: FlightPlan, now: datetime, *, rules_changed: bool) -> PlanSituation:
        now_s = now.timestamp()
        template = self._cache.templates.get(("", plan.spec.template))
        original = None
        if plan.spec.change_of is not None:
            found = self._cache.flight_plans.get((plan.metadata.namespace or "", plan.spec.change_of))
            original = found if isinstance(found, FlightPlan) else None
        own = original or plan
        return PlanSituation(
            plan,
            template,
            lambda: self._cache.flight_inventory(plan, now_s, own.metadata.uid),
            self._settings,
            self._cache.flights.airspace,
            self._mission(own),
            now_s,
            original,
            rules_changed,
        )

    def _mission(self, plan: FlightPlan) -> FlownMission:
        """Return the Application of a plan, as observed."""
        status = plan.status or FlightPlanStatus()
        uid = plan.metadata.uid or ""
        key = (plan.metadata.namespace or "", application_name(uid))
        submitted = self._cache.applications.get(key)
        if submitted is not None and not _owned_by(submitted, uid):
            submitted = None
        recorded = any(each.type == STARTED and each.status == "True" for each in status.conditions)
        mission = FlownMission(started=submitted is not None or recorded or uid in self._seen)
        record = None
        if submitted is not None:
            planned = self._cache.plans.latest(key, submitted.uid)
            record = planned.flown if planned is not None else None
            application = submitted.application
            mission = replace(
                mission,
                exists=True,
                leaving=submitted.metadata.deletion_timestamp is not None,
                digest=application.spec.mission_digest if application is not None else None,
                record=record,
            )
        drone = self._cache.drone(status.drone or "")
        reported = drone.status if drone is not None else None
        home = drone.spec.home if drone is not None else None
        landed = record is not None and record.landed
        return replace(
            mission,
            drone_exists=drone is not None,
            in_air=status.drone is not None and self._cache.fleet.is_in_flight(status.drone) and not landed,
            lost=not landed and (drone is None or not (drone.in_air or drone.on_ground)),
            unreported=drone is not None and self._unreported(drone, key, record),
            position=reported.position if reported is not None else None,
            home_m=home.alt if home is not None else None,
        )

    def _unreported(self, drone: Drone, application: Key, record: MissionRecord | None) -> bool:
        """Return True if a drone may have taken off for an Application since its last report."""
        if record is not None and record.outcome == "Complete" and record.landed:
            return False
        claim = self._cache.fleet.claims().get(drone.name)
        return drone.may_take_off and (claim is None or claim.key == application)

    async def _expire(self, plan: FlightPlan, now: datetime) -> bool:
        """Delete a dry run that is old enough. Return True if it was deleted."""
        created = plan.metadata.creation_timestamp
        if created is None or plan.status is None or (now - created).total_seconds() < DRY_RUN_S:
            return False
        if plan.status.state in FLYING:
            return False
        await self._store.delete(kinds.FLIGHT_PLAN, (plan.metadata.namespace or "", plan.name), plan.metadata.uid)
        return True

    # -- writes --

    async def _report(self, plan: FlightPlan, step: PlanStep, now: datetime) -> None:
        """Write the status of a plan if it changed, and then an Event for each transition.

        Raises:
            KubeError: The API server refused the status, or could not be reached.
        """
        before = plan.status.conditions if plan.status is not None else ()
        conditions, transitions = merge_conditions(before, step.conditions, plan.metadata.generation, now)
        status = step.status.model_copy(update={"conditions": conditions})
        if status == plan.status:
            return
        key = (plan.metadata.namespace or "", plan.name)
        header = kinds.FLIGHT_PLAN.header(plan.name, key[0], uid=plan.metadata.uid)
        body: Body = {**header, "status": status.to_dict()}
        applied = await self._store.apply(kinds.FLIGHT_PLAN, body, subresource="status")
        # The status is stored, so its reservation must remain even if the next write fails.
        self._cache.flight_plans.record_write(key, applied)
        if parse_object(FlightPlan, applied).status != status:
            # An apply does not remove fields of other writers, such as volumes that a user added.
            applied = await self._store.replace_status(kinds.FLIGHT_PLAN, applied, status.to_dict())
            self._cache.flight_plans.record_write(key, applied)
        log.info("flight plans: status written (plan=%s/%s state=%s)", *key, status.state)
        await create_events(self._store, header, transition_events(transitions), now)

    async def _start(self, plan: FlightPlan, application: Application) -> None:
        """Create the Application of a plan, and report a failure by an Event.

        Raises:
            KubeError: The API server refused the Application, or another Application has its name.
        """
        key = (plan.metadata.namespace or "", plan.name)
        try:
            created = await self._create(application, plan)
        except KubeError as error:
            failed = ConditionUpdate(STARTED, "False", error.reason, f"the Application is not created: {error}")
            header = kinds.FLIGHT_PLAN.header(plan.name, key[0], uid=plan.metadata.uid)
            await create_events(self._store, header, [failed], self._clock())
            raise
        log.info("flight plans: Application created (plan=%s/%s application=%s)", *key, application.name)
        self._seen.add(plan.metadata.uid or "")
        self._cache.applications.record_write((key[0], application.name), created)
        self.work_queue.add(key)

    async def _create(self, application: Application, plan: FlightPlan) -> Body:
        """Create the Application of a plan, or return the one that exists.

        The Application gets the finalizer of Applications at once, so that its deletion is always observed.
        """
        body = application.to_dict()
        body["metadata"]["finalizers"] = [FINALIZER]
        try:
            return await self._store.create(kinds.APPLICATION, body)
        except Conflict:
            existing = await self._store.get(kinds.APPLICATION, application.name, plan.metadata.namespace or "")
        present = parse_application(existing)
        digest = present.application.spec.mission_digest if present.application is not None else None
        if not _owned_by(present, plan.metadata.uid or "") or digest != application.spec.mission_digest:
            message = (
                f"Application {application.name} exists, but is not the flight of FlightPlan {plan.name}; delete it"
            )
            raise KubeError(409, "NameTaken", message)
        return existing

    async def _set_finalizer(self, plan: FlightPlan, *, wanted: bool) -> None:
        """Add the finalizer of flying plans to a plan, or remove it."""
        key = (plan.metadata.namespace or "", plan.name)
        present = self._cache.flight_plans.get(key)
        if present is None or isinstance(present, Unreadable):
            return
        finalizers = present.metadata.finalizers
        has = LANDING_FINALIZER in finalizers
        if has == wanted or (wanted and present.metadata.deletion_timestamp is not None):
            return
        kept = [each for each in finalizers if each != LANDING_FINALIZER]
        changes = {
            "finalizers": [*kept, LANDING_FINALIZER] if wanted else kept,
            "resourceVersion": present.metadata.resource_version,
        }
        try:
            patched = await self._store.patch(kinds.FLIGHT_PLAN, key, {"metadata": changes}, ContentType.MERGE)
        except NotFound:
            return
        if not patched["metadata"].get("deletionTimestamp"):
            self._cache.flight_plans.record_write(key, patched)


def _owned_by(submitted: Submitted, uid: str) -> bool:
    return any(owner.kind == FlightPlan.KIND and owner.uid == uid for owner in submitted.metadata.owner_references)
