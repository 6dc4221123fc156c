"""Map and lists of the page of `fractus view` in Chromium, with events of the test."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path

import pytest
from axe_playwright_python.sync_playwright import Axe
from browser import CHROMIUM, SOFTWARE_GL, TIMEOUT_MS, launched, opened
from fractus_view.base_map import open_map
from fractus_view.events import (
    Areas,
    Contact,
    Event,
    Feature,
    Fix,
    Picture,
    PictureSource,
    Policies,
    Policy,
    Records,
    State,
    Verdict,
)
from page_server import PageSource
from PIL import Image
from playwright.sync_api import Browser, Page, expect, sync_playwright

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        CHROMIUM is None, reason="Chromium is not installed; `make packages` installs it on machines with apt-get"
    ),
    pytest.mark.xdist_group("browser"),
]

LAT = 39.36
LON = 22.93
T_MS = 1_780_000_000_000
COLOURS = {
    "exclusion": (194, 24, 43), "inclusion": (77, 107, 0), "noPictures": (163, 21, 122), "speedLimit": (179, 71, 0),
    "denial": (74, 85, 128),
}  # fmt: skip
"""Colours of outlines in the light colour scheme, by use of the zone."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright, launched(playwright, *SOFTWARE_GL) as browser:
        yield browser


@pytest.fixture
def source() -> PageSource:
    return PageSource()


def square(west: float, south: float, size: float = 0.001) -> list[list[tuple[float, float]]]:
    """Return the rings of a square, in degrees from the origin."""
    corners = [(0.0, 0.0), (size, 0.0), (size, size), (0.0, size), (0.0, 0.0)]
    return [[(LON + west + x, LAT + south + y) for x, y in corners]]


def zone(name: str, rings: list[list[tuple[float, float]]], *uses: str) -> Feature:
    properties = {"kind": "zone", "name": name, "uses": list(uses)}
    return {"type": "Feature", "properties": properties, "geometry": {"type": "Polygon", "coordinates": rings}}  # type: ignore[typeddict-item]


def drone(time_ms: int, north: float, *, phase: str = "in the air", flight_ms: int | None = None) -> list[Event]:
    """Return position and state of a drone at a distance north of the origin, in degrees."""
    return [
        Fix("drone-1", time_ms, LAT + north, LON, 30.0, 0.0),
        State("drone-1", time_ms, 10.0, 1.0, 0.5, "GUIDED", "Navigator", phase, None, flight_ms),
    ]


def pixels(page: Page, colour: tuple[int, int, int]) -> int:
    """Return the number of pixels of the map that have nearly the given colour."""
    image = Image.open(io.BytesIO(page.locator("#map").screenshot(timeout=TIMEOUT_MS))).convert("RGB")
    return sum(
        count for count, value in image.getcolors(1 << 24) or () if max(abs(a - b) for a, b in zip(value, colour, strict=True)) < 25  # type: ignore[arg-type, call-overload]
    )  # fmt: skip


def test_view_map_colours_zones_by_the_effect_of_their_policies(browser: Browser, source: PageSource) -> None:
    zones = [zone(use, square(0.002 * i, 0), use) for i, use in enumerate(COLOURS)]
    zones.append(zone("both", square(0, 0.002), "exclusion", "speedLimit"))
    zones.append(zone("unused", square(0.002, 0.002)))
    source.publish(Areas("zones", T_MS, zones), *drone(T_MS, -0.001))
    with source.serving() as address, opened(browser, address) as page:
        page.wait_for_selector("#map[data-map=ready]")
        page.wait_for_timeout(1_000)
        for use, colour in COLOURS.items():
            assert pixels(page, colour) > 60, use
        listed = page.locator("#zones")
        expect(listed).to_contain_text("both exclusion zone, speed limit, all altitudes")
        expect(listed).to_contain_text("unused zone without a policy")
        legend = page.locator("#legend")
        expect(legend).to_contain_text("exclusion zone")
        expect(legend.locator("[data-class=operationArea]")).to_be_hidden()
        results = Axe().run(page)
        assert results.violations_count == 0, results.generate_report()


