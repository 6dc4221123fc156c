"""Requests of message rates: if they have no effect, the service repeats them at increasing intervals."""

from __future__ import annotations

import itertools

from fractus_services.mobility.mavlink.telemetry_requests import (
    CHECK_PERIOD_S,
    MAX_CHECK_PERIOD_S,
    MAX_NEVER_RECEIVED,
    RATES_HZ,
    TelemetryRates,
)

STEP_S = 0.5


class SlowAutopilot:
    """Fake autopilot. It accepts every requested rate, but sends each message only once a second."""

    def __init__(self, *missing: str) -> None:
        self.messages = RATES_HZ.keys() - set(missing)
        self.now = 0.0
        self.requests: list[tuple[float, int]] = []

    async def command(self, command: int, *params: float, attempts: int = 1) -> None:
        self.requests.append((self.now, command))


async def request_times(
    rates: TelemetryRates, autopilot: SlowAutopilot, until_s: float, *, flying: bool
) -> list[float]:
    """Return the times of all requests until `until_s`. The service checks the rates twice a second."""
    while autopilot.now < until_s:
        await rates.request(autopilot, flying)
        autopilot.now += STEP_S
        if autopilot.now % 1.0 == 0.0:
            for name in autopilot.messages:
                rates.take(name)
    return sorted({at for at, _ in autopilot.requests})


async def test_rates_are_requested_less_and_less_often_from_a_slow_autopilot() -> None:
    rates = TelemetryRates()
    autopilot = SlowAutopilot()
    times = await request_times(rates, autopilot, 200.0, flying=True)
    intervals = [after - before for before, after in itertools.pairwise(times)]
    assert intervals[0] == CHECK_PERIOD_S
    assert all(later in {2 * before, MAX_CHECK_PERIOD_S} for before, later in itertools.pairwise(intervals))
    assert intervals[-1] == MAX_CHECK_PERIOD_S
    assert len(autopilot.requests) == len(times) * len(RATES_HZ)


async def test_landing_resets_the_check_period() -> None:
    rates = TelemetryRates()
    autopilot = SlowAutopilot()
    await request_times(rates, autopilot, 100.0, flying=True)
    times = await request_times(rates, autopilot, 130.0, flying=False)
    assert times[-1] == 100.0, "on the ground, 1 Hz is a sufficient share of the requested rate"
    times = await request_times(rates, autopilot, 150.0, flying=True)
    assert [at for at in times if at > 100.0] == [130.0, 130.0 + CHECK_PERIOD_S, 130.0 + 3 * CHECK_PERIOD_S]


async def test_message_that_never_arrives_is_not_requested_indefinitely() -> None:
    times = await request_times(TelemetryRates(), SlowAutopilot("EXTENDED_SYS_STATE"), 600.0, flying=False)
    assert len(times) == 1 + MAX_NEVER_RECEIVED
