"""The mission in the web view: live during the flight, and from its recording afterwards."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

from fractus_sim.demo.mission_data import mobility_pod
from fractus_sim.testbeds.kube_commands import SYSTEM, Kube

RECORDINGS = "recordings"
"""Folder of recordings in the report."""

_ON_NODE = "/var/lib/fractus/recordings"
_LIST = "import sys, pathlib as p; r = p.Path(sys.argv[1]); [print(f.stat().st_mtime, f.relative_to(r)) for f in r.glob('*/*.mcap')]"
_END_S = 10.0


@contextlib.contextmanager
def shown(kubeconfig: Path, say: Callable[[str], None]) -> Iterator[None]:
    """Serve the page of `fractus view` and print its address. The demo continues if the page cannot be served."""
    command = [sys.executable, "-m", "fractus_cli", "view", "--kubeconfig", str(kubeconfig), "--listen", "127.0.0.1:0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:

        def tell() -> None:
            line = process.stdout.readline().strip() if process.stdout is not None else ""
            _, found, address = line.partition("view: open ")
            if line:
                say(f"live view: {address}" if found else f"live view not available: {line}")

        # The mission does not wait for the page.
        telling = threading.Thread(target=tell, daemon=True)
        telling.start()
        try:
            yield
        finally:
            process.terminate()
            try:
                process.wait(_END_S)
            except subprocess.TimeoutExpired:
                process.kill()
            telling.join(_END_S)


def fetch_recordings(kube: Kube, drone: str, since_s: float, folder: Path) -> list[Path]:
    """Copy the recordings that the services of a drone wrote since a time (Unix seconds).

    A recording can begin before the mission, because recordings include the seconds before arming. The result is empty
    if the services do not record.

    Raises:
        ExperimentError: The recordings cannot be read.
    """
    pod = mobility_pod(kube, drone)
    found: list[Path] = []
    for line in sorted(kube.run("exec", "-n", SYSTEM, pod, "--", "python3", "-c", _LIST, _ON_NODE).splitlines()):
        written_s, _, name = line.partition(" ")
        if float(written_s) >= since_s:
            to = folder / RECORDINGS / name.replace("/", "-")
            to.parent.mkdir(parents=True, exist_ok=True)
            kube.fetch(pod, f"{_ON_NODE}/{name}", to)
            found.append(to)
    return found


def replay_command(folder: Path) -> str | None:
    """Return the command that shows the recordings of a report, or None without recordings."""
    return f"fractus view {folder / RECORDINGS}/*.mcap" if any((folder / RECORDINGS).glob("*.mcap")) else None
