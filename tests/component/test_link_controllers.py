"""Link controllers, heuristics, interface checks and rulesets, without devices, nftables or networks."""

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
from fractus_agent.links import drone_link_controller, edge_link_controller, link_manager
from fractus_agent.links.direct_link_store import allowed_callers, isolated_pods
from fractus_agent.links.drone_link_controller import DroneLinkController
from fractus_agent.links.edge_link_controller import EdgeLinkController
from fractus_agent.links.pairing import LinkLost, Session
from fractus_agent.links.wired import InterfaceProblem, WiredInterface
from fractus_agent.redirector import ruleset
from fractus_agent.redirector.connections import PodNamespaces
from fractus_agent.redirector.netlink import NetlinkError
from fractus_agent.redirector.nft_maps import Endpoint
from fractus_agent.redirector.redirector import Redirector
from fractus_agent.settings import DEFAULT_DRAIN_S, MAX_DRAIN_S, BadSetting, Settings
from fractus_core.api.direct_links import DirectLink, LinkedService
from fractus_core.linking import HeuristicRegistry, PathMetrics, UnknownHeuristic

PATH = PathMetrics(8.0, 8.0, 60.0, 60.0)


def link(node: str) -> DirectLink:
    return cast(DirectLink, SimpleNamespace(spec=SimpleNamespace(drone="d1", node=node, services=())))


class FakeCollaborator:
    """Fake redirector or session that accepts any call."""

    peer = "d1"

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *_, **__: None

    async def send(self, _message: Any) -> None:
        return


def drone_controller(drain_s: float = DEFAULT_DRAIN_S) -> DroneLinkController:
    return DroneLinkController(
        "d1", Path(), cast(Redirector, FakeCollaborator()), cloud=lambda: PATH, telemetry=lambda: None, report=lambda _: None,
        record=lambda *_: None, drain_s=drain_s,
    )  # fmt: skip


@pytest.mark.parametrize(("drain_s", "leave_s"), [(0.5, 2.0), (1.5, 2.0), (10.0, 10.5)])
def test_traffic_leaves_a_link_early_enough_for_the_drain(drain_s: float, leave_s: float) -> None:
    assert drone_controller(drain_s)._settings.drain_s == leave_s


def test_beacons_of_unknown_nodes_are_ignored() -> None:
    controller = drone_controller()
    controller.set_links((link("e1"),))
    for name in ("e1", "e2", "e3"):
        controller.on_beacon(name)
    assert set(controller._range_model.ranges) == {"e1"}
    controller.set_links(())
    assert not controller._range_model.ranges


def test_session_ends_after_the_direct_link_of_its_drone_is_deleted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(edge_link_controller, "REMOVAL_GRACE_S", 0.01)

    async def serve() -> None:
        controller = EdgeLinkController(
            "e1", Path(), cast(Redirector, FakeCollaborator()), lambda: None, lambda *_: None
        )
        controller.set_links((link("e1"),))
        serving = asyncio.create_task(controller._serve(cast(Session, FakeCollaborator())))
        await asyncio.sleep(0)
        controller.set_links(())
        async with asyncio.timeout(10):
            await serving

    with pytest.raises(LinkLost, match="no DirectLink names d1 any longer"):
        asyncio.run(serve())


def test_pod_isolation_is_retried_if_the_kernel_refuses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(edge_link_controller, "LISTEN_RETRY_S", 0.01)

    class RefusingRedirector(FakeCollaborator):
        def __init__(self) -> None:
            self.attempts = 0
            self.isolated = asyncio.Event()

        def set_services(self, _services: object, _callers: object) -> None:
            self.attempts += 1
            if self.attempts < 3:
                raise NetlinkError(1, "not now")
            self.isolated.set()

    async def run() -> None:
        redirector = RefusingRedirector()
        controller = EdgeLinkController("e1", Path("none"), cast(Redirector, redirector), lambda: None, lambda *_: None)
        controller.set_links((link("e1"),))
        running = asyncio.create_task(controller.run())
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


def test_both_ends_of_a_link_admit_only_the_callers_of_a_service() -> None:
    class RecordingRedirector(FakeCollaborator):
        def set_services(self, _services: object, callers: object) -> None:
            self.callers = callers

    services = [LinkedService.model_validate(SERVICE), LinkedService.model_validate({**SERVICE, "callers": []})]
    named = link("e1")
    object.__setattr__(named.spec, "services", services)
    redirector = RecordingRedirector()
    EdgeLinkController("e1", Path(), cast(Redirector, redirector), lambda: None, lambda *_: None).set_links((named,))
    assert redirector.callers == {Endpoint(IPv4Address("10.88.0.2"), 80): frozenset()}, "no caller is known yet"
    virtual = Endpoint(IPv4Address("10.96.0.5"), 8080)
    assert allowed_callers([named]) == {virtual: {IPv4Address("10.87.0.2")}}
    # If a service does not restrict its callers, neither end of the link filters them.
    object.__setattr__(named.spec, "services", [services[0].model_copy(update={"callers": None})])
    assert not allowed_callers([named])
    assert not isolated_pods([named])


def test_failure_of_the_redirect_refresh_is_raised() -> None:
    async def fails() -> None:
        raise ValueError("a defect")

    async def watch() -> None:
        await link_manager._raise_when_done(asyncio.create_task(fails()))

    with pytest.raises(ValueError, match="a defect"):
        asyncio.run(watch())


def broken(_path: PathMetrics) -> float:
    """Raise, like a user-defined heuristic with a defect."""
    raise ZeroDivisionError("a defect")


