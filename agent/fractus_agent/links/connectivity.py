"""Direct links of a node as a whole: its interface, its table, its end of the links, while DirectLinks name the node."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from datetime import datetime
from pathlib import Path

from fractus_core.api.nodes import Drone, Interface, direct_interface
from fractus_core.linking import Seen
from fractus_runtime.figures import Figure

from fractus_agent.cluster.store import End, Store
from fractus_agent.links import beacons, pairing
from fractus_agent.links.addressing import link_address
from fractus_agent.links.beacons import Beacons
from fractus_agent.links.drone import DroneEnd
from fractus_agent.links.evidence import Record
from fractus_agent.links.interfaces.controller import Controller, InterfaceProblem
from fractus_agent.links.interfaces.simulated import Plain
from fractus_agent.links.interfaces.wifi import Wifi
from fractus_agent.links.metrics import LinkMetrics
from fractus_agent.links.peer import PeerEnd
from fractus_agent.links.plans import LinkPlans, callers, isolated
from fractus_agent.links.reports import DroneReport, LinkReports, peer_condition
from fractus_agent.links.uplink import Node, Uplink
from fractus_agent.redirector import leftovers, nft, tables
from fractus_agent.redirector.conntrack import Conntrack
from fractus_agent.redirector.netlink import NETLINK_NETFILTER, Netlink, NetlinkError
from fractus_agent.redirector.redirector import DRAIN_S, Namespaces, Redirector

log = logging.getLogger(__name__)

PODS = Path("/run/netns")
"""Where the container runtime keeps the network namespaces of pods."""
SUPPLICANT = Path("/run/wpa_supplicant")
"""Where wpa_supplicant has its control sockets."""
DEVICES = Path("/sys/class/net")
LOG = "links.jsonl"
"""Name of the audit log of direct links."""
CHECK_S = 2.0
"""Seconds between looks at the interface: a device may go, and come back without its address."""
RETRY_S = 5.0


class Connectivity:
    """Runs this node's end of its direct links.

    Args:
        store: the API server.
        node: name of this node.
        directory: where its DirectLinks are stored.
        tls: its certificate, key and authority.
        resource: its Drone or EdgeNode as it is now; None while that is not known.
        seen: what telemetry says of the drone now.
        wall: the wall clock.
        changed: called when links begin or cease to be planned.
        audit: directory of the node's audit logs.
        pods: directory of the pods' network namespaces.
        drain_s: how long connections may finish what they do on a path that their service leaves while it works.
    """

    def __init__(
        self,
        store: Store,
        node: str,
        directory: Path,
        tls: Path,
        *,
        resource: Callable[[], Node | None],
        seen: Callable[[], Seen | None],
        wall: Callable[[], datetime],
        audit: Path,
        changed: Callable[[], None] = lambda: None,
        pods: Path = PODS,
        drain_s: float = DRAIN_S,
    ) -> None:
        self._drain_s = drain_s
        self._store = store
        self._node = node
        self._tls = tls
        self._audit = audit / LOG
        self._resource = resource
        self._seen = seen
        self._told = changed
        self._pods = pods
        self._end: End = "drone" if isinstance(resource(), Drone) else "node"
        self._plans = LinkPlans(store, directory, node, self._end, self._planned)
        self._reports = LinkReports(store, self._end, wall)
        self._metrics = LinkMetrics()
        self._changed = asyncio.Event()
        self._problem: tuple[str, str] | None = None
        self._peer: PeerEnd | None = None
        self._drone: DroneEnd | None = None

    @property
    def active(self) -> bool:
        """Whether links are planned for this node."""
        return bool(self._plans.links)

    def figures(self) -> Iterator[Figure]:
        """What Prometheus is told of the drone's links; nothing on the other end."""
        return self._metrics.collect() if self._end == "drone" else iter(())

    async def run(self) -> None:
        """Run until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._plans.follow())
            tasks.create_task(self._reports.run())
            tasks.create_task(self._hold())

    def _planned(self) -> None:
        if self._drone is not None and self._plans.links:  # without any, it is ended as a whole
            self._drone.plan(self._plans.links)
        if self._peer is not None:
            self._peer.plan(self._plans.links)
        self._say()
        self._changed.set()
        self._told()

    def _say(self) -> None:
        """Report what does not come from decisions: of the end that is asked, and while the interface cannot be used."""
        if self._end == "node":
            drones = self._peer.drones if self._peer is not None else frozenset()
            self._reports.conditions(self._plans.links, lambda link: peer_condition(link, self._problem, drones))
        elif self._problem is not None:
            self._reports.unusable(self._plans.links, *self._problem)

    async def _hold(self) -> None:
        """Hold the interface while it is there to be used and links are planned."""
        clean = False
        while True:
            self._changed.clear()
            interface = self._interface()
            if interface is None or not self._plans.links:
                clean = clean or await _clean(interface, self._node)
                with suppress(TimeoutError):
                    await asyncio.wait_for(self._changed.wait(), RETRY_S)
                continue
            using = asyncio.create_task(self._use(interface))
            try:
                while not using.done() and self._needed() and self._interface() == interface:
                    self._changed.clear()
                    changed = asyncio.create_task(self._changed.wait())
                    await asyncio.wait({using, changed}, timeout=CHECK_S, return_when=asyncio.FIRST_COMPLETED)
                    changed.cancel()
            finally:
                using.cancel()
                await asyncio.gather(using, return_exceptions=True)
            if not using.cancelled() and (error := using.exception()) is not None:
                self._set_problem("Failed", f"direct links failed, and are tried again: {_first(error)}")
                await asyncio.sleep(RETRY_S)

    def _needed(self) -> bool:
        """Whether links are planned, or a drone whose link was has not led its calls back yet."""
        return bool(self._plans.links or (self._peer is not None and self._peer.drones))

    def _interface(self) -> Interface | None:
        node = self._resource()
        return direct_interface(node.spec.interfaces) if node is not None else None

    async def _use(self, interface: Interface) -> None:
        """What an interface is used for, with an audit log of it.

        Raises:
            OSError: the directory of audit logs cannot be made.
        """
        # Imported here: its signatures need the cryptography, a fifth of the memory, which nodes without links do not need.
        from fractus_runtime.audit import AuditLog  # noqa: PLC0415

        audit = AuditLog(self._audit, time.time, tls=self._tls)
        try:
            await self._serve(interface, audit.append)
        finally:
            await audit.close()

    async def _serve(self, interface: Interface, record: Record) -> None:
        """Everything that one interface takes, made new at the beginning and removed in the end."""
        assert interface.device is not None
        ports = tables.Ports(udp=beacons.PORT, tcp=pairing.PORT)
        drone = self._end == "drone"
        controller = _controller(interface, self._node)
        # Closed before it gets an address. One that cannot be used is left alone; instances are isolated without it.
        device = interface.device if self._usable(controller) else tables.NO_DEVICE

        def make_table(guards: nft.Callers) -> None:
            tables.create(device, ports, clients=drone, callers=guards)

        # With what an agent before this one guarded: its table is replaced.
        guards = (callers if drone else isolated)(self._plans.links)
        make_table(guards)
        netlink = Netlink(NETLINK_NETFILTER)
        conntrack = Conntrack(netlink)
        # What an agent before this one led anywhere, that knows where it is to be no more.
        conntrack.forget_all()
        maps = nft.Maps(netlink, make_table, guards)
        redirector = Redirector(maps, conntrack, Namespaces(self._pods if drone else None), drain_s=self._drain_s)

        async def keep_up() -> None:
            nonlocal controller, device
            while device == tables.NO_DEVICE:
                await asyncio.sleep(CHECK_S)
                # Only where it is there can be told whether it is a radio.
                controller = _controller(interface, self._node)
                if self._usable(controller):
                    device = controller.device
                    maps.remake()
            await self._keep_up(controller)

        # Outside of the group: redirects are kept alive while the end leads the traffic back.
        keeping = asyncio.create_task(redirector.run())
        try:
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(_outlived(keeping))
                tasks.create_task(keep_up())
                tasks.create_task(self._run_end(redirector, interface.device, record))
        finally:
            keeping.cancel()
            await asyncio.gather(keeping, return_exceptions=True)
            redirector.close()
            try:
                # Before the table goes: what is up without it is open to every radio in reach.
                if device != tables.NO_DEVICE:
                    await controller.down()
            except InterfaceProblem as problem:
                log.warning("links: the packet filter stays: %s", problem)
            else:
                with suppress(nft.RedirectFailed):
                    tables.remove()
            finally:
                # After the table, which would mark new connections.
                with suppress(NetlinkError):
                    conntrack.forget_all()
                netlink.close()

    async def _run_end(self, redirector: Redirector, device: str, record: Record) -> None:
        uplink = Uplink(self._resource, self._store.answers)
        if self._end == "drone":
            drone = self._drone = DroneEnd(
                self._node,
                self._tls,
                redirector,
                cloud=uplink.offers,
                seen=self._seen,
                report=self._report,
                record=record,
            )
            drone.plan(self._plans.links)
            told, run = Beacons(self._node, drone.heard), drone.run
        else:
            peer = self._peer = PeerEnd(self._node, self._tls, redirector, self._say, record)
            peer.plan(self._plans.links)
            told, run = Beacons(self._node, lambda _: None), peer.run
        try:
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(told.run(device))
                tasks.create_task(run())
                if self._drone is not None:
                    tasks.create_task(uplink.run())
        finally:
            self._drone = self._peer = None
            self._say()

    def _report(self, report: DroneReport) -> None:
        self._metrics.take(report)
        if self._problem is None:
            self._reports.drone(report)

    def _usable(self, controller: Controller) -> bool:
        """Whether the device is there, and for direct links alone."""
        try:
            controller.check()
        except InterfaceProblem as problem:
            self._set_problem(problem.reason, str(problem))
            return False
        return True

    async def _keep_up(self, controller: Controller) -> None:
        """Have the interface up, whatever becomes of its device."""
        while True:
            try:
                await controller.up()
            except InterfaceProblem as problem:
                self._set_problem(problem.reason, str(problem))
            else:
                self._set_problem("", "")
            await asyncio.sleep(CHECK_S)

    def _set_problem(self, reason: str, message: str) -> None:
        found = (reason, message) if reason else None
        if found != self._problem:
            log.log(logging.WARNING if found else logging.INFO, "links: %s", message or "the interface is up")
            self._problem = found
            self._say()


def _controller(interface: Interface, node: str) -> Controller:
    """What controls an interface of a node: a radio has to join a network first."""
    device, pairing = interface.device, interface.pairing
    assert device is not None
    assert pairing is not None
    if (DEVICES / device / "phy80211").exists():
        return Wifi(device, link_address(node), pairing, SUPPLICANT)
    return Plain(device, link_address(node))


async def _clean(interface: Interface | None, node: str) -> bool:
    """Remove what an agent that was killed while its links ended has left; whether that is done."""
    try:
        if leftovers.table_is_left():
            if interface is not None:
                await _controller(interface, node).down()
            leftovers.remove()
            log.info("links: removed what an earlier agent left")
    except (InterfaceProblem, NetlinkError, nft.RedirectFailed) as error:
        log.warning("links: what an earlier agent left stays, trying again (error=%s)", error)
        return False
    return True


async def _outlived(keeping: asyncio.Task[None]) -> None:
    """Fail when the redirects are kept alive no more; unlike an await of the task itself, this ends without ending it."""
    await asyncio.wait({keeping})
    keeping.result()


def _first(error: BaseException) -> BaseException:
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    return error
