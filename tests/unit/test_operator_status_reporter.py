"""Status reporter: conditions under which the status of an Application is written."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any, cast

import pytest
import yaml
from fractus_core.api.conditions import ConditionUpdate
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_operator.cache import ClusterCache
from fractus_operator.kinds import Body, Kind
from fractus_operator.parsing import Submitted, parse_application
from fractus_operator.status import StatusUpdate
from fractus_operator.status_reporter import StatusReporter
from fractus_operator.store import Conflict, KubeError, Store

INPUT = yaml.safe_load((Path(__file__).parents[1] / "golden" / "operator" / "input.yaml").read_text())
PLAN = DeploymentPlanSpec.model_validate(INPUT["plan"])
NOW = datetime(2026, 6, 1, 12, 0, tzinfo=UTC)
DONE = StatusUpdate("Completed", "done", (ConditionUpdate("Ready", "False", "MissionComplete", "done", progress=True),))


class Statuses:
    """Fake API server that stores statuses and Events of applications, or refuses all of them."""

    def __init__(self) -> None:
        self.refusal: KubeError | None = None
        self.written: list[Body] = []
        self.events: list[str] = []

    async def apply(self, _kind: Kind, body: Body, *, subresource: str) -> Body:
        assert subresource == "status"
        if self.refusal is not None:
            raise self.refusal
        self.written.append(body["status"])
        return {**INPUT["application"], **body, "metadata": {**INPUT["application"]["metadata"], **body["metadata"]}}

    async def create_event(self, _regarding: Body, *, reason: str, **_: Any) -> None:
        self.events.append(reason)


def new() -> tuple[Statuses, ClusterCache, StatusReporter, Submitted]:
    """Application without a status."""
    api = Statuses()
    cache = ClusterCache(cast(Store, None))
    submitted = parse_application({k: v for k, v in INPUT["application"].items() if k != "status"})
    cache.applications.record_write(submitted.key, submitted.body)
    return api, cache, StatusReporter(cast(Any, api), cache.applications, lambda: NOW), submitted


async def test_queued_rollout_is_reported() -> None:
    api, _, reporter, submitted = new()
    await reporter.report_queued(submitted, PLAN, 1)
    assert not api.written, "a short queue is not reported, because the rollout soon writes the first status"
    await reporter.report_queued(submitted, PLAN, 20)
    (status,) = api.written
    assert (status["phase"], status["conditions"][0]["reason"]) == ("Pending", "OperatorBusy")
    assert "20 other Applications" in status["message"]
    assert not api.events, "no Event is posted, to save a request"
    await reporter.report_queued(submitted, PLAN, 21)
    assert len(api.written) == 1, "an Application with a status is not reported as queued"


async def test_refused_first_status_is_ignored() -> None:
    api, _, reporter, submitted = new()
    api.refusal = KubeError(429, "TooManyRequests", "later")
    await reporter.report_queued(submitted, PLAN, 20)
    assert not reporter.last(submitted)


async def test_outcome_is_not_recorded_after_write_conflict() -> None:
    """The reporter must raise the conflict, because the next step deletes the Grants.

    The outcome would then be lost, and the mission would be flown again.
    """
    api, cache, reporter, submitted = new()
    api.refusal = Conflict(409, "Conflict", "it changed meanwhile")
    with pytest.raises(Conflict):
        await reporter.report(submitted, DONE)
    cache.applications._drop(submitted.key)
    await reporter.report(submitted, DONE)
    assert not reporter.last(submitted)


async def test_persistent_failure_replaces_outdated_message() -> None:
    """In this test, the status reports a queue, although a webhook now refuses all Deployments."""
    api, _, reporter, submitted = new()
    await reporter.report_queued(submitted, PLAN, 20)
    error = KubeError(500, "InternalError", "failed calling webhook")
    for attempts in (1, 2):
        await reporter.report_failure(submitted, attempts, error)
    assert len(api.written) == 1, "the first failures are not reported"
    for attempts in (3, 4):
        await reporter.report_failure(
            submitted, attempts, KubeError(500, "InternalError", f"failed calling webhook in {attempts} s")
        )
    _, status = api.written
    assert (status["phase"], [(c["type"], c["reason"]) for c in status["conditions"]]) == (
        "Pending",
        [("Deployed", "InternalError"), ("Ready", "InternalError")],
    )
    assert "failed calling webhook" in status["message"]
    assert api.events == ["InternalError"]


async def test_failure_report_keeps_flight_phase() -> None:
    api, _, reporter, submitted = new()
    ready = (ConditionUpdate("Ready", "True", "PodsReady"), ConditionUpdate("Deployed", "True", "Deployed"))
    await reporter.report(submitted, StatusUpdate("Flying", "it flies", ready, drone="drone-1", pods="3/3"))
    api.refusal = error = KubeError(429, "TooManyRequests", "later")
    await reporter.report_failure(submitted, 3, error)
    api.refusal = None
    await reporter.report_failure(submitted, 4, error)
    assert (api.written[1]["phase"], api.written[1]["drone"], api.written[1]["pods"]) == ("Flying", "drone-1", "3/3")
    assert [c["status"] for c in api.written[1]["conditions"]] == ["True", "False"]
    await reporter.report(submitted, DONE)
    await reporter.report_failure(submitted, 5, error)
    await reporter.report_failure(None, 5, error)
    assert len(api.written) == 3, "the outcome of a mission is always written"
