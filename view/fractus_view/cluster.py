"""Live flights of a cluster: watches its objects, and reports if the shown state is stale."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from operator import attrgetter
from typing import Any, TypeVar

from fractus_core import api
from fractus_runtime.kubernetes import Body, Client, Informer, Key, Kind, KubeError
from fractus_runtime.metrics import gauge
from prometheus_client import Metric

from fractus_view import objects
from fractus_view.cluster_pictures import ClusterPictures
from fractus_view.events import Applications, Areas, Contact, Event, Gone, Links, Policies, Problem
from fractus_view.flight_times import FlightTimes
from fractus_view.hub import Hub
from fractus_view.log_verdicts import LogVerdicts

PUBLISH_INTERVAL_S = 0.2
"""Interval between two publications of changes, in seconds."""

PROBE_INTERVAL_S = 1.0
"""Interval between two probes of the API server, in seconds."""

PROBE_TIMEOUT_S = 3.0
"""Response time, in seconds, above which the API server counts as unreachable."""

STALE_AFTER_S = 2.0
"""Time without contact, in seconds, after which the state counts as stale. Watches end and restart regularly."""

T = TypeVar("T", bound=api.Resource)

KINDS: tuple[type[api.Resource], ...] = (
    api.Drone, api.EdgeNode, api.Depot, api.Zone, api.Policy, api.Application, api.DeploymentPlan, api.DirectLink,
)  # fmt: skip
"""Kinds that are watched."""


class ClusterSource:
    """`Source` of a cluster's flights. It only reads the cluster.

    Args:
        client: Client of the API server.
        namespace: Namespace of the shown applications. An empty string shows all namespaces.
        now_ms: Returns the current time in Unix milliseconds.
        system_namespace: Namespace of the mobility and camera services.
        kubectl: Command of kubectl with the options that select the cluster, to show pictures. Empty: no pictures.
    """

    def __init__(
        self,
        client: Client,
        namespace: str = "",
        now_ms: Callable[[], int] = lambda: round(time.time() * 1000),
        system_namespace: str = "fractus-system",
        kubectl: Sequence[str] = (),
    ) -> None:
        self._client = client
        self._namespace = namespace
        self._now_ms = now_ms
        self._hub = Hub()
        self._changed: set[type[api.Resource]] = set()
        self._changed_drones: set[str] = set()
        self._returning: frozenset[str] = frozenset()
        self._flights = FlightTimes()
        self._last_contact_ms = now_ms()
        self._verdicts = LogVerdicts(
            client,
            system_namespace,
            namespace=namespace,
            drones=self._followed_drones,
            publish=self._hub.publish,
            now_ms=now_ms,
        )
        self._pictures: ClusterPictures | None = None
        if kubectl:
            self._pictures = ClusterPictures(
                client,
                kubectl,
                system_namespace,
                drones=self._followed_drones,
                publish=self._hub.publish,
                now_ms=now_ms,
            )
        self._informers: dict[type[api.Resource], Informer[Any]] = {
            model: self._informer(model, namespace if model.NAMESPACED else "") for model in KINDS
        }

    def picture(self, id_: str) -> bytes | None:
        """Return a thumbnail by its id, or None if there is none."""
        return self._pictures.picture(id_) if self._pictures is not None else None

    def stream(self, last_id: str) -> AsyncIterator[bytes]:
        """Yield the current state, then changes."""
        return self._hub.stream(last_id)

    async def check(self) -> None:
        """List all objects once.

        Raises:
            KubeError: The API server is unreachable, the kinds of Fractus are not installed, or access to them is denied.
        """
        for informer in self._informers.values():
            await self._probe(informer.kind)

    async def run(self) -> None:
        """Watch until cancelled."""
        async with asyncio.TaskGroup() as group:
            for informer in self._informers.values():
                group.create_task(informer.run())
            group.create_task(self._report_contact())
            group.create_task(self._publish_changes())
            group.create_task(self._verdicts.run())
            if self._pictures is not None:
                group.create_task(self._pictures.run())

    def metrics(self) -> Iterator[Metric]:
        """Yield the metrics of the watches."""
        synced = [informer for informer in self._informers.values() if informer.synced.is_set()]
        watching = {informer.kind.plural: float(informer.watching) for informer in synced}
        yield gauge(
            "fractus_view_watch_open", "1 while the watch of a kind is open (view of a cluster).", watching, "kind"
        )
        ages_s = {informer.kind.plural: informer.age_s() for informer in synced}
        yield gauge(
            "fractus_view_watch_age_seconds",
            "Seconds since the last message of the API server about a kind. Above 100 the watch is dead.",
            ages_s,
            "kind",
        )

    # Current state

    def _informer(self, model: type[T], namespace: str) -> Informer[T]:
        def parse(body: Body) -> T:
            try:
                return model.from_body(body)
            except api.InvalidObject as error:
                self._hub.publish([Problem(self._now_ms(), f"invalid {model.KIND}, not shown: {error}")])
                raise

        def changed(key: Key, _old: T | None, _new: T | None) -> None:
            self._changed.add(model)
            if model is api.Drone:
                self._changed_drones.add(key[1])

        kind = Kind(api.API_VERSION, model.KIND, model.PLURAL, model.NAMESPACED)
        return Informer(self._client, kind, parse, changed, namespace=namespace)

    async def _publish_changes(self) -> None:
        for informer in self._informers.values():
            await informer.synced.wait()
        self._changed = set(KINDS)
        while True:
            changed = self._changed
            self._changed = set()
            drones = self._changed_drones
            self._changed_drones = set()
            if changed:
                self._hub.publish(self._events(changed, drones))
            await asyncio.sleep(PUBLISH_INTERVAL_S)

    def _events(self, changed: set[type[api.Resource]], drones: set[str]) -> Iterator[Event]:
        now_ms = self._now_ms()
        returning = objects.returning_drones(self._all(api.Application))
        for name in sorted(drones | (returning ^ self._returning)):
            yield from self._drone(name, now_ms, returns=name in returning)
        self._returning = returning
        if changed & {api.Zone, api.Policy}:
            yield Areas("zones", now_ms, objects.zones(self._all(api.Zone), self._all(api.Policy)))
        if changed & {api.EdgeNode, api.Depot}:
            yield Areas("places", now_ms, objects.places(self._all(api.EdgeNode), self._all(api.Depot)))
        if changed & {api.Application, api.DeploymentPlan, api.Depot}:
            depots = {depot.name: depot for depot in self._all(api.Depot)}
            plans = {
                (plan.metadata.namespace or "", plan.spec.application): plan for plan in self._all(api.DeploymentPlan)
            }
            yield Areas("plans", now_ms, objects.planned_flights(self._all(api.Application), plans, depots))
        if api.Application in changed:
            applications = map(objects.application, self._all(api.Application))
            yield Applications(now_ms, sorted(applications, key=attrgetter("name")))
        if api.DirectLink in changed:
            links = map(objects.link, self._all(api.DirectLink))
            yield Links(now_ms, sorted(links, key=attrgetter("name")))
        if api.Policy in changed:
            policies = map(objects.policy, self._all(api.Policy))
            yield Policies(now_ms, sorted(policies, key=attrgetter("name")))

    def _drone(self, name: str, now_ms: int, *, returns: bool) -> Iterator[Event]:
        drone: api.Drone | None = self._informers[api.Drone].get(("", name))
        if drone is None:
            self._flights.forget(name)
            yield Gone(name, now_ms)
            return
        flight_ms = self._flights.update(name, now_ms, in_air=objects.in_air(drone))
        yield objects.state(drone, now_ms, flight_ms, returns=returns)
        fix = objects.fix(drone, now_ms)
        if fix is not None:
            yield fix

    def _followed_drones(self) -> frozenset[str]:
        """Return the drones with a running application, and without a selected namespace also all drones in the air."""
        drones = set(objects.assigned_drones(self._all(api.Application)))
        if not self._namespace:
            drones |= {drone.name for drone in self._all(api.Drone) if objects.in_air(drone)}
        return frozenset(drones)

    def _all(self, model: type[T]) -> Iterator[T]:
        return self._informers[model].values()

    # Staleness

    async def _report_contact(self) -> None:
        """Probe the API server continuously, because a broken watch looks like a watch without changes."""
        while True:
            problem = await self._problem()
            now_ms = self._now_ms()
            if problem is None:
                self._last_contact_ms = now_ms
                self._hub.publish([Contact(now_ms, None, "")])
            elif now_ms - self._last_contact_ms > STALE_AFTER_S * 1000:
                self._hub.publish([Contact(now_ms, self._last_contact_ms, problem)])
            await asyncio.sleep(PROBE_INTERVAL_S)

    async def _problem(self) -> str | None:
        """Return the reason why the state may be stale, or None."""
        informers = list(self._informers.values())
        unwatched = [informer for informer in informers if not (informer.watching and informer.synced.is_set())]
        try:
            await self._probe((unwatched or informers)[0].kind)
        except KubeError as error:
            return str(error)
        return f"{unwatched[0].kind.plural} are not watched yet" if unwatched else None

    async def _probe(self, kind: Kind) -> None:
        await self._client.request("GET", kind.path(self._namespace), params={"limit": "1"}, timeout_s=PROBE_TIMEOUT_S)
