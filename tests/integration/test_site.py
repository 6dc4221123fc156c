"""Documentation site: links resolve, every page is included, and the reference is complete."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from browser import CHROMIUM, launched
from docs_pages import shell_lines
from playwright.sync_api import Browser, sync_playwright

pytestmark = pytest.mark.slow
in_browser = pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed; `make packages` installs it")

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("site")
    argv = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(out)]
    env = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    result = subprocess.run(argv, cwd=ROOT, env=env, capture_output=True, text=True, timeout=600, check=False)
    assert result.returncode == 0, result.stderr
    return out


def text(site: Path, page: str) -> str:
    return re.sub(r"<[^>]+>", "", (site / page).read_text())


def test_site_reference_has_kinds_calls_values_and_commands(site: Path) -> None:
    kinds = text(site, "reference/kinds.html")
    for path in (ROOT / "crds").glob("*.yaml"):
        assert yaml.safe_load(path.read_text())["spec"]["names"]["kind"] + ".spec" in kinds
    assert "spec.components[].controlPoints[].path[].alt".removeprefix("spec.") in kinds
    calls = text(site, "reference/calls.html")
    assert {"MobilityService", "CameraService", "SubscribeTelemetry", "RetrieveImage"} <= set(re.findall(r"\w+", calls))
    values = text(site, "reference/values.html")
    assert "operator.planning.safetyRadius" in values
    assert "vehicle.home" in values
    assert "fractus audit export" in text(site, "reference/commands.html")


def test_site_reference_has_methods_fields_and_errors_of_the_sdk(site: Path) -> None:
    page = set(re.findall(r"[\w.]+", text(site, "reference/sdk.html")))
    assert {"fractus.Mobility", "goto", "remaining", "waypoints_reached", "status_texts", "radius_m"} <= page
    assert {"fractus.MissionEnded", "fractus.sync"} <= page


def test_site_loads_no_external_resources(site: Path) -> None:
    for page in ("index.html", "safety-case.html", "reference/sdk.html"):
        loaded = re.findall(r'<(?:script|link|img)[^>]+(?:src|href)="([^"]+)"', (site / page).read_text())
        assert loaded
        assert not [address for address in loaded if "://" in address]


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright, launched(playwright) as running:
        yield running


@in_browser
@pytest.mark.parametrize("page", ["tutorial", "view", "experiments"])
def test_copy_buttons_copy_commands_without_prompts_and_output(site: Path, browser: Browser, page: str) -> None:
    with browser.new_page(viewport={"width": 1280, "height": 800}) as tab:
        tab.goto((site / f"{page}.html").as_uri())
        # The theme copies the text of a block while the block has this attribute.
        copied = tab.evaluate("""
            () => Array.from(document.querySelectorAll(".highlight code:has(.gp)"), block => {
                block.setAttribute("data-md-copying", "");
                return block.innerText;
            })
        """)
    lines = [line.strip() for line in "\n".join(copied).replace("\\\n", "").splitlines() if line.strip()]
    assert lines
    assert not [line for line in lines if line not in shell_lines(f"docs/{page}.md")]


@in_browser
@pytest.mark.parametrize("page", ["kinds", "values", "calls"])
def test_reference_tables_show_each_name_on_one_line(site: Path, browser: Browser, page: str) -> None:
    with browser.new_page(viewport={"width": 1280, "height": 800}) as tab:
        tab.goto((site / "reference" / f"{page}.html").as_uri())
        broken = tab.evaluate("""
            () => Array.from(document.querySelectorAll("td:first-child code"))
                .filter(name => name.getClientRects().length > 1)
                .map(name => name.textContent)
        """)
    assert broken == []
