"""Streams that were asked for without success are asked for again, more and more seldom."""

from __future__ import annotations

import itertools

from fractus_services.mobility.mavlink.streams import LOOK_S, MAX_LOOK_S, MAX_UNHEARD, STREAMS, Streams

STEP_S = 0.5


class SlowAutopilot:
    """Accepts every rate, and sends each message that it has once a second, whatever it is asked for."""

    def __init__(self, *lacks: str) -> None:
        self.has = STREAMS.keys() - set(lacks)
        self.now = 0.0
        self.asked: list[tuple[float, int]] = []

    async def command(self, command: int, *params: float, attempts: int = 1) -> None:
        self.asked.append((self.now, command))


async def asks(streams: Streams, autopilot: SlowAutopilot, until_s: float, *, flying: bool) -> list[float]:
    """When they are asked for until a moment, as the service looks at them twice a second."""
    while autopilot.now < until_s:
        await streams.ask(autopilot, flying)
        autopilot.now += STEP_S
        if autopilot.now % 1.0 == 0.0:
            for name in autopilot.has:
                streams.take(name)
    return sorted({at for at, _ in autopilot.asked})


async def test_a_slow_autopilot_is_not_asked_all_the_time() -> None:
    streams, autopilot = Streams(), SlowAutopilot()
    at = await asks(streams, autopilot, 200.0, flying=True)
    waited = [after - before for before, after in itertools.pairwise(at)]
    assert waited[0] == LOOK_S
    assert all(later in {2 * before, MAX_LOOK_S} for before, later in itertools.pairwise(waited))
    assert waited[-1] == MAX_LOOK_S
    assert len(autopilot.asked) == len(at) * len(STREAMS)


async def test_a_landing_makes_it_look_early_again() -> None:
    streams, autopilot = Streams(), SlowAutopilot()
    await asks(streams, autopilot, 100.0, flying=True)
    at = await asks(streams, autopilot, 130.0, flying=False)
    assert at[-1] == 100.0  # four a second were asked for: one is enough
    at = await asks(streams, autopilot, 150.0, flying=True)
    assert [moment for moment in at if moment > 100.0] == [130.0, 130.0 + LOOK_S, 130.0 + 3 * LOOK_S]


async def test_a_stream_that_never_comes_is_not_asked_for_indefinitely() -> None:
    streams, autopilot = Streams(), SlowAutopilot("EXTENDED_SYS_STATE")
    at = await asks(streams, autopilot, 600.0, flying=False)
    assert len(at) == 1 + MAX_UNHEARD
