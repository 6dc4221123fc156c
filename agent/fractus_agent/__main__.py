"""Entry point of the agent: `python -m fractus_agent`."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import sys
from collections.abc import Mapping

from fractus_runtime import logs

from fractus_agent.agent import Agent
from fractus_agent.settings import BadSetting, MissingSetting, Settings
from fractus_agent.store import Store, Unconfigured, connect

log = logging.getLogger("fractus_agent")


async def serve(settings: Settings) -> None:
    """Run the agent until SIGTERM or SIGINT.

    Raises:
        Unconfigured: There is no service account and no KUBECONFIG.
    """
    store = Store(await connect(), settings.node)
    task = asyncio.create_task(Agent(settings, store).run())
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, task.cancel)
    try:
        with contextlib.suppress(asyncio.CancelledError):
            await task
    finally:
        await store.close()


def main(environment: Mapping[str, str] = os.environ) -> int:
    """Run the agent of this node, and return the exit code."""
    try:
        settings = Settings.from_environment(environment)
    except (MissingSetting, BadSetting) as error:
        print(error, file=sys.stderr)
        return 2
    try:
        logs.configure(settings.log_level, settings.log_format)
    except ValueError as error:
        print(f"FRACTUS_LOG_LEVEL, FRACTUS_LOG_FORMAT: {error}", file=sys.stderr)
        return 2
    log.info("agent: started (node=%s)", settings.node)
    try:
        asyncio.run(serve(settings))
    except Unconfigured as error:
        log.error("agent: %s", error)  # noqa: TRY400 (one line is enough)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
