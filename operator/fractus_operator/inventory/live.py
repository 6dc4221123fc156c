"""A current, typed view of the cluster, fed by reflectors; hands planning its input and wakes who depends on it."""

from __future__ import annotations

import asyncio
import itertools
import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any

from fractus_core.api import (
    DeploymentPlan,
    Depot,
    Drone,
    EdgeNode,
    Grant,
    Policy,
    Zone,
)
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.planning.candidates import requests
from fractus_core.planning.inventory import Flight, Host, Inventory
from fractus_core.planning.locations import NodeLocations

from fractus_operator.cluster import kinds
from fractus_operator.cluster.kinds import Body, Key, Kind
from fractus_operator.cluster.labels import APPLICATION_LABEL, MANAGED_SELECTOR, NAMESPACE_LABEL, label_value
from fractus_operator.cluster.pods import PodView, read_host, read_pod
from fractus_operator.cluster.reading import Broken, Makes, Submitted, keeping_broken, read_submitted, reader
from fractus_operator.cluster.store import Reflector, Store
from fractus_operator.inventory.bookings import Asked, BookedHosts, Bookings, ByName, corrections
from fractus_operator.inventory.claims import Claim, Flown, OwnedPlan, claims, host_key

logger = logging.getLogger(__name__)

SIGNER = "fractus.dev/node"


class Subscription:
    """Wakes one reconciler when an input of its object changed."""

    def __init__(self) -> None:
        self._changed = asyncio.Event()
        self._urgent = asyncio.Event()

    def wake(self, *, urgent: bool = False) -> None:
        """Note a change; an urgent one ends a rest."""
        self._changed.set()
        if urgent:
            self._urgent.set()

    async def changed(self, timeout_s: float) -> bool:
        """Wait for a change since the last call; False after the timeout."""
        try:
            async with asyncio.timeout(timeout_s):
                await self._changed.wait()
        except TimeoutError:
            return False
        finally:
            self._changed.clear()
        return True

    async def rest(self, duration_s: float) -> None:
        """Let changes gather, unless one is urgent."""
        with suppress(TimeoutError):
            async with asyncio.timeout(duration_s):
                await self._urgent.wait()
        self._urgent.clear()


