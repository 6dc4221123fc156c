"""Check before uninstallation: Fractus may be removed if no Application exists and no drone is in the air."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
from fractus_operator import uninstall_check
from fractus_operator.store import KubeError, NotFound, Store
from fractus_operator.uninstall_check import check, objection


def application(name: str, *finalizers: str) -> dict[str, Any]:
    return {"metadata": {"name": name, "namespace": "default", "finalizers": list(finalizers)}}


def drone(name: str, state: str | None) -> dict[str, Any]:
    return {"metadata": {"name": name}, "status": {"flightState": state} if state else {}}


def test_uninstall_is_allowed_when_all_drones_are_on_the_ground() -> None:
    drones = [drone("a", "inactive"), drone("b", "charging"), drone("c", None), {"metadata": {"name": "d"}}]
    assert objection([], drones) == ""
    assert objection([application("new"), application("other", "example.com/else")], drones) == ""


def test_uninstall_names_remaining_applications() -> None:
    message = objection([application("patrol", "fractus.dev/teardown"), application("new")], [])
    assert "default/patrol" in message
    assert "default/new" not in message
    assert "kubectl delete applications" in message


@pytest.mark.parametrize("state", ["flying", "returning"])
def test_uninstall_names_drones_in_flight(state: str) -> None:
    message = objection([], [drone("drone-1", state), drone("drone-2", "inactive")])
    assert f"drone-1 ({state})" in message
    assert "drone-2" not in message


def test_uninstall_uses_last_state_of_stale_drone() -> None:
    silent = {"metadata": {"name": "drone-1"}, "status": {"flightState": "unknown", "lastFlightState": "landing"}}
    assert "drone-1 (unknown)" in objection([], [silent])
    silent["status"]["lastFlightState"] = "inactive"
    assert objection([], [silent]) == ""


def test_uninstall_shortens_long_lists() -> None:
    message = objection([], [drone(f"d{i}", "flying") for i in range(9)])
    assert "d4 (flying) and 4 more" in message


def test_uninstall_names_drone_that_may_have_taken_off() -> None:
    last_seen = "2026-01-01T00:00:00Z"
    doubtful = drone("drone-1", "inactive")
    doubtful["status"] |= {"lastSeen": last_seen, "conditions": [{"type": "OnMission", "status": "Unknown"}]}
    assert "drone-1 may have taken off" in objection([], [doubtful])
    flying = drone("drone-2", "flying")
    flying["status"]["lastSeen"] = last_seen
    for body in (doubtful, flying):
        body["metadata"]["annotations"] = {"fractus.dev/grounded": "2025-12-31T00:00:00Z"}
    assert "drone-2" in objection([], [doubtful, flying])
    for body in (doubtful, flying):
        body["metadata"]["annotations"] = {"fractus.dev/grounded": last_seen}
    assert objection([], [doubtful, flying]) == ""


async def test_uninstall_is_refused_without_response(monkeypatch: pytest.MonkeyPatch) -> None:
    class Silent:
        async def list(self, _: object) -> None:
            await asyncio.Event().wait()

        async def aclose(self) -> None:
            pass

    async def connect() -> Silent:
        return Silent()

    monkeypatch.setattr(Store, "connect", connect)
    monkeypatch.setattr(uninstall_check, "_REPORTS_S", 0.05)
    assert "the API server did not respond" in await check()


class Lists:
    """Fake API server. For each kind, its list request returns given objects or raises a given error."""

    def __init__(self, **of: Any) -> None:
        self.of = of

    async def list(self, kind: Any) -> list[Any]:
        answer = self.of[kind.name]
        if isinstance(answer, KubeError):
            raise answer
        return list(answer)

    async def aclose(self) -> None:
        pass


async def test_uninstall_is_allowed_without_kinds(monkeypatch: pytest.MonkeyPatch) -> None:
    """If the CRDs are removed before the chart, the missing kinds must not block the removal of the chart."""
    missing = NotFound(404, "NotFound", "the server could not find the requested resource")
    lists = Lists(Application=missing, Drone=missing)

    async def connect() -> Lists:
        return lists

    monkeypatch.setattr(Store, "connect", connect)
    assert await check() == ""
    lists.of["Drone"] = [drone("drone-1", "flying")]
    assert "drone-1 (flying)" in await check()
    lists.of["Drone"] = KubeError(403, "Forbidden", "it may not list drones")
    with pytest.raises(KubeError):
        await check()


async def test_uninstall_of_one_drone_ignores_other_drones_and_applications(monkeypatch: pytest.MonkeyPatch) -> None:
    lists = Lists(Application=[application("patrol", "fractus.dev/teardown")], Drone=[drone("other", "flying")])

    async def connect() -> Lists:
        return lists

    monkeypatch.setattr(Store, "connect", connect)
    assert await check("drone-1") == ""
    lists.of["Drone"].append(drone("drone-1", "flying"))
    assert "Fractus still flies drone-1 (flying)" in await check("drone-1")
    assert "default/patrol" in await check()
