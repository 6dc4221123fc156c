"""The page of `fractus view`, as it is served and in a real Chromium."""

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
def launched(playwright: Playwright, *more: str) -> Iterator[Browser]:
    browser = playwright.chromium.launch(executable_path=CHROMIUM, args=[*QUIET, *more], timeout=TIMEOUT_MS)
    yield browser
    browser.close()


@contextlib.contextmanager
def serving(*arguments: str | Path) -> Iterator[str]:
    """The address that `fractus view` prints."""
    command = [sys.executable, "-m", "fractus_cli", "view", "--listen", "127.0.0.1:0", *map(str, arguments)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            found = re.search(r"http://\S+", process.stdout.readline())
            assert found is not None
            yield found[0]
        finally:
            process.send_signal(signal.SIGTERM)
        assert process.wait(20) == 0


def told_to_pages(address: str, *words: str) -> None:
    """Wait until pages of those who have the token are told all of these words; no one else is told anything."""
    plain, _, token = address.partition("?token=")
    with pytest.raises(urllib.error.HTTPError) as refused:
        urllib.request.urlopen(plain, timeout=20)
    assert refused.value.code == 401
    request = urllib.request.Request(f"{plain}stream", headers={"Authorization": f"Bearer {token}"})
    missing = set(words)
    with urllib.request.urlopen(request, timeout=20) as answer:
        while missing:
            line = answer.readline().decode()
            assert line, f"the stream ended without {missing}"
            missing = {word for word in missing if word not in line}


@contextlib.contextmanager
def opened(browser: Browser, address: str, **how: str) -> Iterator[Page]:
    """The page, without an error on its console, and without a request to anything else."""
    context = browser.new_context(viewport={"width": 1280, "height": 800}, **how)  # type: ignore[arg-type]
    context.set_default_timeout(TIMEOUT_MS)
    page = context.new_page()
    wrong = list[str]()
    page.on("console", lambda said: wrong.append(said.text) if said.type == "error" else None)
    page.on("pageerror", lambda error: wrong.append(str(error)))

    def local(route: Route) -> None:
        if not route.request.url.startswith(address.partition("?")[0]):
            wrong.append(route.request.url)
        route.continue_()

    page.route("**/*", local)
    page.goto(address)
    yield page
    assert wrong == []
    context.close()