def test_view_states_policies_at_the_place_of_a_drone(browser: Browser, source: PageSource) -> None:
    fence = Policy("no-school", "exclusion, ignore", ["school"])
    source.publish(
        Contact(T_MS, None, ""),
        Areas("zones", T_MS, [zone("school", square(-0.0005, 0.001), "exclusion")]),
        Policies(T_MS, [fence]),
        *drone(T_MS, 0.0),
    )
    with source.serving() as address, opened(browser, address) as page:
        expect(page.locator("#drones")).to_contain_text("no policy restricts this place", timeout=TIMEOUT_MS)
        source.publish(*drone(T_MS + 1_000, 0.0015))
        expect(page.locator("#drones")).to_contain_text("policy here: no-school", timeout=TIMEOUT_MS)
        source.publish(Policies(T_MS + 2_000, []))
        expect(page.locator("#policies")).to_contain_text("No policy restricts flights or pictures.")
        source.publish(Contact(T_MS + 3_000, T_MS, "no route"))
        expect(page.locator("#policies-age")).to_have_text("as of 20:26:40 UTC, may have changed")


def test_view_states_that_recordings_do_not_list_policies(browser: Browser, source: PageSource) -> None:
    source.publish(*drone(T_MS, 0.0))
    with source.serving() as address, opened(browser, address) as page:
        expect(page.locator("#policies")).to_contain_text("Recordings do not list policies.", timeout=TIMEOUT_MS)
        expect(page.locator("#drones")).not_to_contain_text("polic")


def test_view_map_states_policies_at_a_clicked_place(browser: Browser, source: PageSource) -> None:
    source.publish(
        Contact(T_MS, None, ""),
        Areas("zones", T_MS, [zone("school", square(0, 0), "exclusion")]),
        Policies(T_MS, [Policy("no-school", "exclusion, ignore", ["school"])]),
    )
    with source.serving() as address, opened(browser, address) as page:
        page.wait_for_selector("#map[data-map=ready]")
        page.locator("#map canvas").first.click()
        popup = page.locator(".maplibregl-popup-content")
        expect(popup).to_contain_text("school: exclusion zone")
        expect(popup).to_contain_text("policy here: no-school")
        page.locator("#map canvas").first.click(position={"x": 60, "y": 60})
        expect(popup).to_contain_text("no zone or area here")
        expect(popup).to_contain_text("no policy restricts this place")


def wait_for_pixels(page: Page, colour: tuple[int, int, int], at_least: int) -> None:
    """Wait until the map has pixels of a colour."""
    found = 0
    for _ in range(40):
        found = pixels(page, colour)
        if found >= at_least:
            return
        page.wait_for_timeout(500)
    raise AssertionError(f"{found} pixels of {colour}, expected at least {at_least}")


def scale_m(page: Page) -> float:
    """Return the length of the scale bar in metres."""
    number, unit = page.locator(".maplibregl-ctrl-scale").inner_text().split()
    return float(number) * {"m": 1, "km": 1_000}[unit]


