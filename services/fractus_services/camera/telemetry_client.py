"""Follows the mobility service of the same node, for the poses of a drone's camera."""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections import deque
from collections.abc import Callable

import grpc
from fractus_core.api.names import node_server_name
from fractus_core.policy.decision_types import Attitude, Home, Situation
from fractus_proto.v1 import mobility_pb2, mobility_pb2_grpc

from fractus_services.auth import TlsFiles
from fractus_services.camera.pose_history import Measurement

log = logging.getLogger(__name__)

INTERVAL_S = 0.1
RETRY_S = 1.0
DEFAULT_ERROR_M = 10.0
"""Position error where the mobility service reports none."""
DEFAULT_AGE_S = 0.5
"""Age of a measurement where the mobility service reports none."""
STEP_S = 10.0
"""A step of the clock counts against the messages that arrive for so long after it: they may have been made before."""
MAX_AHEAD_S = 0.05
"""A message that is made later than it arrives, by more, has its time from another clock."""


class ArrivalClock:
    """Unix time as messages arrive, by the latest reading of late: a clock that is stepped back makes no message younger.

    Args:
        clock: Unix time; where that is in doubt, the later reading.
        now: monotonic seconds.
    """

    def __init__(self, clock: Callable[[], float], now: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._now = now
        self._offsets: deque[tuple[float, float]] = deque()

    def __call__(self) -> float:
        """Now."""
        now = self._now()
        self._offsets.append((now, self._clock() - now))
        while now - self._offsets[0][0] > STEP_S:
            self._offsets.popleft()
        return now + max(offset_s for _, offset_s in self._offsets)


async def follow_telemetry(
    address: str,
    node: str,
    tls: TlsFiles,
    add: Callable[[Measurement], None],
    *,
    clock: Callable[[], float],
    gimbal: bool = False,
) -> None:
    """Subscribe to the telemetry, and again after every failure, until cancelled.

    Args:
        address: host:port of the mobility service.
        node: name of the node, which its certificate carries.
        tls: the node's certificate.
        add: takes each measurement.
        clock: Unix time as the mobility service has it, also while the clock's steps are in doubt.
        gimbal: whether the camera's attitude is that of a gimbal.
    """
    await tls.wait()
    arrival = ArrivalClock(clock)
    options = (("grpc.ssl_target_name_override", node_server_name(node)), ("grpc.enable_http_proxy", 0))
    while True:
        try:
            async with grpc.aio.secure_channel(address, tls.client_credentials(), options) as channel:
                stub = mobility_pb2_grpc.MobilityServiceStub(channel)
                async for message in stub.SubscribeTelemetry(
                    mobility_pb2.SubscribeTelemetryRequest(interval_s=INTERVAL_S)
                ):
                    add(measurement(message, time.monotonic(), arrival(), gimbal=gimbal))
        except grpc.aio.AioRpcError as error:
            log.warning("telemetry: stream ended (mobility=%s): %s", address, error.details())
        except OSError as error:
            log.warning("telemetry: no certificate to connect with (mobility=%s): %s", address, error)
        await asyncio.sleep(RETRY_S)


def measurement(message: mobility_pb2.Telemetry, now_s: float, time_s: float, *, gimbal: bool = False) -> Measurement:
    """Translate a message that arrived at a moment; the attitude is the airframe's, or the gimbal's.

    Ages count from when the message was made: those that wait while one of the two processes is stalled arrive all at once. Both
    read the same clock, and where that is stepped meanwhile a message counts as older, never as younger; how old one is that would
    arrive before it was made is not known.

    Args:
        message: of the mobility service of this node.
        now_s: monotonic seconds.
        time_s: Unix time, see `ArrivalClock`.
        gimbal: whether the camera's attitude is that of a gimbal.
    """
    turned = "gimbal" if gimbal else "attitude"
    late_s = time_s - message.time.ToNanoseconds() / 1e9 if message.HasField("time") else 0.0
    late_s = max(late_s, 0.0) if late_s >= -MAX_AHEAD_S else math.inf
    position_age_s, attitude_age_s = (
        late_s + (getattr(message, name) if message.HasField(name) else DEFAULT_AGE_S)
        for name in ("position_age_s", f"{turned}_age_s")
    )
    # Without a link to the autopilot the position in the message is an old one.
    position = message.position if message.HasField("position") and message.autopilot_connected else None
    velocity, attitude, home = message.velocity, getattr(message, turned), message.home
    return Measurement(
        received_at=now_s,
        position_at=now_s - position_age_s,
        attitude_at=now_s - attitude_age_s,
        situation=Situation(
            time_s=0.0,
            lat=position.latitude_deg if position is not None else None,
            lon=position.longitude_deg if position is not None else None,
            altitude_m=position.altitude_m if position is not None else 0.0,
            north_mps=velocity.north_mps,
            east_mps=velocity.east_mps,
            down_mps=velocity.down_mps,
            home=Home(home.latitude_deg, home.longitude_deg, home.altitude_m) if message.HasField("home") else None,
            armed=message.armed,
            in_air=message.in_air,
            position_error_m=message.position_error_m or DEFAULT_ERROR_M,
            attitude=Attitude(attitude.roll_deg, attitude.pitch_deg, attitude.yaw_deg)
            if message.HasField(turned)
            else None,
        ),
    )
