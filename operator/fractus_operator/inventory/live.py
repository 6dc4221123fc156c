"""A current, typed view of the cluster, fed by reflectors; gives planning its input and wakes what depends on it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from fractus_core.api import DeploymentPlan, Depot, DirectLink, Drone, EdgeNode, Grant, Policy, Zone
from fractus_core.api.names import NODE_SIGNER
from fractus_core.planning.candidates import readiness
from fractus_core.planning.inventory import Flight, Host, Inventory
from fractus_core.planning.spatial_index import NodeLocations

from fractus_operator.cluster import kinds
from fractus_operator.cluster.kinds import Body, Key, Kind
from fractus_operator.cluster.labels import labelled
from fractus_operator.cluster.pods import (
    REFUSED,
    REPLICA_FAILURE,
    PlannedRequest,
    PodView,
    read_host,
    read_pod,
    refusal_of,
)
from fractus_operator.cluster.reading import PartPool, Submitted, Unreadable, read_submitted, reader, tolerant_reader
from fractus_operator.cluster.store import Reflector, Store
from fractus_operator.inventory.bookings import BookedHosts, Bookings, ByName
from fractus_operator.inventory.claims import Fleet, HolderNames
from fractus_operator.inventory.grouped import Grouped
from fractus_operator.inventory.made import Made, application_of
from fractus_operator.inventory.node_objects import NodeObjects
from fractus_operator.inventory.node_services import NodeServices, read_revision
from fractus_operator.inventory.observed import Observed
from fractus_operator.inventory.plans import Plans
from fractus_operator.inventory.subscriptions import Subscriptions

_REPORTED_ON = frozenset({kinds.DEPLOYMENT, kinds.DIRECT_LINK})
"""Kinds whose status changes all the time, while pods come up or a drone flies by, and does not matter here."""


class LiveInventory:
    """What the operator knows of the cluster, current within a watch event's delay; the system lives in `namespace`."""

    def __init__(self, store: Store, namespace: str = "fractus-system") -> None:
        parts = PartPool()
        self.services = NodeServices(namespace)
        self.revisions = Reflector(
            store, kinds.CONTROLLER_REVISION, read_revision, self.services.revision_changed, namespace=namespace
        )
        self.node_objects = NodeObjects(store)
        self.hosts = Reflector(store, kinds.NODE, read_host, self._host_changed)
        self.pods = Reflector(store, kinds.POD, read_pod, self._pod_changed)
        self.drones = Reflector(store, kinds.DRONE, parts.sharing(reader(Drone)), self._drone_changed)
        self.edge_nodes = Reflector(store, kinds.EDGE_NODE, parts.sharing(reader(EdgeNode)), self._edge_node_changed)
        self.depots = Reflector(store, kinds.DEPOT, reader(Depot), self._depot_changed)
        self.zones = Reflector(store, kinds.ZONE, tolerant_reader(Zone), self._spec_changed(kinds.ZONE))
        self.policies = Reflector(store, kinds.POLICY, tolerant_reader(Policy), self._spec_changed(kinds.POLICY))
        self.applications = Reflector(store, kinds.APPLICATION, read_submitted, self._application_changed)
        self.signing_requests = Reflector(
            store,
            kinds.SIGNING_REQUEST,
            _as_is,
            lambda key, _old, _new: self._report(kinds.SIGNING_REQUEST, key),
            selectors={"fieldSelector": f"spec.signerName={NODE_SIGNER}"},
        )
        self.children: dict[Kind, Made] = {
            kind: Made(store, kind, _without_status if kind in _REPORTED_ON else _as_is, self._child_changed)
            for kind in kinds.CHILDREN
        }
        self.subscriptions = Subscriptions()
        self.fleet = Fleet(self.drones, self.applications)
        self._bookings = Bookings()
        self.plans = Plans(self.applications, self.subscriptions.wake, self.fleet, self._planned)
        self.torn_down: dict[Key, str] = {}
        """The uids of applications whose teardown has begun, until they are gone: nothing more is made for them."""
        self.rules_revision = 0
        """Counts the changes of what grants are compiled from: zones, policies, depots, and specs of nodes."""
        self._listeners: dict[Kind, list[Callable[[Key], None]]] = {}
        self._grants: Grouped[Grant] = Grouped()
        self._known_grants: dict[Key, Grant] = {}
        self._areas = PartPool(parts=64)
        self._pods: Grouped[PodView] = Grouped()
        self._locations = NodeLocations()

    def reflectors(self) -> list[Reflector[Any]]:
        """Every reflector; run each as a task of its own."""
        own: list[Reflector[Any]] = [r for r in vars(self).values() if isinstance(r, Reflector)]
        return own + list(self.children.values()) + self.node_objects.reflectors()

    async def synced(self) -> None:
        """Wait until every collection was listed once: before that, nothing can be decided."""
        for reflector in self.reflectors():
            await reflector.synced.wait()

    def silence_s(self) -> float:
        """For how long the quietest watch has heard nothing."""
        return max(reflector.age_s() for reflector in self.reflectors())

    def listen(self, kind: Kind, listener: Callable[[Key], None]) -> None:
        """Call the listener with the key of every object of the kind that appears, changes or goes."""
        self._listeners.setdefault(kind, []).append(listener)

    # -- reading --

    def observe(self, submitted: Submitted) -> Observed:
        """An application and what its next step depends on."""
        key = submitted.key
        plan = self.plans.get(key, submitted.uid)
        return Observed(
            submitted,
            plan,
            pods=self.pods_of(key),
            grants=self.grants_of(key),
            host=self.plans.host_of(plan),
            in_flight=self.fleet.in_flight(plan),
            rules=self.rules_revision,
        )

    def snapshot(
        self,
        key: Key,
        uid: str,
        flights: Mapping[str, Flight] | None = None,
    ) -> Inventory:
        """The input of planning and of grants, as of now; good until something is awaited.

        Args:
            key: The application that asks: what its own pods have is free for it.
            uid: Its uid: claims under its name that are not its own show another holder.
            flights: What drones that are claimed fly, for an application that may share a flight.
        """
        own = labelled(key)
        return Inventory(
            hosts=BookedHosts(self.hosts, self._bookings, own, self._pods.of(own)),
            drones=ByName(self.drones),
            edge_nodes=ByName(self.edge_nodes),
            depots=self.depots_by_name(),
            zones={z.name: z for z in self.zones.values() if isinstance(z, Zone)},
            policies={p.name: p for p in self.policies.values() if isinstance(p, Policy)},
            unreadable_zones={z.name: z.problem for z in self.zones.values() if isinstance(z, Unreadable)},
            unreadable_policies={p.name: p.problem for p in self.policies.values() if isinstance(p, Unreadable)},
            claimed=HolderNames(self.fleet.claims(), uid),
            flights=flights or {},
            locations=self._locations,
        )

    def drone(self, name: str) -> Drone | None:
        """The Drone of a name, if there is one that can be read."""
        return self.drones.get(("", name))

    def depots_by_name(self) -> Mapping[str, Depot]:
        """The depots."""
        return ByName(self.depots)

    def pods_of(self, key: Key, *, kept: bool = False) -> list[PodView]:
        """The pods of an application, or those of its last mission that are only kept for their logs."""
        return [pod for pod in self._pods.of(labelled(key)) if (pod.finished_at is not None) == kept]

    def grants_of(self, key: Key) -> list[Grant]:
        """The grants of an application, also of one that had its name before."""
        return list(self._grants.of(key))

    def forget(self, key: Key) -> None:
        """Drop the plan of an application that is over; its drone is free once it is home."""
        if self.plans.forget(key):
            self.subscriptions.wake_waiting()

    # -- what reflectors report --

    def _host_changed(self, key: Key, old: Host | None, new: Host | None) -> None:
        self._report(kinds.NODE, key)
        if new is None:
            self._locations.remove_host(key[1])
        else:
            self._locations.upsert_host(new.name, new.is_cloud)
        if _host_view(old) != _host_view(new):
            self.subscriptions.wake_all()

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
        if (held := _held(old)) is not None and held != _held(new):
            self.subscriptions.wake_for_room(held[0])

    def _drone_changed(self, key: Key, old: Drone | None, new: Drone | None) -> None:
        self.fleet.drone_changed(key[1], new)
        self._report(kinds.DRONE, key)
        if new is None:
            self._locations.remove_drone(key[1])
        elif old is None or (old.spec.depot, old.spec.home) != (new.spec.depot, new.spec.home):
            self._locations.upsert_drone(new)
        if _rules_differ(old, new):
            self._rules_changed()
        elif old is not None and new is not None and _planning_view(old) != _planning_view(new):
            # What takes off leaves nothing to who waits: neither itself, nor more of a flight to share than before.
            if not (new.in_air and not old.in_air and _ready(old) == _ready(new)):
                self.subscriptions.wake_waiting()
            self._wake_flyers(new.name)
        elif old is not None and new is not None and _flight_view(old) != _flight_view(new):
            self._wake_flyers(new.name)

    def _planned(self, application: Key, requests: Sequence[PlannedRequest]) -> None:
        for node in self._bookings.planned(application, requests):
            self.subscriptions.wake_for_room(node)

    def _wake_flyers(self, drone: str) -> None:
        """Wake the applications on a drone, also those that share its flight."""
        for application in self.fleet.on(drone):
            self.subscriptions.wake(application)

    def _edge_node_changed(self, key: Key, old: EdgeNode | None, new: EdgeNode | None) -> None:
        self._report(kinds.EDGE_NODE, key)
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
        self._spec_changed(kinds.DEPOT)(key, old, new)

    def _spec_changed(self, kind: Kind) -> Callable[[Key, Any, Any], None]:
        def changed(key: Key, old: Any, new: Any) -> None:
            self._report(kind, key)
            if old is None or new is None or type(old) is not type(new) or old.spec != new.spec:
                self._rules_changed(urgent=True)

        return changed

    def _rules_changed(self, *, urgent: bool = False) -> None:
        self.rules_revision += 1
        self.subscriptions.wake_all(urgent=urgent, first=self.fleet.flying())

    def _application_changed(self, key: Key, old: Submitted | None, new: Submitted | None) -> None:
        self.plans.application_changed(key)
        self._report(kinds.APPLICATION, key)
        if new is None:
            self.plans.forget(key)
            self.torn_down.pop(key, None)
        if old is None or new is None or old.settled_generation != new.settled_generation:
            self.plans.wake_sharing(key)
            # What is new leaves nothing to others.
            if old is not None:
                self.subscriptions.wake_waiting()
        self.subscriptions.wake(key, urgent=_was_changed(old, new))

    def _child_changed(self, key: Key, old: Body | None, new: Body | None) -> None:
        body = new or old or {}
        if body.get("kind") == Grant.KIND:
            self._grant_changed(key, new)
            self.node_objects.grant_changed(key, old, new)
        elif body.get("kind") == DeploymentPlan.KIND:
            self.plans.stored(key, new)
            if new is None:
                self.subscriptions.wake_waiting()
        elif body.get("kind") == DirectLink.KIND:
            self._report(kinds.DIRECT_LINK, key)
        self.subscriptions.wake(application_of(body))

    def _grant_changed(self, key: Key, new: Body | None) -> None:
        grant = self._areas.grant(new) if new is not None else None
        known = self._known_grants.pop(key, None)
        if known is not None:
            self._grants.drop(_holder(known), key)
        if grant is not None:
            self._known_grants[key] = grant
            self._grants.put(_holder(grant), key, grant)
        self.fleet.grant_changed(key, known, grant)
        if grant is None:
            self.subscriptions.wake_waiting()
        self._report(kinds.GRANT, key)

    def _report(self, kind: Kind, key: Key) -> None:
        for listener in self._listeners.get(kind, ()):
            listener(key)