class LiveInventory:
    """What the operator knows of the cluster, current within a watch event's delay."""

    def __init__(self, store: Store) -> None:
        managed = {"labelSelector": MANAGED_SELECTOR}
        self.hosts = Reflector(store, kinds.NODE, read_host, self._host_changed)
        self.pods = Reflector(store, kinds.POD, read_pod, self._pod_changed)
        makes = Makes()
        self.drones = Reflector(store, kinds.DRONE, makes.sharing(reader(Drone)), self._drone_changed)
        self.edge_nodes = Reflector(store, kinds.EDGE_NODE, makes.sharing(reader(EdgeNode)), self._edge_node_changed)
        self.depots = Reflector(store, kinds.DEPOT, reader(Depot), self._depot_changed)
        self.zones = Reflector(store, kinds.ZONE, keeping_broken(Zone), self._spec_changed(kinds.ZONE))
        self.policies = Reflector(store, kinds.POLICY, keeping_broken(Policy), self._spec_changed(kinds.POLICY))
        self.applications = Reflector(store, kinds.APPLICATION, read_submitted, self._application_changed)
        self.signing_requests = Reflector(
            store,
            kinds.SIGNING_REQUEST,
            _as_is,
            self._report_only(kinds.SIGNING_REQUEST),
            selectors={"fieldSelector": f"spec.signerName={SIGNER}"},
        )
        self.children: dict[Kind, Reflector[Body]] = {
            kind: Reflector(
                store,
                kind,
                _without_status if kind is kinds.DEPLOYMENT else _as_is,
                self._child_changed,
                selectors=managed,
            )
            for kind in kinds.CHILDREN
        }
        self._subscriptions: dict[Key, list[Subscription]] = {}
        self._listeners: dict[Kind, list[Callable[[Key], None]]] = {}
        self._decided: dict[Key, OwnedPlan] = {}
        self._plans: dict[Key, OwnedPlan] = {}
        self._grants: dict[Key, Grant] = {}
        self._areas = Makes(parts=64)
        self._last_claims: dict[str, Claim] = {}
        self._aloft: set[str] = set()
        self._bookings = Bookings()
        self._pods: dict[Key, dict[Key, PodView]] = {}
        self._where = NodeLocations()
        self._asked: dict[Key, tuple[OwnedPlan, Submitted, tuple[Asked, ...]]] = {}
        self.rules_revision = 0

    # -- running --

    def reflectors(self) -> list[Reflector[Any]]:
        """Every reflector; run each as a task of its own."""
        own: list[Reflector[Any]] = [r for r in vars(self).values() if isinstance(r, Reflector)]
        return own + list(self.children.values())

    async def synced(self) -> None:
        """Wait until every collection was listed once: before that, nothing can be decided."""
        for reflector in self.reflectors():
            await reflector.synced.wait()

    def listen(self, kind: Kind, listener: Callable[[Key], None]) -> None:
        """Call the listener with the key of every object of the kind that appears, changes or goes."""
        self._listeners.setdefault(kind, []).append(listener)

    @contextmanager
    def subscription(self, key: Key) -> Iterator[Subscription]:
        """Wake-up calls for one application, as long as the context lasts."""
        place, subscription = _place(key), Subscription()
        self._subscriptions.setdefault(place, []).append(subscription)
        try:
            yield subscription
        finally:
            self._subscriptions[place].remove(subscription)
            if not self._subscriptions[place]:
                del self._subscriptions[place]

    # -- reading --

    def snapshot(
        self, key: Key | None = None, uid: str | None = None, flights: Mapping[str, Flight] | None = None
    ) -> Inventory:
        """The input of planning and of grants, as of now; good until something is awaited.

        Args:
            key: The application that asks: what its own pods have is free for it.
            uid: Its uid: claims under its name that are not its own show another holder.
            flights: What drones that are claimed fly, for who may come along.
        """
        own = _place(key) if key is not None else None
        pods = (pod for pods in self._pods.values() for pod in pods.values())
        return Inventory(
            hosts=BookedHosts(self.hosts, self._bookings, corrections(self._planned(), pods, own)),
            drones=ByName(self.drones),
            edge_nodes=ByName(self.edge_nodes),
            depots=ByName(self.depots),
            zones={z.name: z for z in self.zones.values() if isinstance(z, Zone)},
            policies={p.name: p for p in self.policies.values() if isinstance(p, Policy)},
            unreadable_zones={z.name: z.problem for z in self.zones.values() if isinstance(z, Broken)},
            unreadable_policies={p.name: p.problem for p in self.policies.values() if isinstance(p, Broken)},
            claimed={node: claim.holder(uid) for node, claim in self.claims().items()},
            flights=flights or {},
            locations=self._where,
        )

    def depots_by_name(self) -> Mapping[str, Depot]:
        """The depots."""
        return ByName(self.depots)

    def flown(self) -> Iterator[Flown]:
        """The applications that have a drone of their own, each by a plan that stands."""
        owners = {(claim.uid, node) for node, claim in self.claims().items() if not claim.over}
        for key, plan in self.plans().items():
            submitted, drone = self.applications.get(key), plan.spec.drone
            if drone is None or drone.shared_with is not None or (plan.uid, drone.node) not in owners:
                continue
            found = self.drones.get(("", drone.node))
            if found is not None and submitted is not None and submitted.application is not None:
                yield Flown(submitted.application, plan.spec, found, is_flying(found))

    def plans(self) -> dict[Key, OwnedPlan]:
        """The plan of every application whose mission is not over."""
        return {key: plan for key, plan in (self._plans | self._decided).items() if self._is_live(key, plan)}

    def plan_of(self, key: Key, uid: str) -> DeploymentPlanSpec | None:
        """The plan of the application with this uid, unless the mission it was made for is over."""
        plan = self._decided.get(key) or self._plans.get(key)
        return plan.spec if plan is not None and plan.uid == uid and self._is_live(key, plan) else None

    def host_of(self, plan: DeploymentPlanSpec | None) -> tuple[Submitted | None, DeploymentPlanSpec | None]:
        """The application that a guest comes along with, and that one's plan; None each, if there is none any more."""
        if plan is None or plan.drone is None or plan.drone.shared_with is None:
            return None, None
        key = host_key(plan.drone.shared_with)
        submitted = self.applications.get(key)
        return submitted, self.plan_of(key, submitted.uid) if submitted is not None else None

    def _is_live(self, key: Key, plan: OwnedPlan) -> bool:
        submitted = self.applications.get(key)
        if submitted is None or submitted.uid != plan.uid:
            return False
        over = submitted.settled_generation
        return over is None or (plan.spec.application_generation or 0) > over

    def claims(self) -> dict[str, Claim]:
        """Which application has which drone.

        A drone is claimed from the plan on until its grants are gone and it has come home.
        """
        found = claims(self.plans(), self._grants.values())
        for drone in self.drones.values():
            if drone is not None and drone.name not in found and is_flying(drone):
                last = self._last_claims.get(drone.name) or self._claim_on_record(drone.name)
                found[drone.name] = replace(last, over=True)
        self._last_claims.update(found)
        return found

    def has_lost_drone(self, key: Key, uid: str) -> str | None:
        """The drone of an application's plan that another application turns out to have; None: it has its own."""
        plan = self.plan_of(key, uid)
        if plan is None or plan.drone is None or plan.drone.shared_with is not None:
            return None
        claim = self.claims().get(plan.drone.node)
        return plan.drone.node if claim is not None and claim.uid != uid else None

    def in_the_air(self, node: str) -> bool:
        """Whether a drone flies; one whose object went while it flew still does, for all that is known."""
        drone = self.drones.get(("", node))
        return is_flying(drone) if drone is not None else node in self._aloft

    def aloft(self, plan: DeploymentPlanSpec | None) -> str | None:
        """The drone of a plan, while it flies."""
        drone = plan.drone.node if plan is not None and plan.drone is not None else None
        return drone if drone is not None and self.in_the_air(drone) else None

    def pods_of(self, key: Key) -> list[PodView]:
        """The pods of an application."""
        return list(self._pods.get(_place(key), {}).values())

    def grants_of(self, key: Key, uid: str | None = None) -> list[Grant]:
        """The grants of an application; with a uid, only of the one that has it."""
        return [
            grant
            for grant in self._grants.values()
            if (grant.spec.application.namespace, grant.spec.application.name) == key
            and uid in (None, grant.spec.application.uid)
        ]

    def children_of(self, key: Key, kind: Kind) -> list[Body]:
        """What was made of a kind for an application."""
        namespace, name = key
        return [
            body
            for body in self.children[kind].values()
            if body["metadata"]["labels"][APPLICATION_LABEL] == label_value(name)
            and (body["metadata"].get("namespace") or body["metadata"]["labels"].get(NAMESPACE_LABEL)) == namespace
        ]

    # -- deciding --

    def decide(self, key: Key, uid: str, plan: DeploymentPlanSpec) -> None:
        """Note a plan as soon as it is made, so that the next one already sees its claims and bookings."""
        self._decided[key] = OwnedPlan(uid, plan)

    def forget(self, key: Key) -> None:
        """Drop the plan of an application that is over; its drone is free once it is home."""
        if self._decided.pop(key, None) is not None:
            self.wake_all()

    def wake_all(self, *, urgent: bool = False) -> None:
        """Wake every application: something they all depend on changed."""
        for subscription in itertools.chain.from_iterable(self._subscriptions.values()):
            subscription.wake(urgent=urgent)

    def wake(self, key: Key) -> None:
        """Wake one application."""
        for subscription in self._subscriptions.get(_place(key), ()):
            subscription.wake()

    # -- what reflectors report --

    def _host_changed(self, key: Key, old: Host | None, new: Host | None) -> None:
        self._report(kinds.NODE, key)
        if new is None:
            self._where.remove_host(key[1])
        else:
            self._where.upsert_host(new.name, new.node_class)
        self.wake_all()

    def _pod_changed(self, key: Key, old: PodView | None, new: PodView | None) -> None:
        self._bookings.changed(old, new)
        for pod in (old, new):
            if pod is not None and pod.application is not None:
                place = (pod.namespace, pod.application)
                pods = self._pods.setdefault(place, {})
                if pod is new:
                    pods[key] = pod
                elif pods.pop(key, None) is not None and not pods:
                    del self._pods[place]
                self.wake(place)

    def _drone_changed(self, key: Key, old: Drone | None, new: Drone | None) -> None:
        self._report(kinds.DRONE, key)
        if new is not None:
            (self._aloft.add if is_flying(new) else self._aloft.discard)(new.name)
            if old is None or _stand(old) != _stand(new):
                self._where.upsert_drone(new)
        else:
            self._where.remove_drone(key[1])
        if old is None or new is None or old.spec != new.spec or old.metadata.labels != new.metadata.labels:
            self.rules_revision += 1
            self.wake_all()
        elif _planning_view(old) != _planning_view(new):
            self.wake_all()

    def _edge_node_changed(self, key: Key, old: EdgeNode | None, new: EdgeNode | None) -> None:
        self._report(kinds.EDGE_NODE, key)
        if new is None:
            self._where.remove_edge_node(key[1])
        elif old is None or old.spec.location != new.spec.location:
            self._where.upsert_edge_node(new)
        if old is None or new is None or old.spec != new.spec or old.metadata.labels != new.metadata.labels:
            self.rules_revision += 1
            self.wake_all()

    def _depot_changed(self, key: Key, old: Depot | None, new: Depot | None) -> None:
        if new is None:
            self._where.remove_depot(key[1])
        else:
            self._where.upsert_depot(new)
        self._spec_changed(kinds.DEPOT)(key, old, new)

    def _spec_changed(self, kind: Kind) -> Callable[[Key, Any, Any], None]:
        def changed(key: Key, old: Any, new: Any) -> None:
            self._report(kind, key)
            if old is None or new is None or type(old) is not type(new) or old.spec != new.spec:
                self.rules_revision += 1
                self.wake_all(urgent=True)

        return changed

    def _application_changed(self, key: Key, old: Submitted | None, new: Submitted | None) -> None:
        self._report(kinds.APPLICATION, key)
        if new is None:
            self._decided.pop(key, None)
        if old is None or new is None or old.settled_generation != new.settled_generation:
            self.wake_all()
        else:
            self.wake(key)

    def _child_changed(self, key: Key, _old: Body | None, new: Body | None) -> None:
        body = new or _old or {}
        if body.get("kind") == Grant.KIND:
            self._grant_changed(key, new)
        elif body.get("kind") == DeploymentPlan.KIND:
            self._plan_changed(key, new)
        labels = body.get("metadata", {}).get("labels", {})
        if APPLICATION_LABEL in labels:
            self.wake((key[0] or labels.get(NAMESPACE_LABEL, ""), labels[APPLICATION_LABEL]))

    def _grant_changed(self, key: Key, new: Body | None) -> None:
        grant = self._areas.grant(new) if new is not None else None
        if grant is None:
            self._grants.pop(key, None)
            self.wake_all()
        else:
            self._grants[key] = grant
        self._report(kinds.GRANT, key)

    def _plan_changed(self, key: Key, new: Body | None) -> None:
        plan = reader(DeploymentPlan)(new) if new is not None else None
        owner = next((o.uid for o in plan.metadata.owner_references), None) if plan is not None else None
        if plan is None or owner is None:
            self._plans.pop(key, None)
        else:
            self._plans[key] = OwnedPlan(owner, plan.spec)

    def _report_only(self, kind: Kind) -> Callable[[Key, Body | None, Body | None], None]:
        return lambda key, _old, _new: self._report(kind, key)

    def _report(self, kind: Kind, key: Key) -> None:
        for listener in self._listeners.get(kind, ()):
            listener(key)

    # -- bookings --

    def _planned(self) -> Iterator[Asked]:
        """Each planned instance on a node, with what it asks for."""
        plans = self.plans()
        for gone in self._asked.keys() - plans.keys():
            del self._asked[gone]
        for key, plan in plans.items():
            submitted = self.applications.get(key)
            if submitted is None:
                continue
            known = self._asked.get(key)
            if known is None or known[0] is not plan or known[1] is not submitted:
                known = self._asked[key] = (plan, submitted, tuple(_asked(key, plan, submitted)))
            yield from known[2]

    def _claim_on_record(self, drone: str) -> Claim:
        """Who flew the drone last, from the applications' statuses, for an operator that was restarted since."""
        for key, submitted in sorted(self.applications.items()):
            if (submitted.body.get("status") or {}).get("drone") == drone:
                return Claim(key, submitted.uid)
        return Claim(("fractus-system", "flight-home"), "")


