"""A chaos run in a separate process ends immediately when it is interrupted."""

from __future__ import annotations

import subprocess
import sys

PROGRAM = """
from fractus_sim.chaos import chaos_run

def interrupt(*_, **__):
    raise KeyboardInterrupt

chaos_run.Missions.step = interrupt
chaos_run.execute_run(None, None, chaos_run.RunConfig(1, 1800.0, ["etcd-restart"]), print)
"""


def test_interrupted_chaos_run_does_not_wait_for_scheduled_faults() -> None:
    process = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=60, check=False)
    assert process.returncode
    assert process.stderr.endswith("KeyboardInterrupt\n")
