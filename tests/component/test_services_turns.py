"""Fairness of the event loop: long computations and many calls must not delay motion monitor, watchdog and heartbeats."""

from __future__ import annotations

import asyncio
import itertools
import math
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

import grpc
import pytest
from fractus_core.policy.decision_types import Call, TakeoffArgs, Verdict
from fractus_proto.v1 import mobility_pb2
from fractus_services import background, grpc_server
from fractus_services.auth import Caller
from fractus_services.background import in_slices
from fractus_services.grant_files import ActiveGrant
from fractus_services.mobility.flight import authorization, route_following
from fractus_services.mobility.rpc.handlers import MobilityHandlers
from google.rpc import error_details_pb2, status_pb2
from mobility_world import World, at, partial, refusal, spec, zone
from virtual_time import fly

WALL = (-40.0, 25.0, 40.0, 40.0)


class Clock:
    """Fake clock that advances by one millisecond with each reading."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def perf_counter(self) -> float:
        self.seconds += 0.001
        return self.seconds


class Context:
    """Fake gRPC context of one caller."""

    def __init__(self, grant: ActiveGrant) -> None:
        self.grant = grant

    def auth_context(self) -> ActiveGrant:
        return self.grant

    def time_remaining(self) -> float:
        return 5.0

    async def write(self, message: Any) -> None:
        """Discard the message."""

    async def abort(self, code: grpc.StatusCode, text: str, metadata: Any) -> None:
        status = status_pb2.Status()
        why = error_details_pb2.ErrorInfo()
        status.ParseFromString(dict(metadata)["grpc-status-details-bin"])
        for detail in status.details:
            if detail.Is(why.DESCRIPTOR):
                detail.Unpack(why)
        raise PermissionError(why.reason)


@pytest.fixture
def world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], World]:
    monkeypatch.setattr(grpc_server.Callers, "of", lambda _self, grant, _urgent: Caller(grant.identity, math.inf))
    return lambda: World(tmp_path)


def handlers_of(world: World) -> MobilityHandlers:
    return MobilityHandlers(
        world.service, world.control, world.streams, grants=world.grants, node="drone-1", clock=lambda: 1.8e9  # type: ignore[arg-type]
    )  # fmt: skip


def costly(world: World, method: str, monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Make each policy check of a method take 0.1 s of computing time. Return a list of the times of the checks."""
    judge = world.gate.judge
    clock = Clock()
    at_s = list[float]()
    monkeypatch.setattr(authorization, "time", clock)

    def slow(call: Call, *args: Any, **options: Any) -> Verdict:
        if call.method == method:
            clock.seconds += 0.1
            at_s.append(world.plane.now)
        return judge(call, *args, **options)

    monkeypatch.setattr(world.gate, "judge", slow)
    return at_s


async def test_long_computation_yields_to_other_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(background, "time", Clock())
    turns = 0

    async def other() -> None:
        nonlocal turns
        while True:
            turns += 1
            await asyncio.sleep(0)

    def long() -> Generator[None, None, str]:
        for _ in range(400):
            yield
        return "done"

    task = asyncio.ensure_future(other())
    assert await in_slices(long()) == "done"
    task.cancel()
    assert turns > 80, "the computation yields every four milliseconds"


