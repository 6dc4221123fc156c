"""Agent of one node: creates the parts of the agent, and connects them."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from functools import partial

from fractus_core.api.nodes import Drone, EdgeNode, direct_interface
from fractus_core.linking import TelemetrySample
from fractus_runtime.metrics import BackgroundReader, serve_metrics
from prometheus_client import Metric

from fractus_agent.agent_metrics import AgentMetrics
from fractus_agent.grant_synchronizer import GrantDirectory, GrantSynchronizer, GrantVerifier
from fractus_agent.identity import NodeIdentity
from fractus_agent.links.link_manager import LinkManager
from fractus_agent.records.record_server import RecordServer
from fractus_agent.registration.diagnostics import (
    read_audit_heads,
    read_gateway_problem,
    read_picture_counts,
    read_recording_problems,
)
from fractus_agent.registration.node_object_file import NodeObjectFile
from fractus_agent.registration.node_status import NodeObservation, StatusReporter
from fractus_agent.registration.registration import Registration
from fractus_agent.settings import Settings
from fractus_agent.store import Object, Store
from fractus_agent.supervisor import Supervisor, run_watchdog
from fractus_agent.telemetry import CONTACT_INTERVAL_S, LINK_INTERVAL_S, TELEMETRY_INTERVAL_S, TelemetryFeed

CONTACT_TIMEOUT_S = 3.0
"""Longest duration of a request that tests the contact with the API server."""


class Agent:
    """Agent of one node.

    Args:
        settings: Settings of the agent.
        store: The node's objects at the API server.
    """

    def __init__(self, settings: Settings, store: Store) -> None:
        self._settings = settings
        self._store = store
        node = settings.node
        self._identity = NodeIdentity(store, settings.tls, node, _now, on_change=self._on_change)
        self._grants = GrantSynchronizer(
            store,
            GrantDirectory(settings.grants),
            node,
            GrantVerifier(settings.tls).verify,
            refresh_authority=self._identity.refresh_authority,
            pictures=partial(read_picture_counts, settings.state),
        )
        self._certificate_serial = 0
        self._object_file = NodeObjectFile(settings.node_object)
        self._registration = Registration(
            store, settings.description, node, self._object_file, on_change=self._on_change
        )
        # An agent that starts while the API server is unreachable uses the stored object.
        self._stored = self._object_file.read()
        self._mobility = asyncio.Event()
        self._linking = asyncio.Event()
        self._links: LinkManager | None = None
        self._feed: TelemetryFeed | None = None
        self._reporter = StatusReporter(
            store,
            body=lambda: self._registration.body,
            observe=self._observe,
            on_written=self._registration.on_status_written,
            wall=_now,
            monotonic=time.monotonic,
        )
        self._audit_heads = BackgroundReader(partial(read_audit_heads, settings.audit, settings.gateway_audit))
        self._supervisor = Supervisor()
        self._supervisor.add("watchdog", run_watchdog)
        self._supervisor.add("grants", self._grants.follow)
        self._supervisor.add("grant reports", self._grants.report)
        self._supervisor.add("identity", self._identity.run)
        self._supervisor.add("registration", self._registration.run)
        self._supervisor.add("status", self._reporter.run)
        self._supervisor.add("telemetry", self._run_telemetry)
        self._supervisor.add("contact", self._keep_contact)
        if settings.direct_links:
            self._supervisor.add("links", self._run_links)
        if settings.records:
            self._supervisor.add("records", self._serve_records)

    async def run(self) -> None:
        """Run all parts until cancelled.

        Raises:
            ExceptionGroup: A part failed.
        """
        self._on_change()
        async with serve_metrics(self._settings.metrics, self._metrics):
            await self._supervisor.run()

    def _metrics(self) -> Iterator[Metric]:
        telemetry_age_s = None
        if self._has_mobility():
            telemetry_age_s = self._feed.age_s if self._feed is not None else math.inf
        heads = (head.split(":") for head in self._audit_heads())
        yield from AgentMetrics(
            expires_s=self._identity.expires_s,
            watch_ages_s=self._store.watch_ages_s(),
            report_age_s=self._reporter.age_s,
            telemetry_age_s=telemetry_age_s,
            grants=self._grants.counts(),
            checkpoints={log: (int(number), digest) for log, number, digest in heads},
        ).collect()
        if self._links is not None:
            yield from self._links.metrics()

    async def _run_telemetry(self) -> None:
        """Subscribe to telemetry once the node has a mobility service and a certificate."""
        await self._mobility.wait()
        await self._identity.ready.wait()
        self._feed = TelemetryFeed(
            self._settings.mobility_address,
            self._settings.tls,
            self._settings.node,
            serial=lambda: self._identity.serial,
            on_change=self._on_telemetry,
            contact_age_s=lambda: self._store.contact_age_s if self._grants.depends_on_contact else math.inf,
        )
        self._set_telemetry_interval()
        await self._feed.run()

    async def _keep_contact(self) -> None:
        """Contact the API server every second while an Application depends on the contact."""
        while True:
            if self._grants.depends_on_contact:
                await self._store.is_reachable(CONTACT_TIMEOUT_S)
            await asyncio.sleep(CONTACT_INTERVAL_S)

    async def _serve_records(self) -> None:
        """Serve the records of flights once the node has a mobility service. Other nodes have no flights."""
        await self._mobility.wait()
        server = RecordServer(
            self._settings.records, self._settings.node, self._settings.state, self._settings.tls, self._store
        )
        await server.run(self._identity)

    async def _run_links(self) -> None:
        """Run direct links once the node has a direct interface and a certificate."""
        await self._linking.wait()
        await self._identity.ready.wait()
        self._links = LinkManager(
            self._store,
            self._settings.node,
            self._settings.links,
            self._settings.tls,
            resource=self._resource,
            telemetry=self._telemetry_sample,
            wall=_now,
            audit=self._settings.audit,
            on_change=self._set_telemetry_interval,
            drain_s=self._settings.drain_s,
        )
        await self._links.run()

    def _set_telemetry_interval(self) -> None:
        if self._feed is not None:
            linking = self._links is not None and self._links.active
            self._feed.set_interval(LINK_INTERVAL_S if linking else TELEMETRY_INTERVAL_S)

    def _telemetry_sample(self) -> TelemetrySample | None:
        snapshot = self._feed.latest if self._feed is not None and self._feed.problem is None else None
        if snapshot is None or snapshot.position is None:
            return None
        lat, lon, above_home_m, _ = snapshot.position
        home_amsl_m = snapshot.altitude_amsl_m - above_home_m
        return TelemetrySample(lat, lon, above_home_m, home_amsl_m, snapshot.velocity_mps)

    def _resource(self) -> Drone | EdgeNode | None:
        return self._registration.resource or self._stored

    def _has_mobility(self) -> bool:
        resource = self._resource()
        return resource is not None and resource.kind == "Drone" and resource.spec.services.mobility is not None

    def _has_direct_interface(self) -> bool:
        resource = self._resource()
        return resource is not None and direct_interface(resource.spec.interfaces) is not None

    def _observe(self, body: Object) -> NodeObservation:
        services = (body.get("spec") or {}).get("services") or {}
        snapshot = None
        telemetry_problem = None
        if self._feed is not None:
            snapshot = self._feed.latest
            telemetry_problem = self._feed.problem
        return NodeObservation(
            kind=body["kind"],
            has_mobility=self._has_mobility(),
            needs_certificate=bool(services),
            certified=self._identity.condition,
            snapshot=snapshot,
            telemetry_problem=telemetry_problem,
            described=self._registration.description_problem,
            camera_described=self._object_file.condition,
            audit_heads=read_audit_heads(self._settings.audit, self._settings.gateway_audit),
            recording_problems=read_recording_problems(self._settings.state),
            gateway_problem=read_gateway_problem(self._settings.state),
            records_address=self._settings.records,
        )

    def _on_telemetry(self) -> None:
        if self._feed is not None and self._feed.latest is not None:
            self._grants.set_missions(self._feed.latest.missions)
        self._on_change()

    def _on_change(self) -> None:
        """Notify the parts of the agent after one of them has changed."""
        if self._has_mobility():
            self._mobility.set()
        if self._has_direct_interface():
            self._linking.set()
        if self._certificate_serial != self._identity.serial:
            self._certificate_serial = self._identity.serial
            self._grants.on_authority_changed()
        self._reporter.notify()


def _now() -> datetime:
    return datetime.now(UTC)
