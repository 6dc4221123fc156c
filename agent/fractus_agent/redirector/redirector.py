"""Moves the traffic of services between the cloud path and the direct link, and keeps it there while the agent lives.

A planned switch moves new connections at once and lets each old one finish what it does: it is closed when it is idle, so
that no call is lost, and at the latest after a time that a long reply should take. An abrupt switch, after a link was lost,
closes and forgets all old connections at once: they would never recover by themselves.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from ipaddress import IPv4Address
from pathlib import Path

from fractus_agent.redirector.conntrack import Conntrack
from fractus_agent.redirector.habits import Exchange, Habits
from fractus_agent.redirector.netlink import NETLINK_SOCK_DIAG, Netlink, NetlinkError, in_namespace
from fractus_agent.redirector.nft import MAX_NUMBER, NO_GUARDS, Callers, Endpoint, Maps, Redirect, RedirectFailed
from fractus_agent.redirector.sockets import Connection, DestroyUnsupported, Sockets

log = logging.getLogger(__name__)

LEASE_S = 5.0
"""Redirects live so long without an agent: then the kernel drops them, and new connections take the cloud path."""
REFRESH_S = 1.5

DRAIN_S = 30.0
"""Connections that are in the middle of something stay on the path that their service has left for so long."""
BUSY_TIMEOUT_S = 1.5
"""A client that calls all the time never rests for long: over this time ever less is asked for of its rests between calls."""
DRAIN_POLL_S, SLOW_POLL_S = 0.002, 0.02
LEARN_S = 0.1


@dataclass(frozen=True, slots=True)
class Switched:
    """What a switch did.

    Attributes:
        drained: connections that were closed when they were idle.
        cut: connections that were closed in the middle of something.
    """

    drained: int = 0
    cut: int = 0


class Namespaces:
    """Sockets of the pods on this node, through the network namespaces that the container runtime made.

    Args:
        directory: where the runtime keeps them, /run/netns; None where no client is on this node.
        own: the node's own namespace as well, for clients in the host's network.
    """

    def __init__(self, directory: Path | None, *, own: Path = Path("/proc/self/ns/net")) -> None:
        self._directory = directory
        self._own = own
        self._open: dict[Path, Sockets] = {}

    def refresh(self) -> Collection[Sockets]:
        """Open what is new, close what is gone; all that are there."""
        if self._directory is None:
            return ()
        there = {self._own}
        try:
            there.update(self._directory.iterdir())
        except OSError as error:  # the runtime has made none yet
            log.debug("redirector: no network namespaces of pods (error=%s)", error)
        for path in set(self._open) - there:
            self._open.pop(path).close()
        for path in there - set(self._open):
            try:
                self._open[path] = Sockets(in_namespace(path, lambda: Netlink(NETLINK_SOCK_DIAG)))
            except (OSError, RuntimeError) as error:  # a pod that ends at this moment
                log.debug("redirector: network namespace left out (path=%s error=%s)", path, error)
        return self._open.values()

    def to(self, services: Collection[Endpoint]) -> Iterator[tuple[Sockets, Connection]]:
        """The connections to some services; without those of namespaces that cannot be looked at, such as a pod's that ends."""
        for sockets in self.refresh():
            try:
                found = sockets.to(services)
            except NetlinkError as error:
                log.warning("redirector: connections not looked at (error=%s)", error)
                continue
            for connection in found:
                yield sockets, connection

    def cut(self, services: Collection[Endpoint], only: Collection[bytes]) -> int:
        """Close these of the connections to some services, whatever they do; how many there were.

        Raises:
            NetlinkError: the kernel does not tell.
        """
        cut = 0
        for sockets in self.refresh():
            for connection in sockets.to(services):
                if connection.identity in only:
                    if not _destroy(sockets, connection):
                        return cut
                    cut += 1
        return cut

    def close(self) -> None:
        """Close all sockets."""
        for sockets in self._open.values():
            sockets.close()
        self._open.clear()


@dataclass(frozen=True, slots=True)
class _Left:
    """A path that a service has left.

    Attributes:
        service: where clients connect to.
        number: carried by the connections that were opened on it, and by no others.
        connections: those that were on it when it was left, and on no path that was left before.
    """

    service: Endpoint
    number: int
    connections: frozenset[bytes]