def test_view_map_zooms_to_the_flight_and_separates_earlier_paths(browser: Browser, source: PageSource) -> None:
    far = zone("far", square(0.5, 0.5), "exclusion")
    start_ms = T_MS + 60_000
    source.publish(Areas("zones", T_MS, [far]))
    for second in range(10):
        source.publish(*drone(T_MS + second * 1_000, -0.0001 * second))
    with source.serving() as address, opened(browser, address) as page:
        page.wait_for_selector("#map[data-map=ready]")
        assert scale_m(page) < 500, "the map does not show the flight at the start"
        page.get_by_role("button", name="Show all").press("Enter")
        assert scale_m(page) > 2_000
        for second in range(10):
            source.publish(*drone(start_ms + second * 1_000, 0.0001 * second, flight_ms=start_ms))
        expect(page.locator("#legend")).to_contain_text("earlier path", timeout=TIMEOUT_MS)
        page.get_by_role("button", name="Zoom to flight").press("Enter")
        assert scale_m(page) < 500
        wait_for_pixels(page, (11, 87, 184), 500)
        expect(page.locator("#drones")).to_contain_text("in the air")
        source.publish(*drone(start_ms + 11_000, 0.0, phase="returning", flight_ms=start_ms))
        expect(page.locator("#drones .badge")).to_have_text("returning", timeout=TIMEOUT_MS)


def test_view_of_a_cluster_shows_verdicts_and_states_why_some_may_be_missing(
    browser: Browser, source: PageSource
) -> None:
    verdict = Verdict("drone-1", T_MS, "call", "Navigator", "Goto", "deny", "X", "inside zone a", ["no-a"], None, None)
    source.publish(Contact(T_MS, None, ""), Records(T_MS, ""), *drone(T_MS, 0.0), verdict)
    with source.serving() as address, opened(browser, address) as page:
        expect(page.locator("#verdicts .deny")).to_contain_text("inside zone a", timeout=TIMEOUT_MS)
        expect(page.get_by_label("Show", exact=True)).to_be_hidden()
        expect(page.locator("#verdicts-problem")).to_be_empty()
        source.publish(Records(T_MS + 1_000, "drone-1: no route to host"))
        expect(page.locator("#verdicts-problem")).to_have_text("Verdicts may be missing: drone-1: no route to host")
        # A page that is opened later receives the same problem.
        page.reload()
        expect(page.locator("#verdicts-problem")).to_contain_text("no route to host", timeout=TIMEOUT_MS)


def test_view_map_shows_offline_base_map_with_attribution(browser: Browser, source: PageSource, tmp_path: Path) -> None:
    tile = tmp_path / "map" / "0" / "0" / "0.png"
    tile.parent.mkdir(parents=True)
    Image.new("RGB", (256, 256), (0, 200, 0)).save(tile)
    (tmp_path / "map" / "attribution.txt").write_text("Land registry")
    source.publish(Areas("zones", T_MS, [zone("school", square(0, 0), "exclusion")]))
    with source.serving(base_map=open_map(tmp_path / "map")) as address, opened(browser, address) as page:
        page.wait_for_selector("#map[data-map=ready]")
        expect(page.locator("#attribution")).to_have_text("Land registry")
        # Tile at 70 % above the plain background.
        wait_for_pixels(page, (70, 211, 73), 10_000)


def test_view_of_a_cluster_shows_thumbnails_and_states_why_some_may_be_missing(
    browser: Browser, source: PageSource
) -> None:
    buffer = io.BytesIO()
    Image.new("RGB", (2_000, 1_500), (10, 120, 200)).save(buffer, "JPEG")
    source.pictures["cluster-0"] = buffer.getvalue()
    source.publish(Contact(T_MS, None, ""), *drone(T_MS, 0.0))
    with source.serving() as address, opened(browser, address) as page:
        expect(page.locator("#drones")).to_contain_text("in the air", timeout=TIMEOUT_MS)
        expect(page.locator("#pictures-section")).to_be_hidden()
        source.publish(PictureSource(T_MS, ""), Picture("drone-1", T_MS, "cluster-0"))
        image = page.get_by_role("img", name="Picture that drone-1 took at 20:26:40")
        expect(image).to_be_visible(timeout=TIMEOUT_MS)
        page.wait_for_function("document.querySelector('#pictures img').naturalWidth === 320")
        source.publish(PictureSource(T_MS, "drone-1: pods is forbidden"))
        expect(page.locator("#pictures-problem")).to_have_text("Pictures may be missing: drone-1: pods is forbidden")
