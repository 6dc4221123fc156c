"""Ends the agent when its event loop hangs, so that kubelet starts it again; needs no probe, port or process."""

from __future__ import annotations

import asyncio
import faulthandler

BEAT_INTERVAL_S = 10.0
HANG_TIMEOUT_S = 60.0


async def guard(beat_s: float = BEAT_INTERVAL_S, hang_s: float = HANG_TIMEOUT_S) -> None:
    """Beat until cancelled; once beats stay out for hang_s, the process prints all stacks to stderr and exits with 1."""
    try:
        while True:
            faulthandler.dump_traceback_later(hang_s, exit=True)
            await asyncio.sleep(beat_s)
    finally:
        faulthandler.cancel_dump_traceback_later()
