"""What the wire says, as values."""

from __future__ import annotations

from fractus import Telemetry
from fractus_proto.v1 import mobility_pb2, types_pb2


def test_telemetry_tells_an_unknown_position_from_the_gulf_of_guinea() -> None:
    lost = Telemetry.from_proto(mobility_pb2.Telemetry(position_error_m=1.5))
    assert (lost.position_error_m, lost.autopilot_connected, lost.attitude) == (None, False, None)
    at_zero = mobility_pb2.Telemetry(position=types_pb2.Position(), position_error_m=1.5, autopilot_connected=True)
    known = Telemetry.from_proto(at_zero)
    assert (known.position_error_m, known.autopilot_connected) == (1.5, True)
