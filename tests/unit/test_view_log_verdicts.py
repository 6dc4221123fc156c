"""Verdicts of a cluster's flights from the logs of its services."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Iterable, Mapping
from datetime import UTC, datetime
from typing import Any

import pytest
from fractus_runtime.kubernetes import Body, Key, KubeError, Page
from fractus_runtime.logs import CallerLogLimit, JsonFormatter
from fractus_services.decision_log import log_decision
from fractus_view import log_verdicts
from fractus_view.events import Event, Records, Verdict
from fractus_view.log_verdicts import LogVerdicts, parse_line

NOW_MS = 1_780_000_000_000
STAMP = "2026-05-28T20:26:40.000000000Z"
NAVIGATOR = "spiffe://fractus.dev/ns/demo/app/traffic/component/Navigator/instance/n"
REFUSED = {
    "kind": "call", "action": "deny", "caller": NAVIGATOR, "method": "Goto", "code": "InsideExclusionZone",
    "policies": ["school", "town"], "reason": "inside zone school (reason=none) of policy school",
}  # fmt: skip
TAKEN = {
    "kind": "takeover", "action": "returnToLaunch", "controller": "system", "code": "", "policies": [],
    "reason": "the stream broke",
}  # fmt: skip
TEXT = logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s")


def line(entry: Mapping[str, Any], caplog: pytest.LogCaptureFixture, formatter: logging.Formatter = TEXT) -> str:
    """Return the line that a service logs about an entry of its audit log, with a time stamp of the kubelet."""
    caplog.set_level(logging.INFO)
    caplog.clear()
    log_decision(entry)
    return f"{STAMP} {formatter.format(caplog.records[0])}"


@pytest.mark.parametrize("formatter", [TEXT, JsonFormatter()], ids=["text", "json"])
def test_refused_call_is_read_from_its_log_line(formatter: logging.Formatter, caplog: pytest.LogCaptureFixture) -> None:
    logged = parse_line("drone-1", line(REFUSED, caplog, formatter))
    assert logged is not None
    assert logged.caller == NAVIGATOR
    assert logged.verdict == Verdict(
        "drone-1", NOW_MS, "call", "Navigator", "Goto", "deny", "InsideExclusionZone",
        "inside zone school (reason=none) of policy school", ["school", "town"], None, None,
    )  # fmt: skip


def test_takeover_is_read_from_its_log_line(caplog: pytest.LogCaptureFixture) -> None:
    logged = parse_line("drone-1", line(TAKEN, caplog))
    assert logged is not None
    verdict = logged.verdict
    assert (verdict.kind, verdict.action, verdict.code) == ("takeover", "returnToLaunch", "")
    assert (verdict.reason, verdict.policies) == ("the stream broke", [])


def test_required_filters_are_read_from_their_log_line(caplog: pytest.LogCaptureFixture) -> None:
    entry = REFUSED | {"action": "correct", "method": "CaptureImage", "code": "", "filters": ["blurFaces", "black"]}
    logged = parse_line("drone-1", line(entry, caplog))
    assert logged is not None
    assert (logged.verdict.action, logged.verdict.method) == ("correct", "CaptureImage")
    assert logged.verdict.reason.endswith("; filters: blurFaces,black")


def test_alarm_of_the_monitor_is_read_from_its_log_line() -> None:
    text = "monitor: alarm raised (code=SpeedAboveLimit mode=GUIDED policies=slow reason=5 m/s)"
    logged = parse_line("drone-1", f"{STAMP} 2026-05-28 20:26:40,000 WARNING fractus_services.monitor: {text}")
    assert logged is not None
    verdict = logged.verdict
    assert (verdict.kind, verdict.action, verdict.code, verdict.policies) == (
        "monitor",
        "alarm",
        "SpeedAboveLimit",
        ["slow"],
    )


def test_number_of_suppressed_lines_is_no_part_of_the_reason(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    limit = CallerLogLimit(lambda: 0.0)
    for _ in range(60):
        log_decision(REFUSED)
    record = caplog.records[-1]
    for earlier in caplog.records[:-1]:
        limit.filter(earlier)
    limit._monotonic = lambda: 1_000.0
    assert limit.filter(record)
    logged = parse_line("drone-1", f"{STAMP} {TEXT.format(record)}")
    assert logged is not None
    assert "suppressed" in record.getMessage()
    assert logged.verdict.reason == REFUSED["reason"]


@pytest.mark.parametrize(
    "text",
    ["", "no time", f"{STAMP} ", f"{STAMP} {{", f"{STAMP} []", f'{STAMP} {{"message": 1}}', f"{STAMP} a b INFO c: policy: verdict (x)"],
)  # fmt: skip
def test_other_lines_contain_no_verdict(text: str) -> None:
    assert parse_line("drone-1", text) is None


class Cluster:
    """Fake API server with the pods and logs of services."""

    def __init__(self, *nodes: str) -> None:
        self.pods: list[Body] = [
            {
                "metadata": {
                    "namespace": "fractus-system", "name": f"fractus-mobility-{node}",
                    "labels": {"app.kubernetes.io/component": "mobility"},
                },
                "spec": {"nodeName": node}, "status": {"phase": "Running"},
            }
            for node in nodes
        ]  # fmt: skip
        self.lines: dict[str, list[str]] = {}
        self.refusal: KubeError | None = None
        self.requests: list[Mapping[str, str]] = []

    async def list_whole(self, *_: Any, **__: Any) -> Page:
        if self.refusal is not None:
            raise self.refusal
        return Page({"metadata": {}, "items": self.pods})

    async def log(self, pod: Key, params: Mapping[str, str], *, silence_s: float | None) -> AsyncGenerator[bytes, None]:
        assert silence_s is None
        self.requests.append(params)
        for text in self.lines.get(pod[1], []):
            yield text.encode()


class Published(list[Event]):
    """Published events."""

    def __init__(self) -> None:
        super().__init__()
        self._changed = asyncio.Event()

    def publish(self, events: Iterable[Event]) -> None:
        self.extend(events)
        self._changed.set()

    async def until(self, condition: Callable[[list[Event]], bool]) -> None:
        while not condition(self):
            self._changed.clear()
            await self._changed.wait()


@contextlib.asynccontextmanager
async def followed(
    cluster: Cluster, drones: set[str], monkeypatch: pytest.MonkeyPatch, namespace: str = ""
) -> AsyncIterator[Published]:
    """Follow the logs, and yield the published events."""
    for name in ("PODS_INTERVAL_S", "RETRY_S"):
        monkeypatch.setattr(log_verdicts, name, 0.01)
    events = Published()
    verdicts = LogVerdicts(
        cluster,  # type: ignore[arg-type]
        "fractus-system",
        namespace=namespace,
        drones=lambda: frozenset(drones),
        publish=events.publish,
        now_ms=lambda: NOW_MS + 60_000,
    )
    task = asyncio.create_task(verdicts.run())
    try:
        async with asyncio.timeout(20):
            yield events
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


def call(second: int, caller: str = NAVIGATOR) -> str:
    stamp = datetime.fromtimestamp(NOW_MS / 1000 + second, UTC).strftime("%Y-%m-%dT%H:%M:%S.000000000Z")
    message = f"policy: verdict (action=deny caller={caller} method=Goto code=X policies=- reason={second})"
    return f"{stamp} {json.dumps({'message': message})}"


def reasons(events: Iterable[Event]) -> list[str]:
    return [event.reason for event in events if isinstance(event, Verdict)]


def problem(events: Iterable[Event]) -> str:
    """Return the latest problem, or an empty string."""
    return next((e.verdicts_problem for e in reversed(list(events)) if isinstance(e, Records)), "")


async def test_verdict_is_published_once_although_its_log_is_read_repeatedly(monkeypatch: pytest.MonkeyPatch) -> None:
    cluster = Cluster("drone-1", "drone-2")
    log = cluster.lines["fractus-mobility-drone-1"] = [call(1)]
    cluster.lines["fractus-mobility-drone-2"] = [call(9)]
    async with followed(cluster, {"drone-1"}, monkeypatch) as events:
        await events.until(lambda events: reasons(events) == ["1"])
        log.append(call(2))
        await events.until(lambda events: len(reasons(events)) > 1)
        log.append(call(3))
        await events.until(lambda events: reasons(events)[-1] == "3")
    assert reasons(events) == ["1", "2", "3"], "drone-2 does not fly"
    assert problem(events) == ""
    assert cluster.requests[0]["container"] == "mobility"
    assert "sinceTime" not in cluster.requests[0]
    assert cluster.requests[1]["sinceTime"] == call(1).split()[0]


async def test_calls_of_other_namespaces_are_not_published(monkeypatch: pytest.MonkeyPatch) -> None:
    cluster = Cluster("drone-1")
    cluster.lines["fractus-mobility-drone-1"] = [call(1, NAVIGATOR.replace("/ns/demo/", "/ns/other/")), call(2)]
    async with followed(cluster, {"drone-1"}, monkeypatch, namespace="demo") as events:
        await events.until(lambda events: bool(reasons(events)))
    assert reasons(events) == ["2"]


async def test_missing_permission_is_reported_until_it_is_granted(monkeypatch: pytest.MonkeyPatch) -> None:
    cluster = Cluster("drone-1")
    cluster.refusal = KubeError(403, "Forbidden", "forbidden")
    async with followed(cluster, {"drone-1"}, monkeypatch) as events:
        await events.until(lambda events: bool(problem(events)))
        assert problem(events) == "no permission to read pods in namespace fractus-system; the role view is sufficient"
        cluster.refusal = None
        await events.until(lambda events: not problem(events))


async def test_drone_without_services_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    async with followed(Cluster("drone-1"), {"drone-1", "drone-2"}, monkeypatch) as events:
        await events.until(lambda events: bool(problem(events)))
    assert problem(events) == "no services in namespace fractus-system on drone-2"


async def test_unreadable_log_is_reported_with_its_drone(monkeypatch: pytest.MonkeyPatch) -> None:
    class Unreachable(Cluster):
        async def log(
            self, pod: Key, params: Mapping[str, str], *, silence_s: float | None
        ) -> AsyncGenerator[bytes, None]:
            raise KubeError(502, "BadGateway", "no route to host")
            yield b""

    async with followed(Unreachable("drone-1"), {"drone-1"}, monkeypatch) as events:
        await events.until(lambda events: bool(problem(events)))
    assert problem(events) == "drone-1: no route to host"
