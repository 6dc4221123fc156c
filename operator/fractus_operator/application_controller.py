"""Controller of Applications: plans and deploys an Application, reports its status, and removes its objects at the end."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta

from fractus_core.api import Application, InvalidObject
from fractus_core.api.plans import DeploymentPlanSpec, MissionRecord
from fractus_core.identity.authority import Authority
from fractus_core.identity.grant_signer import GrantSigner
from fractus_core.planning.inventory import Inventory, Settings
from fractus_core.planning.planner import Infeasible
from fractus_core.planning.scale_up import full_nodes
from fractus_core.validation import check_application
from fractus_runtime.backoff import Backoff

from fractus_operator import kinds, status
from fractus_operator.after_flight import AfterFlight, after_flight, until_deleted
from fractus_operator.application_grants import REFUSALS, ApplicationGrants
from fractus_operator.cache import ClusterCache, ObservedApplication
from fractus_operator.child_objects import ChildObjects, NameTaken
from fractus_operator.cleanup import FinishedPods
from fractus_operator.drone_claims import shared_flight_outcome
from fractus_operator.flight_matching import other_drones
from fractus_operator.kinds import Key
from fractus_operator.labels import FINALIZER
from fractus_operator.operator_metrics import phase as timed
from fractus_operator.operator_metrics import reconciling
from fractus_operator.pods import PlanPods, refusal_of
from fractus_operator.replanning import (
    choose_plan,
    flown_generation,
    mission_changed,
    of_generation,
    stuck_nodes,
    waits_for_landing,
)
from fractus_operator.rollout import Rollout
from fractus_operator.route_check_cache import RouteCheckCache
from fractus_operator.status import (
    Blocked,
    Phase,
    StatusUpdate,
    flight,
    mission_outcome,
    reported_record,
    reports_outcome,
)
from fractus_operator.status_reporter import StatusReporter
from fractus_operator.store import KubeError, Store

log = logging.getLogger(__name__)

RESYNC_S = 30.0
_FIRST_RETRY_S = 1.0
_MAX_RETRY_S = 30.0
_MAX_PAUSE_S = 1.0
_PAUSE_FACTOR = 2.0
"""Pause after a reconciliation as a multiple of its duration. Under load, each Application is then reconciled less often."""

EXCLUSION = timedelta(minutes=5)
"""Duration for which plans of an Application avoid a node on which the scheduler placed no pod."""

_RIGHTS = (kinds.GRANT, kinds.DIRECT_LINK)
"""Kinds that are deleted first when a mission is over. Pods follow."""
_AFTER_PODS = (
    kinds.DISRUPTION_BUDGET,
    kinds.ENDPOINT_SLICE,
    kinds.NETWORK_POLICY,
    kinds.SERVICE,
)
"""Kinds that are deleted last when a mission is over. The plan is kept as the record of the mission."""


class BeingDeleted(Exception):
    """The Application or its namespace is being deleted, so there is nothing more to reconcile."""


@dataclass
class _ApplicationState:
    """State of one Application between reconciliations. The state may be lost, for example in a restart.

    Attributes:
        excluded: Nodes that plans avoid, with the end of the exclusion and the reason.
        checked: Uid, generation, and revision of the rules of the last valid Application.
    """

    lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    excluded: dict[str, tuple[datetime, str]] = field(default_factory=dict)
    checked: tuple[object, ...] = ()

    def check(self, application: Application, inventory: Inventory, rules: int) -> None:
        """Validate an Application, once for each generation and each revision of the rules.

        Raises:
            InvalidObject: It names unknown depots, or has invalid regions.
        """
        revision = (application.metadata.uid, application.metadata.generation, rules)
        if self.checked != revision:
            check_application(application, inventory.depots)
            self.checked = revision


class ApplicationController:
    """Brings every Application to the state that its spec, the inventory and its mission require."""

    def __init__(
        self,
        store: Store,
        cache: ClusterCache,
        authority: Authority,
        clock: Callable[[], datetime],
        settings: Settings | None = None,
        *,
        gateway_image: str = "",
    ) -> None:
        self._cache = cache
        self._clock = clock
        self._settings = settings or Settings()
        signer = GrantSigner(authority, clock)
        self._objects = ChildObjects(store, cache.children, signer)
        self._grants = ApplicationGrants(cache, self._objects, signer, self._settings)
        self._finished_pods = FinishedPods(store, cache, self._objects, clock)
        self._rollout = Rollout(self._objects, cache, authority, clock, gateway_image)
        self._reporter = StatusReporter(store, cache.applications, clock)
        self._route_checks = RouteCheckCache(cache.subscriptions.wake, clock)
        self._states: dict[Key, _ApplicationState] = {}

    async def follow(self, key: Key, stopped: Callable[[], bool]) -> None:
        """Reconcile an Application whenever one of its inputs changes, until it is deleted or `stopped` returns True."""
        backoff = Backoff(_FIRST_RETRY_S, _MAX_RETRY_S)
        loop = asyncio.get_running_loop()
        await self._cache.synced()
        with self._cache.subscriptions.subscribe(key) as inputs:
            while not stopped():
                started_s = loop.time()
                try:
                    with reconciling("application"):
                        try:
                            next_s = await self.reconcile(key)
                        except BeingDeleted:
                            return  # caught here, so that the deletion does not count as a failure
                    backoff.succeeded()
                except KubeError as error:
                    next_s = backoff.delay_s()
                    log.warning(
                        "application controller: reconcile failed (application=%s/%s retry_s=%.1f error=%s)",
                        *key,
                        next_s,
                        error,
                    )
                    await self._reporter.report_failure(self._cache.applications.get(key), backoff.attempts, error)
                took_s = loop.time() - started_s
                # Changes come in bursts, such as the pods of a plan. A change by a user ends the pause.
                await inputs.changed(next_s, pause_s=min(_PAUSE_FACTOR * took_s, _MAX_PAUSE_S))

    async def reconcile(self, key: Key) -> float:
        """Take one step towards the desired state. If the operator is killed at any point, the step can be repeated.

        Returns:
            Seconds until the next step, unless an input changes earlier.

        Raises:
            BeingDeleted: The Application or its namespace is being deleted.
            KubeError: The API server refused a write, or could not be reached.
        """
        submitted = self._cache.applications.get(key)
        if submitted is None:
            return RESYNC_S
        metadata = submitted.metadata
        if metadata.deletion_timestamp:
            raise BeingDeleted
        # Without the finalizer nothing is created, because a deletion would then leave Grants behind.
        if FINALIZER not in metadata.finalizers:
            return RESYNC_S
        if self._cache.is_being_deleted(key[0]):
            # Kubernetes deletes the Applications of a namespace only after its pods are gone, which an unreachable node delays.
            await self.teardown(key, submitted.uid)
            raise BeingDeleted
        state = self._states.setdefault(key, _ApplicationState())
        async with state.lock:
            if metadata.uid == self._cache.torn_down.get(key):
                raise BeingDeleted
            return min(await self._step(self._cache.observe(submitted), state), RESYNC_S)

    async def teardown(self, key: Key, uid: str) -> None:
        """Delete every Grant of an Application that is being deleted, and then its other objects.

        When its Grant is deleted, the services of the drone return it to its depot. The garbage collector deletes owned
        objects that are missing in a stale cache. Pods without an owner are listed at the API server.

        Raises:
            KubeError: The API server refused a deletion, or could not be reached.
        """
        await self._cache.synced()
        self._cache.torn_down[key] = uid
        state = self._states.setdefault(key, _ApplicationState())
        async with state.lock:
            await self._objects.revoke(key)
            await self._finished_pods.tear_down(key)
        self._states.pop(key, None)
        for part in (self._grants, self._route_checks, self._reporter, self._rollout, self._cache):
            part.forget(key)

    # -- steps --

    async def _step(self, observed: ObservedApplication, state: _ApplicationState) -> float:
        """Take one step. Return the seconds until the next one."""
        submitted = observed.submitted
        self._cache.subscriptions.set_placed(observed.key, placed=False)
        next_s = await self._follow_finished(observed)
        if next_s is not None:
            return next_s
        observed = self._record_takeoff(observed)
        present = None
        if observed.plan is not None and self._objects.of(observed.key, kinds.DEPLOYMENT):
            present = self._deployed_status(observed, observed.plan, 0)
        try:
            await self._grants.refresh(observed)
            update, next_s = await self._deploy(self._cache.observe(submitted), state)
        except Blocked as blocked:
            # There must be no await between planning and this line. Otherwise a release of resources could be missed.
            self._cache.subscriptions.set_placed(observed.key, placed=False, full=blocked.full)
            await self._reporter.report(submitted, status.blocked(blocked, present))
            if observed.plan is not None:
                await self._rollout.keep_running(observed.key, submitted.application, observed.plan, observed.pods)
            return blocked.retry_s
        await self._reporter.report(submitted, update)
        return next_s

    async def _follow_finished(self, observed: ObservedApplication) -> float | None:
        """Record the outcome of a mission that is over, report it, and remove its objects.

        The plan is the record of the outcome. It is written before anything is deleted, because the Grants are the only other
        record.

        Returns:
            Seconds until the next step, or None if the mission is not over or a new one may begin.
        """
        submitted = observed.submitted
        application = submitted.application
        flown = self._cache.plans.latest(observed.key, observed.uid)
        if flown is None:
            return await self._follow_without_record(observed)
        if not flown.is_over:
            record = self._observed_record(observed, flown)
            if record is None:
                return None
            flown = flown.model_copy(update={"flown": record})
        elif application is not None and self._next_mission_begins(application, flown):
            # If the plan of the last mission remained, it would claim its drone, and exempt the next mission from checks.
            removed = await self._start_over(observed.key, until_deleted(application, flown), _drone_of(flown))
            # The Grants of the last mission must be deleted before a new one begins.
            return 1.0 if removed else None
        # An invalid manifest describes no new mission. The record of the last mission stays until the manifest is valid.
        record = flown.flown
        assert record is not None
        name = flown.drone.node if flown.drone is not None else None
        drone = self._cache.drone(name) if name is not None else None
        # A drone that has landed may later fly for another Application.
        if name is None or (drone is not None and drone.on_ground):
            landed_at = None if record.landed else self._clock().replace(microsecond=0)
            record = record.model_copy(update={"landed": True, "landed_at": record.landed_at or landed_at})
        if record != flown.flown:
            flown = flown.model_copy(update={"flown": record})
        await self._rollout.keep_plan(submitted, flown)
        generation = flown_generation(application, flown) if application is not None else None
        ends = after_flight(application, flown, self._clock())
        update = status.over(record, name, drone)
        if generation is not None and application is not None and not self._next_mission_begins(application, flown):
            update = status.waiting_for_components(update)
        await self._reporter.report(submitted, update, generation)
        return await self._finish(observed, flown, ends)

    def _next_mission_begins(self, application: Application, flown: DeploymentPlanSpec) -> bool:
        """Return True if the Application has another mission, and no component of the last mission must continue to run."""
        if not mission_changed(application, flown):
            return False
        return (
            application.spec.update_policy == "Immediate"
            or after_flight(application, flown, self._clock()).flight_ended
        )

    def _observed_record(self, observed: ObservedApplication, flown: DeploymentPlanSpec) -> MissionRecord | None:
        """Return the record of a mission that is over according to its Grants, or None."""
        outcome = mission_outcome(observed.uid, observed.grants) or shared_flight_outcome(flown, observed.host[1])
        if outcome is not None:
            return status.mission_record(
                outcome, observed.pods, status.reported_pictures(observed.uid, observed.grants)
            )
        # Earlier releases recorded the outcome only in the status. Anyone could have edited the status, so the mission counts as
        # over only if nothing remains that could fly it.
        if flown.drone is not None and flown.drone.shared_with is None:
            remaining = any(reports_outcome(observed.uid, grant) for grant in observed.grants)
        else:
            remaining = bool(self._objects.of(observed.key, kinds.DEPLOYMENT))
        if remaining:
            return None
        return reported_record(self._reporter.last(observed.submitted), flown.application_generation or 0)

    async def _follow_without_record(self, observed: ObservedApplication) -> float | None:
        """Keep an Application without a plan on the ground if its mission may have been flown.

        Returns:
            Seconds until the next step, or None if its Grants report no outcome, and its status reports none or a Grant shows that
            the mission continues.
        """
        submitted = observed.submitted
        generation = submitted.metadata.generation or 0
        reported = self._reporter.last(submitted)
        flies = any(reports_outcome(observed.uid, grant) for grant in observed.grants)
        over = reported_record(reported, generation) is not None and not flies
        if not over and mission_outcome(observed.uid, observed.grants) is None:
            return None
        await self._reporter.report(submitted, status.without_record())
        return await self._finish(observed, None, AfterFlight())

    def _record_takeoff(self, observed: ObservedApplication) -> ObservedApplication:
        """Record in the active plan that its drone has taken off. The rollout of the plan stores the record."""
        plan = observed.plan
        if plan is None or plan.flown is not None or observed.in_flight is None:
            return observed
        self._cache.plans.decide(observed.key, observed.uid, plan.model_copy(update={"flown": MissionRecord()}))
        return self._cache.observe(observed.submitted)

    async def _deploy(self, observed: ObservedApplication, state: _ApplicationState) -> tuple[StatusUpdate, float]:
        """Plan, compile Grants, and apply.

        There is no await between reading the inventory and the decision, so two Applications never get the same drone.

        Raises:
            Blocked: The Application cannot proceed at present.
            KubeError: The API server cannot be reached.
        """
        with timed("observe"):
            inventory, lost = self._cache.planning_input(observed, self._settings.safety_radius_m)
        if lost is not None:
            await self._start_over(observed.key)
            raise Blocked("Queued", "Planned", *lost, retry_s=1.0)
        application = observed.submitted.application
        if application is None:
            raise Blocked("Invalid", "Planned", "Invalid", str(observed.submitted.error))
        if observed.plan is not None and waits_for_landing(application, observed.plan, observed.in_flight):
            await self._rollout.renew_certificates(application, observed.plan, observed.pods)
            await self._rollout.update_addresses(observed.key, observed.plan, observed.pods)
            present = self._deployed_status(observed, observed.plan, len(observed.grants))
            return status.waiting_for_landing(present, observed.in_flight or ""), RESYNC_S
        try:
            state.check(application, inventory, observed.rules)
            with timed("plan"):
                plan, next_s = self._plan(application, observed, inventory, state)
        except InvalidObject as error:
            raise Blocked("Invalid", "Planned", "Invalid", str(error)) from error
        except Infeasible as infeasible:
            phase: Phase = "Queued" if infeasible.reason == "DroneBusy" else "Pending"
            raise Blocked(phase, "Planned", infeasible.reason, infeasible.message, full=infeasible.full) from infeasible
        try:
            with timed("grants"):
                grants = self._grants.compile(application, plan, observed, inventory)
        except InvalidObject as error:
            raise Blocked("Pending", "Granted", "PolicyInvalid", str(error)) from error
        await self._reporter.report_queued(observed.submitted, plan, self._rollout.in_progress)
        try:
            with timed("rollout"):
                complete = await self._rollout.apply(application, plan, grants, observed.pods, observed.rules)
        except NameTaken as error:
            raise Blocked("Pending", "Deployed", "NameTaken", str(error), retry_s=2.0) from error
        except KubeError as error:
            if error.status not in REFUSALS:
                raise
            raise Blocked("Pending", "Deployed", error.reason, str(error), retry_s=10.0) from error
        return self._deployed_status(observed, plan, len(grants)), next_s if complete else 0.0

    def _plan(
        self,
        application: Application,
        observed: ObservedApplication,
        inventory: Inventory,
        state: _ApplicationState,
    ) -> tuple[DeploymentPlanSpec, float]:
        """Return the plan to deploy and the seconds until the next step. A new plan becomes active at once."""
        now = self._clock()
        stuck, recheck_s = stuck_nodes(observed.plan, observed.pods, now)
        stuck = {node: reason for node, reason in stuck.items() if node != observed.in_flight}
        state.excluded = {node: (end, reason) for node, (end, reason) in state.excluded.items() if end > now}
        state.excluded |= {node: (now + EXCLUSION, reason) for node, reason in stuck.items()}
        excluded = {node: reason for node, (_, reason) in state.excluded.items()}
        reserved = self._cache.flights.of_application(observed.submitted)
        if reserved is not None:
            excluded |= other_drones(inventory.drones, reserved.drone, f"the flight plan has Drone {reserved.drone}")
        settings = replace(self._settings, excluded=excluded, time_s=now.timestamp())
        unchecked = observed.plan
        if unchecked is not None and not mission_changed(application, unchecked):
            unchecked = of_generation(application, unchecked)
        present = unchecked
        if unchecked is not None:
            present = self._route_checks.checked(
                observed.key, application, unchecked, rules=observed.rules, inventory=inventory, settings=settings
            )
        choice = choose_plan(application, present, inventory, settings, stuck=stuck, in_flight=observed.in_flight)
        flown = observed.plan.flown if observed.plan is not None else None
        if flown is not None and choice.plan.flown is None and _drone_of(choice.plan) == _drone_of(observed.plan):
            choice = replace(choice, plan=choice.plan.model_copy(update={"flown": flown}))
        # On these nodes the plan would have more instances if they had free capacity.
        full = full_nodes(application, inventory, settings, choice.plan)
        self._cache.subscriptions.set_placed(observed.key, placed=choice.suits, full=full)
        if choice.plan is not observed.plan:
            self._cache.plans.decide(observed.key, observed.uid, choice.plan)
        if choice.plan is not unchecked:
            log.info(
                "application controller: planned (application=%s/%s reason=%s drone=%s)",
                *observed.key,
                choice.reason or "PoliciesChanged",
                choice.plan.drone.node if choice.plan.drone is not None else "none",
            )
        if choice.reason is not None:
            self._route_checks.put(observed.key, choice.plan, observed.rules)
        return choice.plan, (recheck_s or RESYNC_S) if choice.fits else RESYNC_S

    async def _start_over(self, key: Key, ends: AfterFlight | None = None, drone: str | None = None) -> bool:
        """Delete the objects of an Application, including its plan.

        Args:
            key: The Application.
            ends: Instances that continue to run. By default, none.
            drone: Drone of the last mission, if there was one.

        Returns:
            True if there were any objects, or if pods of the last mission still run on the drone.
        """
        ends = ends or AfterFlight()
        rights = await self._objects.remove(key, *_RIGHTS)
        others = await self._objects.remove(key, kinds.DEPLOYMENT, *_AFTER_PODS, keeps=ends.keeps)
        pods = await self._finished_pods.remove(key, ends.instances)
        if drone is not None and self._finished_pods.run_on(key, drone):
            # A program of the last mission must not use the Grants of the next mission.
            return True
        plan = await self._objects.remove(key, kinds.DEPLOYMENT_PLAN)
        self._cache.forget(key)
        return rights or others or pods or plan

    async def _finish(
        self, observed: ObservedApplication, flown: DeploymentPlanSpec | None, ends: AfterFlight
    ) -> float:
        """Delete the objects of a finished mission, except its plan, what still runs, and the pods that are kept for their logs.

        Args:
            observed: The Application.
            flown: The plan, if it exists.
            ends: Instances that continue to run.

        Returns:
            Seconds until the next step.
        """
        key = observed.key
        submitted = observed.submitted
        rights = await self._objects.remove(key, *_RIGHTS)
        pods = await self._finished_pods.stop(submitted, ends.instances)
        others = await self._objects.remove(key, *_AFTER_PODS, keeps=ends.keeps)
        if rights or pods or others:
            self._cache.forget(key)
        if flown is not None and ends.running:
            present = flown.model_copy(update={"placements": ends.running})
            await self._rollout.keep_running(key, submitted.application, present, self._cache.pods_of(key))
        return min(await self._finished_pods.expire(submitted), ends.next_s, RESYNC_S)

    def _deployed_status(self, observed: ObservedApplication, plan: DeploymentPlanSpec, granted: int) -> StatusUpdate:
        node = plan.drone.node if plan.drone is not None else None
        flown = flight(node, self._cache.drone(node), took_off=plan.flown is not None) if node is not None else None
        deployments = self._objects.of(observed.key, kinds.DEPLOYMENT)
        refused = {body["metadata"]["name"]: refusal_of(body) for body in deployments}
        application = observed.submitted.application
        waits = application is not None and bool(PlanPods(plan, observed.pods, application.spec.start).awaited)
        return status.deployed(plan, observed.pods, granted, flown, refused, waits=waits)


def _drone_of(plan: DeploymentPlanSpec | None) -> str | None:
    return plan.drone.node if plan is not None and plan.drone is not None else None
