"""The parts of the agent, and how they hear of each other."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from functools import partial
from typing import TYPE_CHECKING

from fractus_core.api.nodes import direct_interface
from fractus_runtime.exposition import LastRead, serving
from fractus_runtime.figures import text_of

from fractus_agent.cluster.store import Object, Store
from fractus_agent.grants.keeper import GrantDirectory, GrantKeeper
from fractus_agent.grants.verifier import GrantVerifier
from fractus_agent.identity.identity import Identity
from fractus_agent.metrics import AgentFigures
from fractus_agent.registration.evidence import audit_heads, recording_problems
from fractus_agent.registration.handover import Handover
from fractus_agent.registration.registration import Registration
from fractus_agent.registration.status import Observed as ObservedNode
from fractus_agent.registration.status import StatusReporter
from fractus_agent.settings import Settings
from fractus_agent.supervisor import Supervisor
from fractus_agent.watchdog import guard

if TYPE_CHECKING:
    from fractus_core.api.nodes import Drone, EdgeNode
    from fractus_core.linking import Seen
    from fractus_runtime.figures import Figure

    from fractus_agent.links.connectivity import Connectivity
    from fractus_agent.telemetry.feed import TelemetryFeed


class Agent:
    """The agent of one node.

    Args:
        settings: of the node.
        store: the API server.
    """

    def __init__(self, settings: Settings, store: Store) -> None:
        self._settings = settings
        self._store = store
        node = settings.node
        self._identity = Identity(store, settings.tls, node, _now, changed=self._changed)
        self._keeper = GrantKeeper(
            store,
            GrantDirectory(settings.grants),
            node,
            GrantVerifier(settings.tls).verify,
            refresh_authority=self._identity.refresh_authority,
        )
        self._certificates = 0
        self._handover = Handover(settings.node_object)
        self._registration = Registration(store, settings.description, node, self._handover, changed=self._changed)
        # An agent that starts without an API server in reach goes by what the node was when one was.
        self._stored = self._handover.stored()
        self._mobility = asyncio.Event()
        self._linking = asyncio.Event()
        self._links: Connectivity | None = None
        self._feed: TelemetryFeed | None = None
        self._reporter = StatusReporter(
            store,
            body=lambda: self._registration.body,
            observe=self._observe,
            written=self._registration.seen,
            wall=_now,
            monotonic=time.monotonic,
        )
        self._heads = LastRead(partial(audit_heads, settings.audit))
        self._supervisor = Supervisor()
        self._supervisor.add("watchdog", guard)
        self._supervisor.add("grants", self._keeper.follow)
        self._supervisor.add("grant reports", self._keeper.report)
        self._supervisor.add("identity", self._identity.run)
        self._supervisor.add("registration", self._registration.run)
        self._supervisor.add("status", self._reporter.run)
        self._supervisor.add("telemetry", self._follow_telemetry)
        if settings.direct_links:
            self._supervisor.add("links", self._link)

    async def run(self) -> None:
        """Run all parts until cancelled.

        Raises:
            ExceptionGroup: one of them failed.
        """
        self._changed()
        async with serving(self._settings.metrics, lambda: text_of(self._figures())):
            await self._supervisor.run()

    def _figures(self) -> Iterator[Figure]:
        """What Prometheus is told."""
        heads = (head.split(":") for head in self._heads())
        yield from AgentFigures(
            expires_s=self._identity.expires_s,
            heard_s=self._store.heard_s(),
            reported_s=self._reporter.age_s,
            telemetry_s=(self._feed.age_s if self._feed else math.inf) if self._has_mobility() else None,
            grants=self._keeper.counts(),
            checkpoints={log: (int(number), hash_) for log, number, hash_ in heads},
        ).metrics()
        if self._links is not None:
            yield from self._links.figures()

    async def _follow_telemetry(self) -> None:
        """Follow telemetry once the node has a mobility service and a certificate."""
        await self._mobility.wait()
        await self._identity.ready.wait()
        # Imported here: gRPC is a third of the memory, and only drones need it.
        from fractus_agent.telemetry.feed import TelemetryFeed  # noqa: PLC0415

        self._feed = TelemetryFeed(
            self._settings.mobility_address,
            self._settings.tls,
            self._settings.node,
            serial=lambda: self._identity.serial,
            changed=self._telemetry_changed,
        )
        self._feed.hasten(self._links is not None and self._links.active)
        await self._feed.run()

    async def _link(self) -> None:
        """Run direct links once the node has an interface for them and a certificate."""
        await self._linking.wait()
        await self._identity.ready.wait()
        # Imported here: most nodes have no such interface, and need no memory for it.
        from fractus_agent.links.connectivity import Connectivity  # noqa: PLC0415

        self._links = Connectivity(
            self._store,
            self._settings.node,
            self._settings.links,
            self._settings.tls,
            resource=self._resource,
            seen=self._seen,
            wall=_now,
            audit=self._settings.audit,
            changed=self._links_changed,
            drain_s=self._settings.drain_s,
        )
        await self._links.run()

    def _links_changed(self) -> None:
        if self._feed is not None and self._links is not None:
            self._feed.hasten(self._links.active)

    def _seen(self) -> Seen | None:
        from fractus_core.linking import Seen  # noqa: PLC0415 (by then it is there: only direct links ask)

        found = self._feed.latest if self._feed is not None and self._feed.problem is None else None
        if found is None or found.position is None:
            return None
        lat, lon, above_home_m, _ = found.position
        return Seen(lat, lon, above_home_m, found.altitude_amsl_m - above_home_m, found.velocity_mps)

    def _resource(self) -> Drone | EdgeNode | None:
        return self._registration.resource or self._stored

    def _has_mobility(self) -> bool:
        resource = self._resource()
        return resource is not None and resource.kind == "Drone" and resource.spec.services.mobility is not None

    def _has_direct_interface(self) -> bool:
        resource = self._resource()
        return resource is not None and direct_interface(resource.spec.interfaces) is not None

    def _observe(self, body: Object) -> ObservedNode:
        services = (body.get("spec") or {}).get("services") or {}
        return ObservedNode(
            kind=body["kind"],
            has_mobility=self._has_mobility(),
            needs_certificate=bool(services),
            certified=self._identity.condition,
            snapshot=self._feed.latest if self._feed else None,
            problem=self._feed.problem if self._feed else None,
            described=self._registration.described,
            handed=self._handover.condition,
            audit=audit_heads(self._settings.audit),
            unrecorded=recording_problems(self._settings.state),
        )

    def _telemetry_changed(self) -> None:
        if self._feed is not None and self._feed.latest is not None:
            self._keeper.missions_changed(self._feed.latest.missions)
        self._changed()

    def _changed(self) -> None:
        """Pass on what one part found out to the parts that depend on it."""
        if self._has_mobility():
            self._mobility.set()
        if self._has_direct_interface():
            self._linking.set()
        if self._certificates != self._identity.serial:
            self._certificates = self._identity.serial
            self._keeper.authority_changed()
        self._reporter.changed()


def _now() -> datetime:
    return datetime.now(UTC)