class Redirector:
    """Holds the redirects of this node, and switches them.

    Each switch gives the services that it moves new numbers: so connections that clients open while the old ones are drained
    are not forgotten with these, and what a switch could not clean up can be cleaned up later.

    Args:
        maps: our table.
        conntrack: the kernel's connections.
        namespaces: sockets of the pods.
        drain_s: how long connections may finish what they do on a path that their service has left while it lives.
    """

    def __init__(self, maps: Maps, conntrack: Conntrack, namespaces: Namespaces, *, drain_s: float = DRAIN_S) -> None:
        self._drain_s = drain_s
        self._maps = maps
        self._conntrack = conntrack
        self._namespaces = namespaces
        self._redirects: dict[Endpoint, Endpoint] = {}
        self._numbers: dict[Endpoint, int] = {}
        self._peers: frozenset[IPv4Address] = frozenset()
        self._callers = NO_GUARDS
        self._left: list[_Left] = []
        self._draining: set[int] = set()
        self._last_number = 0
        self._habits = Habits()
        self._exchanges: dict[bytes, Exchange] = {}

    @property
    def redirects(self) -> Mapping[Endpoint, Endpoint]:
        """Where connections to virtual endpoints go now; those that are not named take the cloud path."""
        return dict(self._redirects)

    def counted(self) -> dict[Endpoint, tuple[int, int]]:
        """Bytes that services have sent and received over the link since they took it; those of which nothing is known are not named.

        Raises:
            NetlinkError: the kernel does not tell.
        """
        found = self._maps.counted()
        return {service: found[number] for service, number in self._numbers.items() if number in found}

    def admit(self, peers: Iterable[IPv4Address]) -> None:
        """Lead on the connections of these nodes, and of no others, that come over direct interfaces.

        Raises:
            NetlinkError: the kernel refused; nothing was changed.
            RedirectFailed: our table cannot be made.
        """
        before, self._peers = self._peers, frozenset(peers)
        try:
            self._write(self._redirects, self._numbers)
        except (NetlinkError, RedirectFailed):
            self._peers = before
            raise

    def serve(self, services: Iterable[Endpoint], callers: Callers = NO_GUARDS) -> None:
        """Number the services that clients on this node connect to; redirects of others end, and what was led by them.

        Args:
            services: where clients connect to.
            callers: who may, by guarded endpoint: on a node with clients of services, on others of pods that take nothing but
                what comes over a link.

        Raises:
            NetlinkError: the kernel refused; nothing was changed.
            RedirectFailed: our table cannot be made.
        """
        wanted = set(services)
        if wanted == self._numbers.keys() and callers == self._callers:
            return
        numbers: dict[Endpoint, int] = {}
        for service in sorted(wanted):
            # A number stays with its service, for connections that are there carry it.
            numbers[service] = self._numbers.get(service) or self._fresh(numbers)
        # On the cloud path, connections to services that are served no more go on.
        ended = self._paths({service: self._numbers[service] for service in self._redirects.keys() - wanted})
        self._write({virtual: to for virtual, to in self._redirects.items() if virtual in numbers}, numbers, callers)
        self._callers = dict(callers)
        self._left += ended
        self._leave(ended)

    def lead(self, targets: Mapping[Endpoint, Endpoint]) -> None:
        """Lead what comes from elsewhere to pods of this node; connections to pods that are no targets any more are forgotten.

        Raises:
            NetlinkError: the kernel refused; nothing was changed.
            RedirectFailed: our table cannot be made.
        """
        self._leave(self._turn(targets)[1])

    async def run(self) -> None:
        """Keep the redirects alive until cancelled; then new connections take the cloud path at once."""
        try:
            while True:
                for _ in range(round(REFRESH_S / LEARN_S)):
                    await asyncio.sleep(LEARN_S)
                    self.learn()
                try:
                    # Marks as well: someone may have removed the table, and with it what the kernel knew of them.
                    self._write(self._redirects, self._numbers)
                    self._leave([left for left in self._left if left.number not in self._draining])
                except (NetlinkError, RedirectFailed) as error:
                    log.warning("redirector: redirects not refreshed (error=%s)", error)
        finally:
            with suppress(NetlinkError, RedirectFailed):
                self._write({}, None)

    async def switch(self, targets: Mapping[Endpoint, Endpoint | None], *, planned: bool) -> Switched:
        """Lead services elsewhere. A switch may begin while an older one drains: it waits for nothing.

        Args:
            targets: virtual endpoints that are served and where their connections go; None for the cloud path.
            planned: whether the old path still works, so that calls under way may finish on it.

        Raises:
            NetlinkError: the kernel refused; nothing was changed.
            RedirectFailed: our table is gone and cannot be made again.
        """
        moved, left = self._turn(targets)
        if not moved:
            return Switched()
        old = {each.number for each in left}
        drained = 0
        try:
            if planned:
                self._draining |= old
                drained = await self._drain({c for each in left for c in each.connections}, moved)
        finally:
            self._draining -= old
            cut = self._leave(left)
        log.info("redirector: switched (services=%d planned=%s drained=%d cut=%d)", len(moved), planned, drained, cut)
        return Switched(drained, cut)

    def _turn(self, targets: Mapping[Endpoint, Endpoint | None]) -> tuple[list[Endpoint], list[_Left]]:
        """Lead new connections elsewhere; which services were moved, and the paths that they left."""
        before = self._redirects
        after = {v: t for v, t in (before | dict(targets)).items() if t is not None and v in self._numbers}
        moved = sorted(v for v in targets if before.get(v) != after.get(v))
        if not moved:
            return [], []
        old = {virtual: self._numbers[virtual] for virtual in moved if virtual in self._numbers}
        numbers = dict(self._numbers)
        for virtual in old:
            numbers[virtual] = self._fresh(numbers)
        self._write(after, numbers)
        # Connections that clients open from here on take the new path, and have the new number.
        left = self._paths(old)
        self._left += left
        return moved, left

    def _fresh(self, taken: Mapping[Endpoint, int]) -> int:
        """A number that no service has, and none that was left."""
        used = {*taken.values(), *self._numbers.values(), *(left.number for left in self._left)}
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
            (Redirect(virtual, to) for virtual, to in redirects.items()),
            numbers.items() if numbers is not None else None,
            LEASE_S,
            self._peers,
            callers,
        )
        self._redirects = dict(redirects)
        self._numbers = dict(numbers) if numbers is not None else self._numbers

    def _paths(self, numbers: Mapping[Endpoint, int]) -> list[_Left]:
        """What is left of services with these numbers, as it is now; without connections where the kernel does not tell."""
        found: dict[Endpoint, set[bytes]] = {service: set() for service in numbers}
        # Those of a path that was left before are on that one still, which may be well.
        older = frozenset[bytes]().union(*(left.connections for left in self._left))
        for _, connection in self._namespaces.to(found):
            if connection.identity not in older:
                found[connection.peer].add(connection.identity)
        return [_Left(service, number, frozenset(found[service])) for service, number in numbers.items()]

    def _leave(self, paths: Iterable[_Left]) -> int:
        """Close the connections that are left on paths, and forget them; what fails is tried again. How many were closed."""
        paths = [left for left in paths if left in self._left]
        try:
            cut = self._namespaces.cut({p.service for p in paths}, {c for p in paths for c in p.connections})
            for left in paths:
                self._conntrack.forget(left.number)
                self._left.remove(left)
        except NetlinkError as error:
            log.warning("redirector: old paths are not cleaned up yet (paths=%d error=%s)", len(paths), error)
            return 0
        return cut

    def learn(self) -> None:
        """Look at the connections to the services: what they are doing, and how long the services work for a request."""
        before, self._exchanges = self._exchanges, {}
        for _, connection in self._namespaces.to(self._numbers):
            self._habits.learn(connection)
            known = before.get(connection.identity)
            self._exchanges[connection.identity] = known.then(connection) if known else Exchange.first(connection)

    async def _drain(self, old: Collection[bytes], moved: Collection[Endpoint]) -> int:
        """Close old connections as they become idle, until the time is over; how many."""
        begun, drained = time.monotonic(), 0
        watched = [
            (sockets, self._exchanges.get(connection.identity) or Exchange.first(connection))
            for sockets, connection in self._namespaces.to(moved)
            if connection.identity in old
        ]
        while watched and (spent := time.monotonic() - begun) < self._drain_s:
            there = []
            for sockets, exchange in watched:
                try:
                    connection = sockets.now(exchange.connection)
                except NetlinkError as error:  # it is closed with those that were not idle in time
                    log.warning("redirector: a connection is not drained (error=%s)", error)
                    continue
                if connection is None:
                    continue
                seen = exchange.then(connection)
                within_s = self._drain_s if seen.long else min(BUSY_TIMEOUT_S, self._drain_s)
                if not self._habits.closable(seen, max(1 - spent / within_s, 0.0)):
                    there.append((sockets, seen))
                # At once: the next request comes at some time, and none is to come in between.
                elif not _destroy(sockets, connection):
                    return drained
                else:
                    drained += 1
            watched = there
            if watched:
                await asyncio.sleep(DRAIN_POLL_S if spent < BUSY_TIMEOUT_S else SLOW_POLL_S)
        return drained

    def close(self) -> None:
        """Close the sockets of the pods' namespaces."""
        self._namespaces.close()


def _destroy(sockets: Sockets, connection: Connection) -> bool:
    """Close a connection; False where the kernel cannot: then it ends when its packets find no entry any more."""
    try:
        sockets.destroy(connection)
    except DestroyUnsupported as error:
        log.warning("redirector: connections are not closed (error=%s)", error)
        return False
    except NetlinkError as error:
        log.warning("redirector: a connection is not closed (error=%s)", error)
    return True
