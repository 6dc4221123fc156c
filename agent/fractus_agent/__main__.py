"""`python -m fractus_agent`: wires the agent of a node and runs it until it is told to stop."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import sys
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from fractus_agent.cluster.store import Object, Store, Unconfigured, connect
from fractus_agent.grants.keeper import GrantDirectory, GrantKeeper
from fractus_agent.grants.verifier import GrantVerifier
from fractus_agent.identity.identity import Identity
from fractus_agent.registration.registration import Registration
from fractus_agent.registration.status import Observed, StatusReporter
from fractus_agent.settings import MissingSetting, Settings
from fractus_agent.watchdog import guard

if TYPE_CHECKING:
    from fractus_agent.telemetry.feed import TelemetryFeed

LOG = logging.getLogger("fractus_agent")


class Agent:
    """The parts of the agent and how they hear of each other."""

    def __init__(self, settings: Settings, store: Store) -> None:
        self._settings = settings
        node = settings.node
        self.identity = Identity(store, settings.tls, node, _now, changed=self._poke)
        self.keeper = GrantKeeper(
            store,
            GrantDirectory(settings.grants),
            node,
            GrantVerifier(settings.tls).verify,
            ask=self.identity.doubt_authority,
        )
        self._certificates = 0
        self.registration = Registration(store, settings.description, node, changed=self._poke)
        self._mobility = asyncio.Event()
        self._feed: TelemetryFeed | None = None
        self.reporter = StatusReporter(
            store,
            body=lambda: self.registration.body,
            observe=self._observe,
            written=self.registration.seen,
            wall=_now,
            monotonic=time.monotonic,
        )

    async def run(self) -> None:
        """Run all parts; the end of any one is the end of the agent."""
        async with asyncio.TaskGroup() as tasks:
            for part in (
                guard(),
                self.keeper.follow(),
                self.keeper.report(),
                self.identity.run(),
                self.registration.run(),
                self.reporter.run(),
                self._listen(),
            ):
                tasks.create_task(part)

    async def _listen(self) -> None:
        """Follow telemetry once the node has a mobility service and a certificate."""
        await self._mobility.wait()
        await self.identity.ready.wait()
        # Imported here: gRPC is a third of the memory, and only drones need it.
        from fractus_agent.telemetry.feed import TelemetryFeed  # noqa: PLC0415

        self._feed = TelemetryFeed(
            self._settings.mobility_address,
            self._settings.tls,
            self._settings.node,
            serial=lambda: self.identity.serial,
            changed=self._heard,
        )
        await self._feed.run()

    def _has_mobility(self) -> bool:
        resource = self.registration.resource
        return resource is not None and resource.kind == "Drone" and resource.spec.services.mobility is not None

    def _observe(self, body: Object) -> Observed:
        services = (body.get("spec") or {}).get("services") or {}
        return Observed(
            kind=body["kind"],
            has_mobility=self._has_mobility(),
            needs_certificate=bool(services),
            certified=self.identity.finding,
            snapshot=self._feed.latest if self._feed else None,
            problem=self._feed.problem if self._feed else None,
            described=self.registration.described,
        )

    def _heard(self) -> None:
        if self._feed is not None and self._feed.latest is not None:
            self.keeper.missions_changed(self._feed.latest.missions)
        self._poke()

    def _poke(self) -> None:
        if self._has_mobility():
            self._mobility.set()
        if self._certificates != self.identity.serial:
            self._certificates = self.identity.serial
            self.keeper.authority_changed()
        self.reporter.poke()


def _now() -> datetime:
    return datetime.now(UTC)


async def serve(settings: Settings) -> None:
    """Run the agent until SIGTERM or SIGINT.

    Raises:
        Unconfigured: there is no service account and no KUBECONFIG.
    """
    store = Store(await connect(), settings.node)
    task = asyncio.create_task(Agent(settings, store).run())
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, task.cancel)
    try:
        with contextlib.suppress(asyncio.CancelledError):
            await task
    finally:
        await store.close()


def main(environment: Mapping[str, str] = os.environ) -> int:
    """Run the agent of this node; the exit code."""
    try:
        settings = Settings.from_environment(environment)
    except MissingSetting as error:
        print(error, file=sys.stderr)
        return 2
    logging.basicConfig(level=settings.log_level, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    LOG.info("agent of node %s", settings.node)
    try:
        asyncio.run(serve(settings))
    except Unconfigured as error:
        LOG.error("%s", error)  # noqa: TRY400 (one line is enough)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