def test_route_search_uses_fences_changed_during_search(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def flight() -> None:
        async with World(tmp_path, retraces=True) as world:
            grant = world.grants.put(partial())
            searches = 0

            async def slowly(search: Any) -> Any:
                nonlocal searches
                searches += 1
                if searches == 1:
                    world.grants.put(partial(zone("wall", "ignore", *WALL)))
                return await in_slices(search)

            monkeypatch.setattr(route_following, "in_slices", slowly)
            await world.drive(grant)
            assert searches > 2
            assert max(abs(x) for x, _, _ in world.plane.trace) > 41, (
                "the route leads around the wall from the first leg"
            )
            assert not [e for e in world.kinds("control") if e["action"] == "brake"]

    fly(flight)


def test_throttling_delays_driver_less_than_other_callers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            other = world.grants.put(spec(instance="app-viewer", **{"class": "passenger", "control": None}), "m2")
            await world.drive(grant)
            monkeypatch.setattr(authorization, "time", Clock())

            async def call_repeatedly(caller: Any, times: int) -> float:
                async def once() -> None:
                    await world.service.calls.throttle(caller)
                    world.service.calls.check(Call("GetPosition"), caller)

                begun = world.plane.now
                await asyncio.gather(*(once() for _ in range(times)))
                return world.plane.now - begun

            flood = asyncio.ensure_future(call_repeatedly(other, 101))
            assert await call_repeatedly(grant, 101) == pytest.approx(0.1, abs=0.02)
            assert not flood.done()
            assert await flood == pytest.approx(0.4, abs=0.05)

    fly(flight)


def test_takeoff_calls_are_throttled(world: Callable[[], World], monkeypatch: pytest.MonkeyPatch) -> None:
    async def flight() -> None:
        async with world() as w:
            grant = w.grants.put(spec())
            await w.drive(grant)
            await w.service.arm(grant)
            judged = costly(w, "Takeoff", monkeypatch)
            handlers = handlers_of(w)
            for _ in range(5):
                with pytest.raises(PermissionError, match="InvalidArgument"):
                    await handlers.Takeoff(mobility_pb2.TakeoffRequest(altitude_m=-5.0), Context(grant))
            assert len(judged) == 5
            assert min(b - a for a, b in itertools.pairwise(judged)) > 0.09

    fly(flight)


def test_takeoff_without_control_or_arming_is_refused_before_policy_check(
    world: Callable[[], World], monkeypatch: pytest.MonkeyPatch
) -> None:
    async def flight() -> None:
        async with world() as w:
            grant = w.grants.put(spec())
            judged = costly(w, "Takeoff", monkeypatch)

            async def why() -> str:
                async def begun() -> None:
                    w.service.take_off(grant, TakeoffArgs(10.0))

                return (await refusal(begun())).verdict.code

            assert await why() == "NotInControl"
            await w.drive(grant)
            assert await why() == "NotArmed"
            assert not judged

    fly(flight)


def test_throttle_delay_is_not_shortened_by_cheap_call(
    world: Callable[[], World], monkeypatch: pytest.MonkeyPatch
) -> None:
    async def flight() -> None:
        async with world() as w:
            grant = w.grants.put(spec())
            other = w.grants.put(spec(instance="app-other"), "m2")
            await w.up(grant)
            costly(w, "Goto", monkeypatch)
            for caller, rest_s in ((grant, 0.1), (other, 0.4)):
                await w.service.calls.throttle(caller)
                begun = w.plane.now
                w.service.calls.check(Call("Goto"), caller)
                w.service.calls.check(Call("Hover"), caller)
                await w.service.calls.throttle(caller)
                assert w.plane.now - begun == pytest.approx(rest_s, abs=0.02)

    fly(flight)


def test_throttled_call_is_replaced_by_later_call(world: Callable[[], World], monkeypatch: pytest.MonkeyPatch) -> None:
    async def flight() -> None:
        async with world() as w:
            grant = w.grants.put(spec())
            other = w.grants.put(spec(instance="app-other"), "m2")
            await w.up(grant)
            handlers = handlers_of(w)
            costly(w, "GetSpeed", monkeypatch)
            place = dict(zip(("latitude_deg", "longitude_deg", "altitude_m"), (*at(0, 90), 10.0), strict=True))
            goto = mobility_pb2.GotoRequest(target=place)
            hover = mobility_pb2.HoverRequest()

            def setpoint(east_mps: float) -> Any:
                velocity = {"east_mps": east_mps}
                return handlers.SetVelocity(mobility_pb2.SetVelocityRequest(velocity=velocity), Context(grant))

            async def waiting(*calls: Any) -> list[asyncio.Future[Any]]:
                """Start the calls in the given order, during the throttle delay that a policy check has caused."""
                w.service.calls.check(Call("GetSpeed"), grant)
                tasks = [asyncio.ensure_future(call) for call in calls]
                await asyncio.sleep(0.02)
                return tasks

            [stale] = await waiting(handlers.Goto(goto, Context(grant)))
            await handlers.Hover(hover, Context(grant))
            with pytest.raises(PermissionError, match="Replaced"):
                await stale
            assert w.control.motion is None
            assert math.hypot(*w.plane.velocity) < 0.1

            first, second, third = await waiting(setpoint(1.0), setpoint(2.0), setpoint(3.0))
            assert (await third).velocity.east_mps == pytest.approx(3.0)
            for replaced in (first, second):
                with pytest.raises(PermissionError, match="Replaced"):
                    await replaced

            [latest] = await waiting(handlers.Goto(goto, Context(grant)))
            for call in (handlers.Hover(hover, Context(other)), handlers.Goto(goto, Context(other))):
                with pytest.raises(PermissionError, match="NotInControl"):
                    await call
            await latest
            assert w.plane.xy == pytest.approx([0.0, 90.0], abs=2.0)

    fly(flight)
