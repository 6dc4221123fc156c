"""HTTP endpoint of metrics. Requests of any host must not disturb the process."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import threading
import time
from collections.abc import Iterable

import pytest
from fractus_cluster.ports import free_port
from fractus_runtime import metrics
from fractus_runtime.metrics import MAX_CONNECTIONS, BackgroundReader, gauge, serve_metrics
from prometheus_client import Metric
from scraping import get, values


def collect() -> list[Metric]:
    return [gauge("a", "One sample.", 1), gauge("b", "By colour.", {"red": 2.0, "blue": 3.0}, "colour")]


@pytest.mark.parametrize("host", ["", "127.0.0.1"])
async def test_endpoint_serves_metrics_and_no_other_path(host: str) -> None:
    port = free_port()
    async with serve_metrics(f"{host}:{port}", collect):
        status, body = await get(port)
        assert "200" in status
        assert values(body) == {("a",): 1.0, ("b", "red"): 2.0, ("b", "blue"): 3.0}
        assert "404" in (await get(port, "/"))[0]
    with pytest.raises(ConnectionRefusedError):
        await get(port)


async def test_endpoint_drops_silent_connections_after_the_timeout(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics, "REQUEST_TIMEOUT_S", 0.2)
    port = free_port()
    async with serve_metrics(f"127.0.0.1:{port}", collect):
        silent = [await asyncio.open_connection("127.0.0.1", port) for _ in range(2 * MAX_CONNECTIONS)]
        assert "200" in (await get(port))[0]
        for _, writer in silent:
            writer.close()


async def test_endpoint_accepts_a_limited_number_of_connections_at_once() -> None:
    port = free_port()
    async with serve_metrics(f"127.0.0.1:{port}", collect):
        silent = [await asyncio.open_connection("127.0.0.1", port) for _ in range(MAX_CONNECTIONS)]
        waiting = asyncio.create_task(get(port))
        done, _ = await asyncio.wait({waiting}, timeout=0.3)
        assert not done
        silent[0][1].close()
        assert "200" in (await waiting)[0]
        for _, writer in silent:
            writer.close()


async def test_endpoint_returns_500_and_continues_if_collection_fails(caplog: pytest.LogCaptureFixture) -> None:
    failures = [ValueError("value is missing")]

    def collect_or_fail() -> Iterable[Metric]:
        if failures:
            raise failures.pop()
        return collect()

    port = free_port()
    async with serve_metrics(f"127.0.0.1:{port}", collect_or_fail):
        assert "500" in (await get(port))[0]
        assert "value is missing" in caplog.text
        assert "200" in (await get(port))[0]


@pytest.mark.parametrize("listen", ["127.0.0.1:{}", "nowhere.invalid:1", "127.0.0.1:none", "nowhere:at-all"])
async def test_process_runs_without_metrics_if_the_address_cannot_be_bound(
    listen: str, caplog: pytest.LogCaptureFixture
) -> None:
    port = free_port()
    async with serve_metrics(f"127.0.0.1:{port}", collect), serve_metrics(listen.format(port), collect):
        assert "metrics: not served" in caplog.text
        assert "200" in (await get(port))[0]


async def test_endpoint_is_off_without_an_address() -> None:
    async with serve_metrics("", collect):
        assert len(asyncio.all_tasks()) == 1


async def test_address_in_use_is_retried_and_logged_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(metrics, "RETRY_S", 0.05)
    monkeypatch.setattr(metrics, "MAX_RETRY_S", 0.05)
    port = free_port()
    other = socket.create_server(("127.0.0.1", port))
    async with serve_metrics(f"127.0.0.1:{port}", collect):
        await asyncio.sleep(0.3)
        other.close()
        async with asyncio.timeout(10):
            while True:
                with contextlib.suppress(ConnectionError):
                    assert "200" in (await get(port))[0]
                    break
                await asyncio.sleep(0.05)
    assert len([record for record in caplog.records if record.levelname == "WARNING"]) == 1


def test_background_reader_does_not_wait_for_a_slow_read() -> None:
    readable = threading.Event()
    stored = [1.0]

    def read() -> float:
        readable.wait(10)
        return stored[0]

    readable.set()
    reader = BackgroundReader(read)
    assert reader() == 1.0
    readable.clear()
    stored[0] = 2.0
    before = threading.active_count()
    for _ in range(5):
        reader()
    assert threading.active_count() <= before + 1
    readable.set()
    deadline = time.monotonic() + 10
    while reader() != 2.0 and time.monotonic() < deadline:
        time.sleep(0.01)
    assert reader() == 2.0
