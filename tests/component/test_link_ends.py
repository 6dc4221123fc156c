"""The ends of direct links without a device, a table or a network."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Callable
from importlib.metadata import EntryPoint
from ipaddress import IPv4Address
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from fractus_agent.links import connectivity, drone, peer
from fractus_agent.links.drone import DroneEnd
from fractus_agent.links.heuristics import Heuristics
from fractus_agent.links.interfaces import addresses
from fractus_agent.links.interfaces.controller import InterfaceProblem
from fractus_agent.links.interfaces.simulated import Plain
from fractus_agent.links.pairing import LinkLost, Session
from fractus_agent.links.peer import PeerEnd
from fractus_agent.links.plans import callers, isolated
from fractus_agent.redirector import tables
from fractus_agent.redirector.netlink import NetlinkError
from fractus_agent.redirector.nft import Endpoint
from fractus_agent.redirector.redirector import Namespaces, Redirector
from fractus_agent.settings import MAX_DRAIN_S, BadSetting, Settings
from fractus_core.api.direct_links import DirectLink, LinkedService
from fractus_core.linking import PathMetrics, UnknownHeuristic

PATH = PathMetrics(8.0, 8.0, 60.0, 60.0)


def link(node: str) -> DirectLink:
    return cast(DirectLink, SimpleNamespace(spec=SimpleNamespace(drone="d1", node=node, services=())))


class Calls:
    """Takes any call, in place of a redirector or a session."""

    peer = "d1"

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *_, **__: None

    async def send(self, _message: Any) -> None:
        return


def drone_end() -> DroneEnd:
    return DroneEnd(
        "d1", Path(), cast(Redirector, Calls()), cloud=lambda: PATH, seen=lambda: None, report=lambda _: None,
        record=lambda *_: None,
    )  # fmt: skip


def test_beacons_with_invented_names_are_not_kept() -> None:
    drone = drone_end()
    drone.plan((link("e1"),))
    for name in ("e1", "e2", "e3"):
        drone.heard(name)
    assert set(drone._lessons.reaches) == {"e1"}
    drone.plan(())
    assert not drone._lessons.reaches


def test_the_session_of_a_drone_that_no_link_names_any_more_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peer, "PARTING_S", 0.01)

    async def serve() -> None:
        end = PeerEnd("e1", Path(), cast(Redirector, Calls()), lambda: None, lambda *_: None)
        end.plan((link("e1"),))
        serving = asyncio.create_task(end._serve(cast(Session, Calls())))
        await asyncio.sleep(0)
        end.plan(())
        async with asyncio.timeout(10):
            await serving

    with pytest.raises(LinkLost, match="no DirectLink names d1 any more"):
        asyncio.run(serve())


def test_pods_are_isolated_though_the_kernel_refuses_at_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peer, "LISTEN_RETRY_S", 0.01)

    class Refusing(Calls):
        def __init__(self) -> None:
            self.asked, self.isolated = 0, asyncio.Event()

        def serve(self, _services: object, _callers: object) -> None:
            self.asked += 1
            if self.asked < 3:
                raise NetlinkError(1, "not now")
            self.isolated.set()

    async def run() -> None:
        redirector = Refusing()
        end = PeerEnd("e1", Path("none"), cast(Redirector, redirector), lambda: None, lambda *_: None)
        end.plan((link("e1"),))
        running = asyncio.create_task(end.run())
        async with asyncio.timeout(10):
            await redirector.isolated.wait()
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)

    asyncio.run(run())


SERVICE = {
    "component": "Server", "instance": "server-e1", "virtual": {"address": "10.96.0.5", "port": 8080},
    "target": {"address": "10.88.0.2", "port": 80},
    "callers": [{"instance": "client", "address": "10.87.0.2"}, {"instance": "starting"}],
}  # fmt: skip


def test_each_end_is_told_whom_a_service_serves() -> None:
    class Guards(Calls):
        def serve(self, _services: object, callers: object) -> None:
            self.callers = callers

    services = [LinkedService.model_validate(SERVICE), LinkedService.model_validate({**SERVICE, "callers": []})]
    named = link("e1")
    object.__setattr__(named.spec, "services", services)
    asked = Guards()
    PeerEnd("e1", Path(), cast(Redirector, asked), lambda: None, lambda *_: None).plan((named,))
    assert asked.callers == {Endpoint(IPv4Address("10.88.0.2"), 80): frozenset()}, "before any drone has linked"
    virtual = Endpoint(IPv4Address("10.96.0.5"), 8080)
    assert callers([named]) == {virtual: {IPv4Address("10.87.0.2")}}
    # One that names no caller is open at both ends.
    object.__setattr__(named.spec, "services", [services[0].model_copy(update={"callers": None})])
    assert not callers([named])
    assert not isolated([named])


def test_redirects_that_are_kept_alive_no_more_are_a_failure() -> None:
    async def fails() -> None:
        raise ValueError("a defect")

    async def watch() -> None:
        await connectivity._outlived(asyncio.create_task(fails()))

    with pytest.raises(ValueError, match="a defect"):
        asyncio.run(watch())


def broken(_path: PathMetrics) -> float:
    """A user's heuristic with a defect."""
    raise ZeroDivisionError("a defect")


