"""`python -m fractus_operator`: becomes the leader, fills the cache, and runs all controllers."""

from __future__ import annotations

import asyncio
import logging
import os
import secrets
import socket
import sys
import time
from collections.abc import Callable, Coroutine, Iterator
from contextlib import AsyncExitStack, aclosing
from datetime import UTC, datetime
from typing import Any

from fractus_core.identity.authority import Authority, BrokenAuthority
from fractus_runtime import logs
from fractus_runtime.metrics import serve_metrics
from prometheus_client import Metric

from fractus_operator import handlers, kinds, node_liveness, operator_metrics, service_rollout
from fractus_operator.application_controller import ApplicationController
from fractus_operator.ca_secret import CERTIFICATE_PERIOD_S, open_authority, publish_certificate
from fractus_operator.cache import ClusterCache
from fractus_operator.cleanup import ORPHANED_PODS_PERIOD_S, OrphanedObjects, OrphanedPods
from fractus_operator.csr_controller import CsrController
from fractus_operator.drone_events import DroneEventRecorder
from fractus_operator.flight_plan_controller import FlightPlanController
from fractus_operator.kinds import Key, Kind
from fractus_operator.labels import LEASE_NAME
from fractus_operator.link_events import LinkEventRecorder
from fractus_operator.mission_condition import MissionConditionController
from fractus_operator.node_conditions import NodeConditionWriter
from fractus_operator.node_controller import NodeGrantsController, NodeLabelController
from fractus_operator.node_liveness import NodeLivenessController, ObservationClock, displayed_flight_state
from fractus_operator.policy_controller import PolicyController
from fractus_operator.service_rollout import ServiceRollout
from fractus_operator.settings import BadSetting, Settings
from fractus_operator.standby import health_endpoint, wait_for_kinds
from fractus_operator.store import KubeError, LeaseThread, LostLease, Store, Unconfigured
from fractus_operator.template_controller import TemplateController
from fractus_operator.work_queue import WorkQueue, run_periodically

log = logging.getLogger("fractus_operator")


def _now() -> datetime:
    return datetime.now(UTC).replace(microsecond=0)


async def run(settings: Settings, stop: asyncio.Event | None = None) -> None:
    """Run the operator until it is stopped or a part of it fails.

    Args:
        settings: Settings of the operator.
        stop: Event that stops the operator. Signals stop it as well.
    """
    async with aclosing(await Store.connect()) as store:
        await wait_for_kinds(store)
    identity = settings.identity or f"{socket.gethostname()}-{os.getpid()}-{secrets.token_hex(4)}"
    # The Lease has its own thread and connection, so that neither planning nor a burst of requests delays a renewal.
    lease = LeaseThread(Store.connect, (settings.namespace, LEASE_NAME), identity, settings.lease_s, time.monotonic)
    store = await Store.connect(may_write_s=lambda: lease.left_s)
    election = asyncio.create_task(lease.run())
    source = operator_metrics.MetricsSource(lambda: lease.left_s)

    def collect() -> Iterator[Metric]:
        # `source` is assigned again when this operator becomes the leader.
        return source.collect()

    metrics_server = AsyncExitStack()
    try:
        listen = f":{settings.metrics_port}" if settings.metrics_port else ""
        await metrics_server.enter_async_context(serve_metrics(listen, collect))
        async with health_endpoint(settings.health):
            await _wait_for_leadership(lease, election)
        authority = await open_authority(store, settings.namespace)
        cache = ClusterCache(store, settings.namespace)
        source = _metrics_source(lease, cache, authority)
        applications = ApplicationController(
            store, cache, authority, _now, settings.planning, gateway_image=settings.gateway_image
        )
        conditions = NodeConditionWriter(store, cache, _now)
        csr = CsrController(store, cache.signing_requests.get, authority, settings.agent_users, _now)
        # The Lease detects an unreachable API server sooner than a watch.
        watched = (cache.drones, cache.edge_nodes)
        clock = ObservationClock(
            time.monotonic, lambda: all(informer.watching for informer in watched) and lease.left_s > 0
        )
        liveness = NodeLivenessController(cache, conditions, clock.now_s)
        services = ServiceRollout(store, cache, conditions, time.monotonic)
        orphaned_pods = OrphanedPods(store, cache)
        flights = FlightPlanController(store, cache, _now, settings.planning)
        for kind, listener in (
            (kinds.FLIGHT_PLAN, flights.changed),
            (kinds.APPLICATION, flights.application_changed),
            (kinds.DEPLOYMENT_PLAN, flights.application_changed),
            (kinds.DRONE, flights.drone_changed),
        ):
            cache.add_listener(kind, listener)
        cache.add_flight_rules_listener(flights.rules_changed)
        links = LinkEventRecorder(store, _now)
        parts: list[Coroutine[Any, Any, None]] = [
            *(informer.run() for informer in (*cache.informers, links.informer)),
            *(
                queue.run()
                for queue in (*work_queues(store, cache, csr, conditions), links.work_queue, flights.work_queue)
            ),
            run_periodically("node liveness", liveness.step, node_liveness.LIVENESS_PERIOD_S),
            run_periodically("service rollout", services.step, service_rollout.ROLLOUT_PERIOD_S),
            run_periodically("orphaned pods", orphaned_pods.step, ORPHANED_PODS_PERIOD_S),
            run_periodically(
                "authority certificate",
                lambda: publish_certificate(store, settings.namespace, authority),
                CERTIFICATE_PERIOD_S,
            ),
            # Shielded, because the last writes of cancelled parts need the Lease.
            _await(asyncio.shield(election)),
        ]
        background = [asyncio.create_task(part) for part in parts]
        kopf_operator = handlers.operator(
            applications, cache.oldest_contact_s, settings.health, stop, lambda: _end(background)
        )
        await _run_together(kopf_operator, background)
    finally:
        # The Lease is released last. Until here, writes may be in progress, and no other operator may lead.
        election.cancel()
        await asyncio.gather(election, return_exceptions=True)
        await metrics_server.aclose()
        await store.aclose()


