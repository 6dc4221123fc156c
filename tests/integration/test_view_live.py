"""Live view of a real API server in Chromium, also while the API server is unreachable."""

from __future__ import annotations

import contextlib
import re
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from axe_playwright_python.sync_playwright import Axe
from browser import CHROMIUM, SOFTWARE_GL, TIMEOUT_MS, launched, opened, serving
from control_plane import ControlPlane
from operator_world import FRACTUS, World, at, fractus_object, traffic
from playwright.sync_api import expect, sync_playwright

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        CHROMIUM is None, reason="Chromium is not installed; `make packages` installs it on machines with apt-get"
    ),
]


class TcpProxy:
    """TCP proxy to a local port. Tests can interrupt the proxy and open it again."""

    def __init__(self, port: int) -> None:
        self._target_port = port
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self.open = True
        self._pairs: list[tuple[socket.socket, socket.socket]] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                near, _ = self._listener.accept()
                if not self.open:
                    near.close()
                    continue
                far = socket.create_connection(("127.0.0.1", self._target_port))
                self._pairs.append((near, far))
                for a, b in ((near, far), (far, near)):
                    threading.Thread(target=_forward, args=(a, b), daemon=True).start()

    def cut(self) -> None:
        self.open = False
        for pair in self._pairs:
            for end in pair:
                with contextlib.suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)
        self._pairs.clear()

    def close(self) -> None:
        self.cut()
        self._listener.close()


def _forward(source: socket.socket, target: socket.socket) -> None:
    with contextlib.suppress(OSError):
        while data := source.recv(65536):
            target.sendall(data)
    for end in (source, target):
        with contextlib.suppress(OSError):
            end.shutdown(socket.SHUT_RDWR)


@pytest.fixture
def proxy(control_plane: ControlPlane) -> Iterator[TcpProxy]:
    proxy = TcpProxy(int(control_plane.server.rsplit(":", 1)[1]))
    yield proxy
    proxy.close()


def test_view_page_shows_cluster_live_and_stale_when_api_server_is_unreachable(
    control_plane: ControlPlane, world: World, namespace: str, proxy: TcpProxy, tmp_path: Path
) -> None:
    config = tmp_path / "kubeconfig"
    config.write_text(
        control_plane.kubeconfig.read_text().replace(control_plane.server, f"https://127.0.0.1:{proxy.port}")
    )
    area = {"circle": {"center": at(40, 80), "radius": 30}}
    world.put(fractus_object("Zone", "school", {"area": area, "altitude": {"lower": 0, "upper": 30}}))
    fence = {"type": "GeofenceControl", "kind": "exclusion", "selector": {"zones": ["school"]}}
    world.put(fractus_object("Policy", "no-school", fence))
    world.put(traffic(namespace))
    drone = f"{FRACTUS}/drones/drone-1/status"
    with (
        sync_playwright() as playwright,
        launched(playwright, *SOFTWARE_GL) as browser,
        serving("--kubeconfig", config, "-n", namespace) as address,
        opened(browser, address) as page,
    ):
        expect(page.locator("#mode")).to_have_text("live", timeout=TIMEOUT_MS)
        expect(page.locator("#zones")).to_contain_text(
            "school exclusion zone, 0 to 30 m above home", timeout=TIMEOUT_MS
        )
        expect(page.locator("#zones")).to_contain_text("edge-1 edge node")
        expect(page.locator("#policies")).to_contain_text("no-school exclusion, ignore; in school")
        expect(page.locator("#applications")).to_contain_text(f"{namespace}/traffic")
        expect(page.locator("#drones")).to_contain_text("on the ground")
        expect(page.locator("#verdicts")).to_contain_text("No interventions by policies yet.")
        expect(page.locator("#pictures-section")).to_be_hidden()
        world.api.merge(
            drone, {"status": {"flightState": "flying", "position": at(30, 30, alt=15), "controller": "system"}}
        )
        expect(page.locator("#drones")).to_contain_text("in the air", timeout=TIMEOUT_MS)
        expect(page.locator("#drones")).to_contain_text("altitude 15.0 m")
        world.api.merge(
            f"{FRACTUS}/namespaces/{namespace}/applications/traffic/status",
            {"status": {"phase": "Flying", "drone": "drone-1"}},
        )
        expect(page.locator("#verdicts-problem")).to_contain_text(
            "no services in namespace fractus-system on drone-1", timeout=TIMEOUT_MS
        )
        page.wait_for_selector("#map[data-map=ready]")
        results = Axe().run(page)
        assert results.violations_count == 0, results.generate_report()
        proxy.cut()
        expect(page.locator("#mode")).to_have_text("stale", timeout=TIMEOUT_MS)
        expect(page.locator("#connection")).to_have_text(re.compile(r"^Stale since \d\d:\d\d:\d\d UTC: .*"))
        world.api.merge(drone, {"status": {"flightState": "landing"}})
        proxy.open = True
        expect(page.locator("#mode")).to_have_text("live", timeout=TIMEOUT_MS)
        expect(page.locator("#connection")).to_be_empty()
        expect(page.locator("#drones")).to_contain_text("landing", timeout=TIMEOUT_MS)
        world.api.delete(f"{FRACTUS}/drones/drone-1")
        expect(page.locator("#drones")).to_contain_text("No drone", timeout=TIMEOUT_MS)
