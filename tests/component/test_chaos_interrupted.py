"""Interruption of a chaos run by Ctrl-C, in a process."""

from __future__ import annotations

import subprocess
import sys

PROGRAM = """
from fractus_sim.chaos import chaos_run

def interrupted(*_, **__):
    raise KeyboardInterrupt

chaos_run.Missions.step = interrupted
chaos_run.fly(None, None, chaos_run.Task(1, 1800.0, ["etcd-restart"]), print)
"""


def test_interrupted_chaos_run_ends_before_its_next_fault() -> None:
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode
    assert done.stderr.endswith("KeyboardInterrupt\n")
