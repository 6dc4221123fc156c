"""Link manager: runs the direct interface, its nftables table and this node's link controller while links are planned."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from datetime import datetime
from pathlib import Path

from fractus_core.api.nodes import Drone, Interface, direct_interface
from fractus_core.linking import TelemetrySample
from fractus_runtime.audit import AuditLog
from prometheus_client import Metric

from fractus_agent.links import beacons, pairing
from fractus_agent.links.audit_records import AuditRecorder
from fractus_agent.links.beacons import Beacons
from fractus_agent.links.cloud_path import CloudPath, Node
from fractus_agent.links.device_addresses import link_address
from fractus_agent.links.direct_link_store import DirectLinkStore, allowed_callers, isolated_pods
from fractus_agent.links.drone_link_controller import DroneLinkController
from fractus_agent.links.edge_link_controller import EdgeLinkController
from fractus_agent.links.link_metrics import LinkMetrics
from fractus_agent.links.link_status import DroneLinkReport, LinkStatusReporter, edge_condition
from fractus_agent.links.wifi import WifiInterface
from fractus_agent.links.wired import InterfaceController, InterfaceProblem, WiredInterface
from fractus_agent.redirector import cleanup, ruleset
from fractus_agent.redirector.connections import Conntrack, PodNamespaces
from fractus_agent.redirector.netlink import NETLINK_NETFILTER, Netlink, NetlinkError
from fractus_agent.redirector.nft_maps import Callers, NftMaps, RedirectFailed
from fractus_agent.redirector.redirector import Redirector
from fractus_agent.settings import DEFAULT_DRAIN_S
from fractus_agent.store import LinkEnd, Store

log = logging.getLogger(__name__)

PODS = Path("/run/netns")
"""Directory in which the container runtime keeps the network namespaces of pods."""
SUPPLICANT = Path("/run/wpa_supplicant")
"""Directory of wpa_supplicant's control sockets."""
DEVICES = Path("/sys/class/net")
AUDIT_LOG = "links.jsonl"
"""File name of the audit log of direct links."""
INTERFACE_CHECK_INTERVAL_S = 2.0
"""Seconds between checks of the interface, because its device may disappear and come back without its address."""
_RETRY_S = 5.0


