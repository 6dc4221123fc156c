"""Edge end of direct links: accepts the drones that a DirectLink names, and redirects their calls to its pods."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from pathlib import Path

from fractus_core.api.direct_links import DirectLink

from fractus_agent.links.acceptor import Acceptor
from fractus_agent.links.audit_records import AuditRecorder
from fractus_agent.links.device_addresses import link_address
from fractus_agent.links.direct_link_store import isolated_pods, pod_endpoint, route_key, virtual_endpoint
from fractus_agent.links.pairing import LinkLost, Session
from fractus_agent.redirector.netlink import NetlinkError
from fractus_agent.redirector.nft_maps import Endpoint, RedirectFailed
from fractus_agent.redirector.redirector import Redirector

log = logging.getLogger(__name__)

MAX_DRONES = 1
"""Limit of linked drones, because the declared bandwidth of a link is for one drone."""
FIRST_PORT = 30_000
LAST_PORT = 39_999
"""Ports on the link address that are translated to pods. Nothing listens on them."""
LISTEN_RETRY_S = 1.0
REMOVAL_GRACE_S = 3.0
"""Time for a drone to move its traffic back after its DirectLink was deleted, in seconds."""


class EdgeLinkController:
    """Accepts drones, and redirects their calls to pods of this node.

    Args:
        node: Name of this node.
        tls: Directory of its certificate, key and authority.
        redirector: Redirector of this node.
        on_change: Called when a drone links or leaves.
        record: Writes an audit record.
    """

    def __init__(
        self, node: str, tls: Path, redirector: Redirector, on_change: Callable[[], None], record: AuditRecorder
    ) -> None:
        self._address = link_address(node)
        self._redirector = redirector
        self._on_change = on_change
        self._record = record
        self._links: tuple[DirectLink, ...] = ()
        self._next_plan = asyncio.Event()
        """Event that is set at the next change of the DirectLinks.

        Each change also creates a new event for the change after it.
        """
        self._routes: dict[str, dict[Endpoint, Endpoint]] = {}
        self._ports: dict[Endpoint, int] = {}
        self._acceptor = Acceptor(tls, self._refusal, self._serve, max_peers=MAX_DRONES)

    @property
    def drones(self) -> frozenset[str]:
        """Drones that are linked now."""
        return self._acceptor.peers

    def set_links(self, links: tuple[DirectLink, ...]) -> None:
        """Set the current DirectLinks of this node."""
        self._links = links
        try:
            self._write_services()
        except (NetlinkError, RedirectFailed) as error:
            log.warning("links: pods not isolated, retrying (error=%s)", error)
        self._next_plan.set()
        self._next_plan = asyncio.Event()

    async def run(self) -> None:
        """Accept drones until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._isolate())
            tasks.create_task(self._listen())

    async def _isolate(self) -> None:
        """Keep the pods isolated as planned. Retry if the kernel refused."""
        while True:
            next_plan = self._next_plan
            try:
                self._write_services()
            except (NetlinkError, RedirectFailed) as error:
                log.debug("links: pods not isolated, retrying (error=%s)", error)
                await asyncio.sleep(LISTEN_RETRY_S)
            else:
                await next_plan.wait()

    async def _listen(self) -> None:
        while True:
            try:
                await self._acceptor.run(self._address)
            except OSError as error:  # the device or the certificate does not exist yet
                log.debug("links: not listening, retrying (error=%s)", error)
                await asyncio.sleep(LISTEN_RETRY_S)

    def _refusal(self, drone: str) -> str:
        """Return the reason why a drone may not link to this node, empty if it may."""
        if any(link.spec.drone == drone for link in self._links):
            return ""
        return f"no DirectLink names {drone}"

    async def _serve(self, session: Session) -> None:
        """Redirect the drone's calls while its session lasts, and send it the routes.

        Raises:
            LinkLost: The DirectLink of the drone was deleted, and the grace period has ended.
        """
        sent: dict[str, int] | None = None
        self._record("drone", {"drone": session.peer, "linked": True})
        self._on_change()
        try:
            while True:
                if self._refusal(session.peer):
                    await asyncio.sleep(REMOVAL_GRACE_S)
                    if reason := self._refusal(session.peer):
                        raise LinkLost(f"{reason} any longer")
                next_plan = self._next_plan
                try:
                    routes = self._redirect(session.peer)
                except (NetlinkError, RedirectFailed) as error:
                    log.warning("links: calls not redirected, retrying (peer=%s error=%s)", session.peer, error)
                    await asyncio.sleep(LISTEN_RETRY_S)
                    continue
                if routes != sent:
                    await session.send({"routes": routes})
                    self._record("routes", {"drone": session.peer, "services": self._pods_by_service(session.peer)})
                    sent = routes
                await next_plan.wait()
        finally:
            self._routes.pop(session.peer, None)
            self._record("drone", {"drone": session.peer, "linked": False})
            self._on_change()
            try:
                self._write_targets({})
            except (NetlinkError, RedirectFailed) as error:
                log.warning("links: redirects not removed, they will time out (peer=%s error=%s)", session.peer, error)

    def _redirect(self, drone: str) -> dict[str, int]:
        """Redirect a drone's calls to the ready pods.

        Returns:
            Port on the link address by service.

        Raises:
            NetlinkError: The kernel refused the transaction.
            RedirectFailed: The table cannot be created.
        """
        ports: dict[str, int] = {}
        routes: dict[Endpoint, Endpoint] = {}
        for link in self._links:
            for service in link.spec.services if link.spec.drone == drone else ():
                virtual = virtual_endpoint(service)
                pod = pod_endpoint(service)
                if virtual is None or pod is None:
                    continue
                port = self._port(virtual)
                ports[route_key(virtual)] = port
                routes[Endpoint(self._address, port, virtual.protocol)] = pod
        self._routes[drone] = routes
        self._write_targets(routes)
        return ports

    def _pods_by_service(self, drone: str) -> dict[str, str]:
        """Return the pod that receives a drone's calls, by service."""
        pods = {endpoint.port: pod for endpoint, pod in self._routes[drone].items()}
        by_service = ((route_key(service), pods.get(port)) for service, port in self._ports.items())
        return {service: f"{pod.address}:{pod.port}" for service, pod in by_service if pod is not None}

    def _port(self, service: Endpoint) -> int:
        """Return the port of a service on the link address. The port stays the same while the agent runs."""
        if service not in self._ports:
            taken = set(self._ports.values())
            self._ports[service] = next(port for port in range(FIRST_PORT, LAST_PORT + 1) if port not in taken)
        return self._ports[service]

    def _write_targets(self, targets: dict[Endpoint, Endpoint]) -> None:
        self._write_services()
        self._redirector.set_peers(link_address(drone) for drone in self._routes)
        self._redirector.set_targets(targets)

    def _write_services(self) -> None:
        served = {endpoint for routes in self._routes.values() for endpoint in routes}
        self._redirector.set_services(served, isolated_pods(self._links))
