"""What answers Prometheus: it is asked by anyone who reaches it, and never gets in the way of what it observes."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator

import pytest
from exposed import get, values
from fractus_cluster.ports import free_port
from fractus_observe import exposition
from fractus_observe.exposition import MAX_CONNECTIONS, Observed, gauge, serving, text_of
from prometheus_client import CollectorRegistry
from prometheus_client.core import Metric


def text() -> bytes:
    def figures() -> Iterator[Metric]:
        yield gauge("a", "Alone.", 1)
        yield gauge("b", "By colour.", {"red": 2.0, "blue": 3.0}, "colour")

    registry = CollectorRegistry()
    registry.register(Observed(figures))
    return text_of(registry)


@pytest.mark.parametrize("host", ["", "127.0.0.1"])
async def test_it_answers_for_metrics_alone(host: str) -> None:
    port = free_port()
    async with serving(f"{host}:{port}", text):
        first, body = await get(port)
        assert "200" in first
        assert values(body) == {("a",): 1.0, ("b", "red"): 2.0, ("b", "blue"): 3.0}
        assert "404" in (await get(port, "/"))[0]
    with pytest.raises(ConnectionRefusedError):
        await get(port)


async def test_peers_that_say_nothing_keep_no_one_waiting_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exposition, "REQUEST_TIMEOUT_S", 0.2)
    port = free_port()
    async with serving(f"127.0.0.1:{port}", text):
        silent = [await asyncio.open_connection("127.0.0.1", port) for _ in range(2 * MAX_CONNECTIONS)]
        assert "200" in (await get(port))[0]
        for _, writer in silent:
            writer.close()


async def test_a_figure_that_cannot_be_had_ends_nothing(caplog: pytest.LogCaptureFixture) -> None:
    broken = [True]

    def sometimes() -> bytes:
        if broken.pop():
            raise ValueError("no such figure")
        return text()

    port = free_port()
    async with serving(f"127.0.0.1:{port}", sometimes):
        assert "500" in (await get(port))[0]
        assert "no such figure" in caplog.text
        broken.append(False)
        assert "200" in (await get(port))[0]


@pytest.mark.parametrize("listen", ["127.0.0.1:{}", "nowhere.invalid:1", "127.0.0.1:none"])
async def test_an_address_that_cannot_be_bound_costs_the_metrics_alone(
    listen: str, caplog: pytest.LogCaptureFixture
) -> None:
    port = free_port()
    async with serving(f"127.0.0.1:{port}", text), serving(listen.format(port), text):
        assert "metrics: not served" in caplog.text
        assert "200" in (await get(port))[0]


async def test_without_an_address_nothing_is_served() -> None:
    async with serving("", text):
        assert len(asyncio.all_tasks()) == 1
