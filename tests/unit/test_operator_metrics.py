"""What the operator tells Prometheus."""

from __future__ import annotations

import asyncio
import re
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest
from fractus_cluster.ports import free_port
from fractus_operator import metrics
from fractus_operator.cluster.kinds import Key
from fractus_operator.cluster.store import KubeError
from fractus_operator.inventory.live import LiveInventory
from fractus_operator.inventory.subscriptions import Subscriptions
from fractus_operator.metrics import REGISTRY, Observed
from fractus_operator.reconcile.applications import Applications, BeingDeleted
from fractus_operator.reconcile.worklist import Worklist
from prometheus_client.parser import text_string_to_metric_families

DOCS = Path(__file__).parents[2] / "docs" / "metrics.md"


async def get(port: int, path: str) -> tuple[str, str]:
    """The first line and the body of an answer."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(f"GET {path} HTTP/1.1\r\nHost: x\r\n\r\n".encode())
    async with asyncio.timeout(20.0):
        head, _, body = (await reader.read()).decode().partition("\r\n\r\n")
    writer.close()
    return head.splitlines()[0], body


def observed() -> Observed:
    return Observed(
        lambda: 6.5, lambda: {"drones": (True, 3.0)}, lambda: ["Flying", "Flying", "Queued"], lambda: ["flying"]
    )


async def test_every_metric_is_described_and_told() -> None:
    with metrics.reconciling("application"), metrics.phase("plan"):
        pass
    port = free_port()
    async with metrics.serving(port, observed):
        first, body = await get(port, "/metrics")
        assert "404" in (await get(port, "/"))[0]
    assert "200" in first
    told = {f.name + ("_total" if f.type == "counter" else ""): f for f in text_string_to_metric_families(body)}
    rows = {
        name: (kind, set(re.findall(r"`(\w+)`", labels)))
        for name, kind, labels in re.findall(r"^\| `(\w+)` \| (\w+) \| (.*?) ?\|", DOCS.read_text(), re.MULTILINE)
    }
    assert {name: family.type for name, family in told.items()} == {name: kind for name, (kind, _) in rows.items()}
    for name, family in told.items():
        assert {label for s in family.samples for label in s.labels} - {"le"} <= rows[name][1], name
    values = {(s.name, *s.labels.values()): s.value for f in told.values() for s in f.samples}
    assert values["fractus_operator_lease_left_seconds",] == 6.5
    assert values["fractus_operator_watch_open", "drones"] == 1
    assert values["fractus_applications", "Flying"] == 2


@pytest.mark.parametrize(("error", "reason"), [(KubeError(403, "Forbidden", "no"), "Forbidden"), (ValueError(), "Bug")])
async def test_a_step_that_fails_is_counted(error: Exception, reason: str) -> None:
    failed = asyncio.Event()

    async def reconcile(_: object) -> None:
        failed.set()
        raise error

    def count() -> float:
        return (
            REGISTRY.get_sample_value("fractus_operator_reconcile_errors_total", {"kind": "thing", "reason": reason})
            or 0.0
        )

    before = count()
    worklist = Worklist("thing", reconcile)
    worklist.add(("", "a"))
    task = asyncio.create_task(worklist.run())
    async with asyncio.timeout(20.0):
        await failed.wait()
        while not worklist.failures:  # noqa: ASYNC110 (nothing tells when)
            await asyncio.sleep(0)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    assert count() == before + 1


async def test_without_a_port_nothing_is_told() -> None:
    async with metrics.serving(0, observed):
        pass


async def test_an_application_that_is_being_deleted_is_no_failure() -> None:
    class Leaving(Applications):
        def __init__(self) -> None:
            async def synced() -> None:
                pass

            self._live = cast(LiveInventory, SimpleNamespace(synced=synced, subscriptions=Subscriptions()))

        async def reconcile(self, key: Key) -> float:
            raise BeingDeleted

    def count() -> float | None:
        labels = {"kind": "application", "reason": "Bug"}
        return REGISTRY.get_sample_value("fractus_operator_reconcile_errors_total", labels)

    before = count()
    await Leaving().follow(("ns", "a"), lambda: False)
    assert count() == before
