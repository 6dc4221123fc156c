"""`python -m fractus_operator`: connects, learns the cluster, then lets kopf run the Applications."""

from __future__ import annotations

import asyncio
import gc
import logging
import os
import secrets
import socket
import sys
import time
from collections.abc import Callable, Coroutine
from contextlib import AsyncExitStack, aclosing
from datetime import UTC, datetime
from typing import Any

from fractus_core.identity.authority import Authority, BrokenAuthority
from fractus_runtime import logs
from fractus_runtime.exposition import serving

from fractus_operator import handlers, metrics
from fractus_operator.cluster import kinds
from fractus_operator.cluster.kinds import Key, Kind
from fractus_operator.cluster.labels import LEASE_NAME
from fractus_operator.cluster.store import KubeError, LeaseThread, LostLease, Store, Unconfigured
from fractus_operator.identity.ca_secret import open_authority
from fractus_operator.identity.node_requests import NodeSigning
from fractus_operator.inventory.live import LiveInventory
from fractus_operator.reconcile import service_rollout, silence
from fractus_operator.reconcile.applications import Applications
from fractus_operator.reconcile.drone_events import DroneEvents
from fractus_operator.reconcile.link_events import LinkEvents
from fractus_operator.reconcile.location import Locations
from fractus_operator.reconcile.node_grants import NodeGrantsKeeper
from fractus_operator.reconcile.node_reports import NodeReports
from fractus_operator.reconcile.on_mission import OnMission
from fractus_operator.reconcile.orphans import LOST_PODS_PERIOD_S, LostPods, Orphans
from fractus_operator.reconcile.readiness import Readiness
from fractus_operator.reconcile.service_rollout import ServiceRollout
from fractus_operator.reconcile.silence import HearingClock, SilenceWatch, shown_state
from fractus_operator.reconcile.worklist import Worklist, regularly
from fractus_operator.settings import BadSetting, Settings
from fractus_operator.standby import kinds_served, standing_by

logger = logging.getLogger("fractus_operator")

_GC_THRESHOLD = 20_000
"""Containers that are not freed at once before the garbage collector looks for cycles: a deployment makes a few thousand."""


def _now() -> datetime:
    return datetime.now(UTC).replace(microsecond=0)


async def run(settings: Settings, stop: asyncio.Event | None = None) -> None:
    """Run the operator until it is told to stop, or a part of it fails.

    Args:
        settings: How to run.
        stop: Set it to end the operator; signals do so as well.
    """
    async with aclosing(await Store.connect()) as reading:
        await kinds_served(reading)
    identity = settings.identity or f"{socket.gethostname()}-{os.getpid()}-{secrets.token_hex(4)}"
    # The Lease has a thread and a connection of its own: neither a long plan nor a burst of requests keeps a renewal waiting.
    lease = LeaseThread(Store.connect, (settings.namespace, LEASE_NAME), identity, settings.lease_s, time.monotonic)
    store = await Store.connect(may_write_s=lambda: lease.left_s)
    keeping = asyncio.create_task(lease.run())
    shown = metrics.Observed(lambda: lease.left_s)
    measuring = AsyncExitStack()
    try:
        listen = f":{settings.metrics_port}" if settings.metrics_port else ""
        await measuring.enter_async_context(serving(listen, lambda: metrics.text(shown)))
        async with standing_by(settings.health):
            await _leading(lease, keeping)
        authority = await open_authority(store, settings.namespace)
        live = LiveInventory(store, settings.namespace)
        shown = _observed(lease, live, authority)
        applications = Applications(store, live, authority, _now, settings.planning)
        signing = NodeSigning(store, live.signing_requests.get, authority, settings.agent_users, _now)
        background: list[Coroutine[Any, Any, None]] = [reflector.run() for reflector in live.reflectors()]
        reports = NodeReports(store, live, _now)
        background += [worklist.run() for worklist in worklists(store, live, signing, reports)]
        # The Lease tells sooner than a watch that the API server is out of reach.
        watched = (live.drones, live.edge_nodes)
        hearing = HearingClock(time.monotonic, lambda: all(r.watching for r in watched) and lease.left_s > 0)
        watch = SilenceWatch(live, reports, hearing.now_s)
        rollout = ServiceRollout(store, live, reports, time.monotonic)
        background += [regularly("silence", watch.step, silence.PERIOD_S)]
        background += [regularly("services", rollout.step, service_rollout.PERIOD_S)]
        background += [regularly("lost pods", LostPods(store, live).step, LOST_PODS_PERIOD_S)]
        links = LinkEvents(store, _now)
        background += [links.reflector.run(), links.worklist.run()]
        # Cancelling what waits for the lease must not cancel the lease: the last writes need it.
        background += [_wait_for(asyncio.shield(keeping)), _settled(live)]
        await _together(handlers.operator(applications, live.silence_s, settings.health, stop), background)
    finally:
        # Last of all: until here a write of ours may be under way, and no other operator may lead.
        keeping.cancel()
        await asyncio.gather(keeping, return_exceptions=True)
        await measuring.aclose()
        await store.aclose()


