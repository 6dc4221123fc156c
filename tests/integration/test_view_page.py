"""Web page of `fractus view` in Chromium, with the recording of a simulated flight."""

from __future__ import annotations

import asyncio
import contextlib
import io
import re
import signal
from collections.abc import Iterator
from pathlib import Path

import grpc
import pytest
from axe_playwright_python.sync_playwright import Axe
from browser import CHROMIUM, SOFTWARE_GL, TIMEOUT_MS, launched, opened, serving
from fractus_proto.v1 import camera_pb2, camera_pb2_grpc
from fractus_proto.v1 import mobility_pb2 as pb
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from mobility_rig import PASSENGER, Driver, Rig, altitude_limit, fence, grant, passenger_grant
from PIL import Image
from playwright.sync_api import Browser, Page, Playwright, expect, sync_playwright

FLOWN = (11, 87, 184)
EXCLUSION = (194, 24, 43)
"""Colours of the flown path and of exclusion zones in the light colour scheme."""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        CHROMIUM is None, reason="Chromium is not installed; `make packages` installs it on machines with apt-get"
    ),
    pytest.mark.xdist_group("browser"),
]


async def fly(directory: Path) -> None:
    """Record a flight past a zone, with a corrected and a refused target and a picture."""
    rig = Rig(directory)
    try:
        school = fence("school", "exclusion", "ignore", 20, 45, 45, 70, lower=0, upper=30)
        rig.write_grant(grant(altitude_limit(5, 15), school))
        rig.write_grant(passenger_grant(services=[{"service": "camera", "methods": ["CaptureImage"]}]))
        rig.start_service("--recordings", str(directory / "recordings" / "mobility"))
        rig.start_vehicle()
        address = rig.start_camera("--recordings", str(directory / "recordings" / "camera"))
        driver = Driver(rig)
        await driver.up(10.0)
        stub = camera_pb2_grpc.CameraServiceStub(rig.channel(PASSENGER, address=address))
        await stub.CaptureImage(camera_pb2.CaptureImageRequest(), timeout=60, wait_for_ready=True)
        await driver.goto(30, 30, 20.0)
        with contextlib.suppress(grpc.aio.AioRpcError):
            await driver.goto(32, 60, 10.0)
        await driver.goto(60, 0, 12.0)
        await driver.stub.ReturnControl(pb.ReturnControlRequest(), timeout=10)
        await rig.until(lambda t: t.autopilot_connected and not t.armed, 120, "landed")
        rig.kill("service", signal.SIGTERM)
        rig.kill("camera", signal.SIGTERM)
    finally:
        await rig.close()


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("flight")
    asyncio.run(fly(directory))
    return directory / "recordings"


@pytest.fixture(scope="module")
def playwright(recordings: Path) -> Iterator[Playwright]:
    """Playwright. It starts after the recorded flight, because its event loop keeps running in this thread."""
    with sync_playwright() as playwright:
        yield playwright


@pytest.fixture(scope="module")
def browser(playwright: Playwright) -> Iterator[Browser]:
    with launched(playwright, *SOFTWARE_GL) as browser:
        yield browser


@pytest.fixture(scope="module")
def address(recordings: Path) -> Iterator[str]:
    with serving(*sorted(recordings.rglob("*.mcap"))) as address:
        yield address


def go_to_end(page: Page) -> None:
    """Pause the replay, and move to the end of the recording."""
    page.get_by_label("Shown time").wait_for()
    expect(page.locator("#mode")).to_have_text("replay", timeout=TIMEOUT_MS)
    page.get_by_role("button", name="Pause").or_(page.get_by_role("button", name="Play")).click()
    slider = page.get_by_label("Shown time")
    for _ in range(12):
        slider.press("PageUp")


def pixels(page: Page, colour: tuple[int, int, int]) -> int:
    """Return the number of pixels of the map that have nearly the given colour."""
    image = Image.open(io.BytesIO(page.locator("#map").screenshot(timeout=TIMEOUT_MS))).convert("RGB")
    return sum(
        count for count, value in image.getcolors(1 << 24) or () if max(abs(a - b) for a, b in zip(value, colour, strict=True)) < 25  # type: ignore[arg-type, call-overload]
    )  # fmt: skip


def test_view_page_shows_zones_verdicts_path_and_pictures_of_flight(browser: Browser, address: str) -> None:
    with opened(browser, address) as page:
        page.wait_for_selector("#map[data-map=ready]")
        assert "token" not in page.url
        go_to_end(page)
        expect(page.locator("#zones")).to_contain_text("school-zone exclusion zone, 0 to 30 m above home")
        expect(page.locator("#zones")).to_contain_text("operation area of Navigator")
        verdicts = page.locator("#verdicts")
        expect(verdicts).to_contain_text("corrected to 14.8 m above home", timeout=TIMEOUT_MS)
        expect(verdicts.locator(".deny")).to_contain_text("inside zone school-zone of policy school")
        expect(verdicts.locator(".deny")).to_contain_text("policy school")
        expect(page.locator("#drones")).to_contain_text("controller system · mode LAND")
        expect(page.locator("#drones")).to_contain_text(re.compile(r"battery \d+ %"))
        page.wait_for_function("[...document.querySelectorAll('#pictures img')].some(image => image.naturalWidth > 0)")
        page.wait_for_timeout(1_000)
        assert pixels(page, EXCLUSION) > 100
        assert pixels(page, FLOWN) > 600, "the map does not show the flown path"