def _host_view(host: Host | None) -> tuple[object, ...] | None:
    """What of a Node decides over plans; where it is, and flies along, its Drone or EdgeNode says."""
    return (host.is_cloud, host.allocatable, host.ready, host.schedulable) if host is not None else None


def _was_changed(old: Submitted | None, new: Submitted | None) -> bool:
    """Whether a user changed an Application, and waits for the answer; what is reported of it is no such change."""
    return old is not None and new is not None and old.metadata.generation != new.metadata.generation


def _held(pod: PodView | None) -> tuple[str, Mapping[str, float]] | None:
    """The node that a pod takes room on, and how much; None while it takes none."""
    return (pod.node, pod.requests) if pod is not None and pod.node is not None and not pod.finished else None


def _holder(grant: Grant) -> Key:
    return grant.spec.application.namespace, grant.spec.application.name


def _rules_differ(old: Drone | EdgeNode | None, new: Drone | EdgeNode | None) -> bool:
    """Whether a node appeared, went, or changed in what policies select it by and what grants take from it."""
    return old is None or new is None or old.spec != new.spec or old.metadata.labels != new.metadata.labels


def _planning_view(drone: Drone) -> tuple[object, ...]:
    """What of a drone's status decides over plans; its position does not."""
    return drone.in_air, _ready(drone)


def _flight_view(drone: Drone) -> tuple[object, ...]:
    """What of a drone's status the application that it flies for reports."""
    return (drone.status.flight_state, drone.status.controller) if drone.status is not None else ()


def _ready(node: Drone | EdgeNode) -> str | None:
    condition = readiness(node.status)
    return condition.status if condition is not None else None


def _without_status(body: Body) -> Body:
    """A child without what others say of it, but for why pods of a Deployment cannot be made."""
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


def _as_is(body: Body) -> Body:
    return body
