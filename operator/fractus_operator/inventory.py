"""A current, typed view of the cluster, fed by reflectors; hands planning its input and wakes who depends on it."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, TypeVar

from fractus_core.api import (
    DeploymentPlan,
    Depot,
    Drone,
    EdgeNode,
    Grant,
    Policy,
    Resource,
    Zone,
)
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.planning.candidates import requests
from fractus_core.planning.inventory import Host, Inventory

from fractus_operator import kinds
from fractus_operator.claims import Claim, OwnedPlan, claims
from fractus_operator.kinds import Body, Key, Kind
from fractus_operator.labels import APPLICATION_LABEL, MANAGED_SELECTOR, NAMESPACE_LABEL, label_value
from fractus_operator.pods import PodView, read_host, read_pod
from fractus_operator.reading import Broken, Submitted, keeping_broken, read_submitted, reader
from fractus_operator.reflector import Reflector
from fractus_operator.store import Store

logger = logging.getLogger(__name__)

R = TypeVar("R", bound=Resource)

SIGNER = "fractus.dev/node"


class Subscription:
    """Wakes one reconciler when an input of its object changed."""

    def __init__(self) -> None:
        self._changed = asyncio.Event()

    def wake(self) -> None:
        """Note a change."""
        self._changed.set()

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


class LiveInventory:
    """What the operator knows of the cluster, current within a watch event's delay."""

    def __init__(self, store: Store) -> None:
        managed = {"labelSelector": MANAGED_SELECTOR}
        self.hosts = Reflector(store, kinds.NODE, read_host, self._host_changed)
        self.pods = Reflector(store, kinds.POD, read_pod, self._pod_changed)
        self.drones = Reflector(store, kinds.DRONE, reader(Drone), self._drone_changed)
        self.edge_nodes = Reflector(store, kinds.EDGE_NODE, reader(EdgeNode), self._edge_node_changed)
        self.depots = Reflector(store, kinds.DEPOT, reader(Depot), self._spec_changed(kinds.DEPOT))
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
            kind: Reflector(store, kind, _as_is, self._child_changed, selectors=managed) for kind in kinds.CHILDREN
        }
        self._subscriptions: dict[Key, Subscription] = {}
        self._listeners: dict[Kind, list[Callable[[Key], None]]] = {}
        self._decided: dict[Key, OwnedPlan] = {}
        self._plans: dict[Key, OwnedPlan] = {}
        self._grants: dict[Key, Grant] = {}
        self._last_claims: dict[str, Claim] = {}
        self._aloft: set[str] = set()
        self._requested: dict[str, dict[str, float]] = {}

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
        place = (key[0], label_value(key[1]))
        subscription = self._subscriptions[place] = Subscription()
        try:
            yield subscription
        finally:
            if self._subscriptions.get(place) is subscription:
                del self._subscriptions[place]

    # -- reading --

    def snapshot(self, uid: str | None = None) -> Inventory:
        """The input of planning and of grants, as of now.

        Args:
            uid: The application that asks: claims under its name that are not its own show another holder.
        """
        return Inventory(
            hosts=self._hosts_with_requests(),
            drones=_by_name(self.drones),
            edge_nodes=_by_name(self.edge_nodes),
            depots=_by_name(self.depots),
            zones={z.name: z for z in self.zones.values() if isinstance(z, Zone)},
            policies={p.name: p for p in self.policies.values() if isinstance(p, Policy)},
            unreadable_zones={z.name: z.problem for z in self.zones.values() if isinstance(z, Broken)},
            unreadable_policies={p.name: p.problem for p in self.policies.values() if isinstance(p, Broken)},
            claimed={node: claim.holder(uid) for node, claim in self.claims().items()},
        )

    def plans(self) -> dict[Key, OwnedPlan]:
        """The plan of every application whose mission is not over."""
        return {key: plan for key, plan in (self._plans | self._decided).items() if self._is_live(key, plan)}

    def plan_of(self, key: Key, uid: str) -> DeploymentPlanSpec | None:
        """The plan of the application with this uid, unless the mission it was made for is over."""
        plan = self._decided.get(key) or self._plans.get(key)
        return plan.spec if plan is not None and plan.uid == uid and self._is_live(key, plan) else None

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

    def pods_of(self, key: Key) -> list[PodView]:
        """The pods of an application."""
        namespace, name = key
        label = label_value(name)
        return [
            pod
            for pod in self.pods.values()
            if pod.namespace == namespace and pod.labels.get(APPLICATION_LABEL) == label
        ]

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

    def wake_all(self) -> None:
        """Wake every application: something they all depend on changed."""
        for subscription in self._subscriptions.values():
            subscription.wake()

    def wake(self, key: Key) -> None:
        """Wake one application."""
        subscription = self._subscriptions.get((key[0], label_value(key[1])))
        if subscription is not None:
            subscription.wake()

    # -- what reflectors report --

    def _host_changed(self, key: Key, old: Host | None, new: Host | None) -> None:
        self._report(kinds.NODE, key)
        self.wake_all()

    def _pod_changed(self, key: Key, old: PodView | None, new: PodView | None) -> None:
        for pod, sign in ((old, -1.0), (new, 1.0)):
            if pod is not None and pod.node is not None and not pod.finished:
                self._book(pod.node, pod.requests, sign)
        pod = new or old
        if pod is not None and APPLICATION_LABEL in pod.labels:
            self.wake((pod.namespace, pod.labels[APPLICATION_LABEL]))

    def _drone_changed(self, key: Key, old: Drone | None, new: Drone | None) -> None:
        self._report(kinds.DRONE, key)
        if new is not None:
            (self._aloft.add if is_flying(new) else self._aloft.discard)(new.name)
        if old is None or new is None or _planning_view(old) != _planning_view(new):
            self.wake_all()

    def _edge_node_changed(self, key: Key, old: EdgeNode | None, new: EdgeNode | None) -> None:
        self._report(kinds.EDGE_NODE, key)
        if old is None or new is None or old.spec != new.spec:
            self.wake_all()

    def _spec_changed(self, kind: Kind) -> Callable[[Key, Any, Any], None]:
        def changed(key: Key, old: Any, new: Any) -> None:
            self._report(kind, key)
            if old is None or new is None or type(old) is not type(new) or old.spec != new.spec:
                self.wake_all()

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
        grant = reader(Grant)(new) if new is not None else None
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

    def _book(self, node: str, amounts: Mapping[str, float], sign: float) -> None:
        booked = self._requested.setdefault(node, {})
        for resource, amount in amounts.items():
            booked[resource] = booked.get(resource, 0.0) + sign * amount

    def _hosts_with_requests(self) -> dict[str, Host]:
        """Hosts with what is booked on them: by pods that run, and by plans whose pods are yet to come."""
        planned = dict(self._planned_amounts())
        hosts = {}
        for host in self.hosts.values():
            booked = self._requested.get(host.name, {})
            extra = planned.get(host.name)
            if extra:
                booked = {r: booked.get(r, 0.0) + extra.get(r, 0.0) for r in booked.keys() | extra.keys()}
            hosts[host.name] = Host(
                host.name, host.labels, host.allocatable, booked, ready=host.ready, schedulable=host.schedulable
            )
        return hosts

    def _planned_amounts(self) -> Iterable[tuple[str, dict[str, float]]]:
        """What planned instances without a bound pod will ask for, by node."""
        bound = {
            (pod.namespace, pod.instance, pod.node) for pod in self.pods.values() if pod.instance and not pod.finished
        }
        totals: dict[str, dict[str, float]] = {}
        for key, plan in self.plans().items():
            submitted = self.applications.get(key)
            if submitted is None or submitted.application is None:
                continue
            components = {c.name: c for c in submitted.application.spec.components}
            for placed in plan.spec.placements:
                if placed.node is None or (key[0], placed.instance, placed.node) in bound:
                    continue
                if placed.component in components:
                    total = totals.setdefault(placed.node, {})
                    for resource, amount in requests(components[placed.component]).items():
                        total[resource] = total.get(resource, 0.0) + amount
        return totals.items()

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


def _as_is(body: Body) -> Body:
    body["metadata"].pop("managedFields", None)
    return body


def _by_name(reflector: Reflector[R | None]) -> dict[str, R]:
    return {name: value for (_, name), value in reflector.items() if value is not None}
