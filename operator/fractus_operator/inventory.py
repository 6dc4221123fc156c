"""A current, typed view of the cluster, fed by reflectors; hands planning its input and wakes who depends on it."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

from fractus_core.api import (
    Application,
    DeploymentPlan,
    Depot,
    Drone,
    EdgeNode,
    Grant,
    InvalidObject,
    Metadata,
    Policy,
    Resource,
    Zone,
)
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.planning.candidates import requests
from fractus_core.planning.inventory import Host, Inventory

from fractus_operator import kinds
from fractus_operator.kinds import Body, Key, Kind
from fractus_operator.labels import APPLICATION_LABEL, MANAGED_SELECTOR, NAMESPACE_LABEL, label_value
from fractus_operator.pods import PodView, read_host, read_pod
from fractus_operator.reflector import Reflector
from fractus_operator.store import Store

logger = logging.getLogger(__name__)

R = TypeVar("R", bound=Resource)

SETTLED = frozenset({"Completed", "Failed"})
"""Phases of an application whose mission is over."""

SIGNER = "fractus.dev/node"


@dataclass(frozen=True)
class Submitted:
    """An Application as it was submitted: parsed, or with the reason why it cannot be."""

    body: Body
    application: Application | None
    error: InvalidObject | None

    @property
    def metadata(self) -> Metadata:
        """Its metadata."""
        return Metadata.model_validate(self.body["metadata"])

    @property
    def settled(self) -> bool:
        """Whether the mission of this generation is over."""
        status = self.body.get("status") or {}
        return status.get("phase") in SETTLED and status.get("observedGeneration") == self.body["metadata"].get(
            "generation"
        )


def read_submitted(body: Body) -> Submitted:
    """Parse an Application, keeping what cannot be parsed with the reason."""
    body["metadata"].pop("managedFields", None)
    try:
        return Submitted(body, Application.from_body(body), None)
    except InvalidObject as error:
        return Submitted(body, None, error)


@dataclass(frozen=True, slots=True)
class OwnedPlan:
    """A plan and the uid of the Application it is for: one made anew under an old name does not inherit it."""

    uid: str
    spec: DeploymentPlanSpec


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


def _model(model: type[R]) -> Callable[[Body], R | None]:
    def parse(body: Body) -> R | None:
        try:
            return model.from_body(body)
        except InvalidObject as error:
            logger.warning("%s %s is left out: %s", model.KIND, body["metadata"]["name"], error)
            return None

    return parse


class LiveInventory:
    """What the operator knows of the cluster, current within a watch event's delay."""

    def __init__(self, store: Store) -> None:
        managed = {"labelSelector": MANAGED_SELECTOR}
        self.hosts = Reflector(store, kinds.NODE, read_host, self._host_changed)
        self.pods = Reflector(store, kinds.POD, read_pod, self._pod_changed)
        self.drones = Reflector(store, kinds.DRONE, _model(Drone), self._drone_changed)
        self.edge_nodes = Reflector(store, kinds.EDGE_NODE, _model(EdgeNode), self._edge_node_changed)
        self.depots = Reflector(store, kinds.DEPOT, _model(Depot), self._spec_changed)
        self.zones = Reflector(store, kinds.ZONE, _model(Zone), self._spec_changed)
        self.policies = Reflector(store, kinds.POLICY, _model(Policy), self._spec_changed)
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
        self._last_holder: dict[str, Key] = {}
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

    def snapshot(self) -> Inventory:
        """The input of planning and of grants, as of now."""
        return Inventory(
            hosts=self._hosts_with_requests(),
            drones=_by_name(self.drones),
            edge_nodes=_by_name(self.edge_nodes),
            depots=_by_name(self.depots),
            zones=_by_name(self.zones),
            policies=_by_name(self.policies),
            claimed=self.claimed(),
        )

    def plans(self) -> dict[Key, DeploymentPlanSpec]:
        """The plan of every application whose mission is not over."""
        active: dict[Key, DeploymentPlanSpec] = {}
        for key, plan in (self._plans | self._decided).items():
            submitted = self.applications.get(key)
            if submitted is None or submitted.metadata.uid != plan.uid:
                continue
            if key in self._decided or not submitted.settled:
                active[key] = plan.spec
        return active

    def plan_of(self, key: Key, uid: str) -> DeploymentPlanSpec | None:
        """The plan last made for the application with this uid."""
        plan = self._decided.get(key) or self._plans.get(key)
        return plan.spec if plan is not None and plan.uid == uid else None

    def claimed(self) -> dict[str, Key]:
        """Which application has which drone.

        A drone is claimed from the plan on until its grants are gone and it has come home.
        """
        claims = {plan.drone.node: key for key, plan in self.plans().items() if plan.drone is not None}
        for grant in self._grants.values():
            owner = grant.spec.application
            claims.setdefault(grant.spec.node, (owner.namespace, owner.name))
        for drone in self.drones.values():
            if drone is not None and drone.name not in claims and is_flying(drone):
                claims[drone.name] = self._last_holder.get(drone.name) or self._holder_on_record(drone.name)
        self._last_holder.update(claims)
        return claims

    def pods_of(self, key: Key) -> list[PodView]:
        """The pods of an application."""
        namespace, name = key
        label = label_value(name)
        return [
            pod
            for pod in self.pods.values()
            if pod.namespace == namespace and pod.labels.get(APPLICATION_LABEL) == label
        ]

    def grants_of(self, key: Key) -> list[Grant]:
        """The grants of an application."""
        return [
            grant
            for grant in self._grants.values()
            if (grant.spec.application.namespace, grant.spec.application.name) == key
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
        self._decided.pop(key, None)
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
        if old is None or new is None or _planning_view(old) != _planning_view(new):
            self.wake_all()

    def _edge_node_changed(self, key: Key, old: EdgeNode | None, new: EdgeNode | None) -> None:
        self._report(kinds.EDGE_NODE, key)
        if old is None or new is None or old.spec != new.spec:
            self.wake_all()

    def _spec_changed(self, key: Key, old: Any, new: Any) -> None:
        changed = new or old
        for kind in (kinds.ZONE, kinds.POLICY, kinds.DEPOT):
            if changed is not None and kind.name == changed.KIND:
                self._report(kind, key)
        if old is None or new is None or old.spec != new.spec:
            self.wake_all()

    def _application_changed(self, key: Key, old: Submitted | None, new: Submitted | None) -> None:
        self._report(kinds.APPLICATION, key)
        if new is None:
            self._decided.pop(key, None)
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
        grant = _model(Grant)(new) if new is not None else None
        if grant is None:
            self._grants.pop(key, None)
            self.wake_all()
        else:
            self._grants[key] = grant
        self._report(kinds.GRANT, key)

    def _plan_changed(self, key: Key, new: Body | None) -> None:
        plan = _model(DeploymentPlan)(new) if new is not None else None
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
            for placed in plan.placements:
                if placed.node is None or (key[0], placed.instance, placed.node) in bound:
                    continue
                if placed.component in components:
                    total = totals.setdefault(placed.node, {})
                    for resource, amount in requests(components[placed.component]).items():
                        total[resource] = total.get(resource, 0.0) + amount
        return totals.items()

    def _holder_on_record(self, drone: str) -> Key:
        """Who flew the drone last, from the applications' statuses, for an operator that was restarted since."""
        for key, submitted in sorted(self.applications.items()):
            if (submitted.body.get("status") or {}).get("drone") == drone:
                return key
        return ("fractus-system", "flight-home")


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
