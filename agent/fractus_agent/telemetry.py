"""Telemetry of the drone, from a subscription to the node's mobility service."""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import grpc
from fractus_core.api.geometry import Reference
from fractus_core.api.names import node_server_name
from fractus_core.control import Outcome, OutcomeKind, WaypointCounts
from fractus_core.exhaustive import exhaustive
from fractus_proto.v1.mobility_pb2 import (
    MissionOutcome,
    ReportContactRequest,
    SubscribeTelemetryRequest,
    Telemetry,
)
from fractus_proto.v1.mobility_pb2_grpc import MobilityServiceStub
from fractus_proto.v1.types_pb2 import AltitudeReference
from fractus_runtime.backoff import Backoff
from fractus_runtime.files import read_set

from fractus_agent.certificates import CERTIFICATE_FILES

log = logging.getLogger(__name__)

TELEMETRY_INTERVAL_S = 1.0
"""Seconds between messages."""
LINK_INTERVAL_S = 0.25
"""Seconds between messages while direct links are planned, because link decisions use them."""
SILENCE_TIMEOUT_S = 5.0
"""Seconds without a message after which the service counts as unreachable."""

CONTACT_INTERVAL_S = 1.0
"""Seconds between two reports of the contact with the API server, and the longest duration of a report."""

_PROTO_REFERENCES: dict[Reference, AltitudeReference] = exhaustive(
    Reference,
    {
        "home": AltitudeReference.ALTITUDE_REFERENCE_HOME,
        "amsl": AltitudeReference.ALTITUDE_REFERENCE_AMSL,
        "terrain": AltitudeReference.ALTITUDE_REFERENCE_TERRAIN,
    },
)
_REFERENCES = {proto: reference for reference, proto in _PROTO_REFERENCES.items()}

_OUTCOMES = {
    MissionOutcome.KIND_COMPLETE: OutcomeKind.COMPLETE,
    MissionOutcome.KIND_REVOKED: OutcomeKind.REVOKED,
    MissionOutcome.KIND_FAILED: OutcomeKind.FAILED,
}


@dataclass(frozen=True, slots=True)
class TelemetrySnapshot:
    """State of the drone at one moment.

    Attributes:
        flight_state: Flight state.
        controller: Control authority.
        connected: True if the mobility service is connected to the autopilot.
        ready: True if the autopilot would arm now.
        in_air: True if the drone is airborne.
        mode: Flight mode of the autopilot.
        position: Latitude and longitude in degrees, altitude in metres and its reference, None if unknown.
        battery_remaining: Remaining charge as a share of 1.
        battery_voltage_v: Battery voltage, in volts.
        battery_current_a: Battery current, in amperes.
        missions: Outcome by mission key.
        velocity_mps: East, north and up velocity, in m/s.
        altitude_amsl_m: Altitude above mean sea level, in metres.
        recording_problem: Reason why flights are not recorded although they should be, otherwise empty.
        controller_reason: Reason why no driver has control, empty if a driver has control or the reason is unknown.
    """

    flight_state: str
    controller: str
    connected: bool
    ready: bool
    in_air: bool
    mode: str
    position: tuple[float, float, float, str] | None
    battery_remaining: float
    battery_voltage_v: float
    battery_current_a: float
    missions: Mapping[str, Outcome] = field(default_factory=dict)
    velocity_mps: tuple[float, float, float] = (0.0, 0.0, 0.0)
    altitude_amsl_m: float = 0.0
    recording_problem: str = ""
    controller_reason: str = ""


def _parse_outcome(message: MissionOutcome) -> Outcome:
    """Convert a mission outcome. An unknown kind counts as failed."""
    counts = WaypointCounts(message.waypoints_reached, message.waypoints_skipped, message.waypoints_corrected)
    return Outcome(_OUTCOMES.get(message.kind, OutcomeKind.FAILED), message.reason, counts)


def parse_telemetry(message: Telemetry) -> TelemetrySnapshot:
    """Convert a telemetry message."""
    position = None
    if message.HasField("position"):
        reference = _REFERENCES.get(message.position.altitude_reference, "home")
        position = (
            message.position.latitude_deg,
            message.position.longitude_deg,
            message.position.altitude_m,
            reference,
        )
    return TelemetrySnapshot(
        flight_state=message.flight_state,
        controller=message.controller,
        connected=message.autopilot_connected,
        ready=message.ready,
        in_air=message.in_air,
        mode=message.mode,
        position=position,
        battery_remaining=min(1.0, max(0.0, message.battery_remaining)),
        battery_voltage_v=message.battery_voltage_v,
        battery_current_a=message.battery_current_a,
        missions={key: _parse_outcome(result) for key, result in message.missions.items()},
        velocity_mps=(message.velocity.east_mps, message.velocity.north_mps, -message.velocity.down_mps),
        altitude_amsl_m=message.altitude_amsl_m,
        recording_problem=message.recording_problem,
        controller_reason=message.controller_reason,
    )


