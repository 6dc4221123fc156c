"""Where the camera is: on a fixed node, or on a drone that tells by telemetry."""

from __future__ import annotations

import asyncio
import logging
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import grpc
from fractus_core.api.names import node_server_name
from fractus_core.api.nodes import EdgeNodeSpec
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
UNTOLD_AGE_S = 0.5
"""Age of measurements when a mobility service tells none."""
ALTITUDE_ERROR_M = 1.0
TILT_ERROR_DEG = 5.0
YAW_ERROR_DEG = 15.0
"""Bounds of an autopilot's attitude errors, both tilts together and the compass."""
TURN_DEG_S = 60.0
SPEED_UP_MPS2 = 5.0
"""How fast an airframe turns, and how much it speeds up, at most while nobody looks."""
REMEMBERED_S = 30.0
"""Longer than any exposure."""


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

    def way(self, _begun_s: float, time_s: float) -> tuple[Situation, ...]:
        """All that it was since a moment: the same."""
        return (self.situation(time_s),)

    async def run(self) -> None:
        """Nothing to follow."""


@dataclass(frozen=True, slots=True)
class _Told:
    """A message of the mobility service, and when what it tells was measured; times are monotonic seconds."""

    message: mobility_pb2.Telemetry
    heard_at: float
    position_at: float
    attitude_at: float

    @classmethod
    def of(cls, message: mobility_pb2.Telemetry, heard_at: float) -> _Told:
        ages_s = [
            getattr(message, name) if message.HasField(name) else UNTOLD_AGE_S
            for name in ("position_age_s", "attitude_age_s")
        ]
        return cls(message, heard_at, heard_at - ages_s[0], heard_at - ages_s[1])


@dataclass(frozen=True, slots=True)
class _Unseen:
    """What may have happened around a pose without being told.

    Attributes:
        moved_s: seconds for which the airframe may have moved on.
        turned_s: seconds for which it may have turned on.
        tilt_deg: how much further from the pose its roll and pitch are known to have been.
        yaw_deg: how much further from the pose its yaw is known to have been.
    """

    moved_s: float = 0.0
    turned_s: float = 0.0
    tilt_deg: float = 0.0
    yaw_deg: float = 0.0

    @classmethod
    def until(cls, told: _Told, now_s: float) -> _Unseen:
        """After the last pose that was told."""
        return cls(max(now_s - told.position_at, 0.0), max(now_s - told.attitude_at, 0.0))

    @classmethod
    def between(cls, told: _Told, other: _Told) -> _Unseen:
        """On the half of the way to a pose told next or before that lies nearer to this one."""
        moved_s, turned_s = abs(other.position_at - told.position_at), abs(other.attitude_at - told.attitude_at)
        here, there = told.message.attitude, other.message.attitude
        tilts = (here.roll_deg - there.roll_deg, here.pitch_deg - there.pitch_deg)
        yaw_deg = abs(math.remainder(here.yaw_deg - there.yaw_deg, 360.0))
        return cls(
            moved_s / 2 if moved_s <= STALE_S else math.inf,
            turned_s / 2 if turned_s <= STALE_S else math.inf,
            sum(abs(math.remainder(tilt, 360.0)) for tilt in tilts) / 2,
            yaw_deg / 2,
        )

    def joined(self, other: _Unseen) -> _Unseen:
        """Whichever is more."""
        return _Unseen(
            max(self.moved_s, other.moved_s),
            max(self.turned_s, other.turned_s),
            max(self.tilt_deg, other.tilt_deg),
            max(self.yaw_deg, other.yaw_deg),
        )


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
        self._told: deque[_Told] = deque()

    def situation(self, time_s: float) -> Situation:
        """The state as the engine judges it; unknown when the mobility service is silent."""
        if not self._told:
            return self._unknown(time_s)
        return self._state(self._told[-1], _Unseen.until(self._told[-1], self._now()), time_s)

    def way(self, begun_s: float, time_s: float) -> tuple[Situation, ...]:
        """All states since a moment, the one before it first and the present one last.

        The errors of each hold for half of the way to its neighbours as well: it was there at most that long before or
        after, and turned at most half of what the two poses differ by, and what `TURN_DEG_S` allows, away from it.

        Args:
            begun_s: monotonic seconds.
            time_s: Unix time that all states get.
        """
        told = list(self._told)
        first = next((i for i in reversed(range(len(told))) if told[i].heard_at <= begun_s), None)
        states = [self._unknown(time_s)] if first is None else []
        told = told[first or 0 :]
        for i, one in enumerate(told):
            unseen = _Unseen() if i < len(told) - 1 else _Unseen.until(one, self._now())
            for neighbour in (*told[max(i - 1, 0) : i], *told[i + 1 : i + 2]):
                unseen = unseen.joined(_Unseen.between(one, neighbour))
            states.append(self._state(one, unseen, time_s))
        return tuple(states)

    def _unknown(self, time_s: float) -> Situation:
        return Situation(time_s=time_s, lens=self._lens, relief_m=self._relief_m)

    def _state(self, told: _Told, unseen: _Unseen, time_s: float) -> Situation:
        message = told.message
        if not message.autopilot_connected or not message.HasField("position") or unseen.moved_s > STALE_S:
            return self._unknown(time_s)
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
            position_error_m=(message.position_error_m or UNTOLD_ERROR_M) + _flown_m(speed_mps, unseen.moved_s),
            altitude_error_m=ALTITUDE_ERROR_M + _flown_m(abs(message.velocity.down_mps), unseen.moved_s),
            attitude=_attitude(message, unseen),
            lens=self._lens,
            relief_m=self._relief_m,
        )

    def _hear(self, message: mobility_pb2.Telemetry) -> None:
        now_s = self._now()
        self._told.append(_Told.of(message, now_s))
        while self._told[0].heard_at < now_s - REMEMBERED_S:
            self._told.popleft()

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
                        self._hear(message)
            except grpc.aio.AioRpcError as error:
                log.warning("no telemetry from %s: %s", self._address, error.details())
            except OSError as error:
                log.warning("no certificate for %s: %s", self._address, error)
            await asyncio.sleep(RETRY_S)


def _flown_m(speed_mps: float, time_s: float) -> float:
    """How far a drone gets that flies so fast when nobody looks."""
    return (speed_mps + SPEED_UP_MPS2 * time_s / 2) * time_s


def _attitude(message: mobility_pb2.Telemetry, unseen: _Unseen) -> Attitude | None:
    if not message.HasField("attitude") or unseen.turned_s > STALE_S:
        return None
    turned_deg = TURN_DEG_S * unseen.turned_s
    return Attitude(
        message.attitude.roll_deg,
        message.attitude.pitch_deg,
        message.attitude.yaw_deg,
        TILT_ERROR_DEG + turned_deg + unseen.tilt_deg,
        YAW_ERROR_DEG + turned_deg + unseen.yaw_deg,
    )