def test_a_heuristic_that_fails_is_unknown_from_then_on(monkeypatch: pytest.MonkeyPatch) -> None:
    entry = EntryPoint("broken", f"{__name__}:broken", "fractus.linking")
    monkeypatch.setattr("importlib.metadata.entry_points", lambda **_: [entry])
    heuristics = Heuristics()
    assert heuristics.find("broken", None)(PATH) == 0.0
    with pytest.raises(UnknownHeuristic, match="fails: a defect"):
        heuristics.find("broken", None)
    assert heuristics.find("max", "ingress-bandwidth")(PATH) == PATH.ingress_mbps


def test_namespaces_that_cannot_be_looked_at_are_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_thread(*_: Any) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr("fractus_agent.redirector.redirector.in_namespace", no_thread)
    assert not Namespaces(tmp_path / "none").refresh()
    (tmp_path / "file").touch()
    assert not Namespaces(tmp_path / "file").refresh()


ROUTES = """Iface	Destination	Gateway 	Flags	RefCnt	Use	Metric	Mask		MTU	Window	IRTT
lo	00000000	0202000A	0003	0	0	0	{mask}	0	0	0
eth0	0002000A	00000000	0001	0	0	0	00FFFFFF	0	0	0
"""


@pytest.mark.parametrize(("there", "mask", "refused"), [
    ([], "00000000", "a default route"), (["169.254.1.1", "192.168.0.2"], "00FFFFFF", "192.168.0.2"),
    (["169.254.1.1"], "00FFFFFF", ""),
])  # fmt: skip
def test_a_device_with_other_traffic_is_refused(
    there: list[str], mask: str, refused: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "route").write_text(ROUTES.format(mask=mask))
    monkeypatch.setattr(addresses, "ROUTES", tmp_path / "route")
    monkeypatch.setattr(addresses, "_all", lambda *_: iter(IPv4Address(each) for each in there))
    plain = Plain("lo", IPv4Address("169.254.1.1"))
    if not refused:
        plain.check()
        return
    with pytest.raises(InterfaceProblem, match=refused) as problem:
        plain.check()
    assert problem.value.reason == "DeviceInUse"


def test_a_node_without_clients_leads_only_what_paired_nodes_send() -> None:
    text = tables.table("wlan0", tables.Ports(1, 2), clients=False)
    assert "hook output" not in text
    leads = [line for line in text.splitlines() if "dnat" in line or "ct mark set" in line]
    assert len(leads) == 2
    assert all(line.strip().startswith('iifname "wlan0" ip saddr @peers ') for line in leads)
    assert "hook output" in tables.table("wlan0", tables.Ports(1, 2), clients=True)


def test_the_time_of_a_drain_is_a_number() -> None:
    assert Settings.from_environment({"FRACTUS_NODE": "d1", "FRACTUS_DRAIN_S": "2.5"}).drain_s == 2.5
    for bad in ("", " ", "soon", "-1", "nan", "inf", "601", "9" * 400):
        with pytest.raises(
            BadSetting, match=r"^FRACTUS_DRAIN_S is '.{0,80}': give it a number of seconds from 0 to 600$"
        ):
            Settings.from_environment({"FRACTUS_NODE": "d1", "FRACTUS_DRAIN_S": bad})
    schema = json.loads((Path(__file__).parents[2] / "charts/fractus/values.schema.json").read_text())
    drain = schema["properties"]["directLinks"]["properties"]["drainSeconds"]
    assert (drain["type"], drain["minimum"], drain["maximum"]) == ("number", 0, MAX_DRAIN_S)


def test_a_peer_that_serves_nothing_and_says_nothing_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drone, "PROBE_S", 0.0)

    class Quiet(Calls):
        latency_ms = 1.0

        async def probe(self) -> float:
            return 10.0

    with pytest.raises(LinkLost, match="has not said where it takes calls"):
        asyncio.run(drone_end()._use(cast(Session, Quiet())))


@pytest.mark.parametrize(("mbps", "probes"), [(16.0, {2, 3}), (8.5, {2, 3}), (2.0, {5, 6})])
def test_a_link_is_probed_only_while_its_traffic_leaves_room(
    mbps: float, probes: set[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(drone, "PROBE_S", 0.1)
    service = Endpoint(IPv4Address("10.96.0.5"), 8080)

    class Counting(Calls):
        looks, enough = 0, asyncio.Event()

        def counted(self) -> dict[Endpoint, tuple[int, int]]:
            self.looks += 1
            if self.looks == 5:
                self.enough.set()
            return {service: (round(time.monotonic() * mbps * 125_000), 0)}

    class Probed(Calls):
        latency_ms, probed = 1.0, 0

        async def probe(self) -> float:
            self.probed += 1
            return 10.0

    async def use() -> float:
        redirector, session = Counting(), Probed()
        end = DroneEnd(
            "d1", Path(), cast(Redirector, redirector), cloud=lambda: PATH, seen=lambda: None,
            report=lambda _: None, record=lambda *_: None,
        )  # fmt: skip
        using = asyncio.create_task(end._use(cast(Session, session)))
        await asyncio.sleep(0)
        session.told({"routes": {}})
        async with asyncio.timeout(30):
            await redirector.enough.wait()
        measured = end._direct
        using.cancel()
        await asyncio.gather(using, return_exceptions=True)
        # The first rate comes with the second look: what was measured before that was probed.
        assert session.probed in probes
        assert measured is not None
        return measured.ingress_mbps

    assert asyncio.run(use()) == pytest.approx(max(mbps, 10.0), rel=0.1)