def _observed(lease: LeaseThread, live: LiveInventory, authority: Authority) -> metrics.Observed:
    """What the metrics show of a leader."""
    return metrics.Observed(
        lambda: lease.left_s,
        lambda: {r.kind.plural: (r.watching, r.age_s()) for r in live.reflectors() if r.synced.is_set()},
        lambda: ((a.body.get("status") or {}).get("phase", "Pending") for a in live.applications.values()),
        lambda: (shown_state(drone) for drone in live.drones.values() if drone is not None),
        authority.certificate.not_valid_after_utc.timestamp(),
    )


async def _leading(lease: LeaseThread, keeping: asyncio.Task[None]) -> None:
    """Wait until this operator is the leader, or the election failed."""
    held = asyncio.create_task(lease.held())
    done, _ = await asyncio.wait((held, keeping), return_when=asyncio.FIRST_COMPLETED)
    held.cancel()
    if keeping in done:
        keeping.result()


async def _settled(live: LiveInventory) -> None:
    """Keep the garbage collector off what is known of thousands of nodes: looking through it takes 0.1 s each time.

    What is replaced is freed all the same, by its reference count. And let the collector look less often at newer objects.
    """
    await live.synced()
    gc.freeze()
    gc.set_threshold(_GC_THRESHOLD)
    await asyncio.Event().wait()


async def _wait_for(future: asyncio.Future[None]) -> None:
    await future


def worklists(store: Store, live: LiveInventory, signing: NodeSigning, reports: NodeReports) -> list[Worklist]:
    """What is reconciled beside Applications, each fed by the reflectors of its inputs."""
    readiness = Readiness(store, live, _now)
    nodes = Worklist("node", Locations(store, live).reconcile, after=live.synced)
    requests = Worklist("signing request", signing.reconcile)
    zones = Worklist("zone", readiness.reconcile_zone)
    policies = Worklist("policy", readiness.reconcile_policy, after=live.synced)
    unowned = {kind: Orphans(store, live, kind) for kind in (kinds.GRANT, kinds.DIRECT_LINK)}
    orphans = {kind: Worklist(kind.name, those.reconcile, after=live.synced) for kind, those in unowned.items()}
    missions = OnMission(store, live, reports, _now)
    drones = Worklist("drone", missions.reconcile, after=live.synced)
    told = DroneEvents(store, live, missions.holders, _now)

    def policies_of_zone(key: Key) -> None:
        for policy in readiness.policies_of(key[1]):
            policies.add(policy)

    def drone_of_grant(key: Key) -> None:
        drone = missions.grant_changed(key)
        if drone is not None:
            drones.add(drone)
            told.worklist.add(drone)

    def left_by_removed(key: Key) -> None:
        if live.applications.get(key) is None:
            for kind, worklist in orphans.items():
                for left in unowned[kind].of(key):
                    worklist.add(left)

    listeners: list[tuple[Kind, Callable[[Key], None]]] = [
        *((kind, nodes.add) for kind in (kinds.NODE, kinds.DRONE, kinds.EDGE_NODE)),
        (kinds.SIGNING_REQUEST, requests.add),
        (kinds.ZONE, zones.add),
        (kinds.ZONE, policies_of_zone),
        (kinds.POLICY, policies.add),
        *((kind, worklist.add) for kind, worklist in orphans.items()),
        (kinds.GRANT, drone_of_grant),
        (kinds.DRONE, drones.add),
        (kinds.DRONE, told.changed),
        (kinds.APPLICATION, left_by_removed),
    ]
    for kind, listener in listeners:
        live.listen(kind, listener)
    own = [nodes, requests, zones, policies, *orphans.values(), drones, told.worklist]
    return [*own, *NodeGrantsKeeper(store, live).worklists()]


async def _together(main: Coroutine[Any, Any, None], background: list[Coroutine[Any, Any, None]]) -> None:
    """Run the main part until it ends; a background part that fails ends it all."""
    tasks = [asyncio.create_task(part) for part in (main, *background)]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def main() -> int:
    """Run the operator as a program; returns its exit code."""
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
        logger.critical("operator: stopped: %s", error)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
