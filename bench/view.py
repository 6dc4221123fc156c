"""The page of `fractus view` in Chromium: time until its map is shown, and its frames with 100 drones at 5 Hz.

The comparator of the frame durations is the same page with one drone. Without a graphics processor, Chromium draws in
software. Drawing then takes most of each frame, unlike on the machines of users. The time of the scripts shows the cost
of the page itself.
"""

from __future__ import annotations

import asyncio
import itertools
import math
import shutil
import statistics
import sys
import time
from collections.abc import AsyncIterator
from typing import Any

from aiohttp import web
from fractus_view.events import Areas, Event, Feature, Fix, State
from fractus_view.hub import Hub
from fractus_view.server import ViewServer
from harness import Report, parser, print_table, quantile
from playwright.async_api import Browser, async_playwright

LOADS = 7
"""Number of page loads. The result is the median duration."""

PERIOD_S = 0.2
ARGUMENTS = (
    "--no-sandbox", "--disable-background-networking", "--disable-component-update", "--disable-sync", "--disable-gpu", "--enable-unsafe-swiftshader",
)  # fmt: skip

FRAMES = """milliseconds => new Promise(resolve => {
    const times = [];
    const begun = performance.now();
    const frame = now => {
        times.push(now);
        if (now - begun < milliseconds) requestAnimationFrame(frame);
        else resolve(times);
    };
    requestAnimationFrame(frame);
})"""


class Fleet:
    """Source of events: drones that fly circles around one place."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.hub = Hub()
        corners = [[22.94, 39.35], [22.96, 39.35], [22.96, 39.37], [22.94, 39.37], [22.94, 39.35]]
        feature: Feature = {
            "type": "Feature", "properties": {"kind": "zone", "name": "field"},
            "geometry": {"type": "Polygon", "coordinates": [corners]},
        }  # fmt: skip
        self.hub.publish([Areas("bench", round(time.time() * 1000), [feature]), *self.events()])

    def events(self) -> list[Event]:
        """Return the current position and state of each drone."""
        now_ms = round(time.time() * 1000)
        events: list[Event] = []
        for number in range(self.count):
            angle = now_ms / 5_000 + number
            radius = 0.001 + 0.008 * number / self.count
            lat = 39.36 + radius * math.cos(angle)
            lon = 22.95 + radius * math.sin(angle)
            heading = math.degrees(angle + math.pi / 2) % 360
            events.append(Fix(f"drone-{number}", now_ms, lat, lon, 30.0, round(heading, 1)))
            events.append(State(f"drone-{number}", now_ms, 20.0, 5.0, 0.7, "GUIDED", "Navigator", "in the air"))
        return events

    async def run(self) -> None:
        """Publish events until cancelled."""
        while True:
            self.hub.publish(self.events())
            await asyncio.sleep(PERIOD_S)

    def stream(self, last_id: str) -> AsyncIterator[bytes]:
        return self.hub.stream(last_id)

    def picture(self, id_: str) -> bytes | None:
        del id_
        return None


async def measure(browser: Browser, count: int, seconds: float) -> dict[str, float]:
    """Load the page while some drones fly, and return durations in milliseconds."""
    view = ViewServer(Fleet(count), frozenset())
    runner = web.AppRunner(view.application(), shutdown_timeout=0.1)
    await runner.setup()
    site = web.TCPSite(runner, "127.0.0.1", 0)
    await site.start()
    context = await browser.new_context(viewport={"width": 1280, "height": 800})
    page = await context.new_page()
    await page.goto(f"http://127.0.0.1:{runner.addresses[0][1]}/?token={view.token}")
    await page.wait_for_selector("#map[data-map=ready]", timeout=120_000)
    map_ms = float(await page.evaluate("performance.getEntriesByName('map shown')[0].startTime"))
    protocol = await context.new_cdp_session(page)
    await protocol.send("Performance.enable")

    async def scripts_s() -> float:
        metrics: list[Any] = (await protocol.send("Performance.getMetrics"))["metrics"]
        return float(next(metric["value"] for metric in metrics if metric["name"] == "ScriptDuration"))

    before_s = await scripts_s()
    times_ms: list[float] = await page.evaluate(FRAMES, seconds * 1000)
    scripts_ms = (await scripts_s() - before_s) * 1000
    assert await page.locator("#drones li").count() == count
    await context.close()
    await runner.cleanup()
    frames_ms = [after - before for before, after in itertools.pairwise(times_ms)]
    return {
        "map": map_ms, "p50": statistics.median(frames_ms), "p95": quantile(frames_ms, 0.95),
        "scripts": scripts_ms / len(frames_ms),
    }  # fmt: skip


async def measure_all(seconds: float) -> tuple[dict[str, float], dict[str, float]]:
    """Measure the page with one drone and with 100."""
    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=shutil.which("chromium"), args=ARGUMENTS)
        await measure(browser, 1, 3.0)  # The first page of a browser includes the browser's start.
        one = await measure(browser, 1, seconds)
        many = await measure(browser, 100, seconds)
        loads = [await measure(browser, 1, 0.5) for _ in range(LOADS - 1)]
        one["map"] = statistics.median([one["map"], *(load["map"] for load in loads)])
        await browser.close()
    return one, many


def main() -> int:
    options = parser(__doc__, quick="fly 5 s instead of 20 s").parse_args()
    if shutil.which("chromium") is None:
        print("Chromium is not installed (make packages installs it); nothing is measured")
        return 0
    one, many = asyncio.run(measure_all(5.0 if options.quick else 20.0))
    print_table(("drones", *one), [(1, *one.values()), (100, *many.values())])
    report = Report("view", options)
    report.add("map", one["map"])
    report.add("frame", many["p95"], one["p95"])
    report.add("scripts", many["scripts"], one["scripts"])
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
