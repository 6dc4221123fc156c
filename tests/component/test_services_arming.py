"""Arming: preconditions, concurrent requests, retries, and changes of the failsafe verification during arming."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest
from fractus_core.api.grants import GrantSpec
from fractus_core.control import StreamState
from fractus_core.control.events import Airborne, ArmingRequested
from fractus_core.policy.decision_types import Airframe, TakeoffArgs
from fractus_services.errors import AutopilotError
from fractus_services.mobility.autopilot import FailsafeStatus
from mobility_world import BRAKE, World, area, end, partial, refusal, spec, touring
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from virtual_time import fly


def altitude(upper_m: float) -> dict[str, Any]:
    limit = {"type": "LimitControl", "kind": "altitude", "upperLimit": upper_m}
    return {"name": "altitude", "spec": limit}


class Slow:
    """Slow replacement of the method that loads the fence.

    `began_armed` records for each call if the drone was armed when the call began.
    """

    def __init__(self, world: World) -> None:
        self._world = world
        self.began_armed: list[bool] = []

    async def __call__(self, _spec: GrantSpec, *, retraces: bool) -> None:
        del retraces
        self.began_armed.append(self._world.plane.vehicle.armed)
        await asyncio.sleep(4)
        self._world.fence.raised = True


def test_arming_happens_once_for_two_concurrent_requests(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.drive(grant)
            slow = world.fence.raise_around = Slow(world)
            first, second = (asyncio.ensure_future(world.service.arm(grant)) for _ in range(2))
            await first
            await end(world.service.take_off(grant, TakeoffArgs(10.0)))
            await second
            assert slow.began_armed == [False], "no flight is prepared while the drone is armed"
            assert world.plane.commands.count(mavlink.MAV_CMD_COMPONENT_ARM_DISARM) == 1
            assert world.plane.vehicle.armed

    fly(flight)


def test_arming_follows_grant_that_changes_while_autopilot_is_not_ready(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.drive(grant)
            world.plane.vehicle.ready = False
            areas: list[Any] = []
            raise_around = world.fence.raise_around

            async def raised(grant: GrantSpec, *, retraces: bool) -> None:
                areas.append(grant.operation_area)
                await raise_around(grant, retraces=retraces)
                world.grants.put(spec(altitude(8.0), operationArea=[smaller]))

            world.fence.raise_around = raised  # type: ignore[method-assign]
            call = asyncio.ensure_future(world.service.arm(grant, 60.0))
            await asyncio.sleep(3)
            smaller = area(-90, -90, 90, 90)
            changed = world.grants.put(spec(altitude(9.0), operationArea=[smaller]))
            world.plane.vehicle.ready = True
            await call
            assert areas == [changed.spec.operation_area]
            assert world.plane.parameters["RTL_ALT"] <= 800.0

    fly(flight)


def test_arming_is_refused_by_grant_that_changes_while_autopilot_is_not_ready(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.drive(grant)
            world.plane.vehicle.ready = False
            call = asyncio.ensure_future(world.service.arm(grant, 60.0))
            await asyncio.sleep(3)
            world.grants.put(spec(services=[{"service": "mobility", "methods": ["Takeoff"]}]))
            world.plane.vehicle.ready = True
            assert (await refusal(call)).verdict.code == "MethodNotGranted"
            assert not world.plane.vehicle.armed

    fly(flight)


AWAITED = "the mission begins when all components are ready; not ready: ImageChecker, DataStore"


def test_driver_gets_control_when_awaited_components_are_ready(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec(awaits=["ImageChecker", "DataStore"]))
            driving = asyncio.ensure_future(world.drive(grant))
            await asyncio.sleep(30)
            assert [(event.state, event.reason) for event in world.events] == [(StreamState.WAITING, AWAITED)]
            world.grants.put(spec())
            await driving
            assert world.events[-1].state is StreamState.GRANTED

    fly(flight)


@pytest.mark.parametrize("delay_s", [0.0, 2.0], ids=["before", "during"])
def test_arming_waits_for_component_that_stops_being_ready(tmp_path: Path, delay_s: float) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.drive(grant)
            world.fence.raise_around = Slow(world)
            call = asyncio.ensure_future(world.service.arm(grant, 60.0))
            await asyncio.sleep(delay_s)
            world.grants.put(spec(awaits=["ImageChecker", "DataStore"]))
            await asyncio.sleep(20)
            assert not world.plane.vehicle.armed
            assert not call.done()
            world.grants.put(spec())
            await call
            assert world.plane.vehicle.armed

    fly(flight)


def test_arming_is_refused_while_component_is_not_ready(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.drive(grant)
            world.grants.put(spec(awaits=["ImageChecker", "DataStore"]))
            refused = await refusal(world.service.arm(grant, 5.0))
            assert (refused.verdict.code, str(refused)) == ("NotReady", AWAITED)

    fly(flight)


def test_mission_that_has_begun_does_not_wait_for_components(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.up(grant)
            await end(world.service.land(grant))
            world.grants.put(spec(awaits=["ImageChecker"]))
            await world.service.arm(grant)
            assert world.plane.vehicle.armed

    fly(flight)


def test_tour_begins_when_awaited_components_are_ready(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.grants.put(touring(tour=((0, 30),), awaits=["ImageChecker"]))
            await asyncio.sleep(60)
            assert not world.plane.vehicle.armed
            world.grants.put(touring(tour=((0, 30),)))
            await world.until(lambda: world.plane.vehicle.armed)

    fly(flight)


def test_queued_arming_is_refused_after_driver_returns_control(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.drive(grant)
            slow = world.fence.raise_around = Slow(world)
            calls = [asyncio.ensure_future(world.service.arm(grant)) for _ in range(2)]
            await asyncio.sleep(1)
            await world.control.return_control(grant)
            for call in calls:
                await refusal(call)
            assert slow.began_armed == [False]
            assert mavlink.MAV_CMD_COMPONENT_ARM_DISARM not in world.plane.commands

    fly(flight)


FRESH = FailsafeStatus("", (), Airframe(retraces=True), 8.0, records_path=True)
"""Result of a failsafe verification after a reconnect. It does not contain the return mode chosen for the flight."""


@pytest.mark.parametrize("verified", [None, FRESH])
@pytest.mark.parametrize("during", ["choice", "fence", "mode"])
def test_arming_is_refused_if_failsafe_verification_changes_during_arming(
    tmp_path: Path, during: str, verified: FailsafeStatus | None
) -> None:
    async def flight() -> None:
        async with World(tmp_path, retraces=True) as world:
            control = world.control
            plane = world.plane
            grant = world.grants.put(spec())
            await world.drive(grant)
            write = plane.vehicle_parameters.write
            set_mode = plane.set_mode
            raise_around = world.fence.raise_around

            async def chosen(name: str, value: float) -> float:
                control.failsafe_status = verified
                return await write(name, value)

            async def raised(grant: GrantSpec, *, retraces: bool) -> None:
                control.failsafe_status = verified
                await raise_around(grant, retraces=retraces)

            async def changed(mode: Any, *_: object) -> None:
                await set_mode(mode)
                control.failsafe_status = verified

            if during == "choice":
                control.dispatch(ArmingRequested(grant.key, grant.identity, (39.3604, 22.95, 10.0)))
                control.dispatch(Airborne())  # same as after a landing during the mission
                plane.vehicle_parameters.write = chosen  # type: ignore[method-assign]
            elif during == "fence":
                world.fence.raise_around = raised  # type: ignore[method-assign]
            else:
                plane.set_to(BRAKE)
                plane.set_mode = changed  # type: ignore[method-assign]
            obey = plane._obey
            motors = list[float]()

            def noted(outgoing: Any) -> None:
                if outgoing.integer("command") == mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
                    motors.append(outgoing.real("param1"))
                obey(outgoing)

            plane._obey = noted  # type: ignore[method-assign]
            why = await refusal(world.service.arm(grant))
            assert why.verdict.code == "FailsafesNotVerified"
            assert control.failsafe_status is verified, "the result of the newer verification is kept"
            assert 1 not in motors

    fly(flight)


def test_return_mode_is_kept_after_link_reconnects_in_flight(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path, retraces=True) as world:
            control = world.control
            plane = world.plane
            plane.parameters |= {"SRTL_POINTS": 300.0, "SYSID_MYGCS": 244.0, "WPNAV_ACCEL": 100.0}
            control.failsafe_status = FailsafeStatus(
                "", (), Airframe(retraces=True, accel_mps2=1.0), 8.0, records_path=True
            )
            grant = world.grants.put(spec())
            await world.drive(grant)
            control.dispatch(ArmingRequested(grant.key, grant.identity, (39.3604, 22.95, 10.0)))
            control.dispatch(Airborne())  # same as after a landing during the mission
            await world.service.arm(grant)
            await end(world.service.take_off(grant, TakeoffArgs(10.0)))
            assert plane.parameters["FS_GCS_ENABLE"] == 1.0
            world.observer.found()
            assert control.failsafe_status.problem
            assert world.gate.situation().airframe.accel_mps2 == 1.0, "acceleration is unchanged"
            await world.until(lambda: control.failsafe_status is not None and not control.failsafe_status.problem, 10)
            assert plane.parameters["FS_GCS_ENABLE"] == 1.0
            assert not control.retraces
            assert world.gate.situation().airframe.accel_mps2 == 1.0

    fly(flight)


def test_arming_is_refused_if_fence_upload_fails(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.drive(grant)
            world.fence.problem = AutopilotError("the autopilot refused the fence: no space")
            why = await refusal(world.service.arm(grant))
            assert why.verdict.code == "FenceNotRaised"
            assert "no space" in str(why)
            assert mavlink.MAV_CMD_COMPONENT_ARM_DISARM not in world.plane.commands
            world.fence.problem = None
            await world.service.arm(grant)

    fly(flight)


def test_arming_is_refused_far_from_grant_home(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.plane.xy = [60.0, 0.0]
            grant = world.grants.put(spec())
            await asyncio.sleep(0.2)
            await world.drive(grant)
            why = await refusal(world.service.arm(grant))
            assert why.verdict.code == "NotAtHome"
            assert "60 m away" in str(why)
            assert mavlink.MAV_CMD_COMPONENT_ARM_DISARM not in world.plane.commands

    fly(flight)


@pytest.mark.parametrize("part", ["journal", "audit"])
def test_arming_is_refused_if_journal_or_audit_log_is_unwritable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, part: str
) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.drive(grant)

            def full(_data: bytes) -> None:
                raise OSError(28, "No space left on device")

            if part == "journal":
                monkeypatch.setattr(world.journal, "_write", full)
            else:
                world.audit.failure = "cannot write the audit log: No space left on device"
            why = await refusal(world.service.arm(grant))
            assert why.verdict.code in {"JournalUnavailable", "AuditUnavailable"}
            assert "No space left" in str(why)
            assert mavlink.MAV_CMD_COMPONENT_ARM_DISARM not in world.plane.commands

    fly(flight)


def test_arming_is_retried_until_caller_deadline(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.drive(grant)
            plane = world.plane
            arm = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
            plane.refuses.add(arm)
            begun = plane.now
            with pytest.raises(AutopilotError, match="failed"):
                await world.service.arm(grant, 9.0)
            assert plane.now - begun <= 9.0
            assert plane.commands.count(arm) > 3
            asyncio.get_running_loop().call_later(5.0, plane.refuses.discard, arm)
            await world.service.arm(grant, 9.0)
            assert plane.vehicle.armed

    fly(flight)


def test_arming_retries_stop_after_caller_cancels(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.drive(grant)
            plane = world.plane
            arm = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
            plane.refuses.add(arm)
            call = asyncio.ensure_future(world.service.arm(grant, 60.0))
            await asyncio.sleep(5.0)
            call.cancel()
            await asyncio.sleep(0.5)
            plane.refuses.discard(arm)
            tried = plane.commands.count(arm)
            await asyncio.sleep(20.0)
            assert plane.commands.count(arm) == tried
            assert not plane.vehicle.armed

    fly(flight)


def test_waiting_driver_receives_reason_why_arming_fails(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            plane = world.plane
            arm = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
            reasons = list[str]()
            plane.refuses.add(arm)

            async def follow() -> None:
                async for event in world.streams.follow(world.grants.put(partial())):
                    reasons.append(event.reason)

            following = asyncio.ensure_future(follow())
            await asyncio.sleep(6.0)
            assert any("COMPONENT_ARM_DISARM" in reason for reason in reasons)
            plane.refuses.discard(arm)
            await world.until(lambda: plane.vehicle.in_air, 20)
            following.cancel()

    fly(flight)


def test_arming_is_refused_without_position_estimate(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.drive(grant)
            world.plane.vehicle.estimated = False
            why = await refusal(world.service.arm(grant))
            assert why.verdict.code == "NotReady"
            assert mavlink.MAV_CMD_COMPONENT_ARM_DISARM not in world.plane.commands
            assert not world.fence.raised

    fly(flight)