class LinkManager:
    """Runs this node's end of its direct links.

    Args:
        store: The node's objects at the API server.
        node: Name of this node.
        directory: Directory of the stored DirectLinks.
        tls: Directory of the node's certificate, key and authority.
        resource: Returns the current Drone or EdgeNode, None if unknown.
        telemetry: Returns the latest telemetry of the drone, None if unavailable.
        wall: Returns the wall clock time.
        audit: Directory of the node's audit logs.
        on_change: Called when links become planned, or are no longer planned.
        pods: Directory of the pods' network namespaces.
        drain_s: Time for which connections may stay on a working path that their service has left, in seconds.
    """

    def __init__(
        self,
        store: Store,
        node: str,
        directory: Path,
        tls: Path,
        *,
        resource: Callable[[], Node | None],
        telemetry: Callable[[], TelemetrySample | None],
        wall: Callable[[], datetime],
        audit: Path,
        on_change: Callable[[], None] = lambda: None,
        pods: Path = PODS,
        drain_s: float = DEFAULT_DRAIN_S,
    ) -> None:
        self._drain_s = drain_s
        self._store = store
        self._node = node
        self._tls = tls
        self._audit = audit / AUDIT_LOG
        self._resource = resource
        self._telemetry = telemetry
        self._on_change = on_change
        self._pods = pods
        self._end: LinkEnd = "drone" if isinstance(resource(), Drone) else "node"
        self._direct_links = DirectLinkStore(store, directory, node, self._end, self._on_links_changed)
        self._status = LinkStatusReporter(store, self._end, wall)
        self._metrics = LinkMetrics()
        self._changed = asyncio.Event()
        self._problem: tuple[str, str] | None = None
        self._edge_controller: EdgeLinkController | None = None
        self._drone_controller: DroneLinkController | None = None

    @property
    def active(self) -> bool:
        """True if links are planned for this node."""
        return bool(self._direct_links.links)

    def metrics(self) -> Iterator[Metric]:
        """Return the Prometheus metrics of the drone's links. An edge node has none."""
        return self._metrics.collect() if self._end == "drone" else iter(())

    async def run(self) -> None:
        """Run until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._direct_links.follow())
            tasks.create_task(self._status.run())
            tasks.create_task(self._manage_interface())

    def _on_links_changed(self) -> None:
        links = self._direct_links.links
        if self._drone_controller is not None and links:  # without links, this manager ends the controller
            self._drone_controller.set_links(links)
        if self._edge_controller is not None:
            self._edge_controller.set_links(links)
        self._report_interface()
        self._changed.set()
        self._on_change()

    def _report_interface(self) -> None:
        """Set the conditions of the DirectLinks that no link controller sets.

        These are all conditions of an edge node, and the conditions of a drone whose interface is not usable.
        """
        links = self._direct_links.links
        if self._end == "node":
            drones = self._edge_controller.drones if self._edge_controller is not None else frozenset()
            self._status.set_conditions(links, lambda link: edge_condition(link, self._problem, drones))
        elif self._problem is not None:
            self._status.set_unusable(links, *self._problem)

    async def _manage_interface(self) -> None:
        """Use the interface while it exists and links are planned."""
        clean = False
        while True:
            self._changed.clear()
            interface = self._interface()
            if interface is None or not self._direct_links.links:
                clean = clean or await _clean_up(interface, self._node)
                with suppress(TimeoutError):
                    await asyncio.wait_for(self._changed.wait(), _RETRY_S)
                continue
            using = asyncio.create_task(self._use(interface))
            try:
                while not using.done() and self._is_needed() and self._interface() == interface:
                    self._changed.clear()
                    changed = asyncio.create_task(self._changed.wait())
                    await asyncio.wait(
                        {using, changed}, timeout=INTERFACE_CHECK_INTERVAL_S, return_when=asyncio.FIRST_COMPLETED
                    )
                    changed.cancel()
            finally:
                using.cancel()
                await asyncio.gather(using, return_exceptions=True)
            if not using.cancelled() and (error := using.exception()) is not None:
                self._set_problem("Failed", f"direct links failed, retrying: {_first_error(error)}")
                await asyncio.sleep(_RETRY_S)

    def _is_needed(self) -> bool:
        """Return True if links are planned, or if a linked drone has not moved its traffic back yet."""
        return self.active or (self._edge_controller is not None and bool(self._edge_controller.drones))

    def _interface(self) -> Interface | None:
        node = self._resource()
        return direct_interface(node.spec.interfaces) if node is not None else None

    async def _use(self, interface: Interface) -> None:
        """Use an interface until cancelled, and write an audit log of the link decisions.

        Raises:
            OSError: The directory of audit logs cannot be created.
        """
        audit = AuditLog(self._audit, time.time, tls=self._tls)
        try:
            await self._run_interface(interface, audit.append)
        finally:
            await audit.close()

    async def _run_interface(self, interface: Interface, record: AuditRecorder) -> None:
        """Create the table, bring the interface up and run the link controller. Remove everything at the end."""
        assert interface.device is not None
        ports = ruleset.Ports(udp=beacons.BEACON_PORT, tcp=pairing.PAIRING_PORT)
        is_drone = self._end == "drone"
        controller = _interface_controller(interface, self._node)
        # Create the packet filter before the device gets an address, so that the device never accepts unfiltered
        # traffic. If the device is not usable, the table does not filter it. The table is still needed, because it
        # isolates the pods.
        device = interface.device if await self._check_usable(controller) else ruleset.NO_DEVICE

        def make_table(callers: Callers) -> None:
            ruleset.create(device, ports, clients=is_drone, callers=callers)

        # The new table replaces the table of an earlier agent. The new table contains the guarded endpoints from its
        # creation on.
        guarded_endpoints = allowed_callers if is_drone else isolated_pods
        guards = guarded_endpoints(self._direct_links.links)
        make_table(guards)
        netlink = Netlink(NETLINK_NETFILTER)
        conntrack = Conntrack(netlink)
        # Delete connections that an earlier agent redirected, because their targets are unknown.
        conntrack.delete_all()
        maps = NftMaps(netlink, make_table, guards)
        namespaces = PodNamespaces(self._pods if is_drone else None)
        redirector = Redirector(maps, conntrack, namespaces, drain_s=self._drain_s)

        async def keep_interface_up() -> None:
            nonlocal controller, device
            while device == ruleset.NO_DEVICE:
                await asyncio.sleep(INTERFACE_CHECK_INTERVAL_S)
                # The kind of the interface is known only when the device exists.
                controller = _interface_controller(interface, self._node)
                if await self._check_usable(controller):
                    device = controller.device
                    maps.recreate_table()
            await self._keep_up(controller)

        # This task is not part of the group, because redirects must stay alive while the controller moves traffic back.
        refreshing = asyncio.create_task(redirector.run())
        try:
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(_raise_when_done(refreshing))
                tasks.create_task(keep_interface_up())
                tasks.create_task(self._run_controller(redirector, interface.device, record))
        finally:
            refreshing.cancel()
            await asyncio.gather(refreshing, return_exceptions=True)
            redirector.close()
            try:
                # The interface goes down before the table is removed, because without the table every radio in range
                # could use it.
                if device != ruleset.NO_DEVICE:
                    await controller.down()
            except InterfaceProblem as problem:
                log.warning("links: packet filter not removed, interface still up (error=%s)", problem)
            else:
                with suppress(RedirectFailed):
                    ruleset.remove()
            finally:
                # Delete the connection tracking entries after the table, because the table would mark new connections.
                with suppress(NetlinkError):
                    conntrack.delete_all()
                netlink.close()

    async def _run_controller(self, redirector: Redirector, device: str, record: AuditRecorder) -> None:
        cloud_path = CloudPath(self._resource, self._store.is_reachable)
        try:
            async with asyncio.TaskGroup() as tasks:
                if self._end == "drone":
                    drone = DroneLinkController(
                        self._node,
                        self._tls,
                        redirector,
                        cloud=cloud_path.metrics,
                        telemetry=self._telemetry,
                        report=self._on_drone_report,
                        record=record,
                        drain_s=self._drain_s,
                    )
                    self._drone_controller = drone
                    drone.set_links(self._direct_links.links)
                    tasks.create_task(Beacons(self._node, drone.on_beacon).run(device))
                    tasks.create_task(drone.run())
                    tasks.create_task(cloud_path.run())
                else:
                    edge = EdgeLinkController(self._node, self._tls, redirector, self._report_interface, record)
                    self._edge_controller = edge
                    edge.set_links(self._direct_links.links)
                    tasks.create_task(Beacons(self._node, lambda _: None).run(device))
                    tasks.create_task(edge.run())
        finally:
            self._drone_controller = None
            self._edge_controller = None
            self._report_interface()

    def _on_drone_report(self, report: DroneLinkReport) -> None:
        self._metrics.update(report)
        if self._problem is None:
            self._status.set_drone_report(report)

    async def _check_usable(self, controller: InterfaceController) -> bool:
        """Return True if the device exists and is reserved for direct links."""
        try:
            await controller.check()
        except InterfaceProblem as problem:
            self._set_problem(problem.reason, str(problem))
            return False
        return True

    async def _keep_up(self, controller: InterfaceController) -> None:
        """Keep the interface up. Its device may disappear and come back."""
        while True:
            try:
                await controller.up()
            except InterfaceProblem as problem:
                self._set_problem(problem.reason, str(problem))
            else:
                self._set_problem("", "")
            await asyncio.sleep(INTERFACE_CHECK_INTERVAL_S)

    def _set_problem(self, reason: str, message: str) -> None:
        problem = (reason, message) if reason else None
        if problem == self._problem:
            return
        if problem is None:
            log.info("links: interface up")
        else:
            log.warning("links: interface not usable (reason=%s error=%s)", reason, message)
        self._problem = problem
        self._report_interface()


def _interface_controller(interface: Interface, node: str) -> InterfaceController:
    """Return the controller of a node's interface. A radio must join a network, a wired device need not."""
    assert interface.device is not None
    assert interface.pairing is not None
    if (DEVICES / interface.device / "phy80211").exists():
        return WifiInterface(interface.device, link_address(node), interface.pairing, SUPPLICANT)
    return WiredInterface(interface.device, link_address(node))


async def _clean_up(interface: Interface | None, node: str) -> bool:
    """Remove kernel state of an earlier agent that was killed. Return True if done."""
    try:
        if cleanup.table_exists():
            if interface is not None:
                await _interface_controller(interface, node).down()
            cleanup.remove_all()
            log.info("links: removed table and connections of an earlier agent")
    except (InterfaceProblem, NetlinkError, RedirectFailed) as error:
        log.warning("links: table of an earlier agent not removed, retrying (error=%s)", error)
        return False
    return True


async def _raise_when_done(task: asyncio.Task[None]) -> None:
    """Wait until a task has ended, and raise its error if it failed.

    If this wait is cancelled, the task continues. `await task` would cancel the task.
    """
    await asyncio.wait({task})
    task.result()


def _first_error(error: BaseException) -> BaseException:
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    return error
