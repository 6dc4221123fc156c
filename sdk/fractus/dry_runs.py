"""Dry runs of calls: `await drone.can_i.goto(lat, lon, 20)` asks whether this component may, and does nothing."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

from fractus_proto.v1 import mobility_pb2

from fractus.requests import gimbal_request, goto_request, speed_request, takeoff_request, velocity_request
from fractus.values import AltitudeReference, Check, Position, Velocity

Ask = Callable[[mobility_pb2.CheckCallRequest], Awaitable[Check]]


class CanI:
    """Dry runs of the calls of `Mobility`, with their arguments.

    Nothing is done and nothing is taken over; the policy checker answers as it would at this moment. It needs a grant, not
    control of the drone.
    """

    def __init__(self, ask: Ask) -> None:
        self._ask = ask

    async def arm(self) -> Check:
        """Start the motors?"""
        return await self._of(arm=mobility_pb2.ArmRequest())

    async def disarm(self) -> Check:
        """Stop the motors?"""
        return await self._of(disarm=mobility_pb2.DisarmRequest())

    async def takeoff(self, altitude_m: float) -> Check:
        """Climb to an altitude above home?"""
        return await self._of(takeoff=takeoff_request(altitude_m))

    async def land(self) -> Check:
        """Land here?"""
        return await self._of(land=mobility_pb2.LandRequest())

    async def return_to_launch(self) -> Check:
        """Fly home and land there?"""
        return await self._of(return_to_launch=mobility_pb2.ReturnToLaunchRequest())

    async def hover(self) -> Check:
        """Stop and stay?"""
        return await self._of(hover=mobility_pb2.HoverRequest())

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
        """Fly straight to a position?"""
        return await self._of(goto=goto_request(Position(lat, lon, alt, reference), yaw_deg, speed_mps))

    async def set_speed(self, speed_mps: float) -> Check:
        """Fly at this speed?"""
        return await self._of(set_speed=speed_request(speed_mps))

    async def set_velocity(
        self,
        north_mps: float,
        east_mps: float,
        down_mps: float = 0.0,
        *,
        yaw_deg: float | None = None,
        hold_s: float = 0.0,
    ) -> Check:
        """Fly with this velocity?"""
        request = velocity_request(Velocity(north_mps, east_mps, down_mps), yaw_deg, hold_s)
        return await self._of(set_velocity=request)

    async def point_gimbal(self, pitch_deg: float, yaw_deg: float = 0.0) -> Check:
        """Turn the camera?"""
        return await self._of(point_gimbal=gimbal_request(pitch_deg, yaw_deg))

    async def position(self) -> Check:
        """Ask where the drone is?"""
        return await self._of(get_position=mobility_pb2.GetPositionRequest())

    async def speed(self) -> Check:
        """Ask how fast the drone is?"""
        return await self._of(get_speed=mobility_pb2.GetSpeedRequest())

    async def _of(self, **call: Any) -> Check:
        return await self._ask(mobility_pb2.CheckCallRequest(**call))
