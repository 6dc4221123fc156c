"""Zones with a schedule have no effect outside it."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from fractus_core.policy.decision_types import Call
from policy_world import ask, at, box, compiled, goto, policy, zone

NOW = datetime.fromtimestamp(at().time_s, tz=UTC)
OFF = [{"days": [("Mon", "Tue", "Wed", "Thu", "Fri", "Sat", "Sun")[(NOW.weekday() + 3) % 7]]}]
ON = [{"days": [("Mon", "Tue", "Wed", "Thu", "Fri", "Sat", "Sun")[NOW.weekday()]]}]


def scheduled(name: str, area: dict[str, Any], schedule: list[dict[str, Any]]) -> dict[str, Any]:
    return {**zone(name, area), "schedule": schedule}


def test_exclusion_zone_applies_only_while_active() -> None:
    def verdict(schedule: list[dict[str, Any]]) -> str:
        verdicts = policy("no-fly", "GeofenceControl", "exclusion", [scheduled("z", box(20, -9, 40, 9), schedule)])
        return ask(compiled(verdicts), goto(30, 0)).action

    assert verdict([]) != "allow"
    assert verdict(ON) != "allow"
    assert verdict(OFF) == "allow"
    assert verdict([*OFF, *ON]) != "allow"


def test_inactive_inclusion_zone_permits_nothing() -> None:
    def verdict(schedule: list[dict[str, Any]]) -> str:
        verdicts = policy("keep-in", "GeofenceControl", "inclusion", [scheduled("z", box(-90, -90, 90, 90), schedule)])
        return ask(compiled(verdicts), goto(10, 0)).action

    assert verdict(ON) == "allow"
    assert verdict(OFF) != "allow"


def test_method_is_granted_in_zone_only_while_active() -> None:
    def code(schedule: list[dict[str, Any]]) -> str | None:
        position = policy(
            "h", "AccessControl", "grant", [scheduled("z", box(-9, -9, 9, 9), schedule)], methods=["Hover"]
        )
        return ask(compiled(position), Call("Hover"), at(0, 0)).code

    assert code(ON) != "MethodNotGrantedHere"
    assert code(OFF) == "MethodNotGrantedHere"
