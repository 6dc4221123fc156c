"""Decision log: one log line for each decision except plain permissions."""

from __future__ import annotations

import json
import logging
from typing import Any

import pytest
from fractus_core.api.names import component_identity
from fractus_runtime.logs import BURST, CallerLogLimit, JsonFormatter
from fractus_services.decision_log import log_decision

CALL = {
    "time": "2026-11-24T12:00:00+00:00", "kind": "call", "caller": "spiffe://fractus.dev/a", "method": "Goto",
    "args": {"lat": 48.1234}, "action": "deny", "code": "InsideExclusionZone", "reason": "policy campus forbids 100% of it",
    "policies": ["campus", "fence"], "takeover": None, "result": {}, "lat": 48.5678, "lon": 11.5, "alt": 20.0,
}  # fmt: skip
CHANGE = {"kind": "takeover", "action": "return", "controller": "system", "code": "", "reason": "", "policies": []}


def lines(caplog: pytest.LogCaptureFixture, *entries: dict[str, Any]) -> list[str]:
    caplog.set_level(logging.DEBUG, "fractus_services.decision_log")
    caplog.clear()
    for entry in entries:
        log_decision(entry)
    return [f"{record.levelname} {record.getMessage()}" for record in caplog.records]


@pytest.mark.parametrize(("entry", "line"), [
    (CALL, "WARNING policy: verdict (action=deny caller=spiffe://fractus.dev/a method=Goto code=InsideExclusionZone "
           "policies=campus,fence reason=policy campus forbids 100% of it)"),
    (CALL | {"action": "correct", "code": "AltitudeAboveLimit", "policies": [], "reason": ""},
     "INFO policy: verdict (action=correct caller=spiffe://fractus.dev/a method=Goto code=AltitudeAboveLimit policies=- reason=-)"),
    (CALL | {"action": "takeover"},
     "WARNING policy: verdict (action=takeover caller=spiffe://fractus.dev/a method=Goto code=InsideExclusionZone "
     "policies=campus,fence reason=policy campus forbids 100% of it)"),
    (CALL | {"method": "CaptureImage", "filters": []},
     "WARNING policy: verdict (action=deny caller=spiffe://fractus.dev/a method=CaptureImage code=InsideExclusionZone "
     "policies=campus,fence reason=policy campus forbids 100% of it)"),
    (CALL | {"method": "CaptureImage", "action": "correct", "filters": ["blurFaces", "black"]},
     "INFO policy: filters required (action=correct caller=spiffe://fractus.dev/a method=CaptureImage filters=blurFaces,black "
     "policies=campus,fence reason=policy campus forbids 100% of it)"),
    (CHANGE, "WARNING control: return (kind=takeover controller=system code=- policies=- reason=-)"),
    (CHANGE | {"kind": "control", "action": "granted",
               "controller": component_identity("default", "patrol", "a", "patrol-a"), "reason": "control point 1", "policies": ["p"]},
     "INFO control: granted (kind=control controller=a code=- policies=p reason=control point 1)"),
])  # fmt: skip
def test_decision_log_line_has_verdict_caller_and_reason(
    caplog: pytest.LogCaptureFixture, entry: dict[str, Any], line: str
) -> None:
    assert lines(caplog, entry) == [line]


@pytest.mark.parametrize("entry", [
    CALL | {"action": "allow"}, CALL | {"kind": "check"}, {"kind": "monitor", "action": "deny"}, {"kind": "state", "lat": 1.0},
])  # fmt: skip
def test_decision_log_omits_permissions_dry_runs_and_states(
    caplog: pytest.LogCaptureFixture, entry: dict[str, Any]
) -> None:
    assert lines(caplog, entry) == []


def test_decision_log_json_has_fields(caplog: pytest.LogCaptureFixture) -> None:
    lines(caplog, CALL)
    assert json.loads(JsonFormatter().format(caplog.records[0]))["fields"] == {
        "action": "deny", "caller": "spiffe://fractus.dev/a", "method": "Goto", "code": "InsideExclusionZone",
        "policies": "campus,fence", "reason": "policy campus forbids 100% of it",
    }  # fmt: skip


def test_flood_of_refusals_of_one_caller_does_not_hide_another_caller(caplog: pytest.LogCaptureFixture) -> None:
    limit = CallerLogLimit(lambda: 1.0)
    lines(caplog, *[CALL] * (BURST + 500), CALL | {"caller": "spiffe://fractus.dev/b"})
    written = [record.getMessage() for record in caplog.records if limit.filter(record)]
    assert len(written) == BURST + 1
    assert "caller=spiffe://fractus.dev/b" in written[-1]
