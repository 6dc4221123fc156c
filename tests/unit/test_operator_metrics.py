"""Prometheus metrics of the operator."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import cast

import pytest
from fractus_operator import operator_metrics
from fractus_operator.application_controller import ApplicationController, BeingDeleted
from fractus_operator.cache import ClusterCache
from fractus_operator.kinds import Key
from fractus_operator.operator_metrics import MetricsSource
from fractus_operator.store import KubeError
from fractus_operator.work_queue import Subscriptions, WorkQueue
from fractus_runtime.metrics import metrics_text
from scraping import assert_documented, values


def source() -> MetricsSource:
    return MetricsSource(
        lambda: 6.5, lambda: {"drones": (True, 3.0)}, lambda: ["Flying", "Flying", "Queued"], lambda: ["flying"], 2e9
    )


def failures(kind: str, reason: str) -> float:
    text = metrics_text(source().collect()).decode()
    return values(text).get(("fractus_operator_reconcile_errors_total", kind, reason), 0.0)


def test_every_metric_is_documented() -> None:
    with operator_metrics.reconciling("application"), operator_metrics.phase("plan"):
        pass
    text = metrics_text(source().collect()).decode()
    assert_documented(text, "Operator")
    samples = values(text)
    assert samples["fractus_operator_lease_left_seconds",] == 6.5
    assert samples["fractus_operator_watch_open", "drones"] == 1
    assert samples["fractus_applications", "Flying"] == 2
    assert samples["fractus_certificate_expiry_timestamp_seconds",] == 2e9


@pytest.mark.parametrize(("error", "reason"), [(KubeError(403, "Forbidden", "no"), "Forbidden"), (ValueError(), "Bug")])
async def test_failed_step_is_counted(error: Exception, reason: str) -> None:
    failed = asyncio.Event()

    async def reconcile(_: object) -> None:
        failed.set()
        raise error

    before = failures("thing", reason)
    work_queue = WorkQueue("thing", reconcile)
    work_queue.add(("", "a"))
    task = asyncio.create_task(work_queue.run())
    async with asyncio.timeout(20.0):
        await failed.wait()
        while not work_queue.failures:  # noqa: ASYNC110 (there is no event to wait for)
            await asyncio.sleep(0)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    assert failures("thing", reason) == before + 1


async def test_deletion_is_not_counted_as_failure() -> None:
    class Leaving(ApplicationController):
        def __init__(self) -> None:
            async def synced() -> None:
                pass

            self._cache = cast(ClusterCache, SimpleNamespace(synced=synced, subscriptions=Subscriptions()))

        async def reconcile(self, key: Key) -> float:
            raise BeingDeleted

    before = failures("application", "Bug")
    await Leaving().follow(("ns", "a"), lambda: False)
    assert failures("application", "Bug") == before
