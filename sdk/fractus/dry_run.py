"""Dry runs of calls: `await drone.can_i.goto(lat, lon, 20)` returns the verdict without any effect."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

from fractus_proto.v1 import mobility_pb2

from fractus.proto_requests import gimbal_request, goto_request, speed_request, takeoff_request, velocity_request
from fractus.values import AltitudeReference, Check, Position, Velocity

CheckCall = Callable[[mobility_pb2.CheckCallRequest], Awaitable[Check]]


class CanI:
    """Dry runs of the calls of `Mobility`, with the same arguments.

    Each method returns the policy engine's current verdict. Nothing is carried out or taken over. The component needs a
    Grant, but not control of the drone.
    """

    def __init__(self, check: CheckCall) -> None:
        self._check = check

    async def arm(self) -> Check:
        """Judge `Mobility.arm`."""
        return await self._judge(arm=mobility_pb2.ArmRequest())

    async def disarm(self) -> Check:
        """Judge `Mobility.disarm`."""
        return await self._judge(disarm=mobility_pb2.DisarmRequest())

    async def takeoff(self, altitude_m: float) -> Check:
        """Judge `Mobility.takeoff`."""
        return await self._judge(takeoff=takeoff_request(altitude_m))

    async def land(self) -> Check:
        """Judge `Mobility.land`."""
        return await self._judge(land=mobility_pb2.LandRequest())

    async def return_to_launch(self) -> Check:
        """Judge `Mobility.return_to_launch`."""
        return await self._judge(return_to_launch=mobility_pb2.ReturnToLaunchRequest())

    async def hover(self) -> Check:
        """Judge `Mobility.hover`."""
        return await self._judge(hover=mobility_pb2.HoverRequest())

    async def goto(
        self,
        lat: float,
        lon: float,
        alt: float,
        *,
        reference: AltitudeReference = AltitudeReference.HOME,
        yaw_deg: float | None = None,
        speed_mps: float | None = None,
    ) -> Check:
        """Judge `Mobility.goto`."""
        return await self._judge(goto=goto_request(Position(lat, lon, alt, reference), yaw_deg, speed_mps))

    async def set_speed(self, speed_mps: float) -> Check:
        """Judge `Mobility.set_speed`."""
        return await self._judge(set_speed=speed_request(speed_mps))

    async def set_velocity(
        self,
        north_mps: float,
        east_mps: float,
        down_mps: float = 0.0,
        *,
        yaw_deg: float | None = None,
        hold_s: float = 0.0,
    ) -> Check:
        """Judge `Mobility.set_velocity`."""
        request = velocity_request(Velocity(north_mps, east_mps, down_mps), yaw_deg, hold_s)
        return await self._judge(set_velocity=request)

    async def point_gimbal(self, pitch_deg: float, yaw_deg: float = 0.0) -> Check:
        """Judge `Mobility.point_gimbal`."""
        return await self._judge(point_gimbal=gimbal_request(pitch_deg, yaw_deg))

    async def position(self) -> Check:
        """Judge `Mobility.position`."""
        return await self._judge(get_position=mobility_pb2.GetPositionRequest())

    async def speed(self) -> Check:
        """Judge `Mobility.speed`."""
        return await self._judge(get_speed=mobility_pb2.GetSpeedRequest())

    async def _judge(self, **call: Any) -> Check:
        return await self._check(mobility_pb2.CheckCallRequest(**call))
