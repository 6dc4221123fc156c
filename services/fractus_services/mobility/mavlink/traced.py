"""What the autopilot is told on behalf of calls, in their traces."""

from __future__ import annotations

from typing import Any

from fractus_runtime import spans
from fractus_runtime.mavlink_codec import enum_name

from fractus_services.mobility.mavlink.autopilot import MavlinkAutopilot


class TracedAutopilot(MavlinkAutopilot):
    """An autopilot whose commands show in the traces of the calls that they are for."""

    async def command(self, command: int, *params: float, **how: Any) -> None:
        """See `MavlinkAutopilot`; its span lasts until the acknowledgement, the wait for others of its kind included."""
        with spans.call().child(f"autopilot.{enum_name('MAV_CMD', command)}"):
            await super().command(command, *params, **how)

    def fly(self, north_mps: float, east_mps: float, down_mps: float, yaw_deg: float | None = None) -> None:
        """See `MavlinkAutopilot`; no autopilot acknowledges it."""
        with spans.call().child("autopilot.SET_POSITION_TARGET_LOCAL_NED"):
            super().fly(north_mps, east_mps, down_mps, yaw_deg)
