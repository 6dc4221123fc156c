"""Run the commands of docs/tutorial.md that need no cluster: its program flies under its Grant."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from docs_pages import ROOT, shell_lines, shown_file
from fractus_cluster.ports import free_port

PAGE_NAME = "docs/tutorial.md"
PAGE = (ROOT / PAGE_NAME).read_text()
FLIGHT_TIMEOUT_S = 180
pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]


def commands(ports: dict[str, str]) -> list[list[str]]:
    """Return the arguments of each `fractus` command of the page, in order, with other ports."""
    lines = [line.removeprefix("fractus ") for line in shell_lines(PAGE_NAME) if line.startswith("fractus ")]
    for documented, port in ports.items():
        lines = [line.replace(documented, port) for line in lines]
    return [shlex.split(line) for line in lines]


@contextmanager
def running(folder: Path, *arguments: str) -> Iterator[None]:
    with (folder / f"{arguments[0]}.log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "fractus_cli", *arguments], stdout=log, stderr=log, cwd=folder
        )
        try:
            yield
        finally:
            process.kill()
            process.wait(10)


def test_program_of_the_tutorial_flies_its_mission(tmp_path: Path) -> None:
    vehicle_port = str(free_port())
    service_port = str(free_port())
    init, sign, vehicle, mobility, *_ = commands({"5760": vehicle_port})
    (tmp_path / "patrol.py").write_text(shown_file(PAGE_NAME, "patrol.py"))
    (tmp_path / "patrol.yaml").write_text(shown_file(PAGE_NAME, "patrol.yaml"))
    for command in (init, sign):
        subprocess.run([sys.executable, "-m", "fractus_cli", *command], cwd=tmp_path, check=True, timeout=60)
    exported = dict(re.findall(r"(FRACTUS_\w+)=(\S+)", PAGE)) | {
        "FRACTUS_MOBILITY_ADDRESS": f"127.0.0.1:{service_port}"
    }
    listen = ("--listen", f"127.0.0.1:{service_port}")
    begun = time.monotonic()
    with (
        running(tmp_path, *vehicle, "--listen", f"tcp:127.0.0.1:{vehicle_port}"),
        running(tmp_path, *mobility, *listen, "--description", "none.yaml"),
    ):
        result = subprocess.run(
            [sys.executable, "patrol.py"], cwd=tmp_path, env={**os.environ, **exported}, capture_output=True, text=True,
            timeout=FLIGHT_TIMEOUT_S, check=False,
        )  # fmt: skip
    output = result.stdout + result.stderr
    assert result.returncode == 0, output + (tmp_path / "mobility.log").read_text()
    expected = re.search(r"\$ python patrol.py\n(.*?)```", PAGE, re.DOTALL)
    assert expected is not None
    for line in filter(lambda line: "waiting" not in line, expected[1].splitlines()):
        assert line.split(" ", 1)[1] in output
    assert time.monotonic() - begun < FLIGHT_TIMEOUT_S
