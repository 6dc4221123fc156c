"""Cache of the cluster: informers of all inputs, indexes on them, the input of planning, and wake-ups of reconcilers."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from fractus_core.airspace import Volume4D
from fractus_core.api import (
    ApplicationTemplate,
    DeploymentPlan,
    Depot,
    DirectLink,
    Drone,
    EdgeNode,
    FlightPlan,
    Grant,
    Policy,
    Zone,
)
from fractus_core.api.names import NODE_SIGNER
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.planning.candidates import readiness
from fractus_core.planning.grant_compiler import PERMITTING_KINDS
from fractus_core.planning.inventory import Flight, Host, Inventory
from fractus_core.planning.spatial_index import NodeLocations

from fractus_operator import kinds
from fractus_operator.active_plans import ActivePlans
from fractus_operator.bookings import BookedHosts, Bookings, ByName
from fractus_operator.drone_claims import Claim, DroneHolders, Fleet, offered_flights, shared_flight_lost
from fractus_operator.flight_matching import SOON_S
from fractus_operator.flight_plan_index import FlightPlanIndex
from fractus_operator.kinds import Body, Key, Kind
from fractus_operator.labels import label_key
from fractus_operator.node_objects import NodeObjects
from fractus_operator.node_services import NodeServicePods, parse_revision
from fractus_operator.owned_objects import GroupedObjects, OwnedObjects, application_label_key
from fractus_operator.parsing import Submitted, Unreadable, optional_parser, parse_application, tolerant_parser
from fractus_operator.pods import (
    REFUSED,
    REPLICA_FAILURE,
    PlannedRequest,
    PodView,
    parse_host,
    parse_pod,
    refusal_of,
)
from fractus_operator.store import Informer, Store
from fractus_operator.work_queue import Subscriptions

log = logging.getLogger(__name__)

_WITHOUT_STATUS = frozenset({kinds.DEPLOYMENT, kinds.DIRECT_LINK})
"""Kinds of child objects whose status changes often and is used by no decision."""


@dataclass(frozen=True, slots=True)
class ObservedApplication:
    """An Application with the inputs of its next step, all read at the same time. The object is valid until the next await.

    Attributes:
        plan: The active plan, if any.
        pods: Pods of the current mission.
        grants: All Grants under its name, including Grants of an earlier Application with the same name.
        host: The Application whose flight it shares, and the latest plan of that Application. Each may be None.
        in_flight: The drone of its plan while that drone is in flight.
        rules: Revision of the inputs of Grants.
    """

    submitted: Submitted
    plan: DeploymentPlanSpec | None
    pods: Sequence[PodView]
    grants: Sequence[Grant]
    host: tuple[Submitted | None, DeploymentPlanSpec | None]
    in_flight: str | None
    rules: int

    @property
    def key(self) -> Key:
        """(namespace, name) of the Application."""
        return self.submitted.key

    @property
    def uid(self) -> str:
        """The uid of the Application."""
        return self.submitted.uid


class ClusterCache:
    """The cluster as the operator knows it, current within the delay of a watch event.

    Args:
        store: The API server.
        namespace: Namespace of the Fractus services.

    Attributes:
        informers: All informers. Run each one in its own task.
        torn_down: The uids of Applications whose teardown has begun. Nothing more is created for them.
        rules_revision: Number of changes of the inputs of Grants: zones, policies, depots, and specs of nodes.
    """

    def __init__(self, store: Store, namespace: str = "fractus-system") -> None:
        self.services = NodeServicePods(namespace)
        self.revisions = Informer(
            store, kinds.CONTROLLER_REVISION, parse_revision, self.services.revision_changed, namespace=namespace
        )
        self.node_objects = NodeObjects(store)
        self.hosts = Informer(store, kinds.NODE, parse_host, self._host_changed)
        self.namespaces = Informer(store, kinds.NAMESPACE, _is_being_deleted, self._namespace_changed)
        self.pods = Informer(store, kinds.POD, parse_pod, self._pod_changed)
        self.drones = Informer(store, kinds.DRONE, optional_parser(Drone), self._drone_changed)
        self.edge_nodes = Informer(store, kinds.EDGE_NODE, optional_parser(EdgeNode), self._edge_node_changed)
        self.depots = Informer(store, kinds.DEPOT, optional_parser(Depot), self._depot_changed)
        self.zones = Informer(store, kinds.ZONE, tolerant_parser(Zone), self._zone_changed)
        self.policies = Informer(store, kinds.POLICY, tolerant_parser(Policy), self._policy_changed)
        self.applications = Informer(store, kinds.APPLICATION, parse_application, self._application_changed)
        self.templates = Informer(
            store,
            kinds.APPLICATION_TEMPLATE,
            optional_parser(ApplicationTemplate),
            lambda key, _old, _new: self._notify(kinds.APPLICATION_TEMPLATE, key),
        )
        self.flight_plans = Informer(store, kinds.FLIGHT_PLAN, tolerant_parser(FlightPlan), self._flight_plan_changed)
        self.flights = FlightPlanIndex(self._reservation_changed)
        self.signing_requests = Informer(
            store,
            kinds.SIGNING_REQUEST,
            _unchanged,
            lambda key, _old, _new: self._notify(kinds.SIGNING_REQUEST, key),
            selectors={"fieldSelector": f"spec.signerName={NODE_SIGNER}"},
        )
        self.children: dict[Kind, OwnedObjects] = {
            kind: OwnedObjects(
                store, kind, _without_status if kind in _WITHOUT_STATUS else _unchanged, self._child_changed
            )
            for kind in kinds.CHILDREN
        }
        self.subscriptions = Subscriptions()
        self.fleet = Fleet(self.drones, self.applications)
        self._bookings = Bookings()
        self.plans = ActivePlans(self.applications, self.subscriptions.wake, self.fleet, self._requests_changed)
        self.torn_down: dict[Key, str] = {}
        self.rules_revision = 0
        self._listeners: dict[Kind, list[Callable[[Key], None]]] = {}
        self._flight_rules_listeners: list[Callable[[Key], None]] = []
        self._grants: GroupedObjects[Grant] = GroupedObjects()
        self._known_grants: dict[Key, Grant] = {}
        self._pods: GroupedObjects[PodView] = GroupedObjects()
        self._locations = NodeLocations()
        self.informers: tuple[Informer[Any], ...] = (
            *(value for value in vars(self).values() if isinstance(value, Informer)),
            *self.children.values(),
            *self.node_objects.informers,
        )

    async def synced(self) -> None:
        """Wait until every kind was listed once. Decisions need all kinds."""
        for informer in self.informers:
            await informer.synced.wait()

    def oldest_contact_s(self) -> float:
        """Return the seconds since the last message of the watch that has been silent for longest."""
        return max(informer.age_s() for informer in self.informers)

    def add_listener(self, kind: Kind, listener: Callable[[Key], None]) -> None:
        """Call the listener with the key of every object of the kind that is created, changed or deleted."""
        self._listeners.setdefault(kind, []).append(listener)

    def add_flight_rules_listener(self, listener: Callable[[Key], None]) -> None:
        """Call the listener with the key of every FlightPlan that a changed policy or zone may concern."""
        self._flight_rules_listeners.append(listener)

    # -- reading --

    def observe(self, submitted: Submitted) -> ObservedApplication:
        """Return an Application with the inputs of its next step."""
        key = submitted.key
        plan = self.plans.get(key, submitted.uid)
        return ObservedApplication(
            submitted,
            plan,
            pods=self.pods_of(key),
            grants=self.grants_of(key),
            host=self.plans.flight_host(plan),
            in_flight=self.fleet.drone_in_flight(plan),
            rules=self.rules_revision,
        )

    def snapshot(self, key: Key, uid: str, flights: Mapping[str, Flight] | None = None) -> Inventory:
        """Return the input for planning an Application and for compiling its Grants. The result is valid until the next await.

        Args:
            key: The Application. Resources of its own pods count as free.
            uid: Uid of the Application. A claim under its name with another uid belongs to another Application.
            flights: Flights of claimed drones that the Application may share.
        """
        label = label_key(key)
        submitted = self.applications.get(key)
        plan_uid = submitted.flight_plan_uid if submitted is not None else None
        return Inventory(
            hosts=BookedHosts(self.hosts, self._bookings, label, self._pods.of(label)),
            drones=ByName(self.drones),
            edge_nodes=ByName(self.edge_nodes),
            depots=self.depots_by_name(),
            zones={z.name: z for z in self.zones.values() if isinstance(z, Zone)},
            policies={p.name: p for p in self.policies.values() if isinstance(p, Policy)},
            unreadable_zones={z.name: z.problem for z in self.zones.values() if isinstance(z, Unreadable)},
            unreadable_policies={p.name: p.problem for p in self.policies.values() if isinstance(p, Unreadable)},
            claimed=DroneHolders(self.fleet.claims(), uid),
            flights=flights or {},
            reservations=self.flights.reservations(plan_uid),
            locations=self._locations,
        )

    def planning_input(
        self, observed: ObservedApplication, radius_m: float
    ) -> tuple[Inventory, tuple[str, str] | None]:
        """Return the input for planning an Application, and the reason if its plan has lost its drone.

        Args:
            observed: The Application. There was no await since it was observed.
            radius_m: Maximum distance of a drone from its path, in metres.

        Returns:
            The inventory, and None or a CamelCase reason with a sentence. A plan has lost its drone if another Application
            holds the drone, or if the shared flight is over or has another route.
        """
        application = observed.submitted.application
        plan = observed.plan
        flights: Mapping[str, Flight] = {}
        spec = application.spec if application is not None else None
        if spec is not None and spec.driver is None and spec.points_of_interest is not None:
            # An Application without a driver may share the flight of another Application that visits its points of
            # interest.
            others = (m for m in self.fleet.active_missions() if m.application.key != observed.key)
            flights = offered_flights(others, self.depots_by_name(), radius_m, plan)
        inventory = self.snapshot(observed.key, observed.uid, flights)
        if plan is None or plan.drone is None:
            return inventory, None
        node = plan.drone.node
        if plan.drone.shared_with is None:
            claim = self.fleet.claims().get(node)
            lost = claim is not None and claim.uid != observed.uid
            return inventory, ("DroneBusy", f"another Application holds {node}") if lost else None
        if application is None:
            return inventory, None
        message = shared_flight_lost(application, plan, observed.host[1], flights.get(node), radius_m)
        return inventory, ("SharedFlightLost", message) if message is not None else None

    def flight_inventory(self, plan: FlightPlan, now_s: float, own: str | None) -> Inventory:
        """Return the input for matching a flight plan with a drone. The result is valid until the next await.

        Claims that end before the window are omitted. Bookings are omitted if the window begins later than `SOON_S`.

        Args:
            plan: The plan.
            now_s: Time in seconds since 1970 UTC.
            own: Uid of the plan whose reservation is omitted, because `plan` may use it.
        """
        begin_s = max(plan.spec.window.begin_s, now_s)
        inventory = self.snapshot(("", ""), "")
        claimed = {
            drone: claim.holder(None)
            for drone, claim in self.fleet.claims().items()
            if self._claimed_until_s(claim, now_s) >= begin_s
        }
        return replace(
            inventory,
            hosts=ByName(self.hosts) if begin_s - now_s > SOON_S else inventory.hosts,
            claimed=claimed,
            reservations=self.flights.reservations(own),
        )

    def _claimed_until_s(self, claim: Claim, now_s: float) -> float:
        """Return until when an Application may need its drone: the duration of its mission from now."""
        plan = self.plans.get(claim.key, claim.uid)
        mission = plan.drone.mission if plan is not None and plan.drone is not None else None
        return now_s + (mission.duration * 60 if mission is not None else SOON_S)

    def is_being_deleted(self, namespace: str) -> bool:
        """Return True if a namespace is being deleted."""
        return bool(self.namespaces.get(("", namespace)))

    def drone(self, name: str) -> Drone | None:
        """Return a valid Drone by name, or None."""
        return self.drones.get(("", name))

    def depots_by_name(self) -> Mapping[str, Depot]:
        """Return the depots by name."""
        return ByName(self.depots)

    def pods_of(self, key: Key, *, kept: bool = False) -> list[PodView]:
        """Return the pods of the current mission of an Application, or the kept pods of its last mission."""
        return [pod for pod in self._pods.of(label_key(key)) if (pod.finished_at is not None) == kept]

    def grants_of(self, key: Key) -> list[Grant]:
        """Return the Grants of an Application, including Grants of an earlier Application with the same name."""
        return list(self._grants.of(key))

    def forget(self, key: Key) -> None:
        """Drop the plan of an Application whose mission is over. Its drone is free when it has returned."""
        if self.plans.forget(key):
            self.subscriptions.wake_waiting()

    # -- handlers of informers --

    def _host_changed(self, key: Key, old: Host | None, new: Host | None) -> None:
        self._notify(kinds.NODE, key)
        if new is None:
            self._locations.remove_host(key[1])
        else:
            self._locations.upsert_host(new.name, new.is_cloud)
        if _host_inputs(old) != _host_inputs(new):
            self.subscriptions.wake_all()

    def _namespace_changed(self, key: Key, _old: bool | None, new: bool | None) -> None:
        if new:
            for submitted in self.applications.values():
                if submitted.key[0] == key[1]:
                    self.subscriptions.wake(submitted.key, urgent=True)

    def _pod_changed(self, key: Key, old: PodView | None, new: PodView | None) -> None:
        self._bookings.pod_changed(old, new)
        self.services.pod_changed(key, old, new)
        for pod in (old, new):
            if pod is not None and pod.application is not None:
                owner = (pod.namespace, pod.application)
                if pod is new:
                    self._pods.put(owner, key, pod)
                else:
                    self._pods.drop(owner, key)
                self.subscriptions.wake(owner)
        occupied = _occupied(old)
        if occupied is not None and occupied != _occupied(new):
            self.subscriptions.wake_for_capacity(occupied[0])

    def _drone_changed(self, key: Key, old: Drone | None, new: Drone | None) -> None:
        self.fleet.drone_changed(key[1], new)
        self._notify(kinds.DRONE, key)
        if new is None:
            self._locations.remove_drone(key[1])
        elif old is None or (old.spec.depot, old.spec.home) != (new.spec.depot, new.spec.home):
            self._locations.upsert_drone(new)
        if _rules_differ(old, new):
            self._rules_changed()
            self._report_flights([plan for plan, _ in self.flights.on_drone(key[1])])
        elif old is not None and new is not None and _planning_inputs(old) != _planning_inputs(new):
            # A takeoff needs no wake-up: the drone is not released, and the part of its flight that others can share
            # shrinks.
            took_off = new.in_air and not old.in_air and _ready(old) == _ready(new)
            if not took_off:
                self.subscriptions.wake_waiting()
            self._wake_applications_on(new.name)
        elif old is not None and new is not None and _reported_state(old) != _reported_state(new):
            self._wake_applications_on(new.name)

    def _requests_changed(self, application: Key, requests: Sequence[PlannedRequest]) -> None:
        for node in self._bookings.plan_changed(application, requests):
            self.subscriptions.wake_for_capacity(node)

    def _wake_applications_on(self, drone: str) -> None:
        """Wake the Applications on a drone, including Applications that share its flight."""
        for application in self.fleet.applications_on(drone):
            self.subscriptions.wake(application)

    def _edge_node_changed(self, key: Key, old: EdgeNode | None, new: EdgeNode | None) -> None:
        self._notify(kinds.EDGE_NODE, key)
        if new is None:
            self._locations.remove_edge_node(key[1])
        elif old is None or old.spec.location != new.spec.location:
            self._locations.upsert_edge_node(new)
        if _rules_differ(old, new):
            self._rules_changed()
        elif old is not None and new is not None and _ready(old) != _ready(new):
            self.subscriptions.wake_all()

    def _depot_changed(self, key: Key, old: Depot | None, new: Depot | None) -> None:
        if new is None:
            self._locations.remove_depot(key[1])
        else:
            self._locations.upsert_depot(new)
        self._spec_changed(kinds.DEPOT, key, old, new)

    def _zone_changed(self, key: Key, old: Zone | Unreadable | None, new: Zone | Unreadable | None) -> None:
        self._spec_changed(kinds.ZONE, key, old, new)
        zones = [each for each in (old, new) if isinstance(each, Zone)]
        policies = [each for each in self.policies.values() if _names_zone(each, key[1])]
        # A policy with a missing zone is invalid at all places.
        changed = isinstance(old, Zone) and isinstance(new, Zone)
        local = all(map(_is_local, policies)) if changed else not policies and bool(zones)
        self._restriction_changed(zones if local else None, old, new)

    def _policy_changed(self, key: Key, old: Policy | Unreadable | None, new: Policy | Unreadable | None) -> None:
        self._spec_changed(kinds.POLICY, key, old, new)
        versions = [each for each in (old, new) if each is not None]
        if all(map(_is_local, versions)):
            names = [name for each in versions if isinstance(each, Policy) for name in each.spec.selector.zones]
            named = [self.zones.get(("", name)) for name in names]
            self._restriction_changed([zone for zone in named if isinstance(zone, Zone)], old, new)
        else:
            self._restriction_changed(None, old, new)

    def _restriction_changed(self, zones: Sequence[Zone] | None, old: Any, new: Any) -> None:
        """Report the flight plans in some zones that a changed policy or zone may concern. None: report all plans."""
        if old is not None and new is not None and type(old) is type(new) and old.spec == new.spec:
            return
        self._report_flights(self.flights.keys() if zones is None else self.flights.in_zones(zones))

    def _report_flights(self, plans: Iterable[Key]) -> None:
        # During the first list every plan is judged anyway.
        if self.flight_plans.synced.is_set():
            for plan in plans:
                for listener in self._flight_rules_listeners:
                    listener(plan)

    def _spec_changed(self, kind: Kind, key: Key, old: Any, new: Any) -> None:
        self._notify(kind, key)
        if old is None or new is None or type(old) is not type(new) or old.spec != new.spec:
            self._rules_changed(urgent=True)

    def _rules_changed(self, *, urgent: bool = False) -> None:
        self.rules_revision += 1
        self.subscriptions.wake_all(urgent=urgent, first=self.fleet.applications_in_flight())

    def _application_changed(self, key: Key, old: Submitted | None, new: Submitted | None) -> None:
        self.plans.application_changed(key)
        self._notify(kinds.APPLICATION, key)
        if new is None:
            self.plans.forget(key)
            self.torn_down.pop(key, None)
        if old is None or new is None:
            self.plans.wake_guests(key)
            # A new Application releases no resources.
            if old is not None:
                self.subscriptions.wake_waiting()
        self.subscriptions.wake(key, urgent=_changed_by_user(old, new))

    def _flight_plan_changed(
        self, key: Key, _old: FlightPlan | Unreadable | None, new: FlightPlan | Unreadable | None
    ) -> None:
        if isinstance(new, Unreadable):
            # The last known reservation stays.
            log.warning("cache: invalid FlightPlan ignored (plan=%s/%s error=%s)", *key, new.problem)
            return
        before = self.flights.get(key)
        self.flights.plan_changed(key, new)
        if before is not None and self.flights.get(key) != before:
            self.subscriptions.wake_waiting()
        self._notify(kinds.FLIGHT_PLAN, key)

    def _reservation_changed(self, key: Key, volumes: Sequence[Volume4D]) -> None:
        # During the first list every plan is queued anyway.
        if self.flight_plans.synced.is_set():
            for plan in self.flights.overlapping(key, volumes):
                self._notify(kinds.FLIGHT_PLAN, plan)

    def _child_changed(self, key: Key, old: Body | None, new: Body | None) -> None:
        body = new or old or {}
        if body.get("kind") == Grant.KIND:
            self._grant_changed(key, new)
            self.node_objects.grant_changed(key, old, new)
        elif body.get("kind") == DeploymentPlan.KIND:
            self.plans.plan_object_changed(key, new)
            if new is None:
                self.subscriptions.wake_waiting()
            self._notify(kinds.DEPLOYMENT_PLAN, key)
        elif body.get("kind") == DirectLink.KIND:
            self._notify(kinds.DIRECT_LINK, key)
        self.subscriptions.wake(application_label_key(body))

    def _grant_changed(self, key: Key, new: Body | None) -> None:
        grant = optional_parser(Grant)(new) if new is not None else None
        known = self._known_grants.pop(key, None)
        if known is not None:
            self._grants.drop(_grant_owner(known), key)
        if grant is not None:
            self._known_grants[key] = grant
            self._grants.put(_grant_owner(grant), key, grant)
        self.fleet.grant_changed(key, known, grant)
        if grant is None:
            self.subscriptions.wake_waiting()
        self._notify(kinds.GRANT, key)

    def _notify(self, kind: Kind, key: Key) -> None:
        for listener in self._listeners.get(kind, ()):
            listener(key)


def _is_local(policy: Policy | Unreadable) -> bool:
    """Return True if a policy concerns only flights in its zones.

    An inclusion concerns flights outside of its zones, and the user selects an action also for zones far from the route.
    """
    if isinstance(policy, Unreadable):
        return False
    return bool(policy.spec.selector.zones) and policy.spec.kind not in PERMITTING_KINDS and not policy.spec.choices


def _names_zone(policy: Policy | Unreadable, zone: str) -> bool:
    return isinstance(policy, Unreadable) or zone in policy.spec.selector.zones


def _host_inputs(host: Host | None) -> tuple[object, ...] | None:
    """Return the fields of a Node that planning uses. The location is a field of its Drone or EdgeNode."""
    return (host.is_cloud, host.allocatable, host.ready, host.schedulable) if host is not None else None


def _changed_by_user(old: Submitted | None, new: Submitted | None) -> bool:
    """Return True if a user changed the spec of an Application. Changes of the status are ignored."""
    return old is not None and new is not None and old.metadata.generation != new.metadata.generation


def _is_being_deleted(namespace: Body) -> bool:
    """Return True if a Namespace is being deleted."""
    return "deletionTimestamp" in namespace["metadata"]


def _occupied(pod: PodView | None) -> tuple[str, Mapping[str, float]] | None:
    """Return the node and the resources that a pod occupies, or None if the pod occupies no resources."""
    return (pod.node, pod.requests) if pod is not None and pod.node is not None and not pod.finished else None


def _grant_owner(grant: Grant) -> Key:
    return grant.spec.application.namespace, grant.spec.application.name


def _rules_differ(old: Drone | EdgeNode | None, new: Drone | EdgeNode | None) -> bool:
    """Return True if a node was created, deleted, or changed in a field that policies select or Grants contain."""
    return old is None or new is None or old.spec != new.spec or old.metadata.labels != new.metadata.labels


def _planning_inputs(drone: Drone) -> tuple[object, ...]:
    """Return the fields of a drone's status that planning uses. Planning does not use the position."""
    return drone.in_air, _ready(drone)


def _reported_state(drone: Drone) -> tuple[object, ...]:
    """Return the fields of a drone's status that its Application reports."""
    return (drone.status.flight_state, drone.status.controller) if drone.status is not None else ()


def _ready(node: Drone | EdgeNode) -> str | None:
    condition = readiness(node.status)
    return condition.status if condition is not None else None


def _without_status(body: Body) -> Body:
    """Return a child object without its status, except for the condition that pods cannot be created."""
    kept = {name: value for name, value in body.items() if name != "status"}
    refused = refusal_of(body)
    if refused:
        failure = {"type": REPLICA_FAILURE, "status": "True", "reason": REFUSED, "message": refused}
        kept["status"] = {"conditions": [failure]}
    kept["metadata"] = {n: v for n, v in body["metadata"].items() if n != "resourceVersion"}
    annotations = dict(kept["metadata"].get("annotations") or {})
    annotations.pop("deployment.kubernetes.io/revision", None)
    kept["metadata"]["annotations"] = annotations
    return kept


def _unchanged(body: Body) -> Body:
    return body
