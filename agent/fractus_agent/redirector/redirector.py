"""Redirector: moves traffic of services between the cloud path and the direct link, and keeps the redirects alive.

A planned switch redirects new connections at once. Existing connections stay on the old path for `drain_s`, in which
their calls can finish. After that they are closed between two calls if possible, and otherwise cut. An abrupt switch,
after the loss of a link, closes all old connections at once, because they would hang until a timeout.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from ipaddress import IPv4Address

from fractus_agent.redirector.connections import Conntrack, PodNamespaces, destroy_connection
from fractus_agent.redirector.netlink import NetlinkError
from fractus_agent.redirector.nft_maps import (
    MAX_NUMBER,
    NO_GUARDS,
    Callers,
    Endpoint,
    NftMaps,
    Redirect,
    RedirectFailed,
)
from fractus_agent.settings import DEFAULT_DRAIN_S

log = logging.getLogger(__name__)

LEASE_S = 5.0
"""Lifetime of redirects without an agent, in seconds. After that the kernel drops them."""
REFRESH_S = 1.5

QUIET_TIMEOUT_S = 0.5
"""Time to wait for a quiet moment of a connection at the end of the drain, in seconds."""
DRAIN_POLL_S = 0.02
QUIET_POLL_S = 0.002


@dataclass(frozen=True, slots=True)
class SwitchResult:
    """Number of connections that a switch closed.

    Attributes:
        drained: Connections closed while quiet.
        cut: Connections closed in the middle of a call.
    """

    drained: int = 0
    cut: int = 0


@dataclass(frozen=True, slots=True)
class _OldPath:
    """Path that a service has left.

    Attributes:
        service: Endpoint that clients connect to.
        number: Service number that only the connections opened on this path have.
        connections: Identities of the connections on the path when the service left it, except connections on earlier paths.
    """

    service: Endpoint
    number: int
    connections: frozenset[bytes]


class Redirector:
    """Holds and switches the redirects of this node.

    Each switch assigns new numbers to the services that it moves. So connections that clients open during a drain are
    not deleted with the old ones, and a failed cleanup can be repeated later.

    Args:
        maps: Elements of the nftables table.
        conntrack: Connection tracking entries of the kernel.
        namespaces: TCP sockets of the pods.
        drain_s: Time for which connections may stay on a working path that their service has left, in seconds.
    """

    def __init__(
        self, maps: NftMaps, conntrack: Conntrack, namespaces: PodNamespaces, *, drain_s: float = DEFAULT_DRAIN_S
    ) -> None:
        self._drain_s = drain_s
        self._maps = maps
        self._conntrack = conntrack
        self._namespaces = namespaces
        self._redirects: dict[Endpoint, Endpoint] = {}
        self._numbers: dict[Endpoint, int] = {}
        self._peers: frozenset[IPv4Address] = frozenset()
        self._callers = NO_GUARDS
        self._old_paths: list[_OldPath] = []
        self._draining: set[int] = set()
        self._last_number = 0

    @property
    def redirects(self) -> Mapping[Endpoint, Endpoint]:
        """Current target by virtual endpoint. Endpoints without a target take the cloud path."""
        return dict(self._redirects)

    def byte_counts(self) -> dict[Endpoint, tuple[int, int]]:
        """Return the bytes sent and received over the link since each service moved to it. Idle services are missing.

        Raises:
            NetlinkError: The counters cannot be read.
        """
        counts = self._maps.byte_counts()
        return {service: counts[number] for service, number in self._numbers.items() if number in counts}

    def set_peers(self, peers: Iterable[IPv4Address]) -> None:
        """Set the nodes whose connections over direct interfaces are redirected.

        Raises:
            NetlinkError: The kernel refused the transaction. Nothing has changed.
            RedirectFailed: The table cannot be created.
        """
        before = self._peers
        self._peers = frozenset(peers)
        try:
            self._write(self._redirects, self._numbers)
        except (NetlinkError, RedirectFailed):
            self._peers = before
            raise

    def set_services(self, services: Iterable[Endpoint], callers: Callers = NO_GUARDS) -> None:
        """Set the services to which clients on this node connect, and remove the redirects of all other services.

        Args:
            services: Endpoints of the services.
            callers: Clients that may connect to each guarded endpoint. On a node with clients, the guarded endpoints
                are services. On other nodes, they are pods that accept only traffic of a direct link.

        Raises:
            NetlinkError: The kernel refused the transaction. Nothing has changed.
            RedirectFailed: The table cannot be created.
        """
        desired = set(services)
        if desired == self._numbers.keys() and callers == self._callers:
            return
        numbers: dict[Endpoint, int] = {}
        for service in sorted(desired):
            # A service keeps its number, because its connections carry it as their mark.
            numbers[service] = self._numbers.get(service) or self._new_number(numbers)
        # Connections of removed services on the cloud path stay open.
        removed = self._redirects.keys() - desired
        ended = self._old_paths_of({service: self._numbers[service] for service in removed})
        redirects = {virtual: target for virtual, target in self._redirects.items() if virtual in numbers}
        self._write(redirects, numbers, callers)
        self._callers = dict(callers)
        self._old_paths += ended
        self._close_old_paths(ended)

    def set_targets(self, targets: Mapping[Endpoint, Endpoint]) -> None:
        """Redirect incoming connections to pods of this node at once. Connections to previous targets are closed.

        Raises:
            NetlinkError: The kernel refused the transaction. Nothing has changed.
            RedirectFailed: The table cannot be created.
        """
        _, old_paths = self._redirect(targets)
        self._close_old_paths(old_paths)

    async def run(self) -> None:
        """Keep the redirects alive until cancelled. Then remove them, so that new connections take the cloud path."""
        try:
            while True:
                await asyncio.sleep(REFRESH_S)
                try:
                    # Write the marks as well, because someone may have removed the table with its elements.
                    self._write(self._redirects, self._numbers)
                    self._close_old_paths([path for path in self._old_paths if path.number not in self._draining])
                except (NetlinkError, RedirectFailed) as error:
                    log.warning("redirector: redirects not refreshed (error=%s)", error)
        finally:
            with suppress(NetlinkError, RedirectFailed):
                self._write({}, None)

    async def switch(self, targets: Mapping[Endpoint, Endpoint | None], *, planned: bool) -> SwitchResult:
        """Redirect services. A switch does not wait until older switches have drained their connections.

        Args:
            targets: Target by virtual endpoint of a service, None for the cloud path.
            planned: True if the old path still works, so that current calls may finish on it.

        Raises:
            NetlinkError: The kernel refused the transaction. Nothing has changed.
            RedirectFailed: The table was removed, and cannot be created again.
        """
        moved, old_paths = self._redirect(targets)
        if not moved:
            return SwitchResult()
        old = {path.number for path in old_paths}
        drained = 0
        try:
            if planned:
                self._draining |= old
                drained = await self._drain({identity for path in old_paths for identity in path.connections}, moved)
        finally:
            self._draining -= old
            cut = self._close_old_paths(old_paths)
        log.info("redirector: switched (services=%d planned=%s drained=%d cut=%d)", len(moved), planned, drained, cut)
        return SwitchResult(drained, cut)

    def _redirect(self, targets: Mapping[Endpoint, Endpoint | None]) -> tuple[list[Endpoint], list[_OldPath]]:
        """Redirect new connections. Return the services that moved, and the paths that they left."""
        before = self._redirects
        after = {v: t for v, t in (before | dict(targets)).items() if t is not None and v in self._numbers}
        moved = sorted(virtual for virtual in targets if before.get(virtual) != after.get(virtual))
        if not moved:
            return [], []
        old = {virtual: self._numbers[virtual] for virtual in moved if virtual in self._numbers}
        numbers = dict(self._numbers)
        for virtual in old:
            numbers[virtual] = self._new_number(numbers)
        self._write(after, numbers)
        # From here on new connections take the new path and carry the new number.
        old_paths = self._old_paths_of(old)
        self._old_paths += old_paths
        return moved, old_paths

    def _new_number(self, taken: Mapping[Endpoint, int]) -> int:
        """Return a number that no service and no old path has."""
        used = {*taken.values(), *self._numbers.values(), *(path.number for path in self._old_paths)}
        while True:
            self._last_number = self._last_number % MAX_NUMBER + 1
            if self._last_number not in used:
                return self._last_number

    def _write(
        self,
        redirects: Mapping[Endpoint, Endpoint],
        numbers: Mapping[Endpoint, int] | None,
        callers: Callers | None = None,
    ) -> None:
        self._maps.write(
            (Redirect(virtual, target) for virtual, target in redirects.items()),
            numbers.items() if numbers is not None else None,
            LEASE_S,
            self._peers,
            callers,
        )
        self._redirects = dict(redirects)
        if numbers is not None:
            self._numbers = dict(numbers)

    def _old_paths_of(self, numbers: Mapping[Endpoint, int]) -> list[_OldPath]:
        """Return the path of each service with its current connections.

        `numbers` contains the number of each service.
        """
        connections: dict[Endpoint, set[bytes]] = {service: set() for service in numbers}
        # Connections on an earlier path stay on that path, which may still work.
        older = frozenset[bytes]().union(*(path.connections for path in self._old_paths))
        for _, connection in self._namespaces.list_connections(connections):
            if connection.identity not in older:
                connections[connection.peer].add(connection.identity)
        return [_OldPath(service, number, frozenset(connections[service])) for service, number in numbers.items()]

    def _close_old_paths(self, paths: Iterable[_OldPath]) -> int:
        """Close the remaining connections of old paths, and return the number of closed ones. Failures are retried later."""
        paths = [path for path in paths if path in self._old_paths]
        try:
            cut = self._namespaces.cut({p.service for p in paths}, {c for p in paths for c in p.connections})
            for path in paths:
                self._conntrack.delete(path.number)
                self._old_paths.remove(path)
        except NetlinkError as error:
            log.warning("redirector: old paths not cleaned up, retrying (paths=%d error=%s)", len(paths), error)
            return 0
        return cut

    async def _drain(self, old: Collection[bytes], services: Collection[Endpoint]) -> int:
        """Wait for `drain_s` or until the old connections have ended. Then close each one at a quiet moment.

        A connection that is not quiet within QUIET_TIMEOUT_S stays open. The caller cuts it.

        Args:
            old: Identities of the connections on the old path.
            services: Services that left the path.

        Returns:
            Number of connections closed at a quiet moment.
        """
        drained = 0
        closing_s = time.monotonic() + self._drain_s
        watched = [pair for pair in self._namespaces.list_connections(services) if pair[1].identity in old]
        while watched:
            now_s = time.monotonic()
            if now_s >= closing_s + QUIET_TIMEOUT_S:
                break
            remaining = []
            for sockets, connection in watched:
                try:
                    current = sockets.refresh(connection)
                except NetlinkError as error:  # the caller cuts it
                    log.warning("redirector: connection not drained (error=%s)", error)
                    continue
                if current is None:
                    continue
                if now_s < closing_s or not current.is_quiet:
                    remaining.append((sockets, current))
                elif destroy_connection(sockets, current):
                    drained += 1
                else:
                    return drained
            watched = remaining
            if watched:
                await asyncio.sleep(DRAIN_POLL_S if now_s < closing_s else QUIET_POLL_S)
        return drained

    def close(self) -> None:
        """Close the sockets of the pods' namespaces."""
        self._namespaces.close()