def test_failed_heuristic_is_unknown_afterwards(monkeypatch: pytest.MonkeyPatch) -> None:
    entry = EntryPoint("broken", f"{__name__}:broken", "fractus.linking")
    monkeypatch.setattr("importlib.metadata.entry_points", lambda **_: [entry])
    heuristics = HeuristicRegistry()
    assert heuristics.find("broken", None)(PATH) == 0.0
    with pytest.raises(UnknownHeuristic, match="failed: a defect"):
        heuristics.find("broken", None)
    assert heuristics.find("max", "ingress-bandwidth")(PATH) == PATH.ingress_mbps


def test_namespaces_that_cannot_be_entered_are_skipped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_thread(*_: Any) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr("fractus_agent.redirector.connections.in_namespace", no_thread)
    assert not PodNamespaces(tmp_path / "none").refresh()
    (tmp_path / "file").touch()
    assert not PodNamespaces(tmp_path / "file").refresh()


class FakeAddresses:
    """Fake of the addresses of a network device. It reports evidence that the device carries other traffic."""

    def __init__(self, evidence: str) -> None:
        self._evidence = evidence

    async def other_traffic(self) -> str:
        return self._evidence


@pytest.mark.parametrize("evidence", ["it has a default route", "it has the address 192.168.0.2", ""])
async def test_device_with_other_traffic_is_refused(evidence: str) -> None:
    interface = WiredInterface("lo", IPv4Address("169.254.1.1"))
    interface._addresses = cast(Any, FakeAddresses(evidence))
    if not evidence:
        await interface.check()
        return
    with pytest.raises(InterfaceProblem, match=evidence) as problem:
        await interface.check()
    assert problem.value.reason == "DeviceInUse"


def test_ruleset_of_edge_node_redirects_only_traffic_of_paired_nodes() -> None:
    text = ruleset.ruleset_text("wlan0", ruleset.Ports(1, 2), clients=False)
    assert "hook output" not in text
    leads = [line for line in text.splitlines() if "dnat" in line or "ct mark set" in line]
    assert len(leads) == 2
    assert all(line.strip().startswith('iifname "wlan0" ip saddr @peers ') for line in leads)
    assert "hook output" in ruleset.ruleset_text("wlan0", ruleset.Ports(1, 2), clients=True)


def test_drain_setting_must_be_a_number_in_range() -> None:
    assert Settings.from_environment({"FRACTUS_NODE": "d1", "FRACTUS_DRAIN_S": "2.5"}).drain_s == 2.5
    for bad in ("", " ", "soon", "-1", "nan", "inf", "601", "9" * 400):
        with pytest.raises(
            BadSetting, match=r"^FRACTUS_DRAIN_S is '.{0,80}': set it to a number of seconds from 0 to 600$"
        ):
            Settings.from_environment({"FRACTUS_NODE": "d1", "FRACTUS_DRAIN_S": bad})
    schema = json.loads((Path(__file__).parents[2] / "charts/fractus/values.schema.json").read_text())
    drain = schema["properties"]["directLinks"]["properties"]["drainSeconds"]
    assert (drain["type"], drain["minimum"], drain["maximum"]) == (["number", "string"], 0, MAX_DRAIN_S)


def test_session_with_a_peer_that_sends_no_routes_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drone_link_controller, "PROBE_INTERVAL_S", 0.0)

    class SilentSession(FakeCollaborator):
        latency_ms = 1.0

        async def probe(self) -> float:
            return 10.0

    with pytest.raises(LinkLost, match="has sent no routes"):
        asyncio.run(drone_controller()._run_session(cast(Session, SilentSession())))


def test_session_with_a_peer_that_returns_no_heartbeats_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drone_link_controller, "ACKNOWLEDGEMENT_TIMEOUT_S", 0.05)

    class DeafSession(FakeCollaborator):
        latency_ms = None

    with pytest.raises(LinkLost, match="returns no heartbeats"):
        asyncio.run(drone_controller()._run_session(cast(Session, DeafSession())))


@pytest.mark.parametrize(("mbps", "probes"), [(16.0, {2, 3}), (8.5, {2, 3}), (2.0, {5, 6})])
def test_link_is_probed_only_if_its_traffic_leaves_capacity(
    mbps: float, probes: set[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(drone_link_controller, "PROBE_INTERVAL_S", 0.1)
    service = Endpoint(IPv4Address("10.96.0.5"), 8080)

    class CountingRedirector(FakeCollaborator):
        reads = 0
        enough = asyncio.Event()

        def byte_counts(self) -> dict[Endpoint, tuple[int, int]]:
            self.reads += 1
            if self.reads == 5:
                self.enough.set()
            return {service: (round(time.monotonic() * mbps * 125_000), 0)}

    class ProbedSession(FakeCollaborator):
        latency_ms = 1.0
        probed = 0

        async def probe(self) -> float:
            self.probed += 1
            return 10.0

    async def use() -> float:
        redirector = CountingRedirector()
        session = ProbedSession()
        controller = DroneLinkController(
            "d1", Path(), cast(Redirector, redirector), cloud=lambda: PATH, telemetry=lambda: None,
            report=lambda _: None, record=lambda *_: None,
        )  # fmt: skip
        using = asyncio.create_task(controller._run_session(cast(Session, session)))
        await asyncio.sleep(0)
        session.on_message({"routes": {}})
        async with asyncio.timeout(30):
            await redirector.enough.wait()
        measured = controller._direct
        using.cancel()
        await asyncio.gather(using, return_exceptions=True)
        # A traffic rate needs two counter readings. Until then, the rate can only be measured by probes.
        assert session.probed in probes
        assert measured is not None
        return measured.ingress_mbps

    assert asyncio.run(use()) == pytest.approx(max(mbps, 10.0), rel=0.1)
