"""Where the camera is: on a fixed node, or on a drone that tells by telemetry."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable
from dataclasses import dataclass

import grpc
from fractus_core.api.nodes import EdgeNodeSpec
from fractus_core.api.plans import node_server_name
from fractus_core.policy.footprint import lens_of
from fractus_core.policy.values import Attitude, Home, Lens, Situation
from fractus_proto.v1 import mobility_pb2, mobility_pb2_grpc

from fractus_services.auth import TlsFiles

log = logging.getLogger(__name__)

INTERVAL_S = 0.1
STALE_S = 1.0
RETRY_S = 1.0
UNTOLD_ERROR_M = 10.0
"""Position error of a mobility service that tells none."""
TILT_ERROR_DEG = 10.0
YAW_ERROR_DEG = 20.0
"""Bounds of an autopilot's attitude errors, both tilts together and the compass, with the tenth of a second that a
measurement is old when it is told."""
TURN_DEG_S = 60.0
"""How fast an airframe turns at most while nobody looks."""


@dataclass(frozen=True, slots=True)
class Fixed:
    """A node that stays where it is."""

    lat: float
    lon: float
    amsl_m: float
    height_m: float = 0.0
    lens: Lens | None = None
    relief_m: float = 0.0

    @classmethod
    def of(cls, spec: EdgeNodeSpec, relief_m: float = 0.0) -> Fixed:
        """The place that a description gives; without the camera's height nobody knows what it sees."""
        camera = spec.services.camera
        height_m = camera.mount.height if camera is not None and camera.mount is not None else None
        lens = lens_of(camera) if height_m is not None else None
        return cls(spec.location.lat, spec.location.lon, spec.location.alt or 0.0, height_m or 0.0, lens, relief_m)

    def situation(self, time_s: float) -> Situation:
        """The state as the engine judges it: the node stands on its own home."""
        return Situation(
            time_s=time_s,
            lat=self.lat,
            lon=self.lon,
            altitude_m=self.height_m,
            home=Home(self.lat, self.lon, self.amsl_m),
            position_error_m=0.5,
            altitude_error_m=0.5,
            attitude=Attitude(0.0, 0.0, 0.0, 0.0, 0.0),
            lens=self.lens,
            relief_m=self.relief_m,
        )

    async def run(self) -> None:
        """Nothing to follow."""


class Airborne:
    """A drone's position, from the mobility service of the same node.

    Args:
        address: host:port of the mobility service.
        node: name of the node.
        tls: the node's certificate.
        now: monotonic seconds.
        lens: what the camera sees; None when nobody knows.
        relief_m: how far the ground around may lie below home.
    """

    def __init__(
        self,
        address: str,
        node: str,
        tls: TlsFiles,
        now: Callable[[], float],
        *,
        lens: Lens | None = None,
        relief_m: float = 0.0,
    ) -> None:
        self._address = address
        self._server_name = node_server_name(node)
        self._tls = tls
        self._now = now
        self._lens = lens
        self._relief_m = relief_m
        self._latest: mobility_pb2.Telemetry | None = None
        self._heard_at = 0.0

    def situation(self, time_s: float) -> Situation:
        """The state as the engine judges it; unknown when the mobility service is silent."""
        message, age_s = self._latest, self._now() - self._heard_at
        if message is None or age_s > STALE_S or not message.HasField("position"):
            return Situation(time_s=time_s, lens=self._lens, relief_m=self._relief_m)
        speed_mps = math.hypot(message.velocity.north_mps, message.velocity.east_mps)
        home = None
        if message.HasField("home"):
            home = Home(message.home.latitude_deg, message.home.longitude_deg, message.home.altitude_m)
        return Situation(
            time_s=time_s,
            lat=message.position.latitude_deg,
            lon=message.position.longitude_deg,
            altitude_m=message.position.altitude_m,
            north_mps=message.velocity.north_mps,
            east_mps=message.velocity.east_mps,
            down_mps=message.velocity.down_mps,
            home=home,
            armed=message.armed,
            in_air=message.in_air,
            position_error_m=(message.position_error_m or UNTOLD_ERROR_M) + speed_mps * max(age_s, 0.0),
            attitude=_attitude(message, age_s),
            lens=self._lens,
            relief_m=self._relief_m,
        )

    async def run(self) -> None:
        """Follow the telemetry until cancelled."""
        options = (("grpc.ssl_target_name_override", self._server_name), ("grpc.enable_http_proxy", 0))
        while True:
            try:
                async with grpc.aio.secure_channel(self._address, self._tls.client_credentials(), options) as channel:
                    stub = mobility_pb2_grpc.MobilityServiceStub(channel)  # type: ignore[no-untyped-call]
                    async for message in stub.SubscribeTelemetry(
                        mobility_pb2.SubscribeTelemetryRequest(interval_s=INTERVAL_S)
                    ):
                        self._latest = message if message.autopilot_connected else None
                        self._heard_at = self._now()
            except grpc.aio.AioRpcError as error:
                log.warning("no telemetry from %s: %s", self._address, error.details())
            except OSError as error:
                log.warning("no certificate for %s: %s", self._address, error)
            await asyncio.sleep(RETRY_S)


def _attitude(message: mobility_pb2.Telemetry, age_s: float) -> Attitude | None:
    if not message.HasField("attitude"):
        return None
    turned_deg = TURN_DEG_S * max(age_s, 0.0)
    return Attitude(
        message.attitude.roll_deg,
        message.attitude.pitch_deg,
        message.attitude.yaw_deg,
        TILT_ERROR_DEG + turned_deg,
        YAW_ERROR_DEG + turned_deg,
    )
