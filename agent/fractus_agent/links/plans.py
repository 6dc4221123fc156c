"""The node's DirectLinks: from the API server, and on disk, so that a drone without one goes on after a restart."""

from __future__ import annotations

import json
import logging
import socket
from collections.abc import Callable, Iterable, Iterator
from ipaddress import AddressValueError, IPv4Address
from pathlib import Path

from fractus_core.api.direct_links import DirectLink, LinkedService
from fractus_core.api.model import InvalidObject
from fractus_runtime.files import remove_file, write_file

from fractus_agent.cluster.store import Changed, Deleted, End, Event, Listed, Object, Store
from fractus_agent.redirector.nft import Endpoint

log = logging.getLogger(__name__)

_PROTOCOLS = {"TCP": socket.IPPROTO_TCP, "UDP": socket.IPPROTO_UDP}


class LinkPlans:
    """Mirrors the DirectLinks of this node to disk, and tells when they change.

    Files are removed only when the API server says so; one that is out of reach removes nothing.

    Args:
        store: the API server.
        directory: the disk.
        node: this node.
        end: which end it is.
        changed: called after each change.
    """

    def __init__(self, store: Store, directory: Path, node: str, end: End, changed: Callable[[], None]) -> None:
        self._store = store
        self._directory = directory
        self._node = node
        self._end: End = end
        self._changed = changed
        self._links: dict[str, DirectLink] = {}

    @property
    def links(self) -> tuple[DirectLink, ...]:
        """The DirectLinks as they are now, by name."""
        return tuple(self._links[name] for name in sorted(self._links))

    async def follow(self) -> None:
        """Keep up with the API server until cancelled."""
        self.restore()
        async for event in self._store.direct_links(self._end):
            self.take(event)

    def restore(self) -> None:
        """Read what is on disk."""
        self._directory.mkdir(parents=True, exist_ok=True, mode=0o700)
        for left in self._directory.glob(".*.tmp"):
            left.unlink()
        for path in self._directory.glob("*.json"):
            try:
                self._read(json.loads(path.read_bytes()))
            except (OSError, ValueError, RecursionError) as error:
                log.warning("links: a stored DirectLink is left out (file=%s error=%s)", path, error)
        if self._links:
            log.info("links: restored from disk (links=%d)", len(self._links))
            self._changed()

    def take(self, event: Event) -> None:
        """Apply one event."""
        match event:
            case Listed(bodies):
                names = {body["metadata"]["name"] for body in bodies}
                for gone in {*self._links, *(path.stem for path in self._directory.glob("*.json"))} - names:
                    self._remove(gone)
                for body in bodies:
                    self._put(body)
            case Changed(body):
                self._put(body)
            case Deleted(name):
                self._remove(name)
        self._changed()

    def _put(self, body: Object) -> None:
        name = body["metadata"]["name"]
        kept = {key: body[key] for key in ("apiVersion", "kind", "spec")}
        kept["metadata"] = {k: body["metadata"][k] for k in ("name", "uid", "generation") if k in body["metadata"]}
        if "deletionTimestamp" in body["metadata"] or not self._read(kept):
            self._remove(name)
            return
        content = json.dumps(kept, sort_keys=True, indent=1).encode() + b"\n"
        path = self._file(name)
        try:
            if not path.exists() or path.read_bytes() != content:
                write_file(path, content)
        except OSError as error:
            log.warning("links: a DirectLink is not stored (link=%s error=%s)", name, error)

    def _read(self, body: Object) -> bool:
        """Take a DirectLink; False for one that is not this node's, or that cannot be read."""
        try:
            link = DirectLink.from_body(body)
        except InvalidObject as error:
            log.warning("links: a DirectLink cannot be read: %s", error)
            return False
        if getattr(link.spec, self._end) != self._node:
            return False
        self._links[link.name] = link
        return True

    def _remove(self, name: str) -> None:
        self._links.pop(name, None)
        try:
            remove_file(self._file(name))
        except OSError as error:
            log.warning("links: a DirectLink stays on disk (link=%s error=%s)", name, error)

    def _file(self, name: str) -> Path:
        return self._directory / f"{name}.json"


def virtual(service: LinkedService) -> Endpoint | None:
    """Where clients call a service; None where the kernel's IPv4 translation cannot lead it elsewhere."""
    return _endpoint(service.virtual.address, service.virtual.port, service.virtual.protocol)


def target(service: LinkedService) -> Endpoint | None:
    """Where the pod listens; None while there is none."""
    if service.target is None:
        return None
    return _endpoint(service.target.address, service.target.port, service.virtual.protocol)


def virtuals(links: Iterable[DirectLink]) -> Iterator[Endpoint]:
    """Where clients call all services of some links."""
    for link in links:
        for service in link.spec.services:
            if (found := virtual(service)) is not None:
                yield found


def callers(links: Iterable[DirectLink]) -> dict[Endpoint, frozenset[IPv4Address]]:
    """Which clients on the drone may call services; without those that all may call."""
    found: dict[Endpoint, frozenset[IPv4Address]] = {}
    for service in (service for link in links for service in link.spec.services if service.callers is not None):
        if (called := virtual(service)) is not None:
            pods = (_endpoint(each.address, 0, "TCP") for each in service.callers or () if each.address is not None)
            found[called] = found.get(called, frozenset()) | {pod.address for pod in pods if pod is not None}
    return found


def isolated(links: Iterable[DirectLink]) -> dict[Endpoint, frozenset[IPv4Address]]:
    """The pods on the node that is asked which take nothing but what is led to them over a link."""
    pods = (target(s) for link in links for s in link.spec.services if s.callers is not None)
    return {pod: frozenset() for pod in pods if pod is not None}


def _endpoint(address: str, port: int, protocol: str) -> Endpoint | None:
    try:
        return Endpoint(IPv4Address(address), port, _PROTOCOLS[protocol])
    except AddressValueError:
        return None


def route_key(endpoint: Endpoint) -> str:
    """How an endpoint is named in what the ends of a link tell each other: 10.96.0.5:8080/TCP."""
    protocol = next(name for name, number in _PROTOCOLS.items() if number == endpoint.protocol)
    return f"{endpoint.address}:{endpoint.port}/{protocol}"
