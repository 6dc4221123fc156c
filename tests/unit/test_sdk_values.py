"""Conversion of protobuf messages to values."""

from __future__ import annotations

from collections.abc import AsyncGenerator

from fractus import Fix, Telemetry, Watch
from fractus_cli.telemetry import _line
from fractus_proto.v1 import mobility_pb2, types_pb2


def test_telemetry_position_is_none_if_unknown() -> None:
    lost = Telemetry.from_proto(mobility_pb2.Telemetry(position_error_m=1.5))
    assert (lost.position_error_m, lost.autopilot_connected, lost.attitude) == (None, False, None)
    assert (lost.position, lost.velocity, lost.home) == (None, None, None)
    assert "position unknown  speed unknown" in _line(lost)
    at_zero = mobility_pb2.Telemetry(position=types_pb2.Position(), position_error_m=1.5, autopilot_connected=True)
    known = Telemetry.from_proto(at_zero)
    assert (known.position_error_m, known.autopilot_connected) == (1.5, True)


async def test_watch_yields_changes_once_and_all_texts() -> None:
    def sample(satellites: int, *texts: str) -> Telemetry:
        message = mobility_pb2.Telemetry(not_ready_reason="it has no home yet")
        message.gps.fix_type = 3
        message.gps.satellites = satellites
        for text in texts:
            message.texts.add(severity=2, text=text)
        return Telemetry.from_proto(message)

    async def telemetry(_interval_s: float) -> AsyncGenerator[Telemetry, None]:
        for one in (sample(7, "PreArm: a", "PreArm: b"), sample(7), sample(9, "PreArm: b")):
            yield one

    watch = Watch(telemetry)
    assert [gps.satellites async for gps in watch.gps()] == [7, 9]
    assert [text.text async for text in watch.status_texts()] == ["PreArm: a", "PreArm: b", "PreArm: b"]
    assert [(health.ready, health.problem) async for health in watch.health()] == [(False, "it has no home yet")]
    assert [wind async for wind in watch.wind()] == []


def test_unknown_gps_fix_type_counts_as_3d_fix() -> None:
    message = mobility_pb2.Telemetry()
    message.gps.fix_type = 42
    gps = Telemetry.from_proto(message).gps
    assert gps is not None
    assert gps.fix is Fix.FIX_3D
