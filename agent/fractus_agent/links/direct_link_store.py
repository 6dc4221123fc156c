"""DirectLinks of the node: received from the API server and stored on disk, so that an offline drone can restart."""

from __future__ import annotations

import json
import logging
import socket
from collections.abc import Callable, Iterable, Iterator
from ipaddress import AddressValueError, IPv4Address
from pathlib import Path

from fractus_core.api.direct_links import DirectLink, LinkedService
from fractus_core.api.model import InvalidObject
from fractus_runtime.files import (
    UnsuitableFile,
    list_files,
    path_text,
    read_file,
    read_json,
    remove_file,
    remove_temporary_files,
    write_file,
)

from fractus_agent.redirector.nft_maps import Endpoint
from fractus_agent.store import Changed, Deleted, LinkEnd, Listed, Object, Store, WatchEvent

log = logging.getLogger(__name__)

_PROTOCOLS = {"TCP": socket.IPPROTO_TCP, "UDP": socket.IPPROTO_UDP}


class DirectLinkStore:
    """Mirrors the DirectLinks of this node to disk.

    Files are removed only if the API server reports the removal. While it is unreachable, all files stay.

    Args:
        store: The node's objects at the API server.
        directory: Directory of the files.
        node: Name of this node.
        end: This node's end of its links, `drone` or `node`.
        on_change: Called after each change.
    """

    def __init__(self, store: Store, directory: Path, node: str, end: LinkEnd, on_change: Callable[[], None]) -> None:
        self._store = store
        self._directory = directory
        self._node = node
        self._end: LinkEnd = end
        self._on_change = on_change
        self._links: dict[str, DirectLink] = {}

    @property
    def links(self) -> tuple[DirectLink, ...]:
        """Current DirectLinks, ordered by name."""
        return tuple(self._links[name] for name in sorted(self._links))

    async def follow(self) -> None:
        """Restore the files, and follow the API server until cancelled."""
        self.restore()
        async for event in self._store.direct_links(self._end):
            self.apply(event)

    def restore(self) -> None:
        """Read the files of the DirectLinks, and remove temporary files."""
        self._directory.mkdir(parents=True, exist_ok=True, mode=0o700)
        remove_temporary_files(self._directory)
        for path in list_files(self._directory, ".json"):
            try:
                self._read(read_json(path))
            except (OSError, ValueError) as error:
                log.warning("links: stored DirectLink skipped (file=%s error=%s)", path_text(path), error)
        if self._links:
            log.info("links: restored from disk (links=%d)", len(self._links))
            self._on_change()

    def apply(self, event: WatchEvent) -> None:
        """Apply one watch event of DirectLinks: store, change or remove their files."""
        match event:
            case Listed(bodies):
                names = {body["metadata"]["name"] for body in bodies}
                for removed in {*self._links, *(path.stem for path in list_files(self._directory, ".json"))} - names:
                    self._remove(removed)
                for body in bodies:
                    self._put(body)
            case Changed(body):
                self._put(body)
            case Deleted(name):
                self._remove(name)
        self._on_change()

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
            if not _contains(path, content):
                write_file(path, content)
        except OSError as error:
            log.warning("links: DirectLink not stored (link=%s error=%s)", name, error)

    def _read(self, body: Object) -> bool:
        """Parse and keep a DirectLink. Return False if it is invalid, or belongs to another node."""
        try:
            link = DirectLink.from_body(body)
        except InvalidObject as error:
            log.warning("links: invalid DirectLink (error=%s)", error)
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
            log.warning("links: DirectLink not removed from disk (link=%s error=%s)", name, error)

    def _file(self, name: str) -> Path:
        return self._directory / f"{name}.json"


def _contains(path: Path, content: bytes) -> bool:
    try:
        return read_file(path) == content
    except (FileNotFoundError, UnsuitableFile):
        return False


def virtual_endpoint(service: LinkedService) -> Endpoint | None:
    """Return the endpoint that clients of a service call.

    Return None if the address of the endpoint is not IPv4, because the agent translates IPv4 addresses only.
    """
    return _endpoint(service.virtual.address, service.virtual.port, service.virtual.protocol)


def pod_endpoint(service: LinkedService) -> Endpoint | None:
    """Return the endpoint of the pod that provides a service. Return None if no pod is ready."""
    if service.target is None:
        return None
    return _endpoint(service.target.address, service.target.port, service.virtual.protocol)


def virtual_endpoints(links: Iterable[DirectLink]) -> Iterator[Endpoint]:
    """Yield the virtual endpoints of all services of some links."""
    for link in links:
        for service in link.spec.services:
            endpoint = virtual_endpoint(service)
            if endpoint is not None:
                yield endpoint


def allowed_callers(links: Iterable[DirectLink]) -> dict[Endpoint, frozenset[IPv4Address]]:
    """Return the clients on the drone that may call a service. Services open to all clients are not included."""
    callers: dict[Endpoint, frozenset[IPv4Address]] = {}
    for service in (service for link in links for service in link.spec.services):
        endpoint = virtual_endpoint(service)
        if service.callers is None or endpoint is None:
            continue
        pods = (_endpoint(caller.address, 0, "TCP") for caller in service.callers if caller.address is not None)
        callers[endpoint] = callers.get(endpoint, frozenset()) | {pod.address for pod in pods if pod is not None}
    return callers


def isolated_pods(links: Iterable[DirectLink]) -> dict[Endpoint, frozenset[IPv4Address]]:
    """Return the pods of the edge node that accept only calls over a link, as guarded endpoints without callers."""
    pods = (pod_endpoint(s) for link in links for s in link.spec.services if s.callers is not None)
    return {pod: frozenset() for pod in pods if pod is not None}


def _endpoint(address: str, port: int, protocol: str) -> Endpoint | None:
    try:
        return Endpoint(IPv4Address(address), port, _PROTOCOLS[protocol])
    except AddressValueError:
        return None


def route_key(endpoint: Endpoint) -> str:
    """Return the name of an endpoint in messages between the ends of a link, such as 10.96.0.5:8080/TCP."""
    protocol = next(name for name, number in _PROTOCOLS.items() if number == endpoint.protocol)
    return f"{endpoint.address}:{endpoint.port}/{protocol}"
