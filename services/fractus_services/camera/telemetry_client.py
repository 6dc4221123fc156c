"""Client of the mobility service's telemetry, which provides the poses of a drone's camera."""

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

DEFAULT_ERROR_M = 10.0
"""Position error if the mobility service reports none, in metres."""
DEFAULT_AGE_S = 0.5
"""Age of a measurement if the mobility service reports none, in seconds."""
STEP_WINDOW_S = 10.0
"""Time after a backward clock step during which messages with timestamps from before the step may still arrive, in seconds."""
MAX_AHEAD_S = 0.05
"""Maximum time by which a message's timestamp may be after its arrival.

If the difference is larger, the sender uses another clock.
"""


class ArrivalClock:
    """Unix time of message arrivals. A backward clock step does not make messages appear younger.

    It uses the largest offset between Unix time and monotonic time during the last `STEP_WINDOW_S` seconds.

    Args:
        clock: Returns Unix time. If the clock is uncertain, the later reading.
        now: Returns monotonic seconds.
    """

    def __init__(self, clock: Callable[[], float], now: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._now = now
        self._offsets: deque[tuple[float, float]] = deque()

    def __call__(self) -> float:
        """Return the Unix time of a message that arrives now."""
        now_s = self._now()
        self._offsets.append((now_s, self._clock() - now_s))
        while now_s - self._offsets[0][0] > STEP_WINDOW_S:
            self._offsets.popleft()
        return now_s + max(offset_s for _, offset_s in self._offsets)


async def follow_telemetry(
    address: str,
    node: str,
    tls: TlsFiles,
    add: Callable[[Measurement], None],
    *,
    clock: Callable[[], float],
    gimbal: bool = False,
    interval_s: float = 0.1,
    retry_s: float = 1.0,
) -> None:
    """Subscribe to telemetry until cancelled, and subscribe again after each failure.

    Args:
        address: HOST:PORT of the mobility service.
        node: Name of the node, which is in its certificate.
        tls: Certificate of the node.
        add: Callback invoked with each measurement.
        clock: Returns Unix time. If the clock is uncertain, the later reading, as in the mobility service.
        gimbal: True if a gimbal turns the camera.
        interval_s: Requested interval between messages, in seconds.
        retry_s: Delay before a new subscription after a failure, in seconds.
    """
    await tls.wait()
    arrival = ArrivalClock(clock)
    options = (("grpc.ssl_target_name_override", node_server_name(node)), ("grpc.enable_http_proxy", 0))
    while True:
        try:
            async with grpc.aio.secure_channel(address, tls.client_credentials(), options) as channel:
                stub = mobility_pb2_grpc.MobilityServiceStub(channel)
                async for message in stub.SubscribeTelemetry(
                    mobility_pb2.SubscribeTelemetryRequest(interval_s=interval_s)
                ):
                    add(to_measurement(message, time.monotonic(), arrival(), gimbal=gimbal))
        except grpc.aio.AioRpcError as error:
            log.warning("telemetry: stream ended (mobility=%s error=%s)", address, error.details())
        except OSError as error:
            log.warning("telemetry: cannot read the client certificate (mobility=%s error=%s)", address, error)
        await asyncio.sleep(retry_s)


def to_measurement(
    message: mobility_pb2.Telemetry, now_s: float, time_s: float, *, gimbal: bool = False
) -> Measurement:
    """Convert a telemetry message with the attitude of the airframe or of the gimbal.

    Ages are computed from the timestamp of the message, because messages that wait while a process is stalled arrive together.
    Both processes read the same clock. After a clock step, a message may appear older, but never younger. If the timestamp is
    after the arrival, the age is unknown.

    Args:
        message: Message of the mobility service of this node.
        now_s: Monotonic time of arrival in seconds.
        time_s: Unix time of arrival in seconds, from `ArrivalClock`.
        gimbal: True if a gimbal turns the camera.
    """
    attitude_field = "gimbal" if gimbal else "attitude"
    delay_s = 0.0
    if message.HasField("time"):
        delay_s = time_s - message.time.ToNanoseconds() / 1e9
        delay_s = max(delay_s, 0.0) if delay_s >= -MAX_AHEAD_S else math.inf
    position_age_s, attitude_age_s = (
        delay_s + (getattr(message, name) if message.HasField(name) else DEFAULT_AGE_S)
        for name in ("position_age_s", f"{attitude_field}_age_s")
    )
    # Without a link to the autopilot, the message contains an old position.
    position = message.position if message.HasField("position") and message.autopilot_connected else None
    velocity = message.velocity
    home = message.home
    attitude = None
    if message.HasField(attitude_field):
        angles = getattr(message, attitude_field)
        attitude = Attitude(angles.roll_deg, angles.pitch_deg, angles.yaw_deg)
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
            attitude=attitude,
        ),
    )
