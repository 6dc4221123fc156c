"""Watchdog of the agent's event loop."""

import subprocess
import sys

PROGRAM = """
import asyncio, time
from fractus_agent.supervisor import run_watchdog
async def main():
    task = asyncio.create_task(run_watchdog(0.05, 0.5))
    await asyncio.sleep({healthy})
    {then}
    task.cancel()
asyncio.run(main())
"""


def run(healthy: float, then: str) -> subprocess.CompletedProcess[str]:
    program = PROGRAM.format(healthy=healthy, then=then)
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)


def test_watchdog_ends_a_hanging_process_and_prints_stacks() -> None:
    result = run(0.1, "time.sleep(15)")
    assert result.returncode == 1
    assert "Timeout" in result.stderr
    assert "in main" in result.stderr


def test_watchdog_does_not_end_a_running_process() -> None:
    assert run(1.2, "pass").returncode == 0