def is_flying(drone: Drone) -> bool:
    """Whether the drone is on its way."""
    return drone.status is not None and drone.status.flight_state not in {"inactive", "charging"}


def _planning_view(drone: Drone) -> tuple[object, ...]:
    """What of a drone decides over plans; its position does not."""
    status = drone.status
    ready = next((c.status for c in status.conditions if c.type == "Ready"), None) if status else None
    return (drone.spec, is_flying(drone), ready)


def _asked(key: Key, plan: OwnedPlan, submitted: Submitted) -> Iterator[Asked]:
    components = {c.name: c for c in submitted.application.spec.components} if submitted.application else {}
    for placed in plan.spec.placements:
        if placed.node is not None and placed.component in components:
            yield _place(key), placed.instance, placed.node, requests(components[placed.component])


def _stand(drone: Drone) -> tuple[object, ...]:
    return (drone.spec.depot, drone.spec.home)


def _place(key: Key) -> Key:
    """The application as labels name it."""
    return (key[0], label_value(key[1]))


def _without_status(body: Body) -> Body:
    """A Deployment without what changes all the time while its pods come up."""
    kept = {name: value for name, value in body.items() if name != "status"}
    kept["metadata"] = {n: v for n, v in body["metadata"].items() if n != "resourceVersion"}
    annotations = dict(kept["metadata"].get("annotations") or {})
    annotations.pop("deployment.kubernetes.io/revision", None)
    kept["metadata"]["annotations"] = annotations
    return kept


def _as_is(body: Body) -> Body:
    return body