def test_view_page_can_be_used_by_keyboard(browser: Browser, address: str) -> None:
    with opened(browser, address) as page:
        go_to_end(page)
        slider = page.get_by_label("Shown time")
        end = float(slider.input_value())
        slider.press("ArrowLeft")
        assert end - float(slider.input_value()) == pytest.approx(1_000, abs=150)
        assert re.search(r"UTC, .* of ", slider.get_attribute("aria-valuetext") or "")
        reached = set()
        page.keyboard.press("Shift+Tab")
        page.locator("body").press("Control+Home")
        page.evaluate("document.activeElement.blur()")
        for _ in range(40):
            page.keyboard.press("Tab")
            reached.add(page.evaluate("document.activeElement.id || document.activeElement.className"))
        assert {"skip", "play", "speed", "shown-time", "verdict-filter", "name", "time", "maplibregl-canvas"} <= reached
        drone = page.get_by_role("button", name="drone-1: show on the map")
        drone.press("Enter")
        expect(drone).to_have_attribute("aria-pressed", "true")
        page.locator(".deny button").press("Enter")
        assert float(slider.input_value()) < end - 1_000
        play = page.locator("#play")
        play.press("Enter")
        expect(play).to_have_text("Pause")
        play.press("Space")
        expect(play).to_have_text("Play")


def test_view_page_announces_new_verdicts_to_screen_readers(browser: Browser, address: str) -> None:
    with opened(browser, address, reduced_motion="reduce") as page:
        expect(page.locator("#mode")).to_have_text("replay", timeout=TIMEOUT_MS)
        (
            expect(page.locator("#play")).to_have_text("Play"),
            "the replay starts automatically although the user prefers reduced motion",
        )
        log = page.get_by_role("log", name="New verdicts")
        expect(log).to_be_empty()
        for _ in range(12):
            page.get_by_label("Shown time").press("PageUp")
        expect(log).to_contain_text("drone-1: ", timeout=TIMEOUT_MS)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_view_page_has_no_accessibility_violation(browser: Browser, address: str, scheme: str) -> None:
    with opened(browser, address, color_scheme=scheme) as page:
        page.wait_for_selector("#map[data-map=ready]")
        go_to_end(page)
        expect(page.locator("#verdicts .deny")).to_be_visible(timeout=TIMEOUT_MS)
        # The content security policy forbids injected scripts, so Axe runs through the debugger protocol.
        results = Axe().run(page)
        assert results.violations_count == 0, results.generate_report()


def test_view_page_blocks_inline_scripts_and_other_servers(browser: Browser, address: str) -> None:
    context = browser.new_context()
    page = context.new_page()
    page.goto(address)
    blocked = page.evaluate(
        """() => new Promise(resolve => {
            const violations = [];
            document.addEventListener('securitypolicyviolation', event => {
                violations.push(event.effectiveDirective);
                if (violations.length === 3) resolve(violations.sort());
            });
            const add = (tag, name, value) => {
                const element = document.createElement(tag);
                element[name] = value;
                document.body.append(element);
            };
            add('script', 'textContent', 'window.ran = true');
            add('img', 'src', 'http://127.0.0.2:9/x.png');
            fetch('http://127.0.0.2:9/').catch(() => {});
        })"""
    )
    assert blocked == ["connect-src", "img-src", "script-src-elem"]
    assert page.evaluate("window.ran") is None
    context.close()


def test_view_page_shows_map_without_areas(browser: Browser, tmp_path: Path) -> None:
    with serving("--recordings", tmp_path) as address, opened(browser, address) as page:
        expect(page.locator("#map .maplibregl-canvas")).to_be_visible(timeout=TIMEOUT_MS)


def test_view_page_explains_missing_token(browser: Browser, address: str) -> None:
    context = browser.new_context()
    page = context.new_page()
    response = page.goto(address.partition("?")[0])
    assert response is not None
    assert response.status == 401
    expect(page.locator("body")).to_contain_text("open the address that `fractus view` printed")
    context.close()


def test_view_page_shows_lists_without_webgl(playwright: Playwright, address: str) -> None:
    with launched(playwright, "--disable-3d-apis") as browser, opened(browser, address) as page:
        expect(page.locator("#no-map")).to_have_text(re.compile("no WebGL"), timeout=TIMEOUT_MS)
        go_to_end(page)
        expect(page.locator("#verdicts .deny")).to_be_visible(timeout=TIMEOUT_MS)
        expect(page.locator("#zones")).to_contain_text("school-zone")


def first_refusal_offset(data: bytes) -> int:
    """Return the offset of the MCAP chunk that contains the first refusal.

    The offset is not constant, because the number of recorded messages depends on the load of the machine.
    """
    file = io.BytesIO(data)
    offset = 0
    for record in StreamReader(file, emit_chunks=True).records:
        if isinstance(record, Chunk) and any(
            isinstance(message, Message) and b'"deny"' in message.data for message in breakup_chunk(record)
        ):
            return offset
        offset = file.tell()
    raise AssertionError("the recording has no refusal")


def test_view_page_follows_growing_recording(browser: Browser, recordings: Path, tmp_path: Path) -> None:
    (source,) = (recordings / "mobility").glob("*.mcap")
    data = source.read_bytes()
    growing = tmp_path / source.name
    offset = first_refusal_offset(data)
    growing.write_bytes(data[:offset])
    with serving("--recordings", tmp_path) as address, opened(browser, address) as page:
        expect(page.locator("#mode")).to_have_text("live", timeout=TIMEOUT_MS)
        expect(page.locator("#drones")).to_contain_text("in the air", timeout=TIMEOUT_MS)
        assert page.locator("#verdicts .deny").count() == 0
        with growing.open("ab") as file:
            file.write(data[offset:])
        expect(page.locator("#verdicts .deny")).to_be_visible(timeout=TIMEOUT_MS)
        page.get_by_role("button", name="Pause").press("Enter")
        expect(page.locator("#mode")).to_have_text("paused")
        page.get_by_role("button", name="Live").press("Enter")
        expect(page.locator("#mode")).to_have_text("live")
