"""Helpers that serve the page of `fractus view` and open it in Chromium."""

from __future__ import annotations

import contextlib
import re
import shutil
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, Playwright, Route

CHROMIUM = shutil.which("chromium")
TIMEOUT_MS = 90_000
QUIET = ("--no-sandbox", "--disable-background-networking", "--disable-component-update", "--disable-sync")
SOFTWARE_GL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


@contextlib.contextmanager
def launched(playwright: Playwright, *arguments: str) -> Iterator[Browser]:
    """Run Chromium with additional arguments."""
    browser = playwright.chromium.launch(executable_path=CHROMIUM, args=[*QUIET, *arguments], timeout=TIMEOUT_MS)
    yield browser
    browser.close()


@contextlib.contextmanager
def serving(*arguments: str | Path) -> Iterator[str]:
    """Run `fractus view`, and yield the address that it prints."""
    command = [sys.executable, "-m", "fractus_cli", "view", "--listen", "127.0.0.1:0", *map(str, arguments)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            match = re.search(r"http://\S+", process.stdout.readline())
            assert match is not None
            yield match[0]
        finally:
            process.send_signal(signal.SIGTERM)
        assert process.wait(20) == 0


def wait_for_events(address: str, *words: str) -> None:
    """Wait until the event stream has sent all words. Also check that the page is refused without the token."""
    plain, _, token = address.partition("?token=")
    with pytest.raises(urllib.error.HTTPError) as refused:
        urllib.request.urlopen(plain, timeout=20)
    assert refused.value.code == 401
    request = urllib.request.Request(f"{plain}stream", headers={"Authorization": f"Bearer {token}"})
    missing = set(words)
    with urllib.request.urlopen(request, timeout=20) as response:
        while missing:
            line = response.readline().decode()
            assert line, f"the event stream ended before it sent {missing}"
            missing = {word for word in missing if word not in line}


@contextlib.contextmanager
def opened(browser: Browser, address: str, **options: str) -> Iterator[Page]:
    """Open the page, and fail if it logs an error on its console or requests another server."""
    context = browser.new_context(viewport={"width": 1280, "height": 800}, **options)  # type: ignore[arg-type]
    context.set_default_timeout(TIMEOUT_MS)
    page = context.new_page()
    problems = list[str]()
    page.on("console", lambda message: problems.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: problems.append(str(error)))

    def check_address(route: Route) -> None:
        if not route.request.url.startswith(address.partition("?")[0]):
            problems.append(route.request.url)
        route.continue_()

    page.route("**/*", check_address)
    page.goto(address)
    yield page
    assert problems == []
    context.close()
