"""What answers Prometheus: it is asked by anyone who reaches it, and never gets in the way of what it observes."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import threading
import time

import pytest
from exposed import get, values
from fractus_cluster.ports import free_port
from fractus_runtime import exposition
from fractus_runtime.exposition import MAX_CONNECTIONS, LastRead, serving
from fractus_runtime.figures import gauge, text_of


def text() -> bytes:
    return text_of([gauge("a", "Alone.", 1), gauge("b", "By colour.", {"red": 2.0, "blue": 3.0}, "colour")])


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


async def test_a_taken_address_is_tried_again_and_told_of_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(exposition, "RETRY_S", 0.05)
    monkeypatch.setattr(exposition, "MAX_RETRY_S", 0.05)
    port = free_port()
    taken = socket.create_server(("127.0.0.1", port))
    async with serving(f"127.0.0.1:{port}", text):
        await asyncio.sleep(0.3)
        taken.close()
        async with asyncio.timeout(10):
            while True:
                with contextlib.suppress(ConnectionError):
                    assert "200" in (await get(port))[0]
                    break
                await asyncio.sleep(0.05)
    assert len([record for record in caplog.records if record.levelname == "WARNING"]) == 1


async def test_no_address_is_told_of_and_left_alone(caplog: pytest.LogCaptureFixture) -> None:
    async with serving("nowhere:at-all", text):
        assert "not served" in caplog.text


def test_a_figure_on_disk_keeps_no_one_waiting() -> None:
    hangs, found = threading.Event(), [1.0]

    def read() -> float:
        hangs.wait(10)
        return found[0]

    hangs.set()
    figure = LastRead(read)
    assert figure() == 1.0
    hangs.clear()
    found[0] = 2.0
    before = threading.active_count()
    for _ in range(5):
        figure()
    assert threading.active_count() <= before + 1
    hangs.set()
    deadline = time.monotonic() + 10
    while figure() != 2.0 and time.monotonic() < deadline:
        time.sleep(0.01)
    assert figure() == 2.0
