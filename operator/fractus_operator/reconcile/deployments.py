"""The service behind Applications: plans them, deploys the plan, follows the mission, takes it all down."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta

from fractus_core.api import Application, Condition, Grant, InvalidObject
from fractus_core.api.plans import DeploymentPlanSpec, GrantSpec
from fractus_core.identity.authority import Authority
from fractus_core.identity.grant_signer import GrantSigner
from fractus_core.planning.growth import room_to_grow
from fractus_core.planning.inventory import Flight, Inventory, Settings
from fractus_core.planning.plan import Infeasible, plan
from fractus_core.policy.grants import compile_grants, refresh
from fractus_core.validation import check_application

from fractus_operator.cluster import kinds
from fractus_operator.cluster.kinds import Body, Key, key_of
from fractus_operator.cluster.labels import FINALIZER
from fractus_operator.cluster.reading import SETTLED, Submitted
from fractus_operator.cluster.store import Conflict, KubeError, NotFound, Store
from fractus_operator.inventory.live import LiveInventory
from fractus_operator.reconcile import builders
from fractus_operator.reconcile.children import Children, NameTaken
from fractus_operator.reconcile.conditions import Fact, merge
from fractus_operator.reconcile.missions import (
    Hindered,
    Phase,
    Standing,
    deployed_standing,
    finished_standing,
    hindered_standing,
    mission_outcome,
    replan_reason,
    stuck_nodes,
)
from fractus_operator.reconcile.rides import flights, may_come_along, ride_lost, ride_outcome
from fractus_operator.reconcile.rollout import Rollout

logger = logging.getLogger(__name__)

RESYNC_S = 30.0
_REFUSALS = frozenset({400, 403, 422})
"""HTTP statuses by which the API server says that it does not want an object: the user should know."""

_OPTIONAL = frozenset({"NodeCordoned", "NodesAppeared"})
"""Reasons for a new plan that can do without: what runs goes on where there is no other."""

EXCLUSION = timedelta(minutes=5)
"""How long a node that the scheduler refused is left out of an application's plans."""


class BeingDeleted(Exception):
    """The application is on its way out: there is nothing more to reconcile."""


@dataclass
class _Memory:
    """What is remembered of one application between reconciles; all of it can be lost."""

    lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    excluded: dict[str, tuple[datetime, str]] = field(default_factory=dict)
    status: tuple[str, Body] | None = None
    """(uid, status) as last written: the watch may be behind."""
    refreshed: tuple[object, ...] | None = None
    """Of what the grants were found to be up to date."""
    compiled: tuple[tuple[object, ...], DeploymentPlanSpec, tuple[GrantSpec, ...]] | None = None
    """Grants as they were compiled last, from what, for which plan."""