class TelemetryFeed:
    """Keeps the latest telemetry, or the reason why it is unavailable.

    Args:
        address: Host and port of the mobility service.
        tls: Directory of the node's certificate, which is the identity of the client.
        node: Name of the node, from which the server name is derived.
        serial: Returns the number of certificate changes. The feed reconnects when it changes.
        on_change: Called after each message and each loss of the connection.
        contact_age_s: Returns the seconds since the last contact with the API server. The feed reports a finite age to the
            service once per second.

    Attributes:
        latest: Latest telemetry, None before the first message.
        problem: Reason why the mobility service is unreachable, None while it is reachable.
    """

    def __init__(
        self,
        address: str,
        tls: Path,
        node: str,
        *,
        serial: Callable[[], int],
        on_change: Callable[[], None],
        contact_age_s: Callable[[], float] = lambda: math.inf,
    ) -> None:
        self._address = address
        self._tls = tls
        self._node = node
        self._serial = serial
        self._on_change = on_change
        self._contact_age_s = contact_age_s
        self._reported_s = -math.inf
        self._interval_s = TELEMETRY_INTERVAL_S
        self._message_s = -math.inf
        self.latest: TelemetrySnapshot | None = None
        self.problem: str | None = "The mobility service has not responded yet."

    @property
    def age_s(self) -> float:
        """Seconds since the last message, infinite before the first."""
        return time.monotonic() - self._message_s

    def set_interval(self, interval_s: float) -> None:
        """Set the seconds between messages."""
        self._interval_s = interval_s

    async def run(self) -> None:
        """Stay subscribed until cancelled."""
        backoff = Backoff(0.5, 5.0)
        while True:
            try:
                async for message in self._messages():
                    if self.problem is not None:
                        log.info("telemetry: connected (mobility=%s)", self._address)
                    self.latest = parse_telemetry(message)
                    self.problem = None
                    self._message_s = time.monotonic()
                    backoff.succeeded()
                    self._on_change()
                continue  # the certificate or the interval has changed
            except grpc.aio.AioRpcError as error:
                self._lost(f"{error.code().name}: {error.details()}")
            except TimeoutError:
                self._lost(f"no message for {SILENCE_TIMEOUT_S:.0f} s")
            except (OSError, ValueError) as error:
                self._lost(str(error))
            await asyncio.sleep(backoff.delay_s())

    async def _messages(self) -> AsyncIterator[Telemetry]:
        files = read_set(self._tls, CERTIFICATE_FILES)
        if files is None:
            raise FileNotFoundError("the node has no certificate yet")
        subscribed = (self._serial(), self._interval_s)
        credentials = grpc.ssl_channel_credentials(files["ca.crt"], files["tls.key"], files["tls.crt"])
        options = (("grpc.ssl_target_name_override", node_server_name(self._node)), ("grpc.enable_http_proxy", 0))
        async with grpc.aio.secure_channel(self._address, credentials, options=options) as channel:
            stub = MobilityServiceStub(channel)
            call = stub.SubscribeTelemetry(SubscribeTelemetryRequest(interval_s=self._interval_s))
            try:
                while (self._serial(), self._interval_s) == subscribed:
                    message = await asyncio.wait_for(call.read(), SILENCE_TIMEOUT_S)
                    if message is grpc.aio.EOF:
                        raise ConnectionResetError(f"the service ended the stream: {await call.details()}")
                    await self._report_contact(stub)
                    yield message
            finally:
                call.cancel()

    async def _report_contact(self, stub: MobilityServiceStub) -> None:
        """Report the contact with the API server if a report is due. To the service, a failed report is missing contact."""
        age_s = self._contact_age_s()
        # The interval is a little shorter than the interval of the telemetry, so that no message is skipped.
        due = time.monotonic() - self._reported_s >= 0.9 * CONTACT_INTERVAL_S
        if not (due and math.isfinite(age_s)):
            return
        self._reported_s = time.monotonic()
        try:
            await stub.ReportContact(ReportContactRequest(age_s=age_s), timeout=CONTACT_INTERVAL_S)
        except grpc.aio.AioRpcError as error:
            log.warning("telemetry: contact not reported (error=%s: %s)", error.code().name, error.details())

    def _lost(self, reason: str) -> None:
        problem = f"The mobility service is unreachable: {reason}."
        if self.problem is None:
            log.warning("telemetry: connection lost (mobility=%s reason=%s)", self._address, reason)
        if problem != self.problem:
            self.problem = problem
            self._on_change()
