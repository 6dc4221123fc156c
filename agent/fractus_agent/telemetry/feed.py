"""Follows the telemetry of the node's mobility service."""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import grpc
from fractus_core.api.geometry import Reference
from fractus_core.api.names import node_server_name
from fractus_core.control import Outcome, OutcomeKind
from fractus_core.exhaustive import exhaustive
from fractus_proto.v1.mobility_pb2 import MissionOutcome, SubscribeTelemetryRequest, Telemetry
from fractus_proto.v1.mobility_pb2_grpc import MobilityServiceStub
from fractus_proto.v1.types_pb2 import AltitudeReference
from fractus_runtime.files import read_set

from fractus_agent.cluster.store import Backoff
from fractus_agent.identity.identity import FILES
from fractus_agent.telemetry.snapshot import Snapshot

LOG = logging.getLogger(__name__)

INTERVAL_S, LINKED_INTERVAL_S = 1.0, 0.25
"""Seconds between messages: usually, and while direct links are decided by them."""
SILENCE_TIMEOUT_S = 5.0
"""Seconds without a message after which the service counts as unreachable."""

_WIRE: dict[Reference, AltitudeReference] = exhaustive(
    Reference,
    {
        "home": AltitudeReference.ALTITUDE_REFERENCE_HOME,
        "amsl": AltitudeReference.ALTITUDE_REFERENCE_AMSL,
        "terrain": AltitudeReference.ALTITUDE_REFERENCE_TERRAIN,
    },
)
_REFERENCES = {wire: reference for reference, wire in _WIRE.items()}


_KINDS = {
    MissionOutcome.KIND_COMPLETE: OutcomeKind.COMPLETE,
    MissionOutcome.KIND_REVOKED: OutcomeKind.REVOKED,
    MissionOutcome.KIND_FAILED: OutcomeKind.FAILED,
}


def outcome(message: MissionOutcome) -> Outcome:
    """Translate how a mission ended; of a kind that this release does not know, it failed."""
    return Outcome(_KINDS.get(message.kind, OutcomeKind.FAILED), message.reason)


def snapshot(message: Telemetry) -> Snapshot:
    """Translate a telemetry message."""
    position = None
    if message.HasField("position"):
        place = message.position
        reference = _REFERENCES.get(place.altitude_reference, "home")
        position = (place.latitude_deg, place.longitude_deg, place.altitude_m, reference)
    return Snapshot(
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
        missions={key: outcome(ended) for key, ended in message.missions.items()},
        velocity_mps=(message.velocity.east_mps, message.velocity.north_mps, -message.velocity.down_mps),
        altitude_amsl_m=message.altitude_amsl_m,
        recording_problem=message.recording_problem,
        controller_reason=message.controller_reason,
    )


class TelemetryFeed:
    """Keeps the latest snapshot, and why there is none.

    Args:
        address: host and port of the mobility service.
        tls: directory of the node's certificate, the client's identity here.
        node: name of the node, for the server's name.
        serial: counts changes of the certificate; the feed reconnects when it moves.
        changed: called after every message and every loss.
    """

    def __init__(
        self, address: str, tls: Path, node: str, *, serial: Callable[[], int], changed: Callable[[], None]
    ) -> None:
        self._address = address
        self._tls = tls
        self._node = node
        self._serial = serial
        self._changed = changed
        self._interval_s = INTERVAL_S
        self._heard_s = -math.inf
        self.latest: Snapshot | None = None
        self.problem: str | None = "The mobility service has not answered yet."

    @property
    def age_s(self) -> float:
        """Seconds since the mobility service was heard; infinite before that."""
        return time.monotonic() - self._heard_s

    def hasten(self, fast: bool) -> None:
        """Ask for messages often, or as usual."""
        self._interval_s = LINKED_INTERVAL_S if fast else INTERVAL_S

    async def run(self) -> None:
        """Stay subscribed until cancelled."""
        backoff = Backoff(0.5, 5.0)
        while True:
            try:
                async for message in self._messages():
                    if self.problem is not None:
                        LOG.info("telemetry: connected (mobility=%s)", self._address)
                    self.latest, self.problem = snapshot(message), None
                    self._heard_s = time.monotonic()
                    backoff.succeeded()
                    self._changed()
                self._lost("asking again", expected=True)
                continue
            except grpc.aio.AioRpcError as error:
                self._lost(f"{error.code().name}: {error.details()}")
            except TimeoutError:
                self._lost(f"silent for {SILENCE_TIMEOUT_S:.0f} s")
            except (OSError, ValueError) as error:
                self._lost(str(error))
            await asyncio.sleep(backoff.delay_s())

    async def _messages(self) -> AsyncIterator[Telemetry]:
        files = read_set(self._tls, FILES)
        if files is None:
            raise FileNotFoundError("the node has no certificate yet")
        asked = (self._serial(), self._interval_s)
        credentials = grpc.ssl_channel_credentials(files["ca.crt"], files["tls.key"], files["tls.crt"])
        options = (("grpc.ssl_target_name_override", node_server_name(self._node)), ("grpc.enable_http_proxy", 0))
        async with grpc.aio.secure_channel(self._address, credentials, options=options) as channel:
            stub = MobilityServiceStub(channel)
            call = stub.SubscribeTelemetry(SubscribeTelemetryRequest(interval_s=self._interval_s))
            try:
                while (self._serial(), self._interval_s) == asked:
                    message = await asyncio.wait_for(call.read(), SILENCE_TIMEOUT_S)
                    if message is grpc.aio.EOF:
                        raise ConnectionResetError(f"the service ended the stream: {await call.details()}")
                    yield message
            finally:
                call.cancel()

    def _lost(self, why: str, *, expected: bool = False) -> None:
        problem = f"The mobility service is out of reach: {why}."
        if self.problem is None and not expected:
            LOG.warning("telemetry: lost (mobility=%s): %s", self._address, why)
        if problem != self.problem and not expected:
            self.problem = problem
            self._changed()