class Deployments:
    """Brings every Application to where its spec, the inventory and its mission want it."""

    def __init__(
        self,
        store: Store,
        live: LiveInventory,
        authority: Authority,
        clock: Callable[[], datetime],
        settings: Settings | None = None,
    ) -> None:
        self._store = store
        self._live = live
        self._clock = clock
        self._settings = settings or Settings()
        self._signer = GrantSigner(authority, clock)
        self._children = Children(store, live, self._signer)
        self._rollout = Rollout(self._children, live, authority, clock)
        self._memories: dict[Key, _Memory] = {}
        self._torn_down: set[str] = set()

    # -- entry points --

    async def reconcile(self, key: Key) -> float:
        """Go one step towards the desired state; safe to be killed at any point and to run again.

        Returns:
            In how many seconds to run again if nothing changes before.

        Raises:
            BeingDeleted: the application is being deleted.
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
            if metadata.uid in self._torn_down:
                raise BeingDeleted
            standing, again_s = await self._advance(key, submitted, memory)
            if standing is not None:
                await self._report(submitted, standing, memory)
            return min(again_s, RESYNC_S)

    async def teardown(self, key: Key, uid: str) -> None:
        """Revoke every grant of an application that is being deleted, then remove what was made for it.

        The drone is brought home by its own services once its grant is gone. What a stale watch hides
        here, the garbage collector finds by its owner.
        """
        self._torn_down.add(uid)
        memory = self._memories.setdefault(key, _Memory())
        async with memory.lock:
            await self._children.revoke(key)
            for kind in reversed(kinds.CHILDREN):
                await self._children.remove(key, kind)
        self._memories.pop(key, None)
        self._live.forget(key)

    # -- steps --

    async def _advance(self, key: Key, submitted: Submitted, memory: _Memory) -> tuple[Standing | None, float]:
        """One step; the standing to report, if any, and when to look again."""
        status = self._status(submitted, memory)
        if status.get("phase") in SETTLED:
            same = status.get("observedGeneration") == submitted.metadata.generation
            begun = self._live.plan_of(key, submitted.uid) is not None
            left_over = not begun and await self._clear(key)
            if not same and not begun:
                # An old plan neither claims its drone for the next mission nor excuses it from any check.
                left_over |= await self._children.remove(key, kinds.DEPLOYMENT_PLAN)
                self._live.forget(key)
            if same or left_over:
                # The last mission's grants must be gone before a new one begins.
                return None, RESYNC_S if same else 1.0
        present = self._present(key, submitted.metadata.uid or "")
        decided = self._live.plan_of(key, submitted.uid)
        outcome = mission_outcome(submitted.uid, self._live.grants_of(key)) or (
            ride_outcome(decided, *self._live.host_of(decided))
        )
        if outcome is not None:
            # Reported before anything is removed: the grants are the only other record of it.
            await self._report(submitted, finished_standing(outcome, present), memory)
            await self._clear(key)
            return None, RESYNC_S
        try:
            await self._refresh(key, submitted.uid, memory)
            await self._give_up_lost_drone(key, submitted.uid)
            await self._give_up_lost_ride(key, submitted)
            return await self._progress(key, submitted, memory)
        except Hindered as hindrance:
            return hindered_standing(hindrance, present), hindrance.again_s

    async def _refresh(self, key: Key, uid: str, memory: _Memory) -> None:
        """Bring the policies of what is granted up to date, whatever becomes of the application's next plan."""
        vouched = self._vouched(key, uid)
        basis = self._basis(vouched)
        if memory.refreshed == basis:
            return
        inventory = self._live.snapshot(key, uid)
        grants = [(grant, refresh(grant.spec, inventory)) for grant in vouched]
        stale = [(grant, spec) for grant, spec in grants if spec != grant.spec]
        memory.refreshed = None if stale else basis
        try:
            await self._children.refresh(stale)
        except KubeError as error:
            # The watch of grants brings a newer one, or the next look finds it refused still.
            logger.warning("%s/%s: grants are not up to date: %s", *key, error)
            if error.status not in _REFUSALS and not isinstance(error, Conflict | NotFound):
                raise

    def _vouched(self, key: Key, uid: str) -> list[Grant]:
        """The grants of an application that are as they were signed: nothing of another one is ever signed again."""
        return [grant for grant in self._live.grants_of(key, uid) if self._signer.problem(grant) is None]

    def _basis(self, grants: Sequence[Grant], *more: object) -> tuple[object, ...]:
        """What tells that nothing changed of which grants are made, nor they themselves."""
        versions = sorted((g.name, g.metadata.uid or "", g.metadata.resource_version or "") for g in grants)
        return (self._live.rules_revision, *versions, *more)

    def _compiled(
        self, application: Application, decided: DeploymentPlanSpec, inventory: Inventory, memory: _Memory
    ) -> tuple[GrantSpec, ...]:
        """The grants of a plan; those of the last look while nothing changed.

        Raises:
            InvalidObject: nothing can be granted.
        """
        present = self._vouched(application.key, application.metadata.uid or "")
        basis = self._basis(present, application.metadata.uid, application.metadata.generation)
        known = memory.compiled
        if known is not None and known[0] == basis and known[1] is decided:
            return known[2]
        before = {grant.spec.instance: grant.spec.model_copy(update={"issued_at": None}) for grant in present}
        made = compile_grants(application, decided, inventory, self._settings, [grant.spec for grant in present])
        # Areas have many points: what equals the present grant is that one, and not kept twice.
        grants = tuple(same if (same := before.get(spec.instance)) == spec else spec for spec in made)
        memory.compiled = (basis, decided, grants)
        return grants

    async def _give_up_lost_drone(self, key: Key, uid: str) -> None:
        """Take down an application whose drone is another's by an older grant, so that it is planned anew.

        Raises:
            Hindered: it has lost its drone.
        """
        drone = self._live.has_lost_drone(key, uid)
        if drone is None:
            return
        await self._begin_anew(key)
        raise Hindered("Queued", "Planned", "DroneBusy", f"another application has {drone}", again_s=1.0)

    async def _give_up_lost_ride(self, key: Key, submitted: Submitted) -> None:
        """Take down an application that came along with a flight which is over or goes elsewhere; it is planned anew.

        Raises:
            Hindered: it has lost its ride.
        """
        decided, guest = self._live.plan_of(key, submitted.uid), submitted.application
        if decided is None or decided.drone is None or decided.drone.shared_with is None or guest is None:
            return
        _, host_plan = self._live.host_of(decided)
        flight = self._flights(key, guest).get(decided.drone.node)
        lost = ride_lost(guest, decided, host_plan, flight, self._settings.safety_radius_m)
        if lost is None:
            return
        await self._begin_anew(key)
        raise Hindered("Queued", "Planned", "RideLost", lost, again_s=1.0)

    async def _begin_anew(self, key: Key) -> None:
        """Remove all that was made for an application, with its plan."""
        await self._clear(key)
        await self._children.remove(key, kinds.DEPLOYMENT_PLAN)
        self._live.forget(key)

    async def _progress(self, key: Key, submitted: Submitted, memory: _Memory) -> tuple[Standing, float]:
        application = submitted.application
        if application is None:
            raise Hindered("Invalid", "Planned", "Invalid", str(submitted.error))
        rules = self._live.rules_revision
        inventory = self._live.snapshot(key, submitted.uid, self._flights(key, application))
        try:
            check_application(application, inventory.depots)
            decided, again_s = self._plan(application, inventory, memory)
        except InvalidObject as error:
            raise Hindered("Invalid", "Planned", "Invalid", str(error)) from error
        except Infeasible as none:
            phase: Phase = "Queued" if none.reason == "DroneBusy" else "Pending"
            raise Hindered(phase, "Planned", none.reason, none.message) from none
        try:
            grants = self._compiled(application, decided, inventory, memory)
        except InvalidObject as error:
            raise Hindered("Pending", "Granted", "PolicyInvalid", str(error)) from error
        try:
            # One look at the pods for all that is said of them.
            pods = self._live.pods_of(key)
            complete = await self._rollout.carry_out(application, decided, grants, pods, rules)
        except NameTaken as error:
            raise Hindered("Pending", "Deployed", "NameTaken", str(error), again_s=2.0) from error
        except KubeError as error:
            if error.status not in _REFUSALS:
                raise
            raise Hindered("Pending", "Deployed", error.reason, str(error), again_s=10.0) from error
        return deployed_standing(decided, pods, len(grants)), again_s if complete else 0.0

    def _plan(
        self, application: Application, inventory: Inventory, memory: _Memory
    ) -> tuple[DeploymentPlanSpec, float]:
        """The plan to deploy: the present one while it stands, else a new one that moves as little as it can.

        There is no await between looking at the inventory and deciding, so two applications never
        get one drone.
        """
        key, uid, now = application.key, application.metadata.uid or "", self._clock()
        previous = self._live.plan_of(key, uid)
        stuck, again_s = stuck_nodes(previous, self._live.pods_of(key), now)
        aloft = self._live.aloft(previous)
        stuck = {node: why for node, why in stuck.items() if node != aloft}
        memory.excluded = {n: (until, why) for n, (until, why) in memory.excluded.items() if until > now}
        memory.excluded |= {node: (now + EXCLUSION, why) for node, why in stuck.items()}
        settings = replace(self._settings, excluded={n: why for n, (_, why) in memory.excluded.items()})
        reason = replan_reason(application, previous, inventory, stuck, aloft)
        if previous is not None and reason is None:
            if room_to_grow(application, inventory, settings, previous) is None:
                return previous, again_s or RESYNC_S
            reason = "NodesAppeared"
        try:
            decided = plan(application, inventory, settings, previous)
        except Infeasible:
            if previous is None or reason not in _OPTIONAL:
                raise
            return previous, RESYNC_S
        if previous is not None and aloft is not None and reason != "SpecChanged" and _flies(decided) != aloft:
            # Trouble elsewhere is no reason to leave a drone that flies.
            return previous, RESYNC_S
        self._live.decide(key, uid, decided)
        drone = f" with drone {decided.drone.node}" if decided.drone is not None else ""
        logger.info("%s/%s is planned (%s)%s", *key, reason, drone)
        return decided, RESYNC_S

    def _flights(self, key: Key, application: Application | None) -> dict[str, Flight]:
        """What claimed drones fly, for an application that may come along; nothing for others."""
        if application is None or not may_come_along(application):
            return {}
        present = self._live.plan_of(key, application.metadata.uid or "")
        flown = (host for host in self._live.flown() if host.application.key != key)
        return flights(flown, self._live.depots_by_name(), self._settings.safety_radius_m, present)

    async def _clear(self, key: Key) -> bool:
        """Remove what a mission that is over leaves, but the plan; True if there was anything."""
        removed = False
        for kind in (kinds.GRANT, kinds.DEPLOYMENT, kinds.ENDPOINT_SLICE, kinds.SERVICE, kinds.SECRET):
            removed |= await self._children.remove(key, kind)
        if removed:
            self._live.forget(key)
        return removed

    # -- reporting --

    def _present(self, key: Key, uid: str) -> Standing | None:
        """What is deployed by an earlier plan, if anything."""
        decided = self._live.plan_of(key, uid)
        if decided is None or not self._live.children_of(key, kinds.DEPLOYMENT):
            return None
        return deployed_standing(decided, self._live.pods_of(key), 0)

    def _status(self, submitted: Submitted, memory: _Memory) -> Body:
        if memory.status is not None and memory.status[0] == submitted.metadata.uid:
            return memory.status[1]
        return dict(submitted.body.get("status") or {})

    async def _report(self, submitted: Submitted, standing: Standing, memory: _Memory) -> None:
        """Write the status if it differs from the present one, then an Event for each transition."""
        now = self._clock()
        before = self._status(submitted, memory)
        previous = [Condition.model_validate(c) for c in before.get("conditions") or ()]
        generation = submitted.metadata.generation
        conditions, news = merge(previous, standing.facts, generation, now)
        status: Body = {
            "observedGeneration": generation,
            "phase": standing.phase,
            "message": standing.message,
            "conditions": [condition.to_dict() for condition in conditions],
        }
        if standing.drone is not None:
            status["drone"] = standing.drone
        if standing.pods is not None:
            status["pods"] = standing.pods
        if status == before:
            return
        try:
            body = builders.application_status(submitted.body, status)
            applied = await self._store.apply(kinds.APPLICATION, body, subresource="status")
        except Conflict:
            return
        self._live.applications.note(key_of(applied), applied)
        memory.status = (submitted.metadata.uid or "", status)
        await self._announce(submitted, news, now)

    async def _announce(self, submitted: Submitted, news: tuple[Fact, ...], now: datetime) -> None:
        for fact in _worth_telling(news):
            name = f"{submitted.metadata.name}.{int(now.timestamp()):x}.{fact.reason.lower()}"
            try:
                await self._store.record_event(
                    submitted.body,
                    reason=fact.reason,
                    message=fact.message,
                    warning=fact.warning,
                    name=name,
                    now=now,
                )
            except KubeError as error:
                logger.warning("Event %s of %s: %s", fact.reason, submitted.metadata.name, error)


def _flies(decided: DeploymentPlanSpec) -> str | None:
    return decided.drone.node if decided.drone is not None else None


def _worth_telling(news: tuple[Fact, ...]) -> Iterator[Fact]:
    """One Event for each new reason; what is merely on its way is in the status."""
    told: set[str] = set()
    for fact in news:
        if fact.reason not in told and fact.reason not in {"MissionUnderway", "PodsNotReady"}:
            told.add(fact.reason)
            yield fact
