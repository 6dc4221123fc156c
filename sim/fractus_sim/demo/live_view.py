"""The web view of the mission: live during the flight, and from its recordings afterwards."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

from fractus_sim.demo.mission_data import RECORDINGS

_STOP_TIMEOUT_S = 10.0


@contextlib.contextmanager
def live_view(kubeconfig: Path, report: Callable[[str], None]) -> Iterator[None]:
    """Serve the page of `fractus view` and report its address. The demo continues if the page cannot be served."""
    command = [sys.executable, "-m", "fractus_cli", "view", "--kubeconfig", str(kubeconfig), "--listen", "127.0.0.1:0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:

        def report_address() -> None:
            line = process.stdout.readline().strip() if process.stdout is not None else ""
            _, separator, address = line.partition("view: open ")
            if separator:
                report(f"live view: {address}")
            elif line:
                report(f"live view not available: {line}")

        # The mission does not wait until the page is served.
        reader = threading.Thread(target=report_address, daemon=True)
        reader.start()
        try:
            yield
        finally:
            process.terminate()
            try:
                process.wait(_STOP_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                process.kill()
            reader.join(_STOP_TIMEOUT_S)


def replay_command(folder: Path) -> str | None:
    """Return the command that shows the recordings of a report, or None without recordings."""
    recordings = folder / RECORDINGS
    return f"fractus view {recordings}/*.mcap" if any(recordings.glob("*.mcap")) else None
