"""Commands of the embedded cluster that are killed at any moment: nothing goes on behind the back of the next one."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

_RUNS = """
import sys
from fractus_cluster.commands import run
run(["sh", "-c", "echo $$ > $0.new; mv $0.new $0; exec sleep 600", sys.argv[1]])
"""


def _runs(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state not in "ZX"


def test_what_a_killed_command_was_running_ends_with_it(tmp_path: Path):
    told, deadline = tmp_path / "pid", time.monotonic() + 60.0
    with subprocess.Popen([sys.executable, "-c", _RUNS, str(told)]) as process:
        while not told.exists() and time.monotonic() < deadline:
            time.sleep(0.02)
        process.kill()
    pid = int(told.read_text())
    while _runs(pid) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not _runs(pid)