def _metrics_source(lease: LeaseThread, cache: ClusterCache, authority: Authority) -> operator_metrics.MetricsSource:
    """Return the metrics of a leader."""
    return operator_metrics.MetricsSource(
        lambda: lease.left_s,
        lambda: {i.kind.plural: (i.watching, i.age_s()) for i in cache.informers if i.synced.is_set()},
        lambda: ((a.body.get("status") or {}).get("phase", "Pending") for a in cache.applications.values()),
        lambda: (displayed_flight_state(drone) for drone in cache.drones.values() if drone is not None),
        authority.certificate.not_valid_after_utc.timestamp(),
    )


async def _wait_for_leadership(lease: LeaseThread, election: asyncio.Task[None]) -> None:
    """Wait until this operator is the leader. If the election fails, raise its error."""
    held = asyncio.create_task(lease.held())
    done, _ = await asyncio.wait((held, election), return_when=asyncio.FIRST_COMPLETED)
    held.cancel()
    if election in done:
        election.result()


async def _await(future: asyncio.Future[None]) -> None:
    await future


def work_queues(
    store: Store, cache: ClusterCache, csr: CsrController, conditions: NodeConditionWriter
) -> list[WorkQueue]:
    """Return the queues of all controllers that kopf does not run, connected to the informers of their inputs."""
    policies = PolicyController(store, cache, _now)
    missions = MissionConditionController(store, cache, conditions, _now)
    events = DroneEventRecorder(store, cache, missions.granted_applications, _now)
    templates = WorkQueue("template", TemplateController(store, cache, _now).reconcile)
    node_queue = WorkQueue("node", NodeLabelController(store, cache).reconcile, after=cache.synced)
    csr_queue = WorkQueue("signing request", csr.reconcile)
    zone_queue = WorkQueue("zone", policies.reconcile_zone)
    policy_queue = WorkQueue("policy", policies.reconcile_policy, after=cache.synced)
    drone_queue = WorkQueue("drone", missions.reconcile, after=cache.synced)
    orphans = {kind: OrphanedObjects(store, cache, kind) for kind in (kinds.GRANT, kinds.DIRECT_LINK)}
    orphan_queues = {kind: WorkQueue(kind.name, orphans[kind].reconcile, after=cache.synced) for kind in orphans}

    def enqueue_policies_of_zone(key: Key) -> None:
        for policy in policies.policies_of(key[1]):
            policy_queue.add(policy)

    def enqueue_policies_with_zones(_: Key) -> None:
        for policy in policies.policies_with_zones():
            policy_queue.add(policy)

    def enqueue_drone_of_grant(key: Key) -> None:
        drone = missions.grant_changed(key)
        if drone is not None:
            drone_queue.add(drone)
            events.work_queue.add(drone)

    def enqueue_orphans(key: Key) -> None:
        if cache.applications.get(key) is None:
            for kind, queue in orphan_queues.items():
                for orphan in orphans[kind].of(key):
                    queue.add(orphan)

    listeners: list[tuple[Kind, Callable[[Key], None]]] = [
        *((kind, node_queue.add) for kind in (kinds.NODE, kinds.DRONE, kinds.EDGE_NODE)),
        (kinds.SIGNING_REQUEST, csr_queue.add),
        (kinds.APPLICATION_TEMPLATE, templates.add),
        (kinds.ZONE, zone_queue.add),
        (kinds.ZONE, enqueue_policies_of_zone),
        (kinds.DEPOT, enqueue_policies_with_zones),
        (kinds.POLICY, policy_queue.add),
        *((kind, queue.add) for kind, queue in orphan_queues.items()),
        (kinds.GRANT, enqueue_drone_of_grant),
        (kinds.DRONE, drone_queue.add),
        (kinds.DRONE, events.changed),
        (kinds.APPLICATION, enqueue_orphans),
    ]
    for kind, listener in listeners:
        cache.add_listener(kind, listener)
    queues = [
        templates,
        node_queue,
        csr_queue,
        zone_queue,
        policy_queue,
        *orphan_queues.values(),
        drone_queue,
        events.work_queue,
    ]
    return [*queues, *NodeGrantsController(store, cache).work_queues()]


async def _run_together(main: Coroutine[Any, Any, None], background: list[asyncio.Task[None]]) -> None:
    """Run the main part until it ends. A failed background part ends all."""
    running = asyncio.create_task(main)
    try:
        done, _ = await asyncio.wait([running, *background], return_when=asyncio.FIRST_COMPLETED)
        ended = [task for task in done if not task.cancelled()]
        for task in ended:
            task.result()
        if not ended:
            await running  # it is stopping, and has cancelled the background
    finally:
        await _end([running, *background])


async def _end(tasks: list[asyncio.Task[None]]) -> None:
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


def main() -> int:
    """Run the operator as a program. Return its exit code."""
    try:
        settings = Settings.from_environment(os.environ)
    except BadSetting as error:
        print(error, file=sys.stderr)
        return 2
    logs.configure(settings.log_level, settings.log_format)
    logging.getLogger("kopf").setLevel(max(settings.log_level, logging.WARNING))
    try:
        asyncio.run(run(settings))
    except (Unconfigured, BrokenAuthority, KubeError, LostLease) as error:
        log.critical("operator: stopped (error=%s)", error)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
