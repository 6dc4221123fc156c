"""An agent whose event loop hangs ends itself and says where it hung."""

import subprocess
import sys

PROGRAM = """
import asyncio, time
from fractus_agent.watchdog import guard
async def main():
    task = asyncio.create_task(guard(0.05, 0.5))
    await asyncio.sleep({healthy})
    {then}
    task.cancel()
asyncio.run(main())
"""


def run(healthy: float, then: str) -> subprocess.CompletedProcess[str]:
    program = PROGRAM.format(healthy=healthy, then=then)
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=20, check=False)


def test_a_hang_ends_the_process_with_stacks() -> None:
    ended = run(0.1, "time.sleep(15)")
    assert ended.returncode == 1
    assert "Timeout" in ended.stderr
    assert "in main" in ended.stderr


def test_a_loop_that_turns_lives_on() -> None:
    assert run(1.2, "pass").returncode == 0
