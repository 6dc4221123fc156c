"""The end of direct links that is asked: takes drones that a DirectLink names, and leads their calls to its pods."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from pathlib import Path

from fractus_core.api.direct_links import DirectLink

from fractus_agent.links.acceptor import Acceptor
from fractus_agent.links.addressing import link_address
from fractus_agent.links.evidence import Record
from fractus_agent.links.pairing import LinkLost, Session
from fractus_agent.links.plans import isolated, route_key, target, virtual
from fractus_agent.redirector.netlink import NetlinkError
from fractus_agent.redirector.nft import Endpoint, RedirectFailed
from fractus_agent.redirector.redirector import Redirector

log = logging.getLogger(__name__)

MAX_DRONES = 1
"""Drones that are linked at one time: what a DirectLink says the link offers is for one."""
FIRST_PORT, LAST_PORT = 30_000, 39_999
"""Ports on the link's address that stand for pods; nothing listens there, they are translated."""
LISTEN_RETRY_S = 1.0
PARTING_S = 3.0
"""A drone whose DirectLink is gone has so long to lead its calls back."""


class PeerEnd:
    """Takes drones, and leads their calls to pods of this node.

    Args:
        node: this node.
        tls: its certificate, key and authority.
        redirector: of this node.
        changed: called when drones come or go.
        record: writes an entry of the audit log: its kind and content.
    """

    def __init__(
        self, node: str, tls: Path, redirector: Redirector, changed: Callable[[], None], record: Record
    ) -> None:
        self._address = link_address(node)
        self._redirector = redirector
        self._changed = changed
        self._record = record
        self._links: tuple[DirectLink, ...] = ()
        self._planned = asyncio.Event()
        """Set by the next change; each change has one of its own."""
        self._routes: dict[str, dict[Endpoint, Endpoint]] = {}
        self._ports: dict[Endpoint, int] = {}
        self._acceptor = Acceptor(tls, self._permits, self._serve, max_peers=MAX_DRONES)

    @property
    def drones(self) -> frozenset[str]:
        """The drones that are linked now."""
        return self._acceptor.peers

    def plan(self, links: tuple[DirectLink, ...]) -> None:
        """Take the DirectLinks of this node as they are now."""
        self._links = links
        try:
            self._serve_routes()
        except (NetlinkError, RedirectFailed) as error:
            log.warning("links: pods are not isolated before a drone comes (error=%s)", error)
        self._planned.set()
        self._planned = asyncio.Event()

    async def run(self) -> None:
        """Take drones until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._isolate())
            tasks.create_task(self._listen())

    async def _isolate(self) -> None:
        """Have pods isolated as planned, also where the kernel refused at first."""
        while True:
            planned = self._planned
            try:
                self._serve_routes()
            except (NetlinkError, RedirectFailed) as error:
                log.debug("links: pods are not isolated, trying again (error=%s)", error)
                await asyncio.sleep(LISTEN_RETRY_S)
            else:
                await planned.wait()

    async def _listen(self) -> None:
        while True:
            try:
                await self._acceptor.run(self._address)
            except OSError as error:  # the device is not there yet, or the certificate
                log.debug("links: not listening, trying again (error=%s)", error)
                await asyncio.sleep(LISTEN_RETRY_S)

    def _permits(self, drone: str) -> str:
        """Why a node may not link to this one; empty when it may."""
        return "" if any(link.spec.drone == drone for link in self._links) else f"no DirectLink names {drone}"

    async def _serve(self, session: Session) -> None:
        """While a session lasts: lead the drone's calls on, and tell it where to.

        Raises:
            LinkLost: no DirectLink names the drone any more; it has had its time to lead its calls back.
        """
        told: dict[str, int] | None = None
        self._record("drone", {"drone": session.peer, "linked": True})
        self._changed()
        try:
            while True:
                if self._permits(session.peer):
                    await asyncio.sleep(PARTING_S)
                    if reason := self._permits(session.peer):
                        raise LinkLost(f"{reason} any more")
                planned = self._planned
                try:
                    routes = self._lead(session.peer)
                except (NetlinkError, RedirectFailed) as error:
                    log.warning("links: calls are not led on, trying again (peer=%s error=%s)", session.peer, error)
                    await asyncio.sleep(LISTEN_RETRY_S)
                    continue
                if routes != told:
                    await session.send({"routes": routes})
                    self._record("routes", {"drone": session.peer, "services": self._led(session.peer)})
                    told = routes
                await planned.wait()
        finally:
            self._routes.pop(session.peer, None)
            self._record("drone", {"drone": session.peer, "linked": False})
            self._changed()
            try:
                self._write({})
            except (NetlinkError, RedirectFailed) as error:
                log.warning(
                    "links: redirects stay until they end by themselves (peer=%s error=%s)", session.peer, error
                )

    def _lead(self, drone: str) -> dict[str, int]:
        """Lead a drone's calls to the pods that are ready; by service, the port that stands for it.

        Raises:
            NetlinkError: the kernel refused.
            RedirectFailed: our table cannot be made.
        """
        found: dict[str, int] = {}
        routes: dict[Endpoint, Endpoint] = {}
        for link in self._links:
            for service in link.spec.services if link.spec.drone == drone else ():
                called, pod = virtual(service), target(service)
                if called is None or pod is None:
                    continue
                port = self._port(called)
                found[route_key(called)] = port
                routes[Endpoint(self._address, port, called.protocol)] = pod
        self._routes[drone] = routes
        self._write(routes)
        return found

    def _led(self, drone: str) -> dict[str, str]:
        """Where a drone's calls go, by the service that they are to."""
        pods = {at.port: pod for at, pod in self._routes[drone].items()}
        found = ((route_key(service), pods.get(port)) for service, port in self._ports.items())
        return {service: f"{pod.address}:{pod.port}" for service, pod in found if pod is not None}

    def _port(self, service: Endpoint) -> int:
        """The port that stands for a service, the same for as long as the agent runs."""
        if service not in self._ports:
            taken = set(self._ports.values())
            self._ports[service] = next(port for port in range(FIRST_PORT, LAST_PORT + 1) if port not in taken)
        return self._ports[service]

    def _write(self, targets: dict[Endpoint, Endpoint]) -> None:
        self._serve_routes()
        self._redirector.admit(link_address(drone) for drone in self._routes)
        self._redirector.lead(targets)

    def _serve_routes(self) -> None:
        served = {endpoint for routes in self._routes.values() for endpoint in routes}
        self._redirector.serve(served, isolated(self._links))
