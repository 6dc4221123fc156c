"""Conversion of protobuf messages to values."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable

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


async def test_watch_yields_changes_once() -> None:
    def sample(satellites: int) -> Telemetry:
        message = mobility_pb2.Telemetry(not_ready_reason="it has no home yet")
        message.gps.fix_type = 3
        message.gps.satellites = satellites
        return Telemetry.from_proto(message)

    watch = Watch(stream(sample(7), sample(7), sample(9)))
    assert [gps.satellites async for gps in watch.gps()] == [7, 9]
    assert [(health.ready, health.problem) async for health in watch.health()] == [(False, "it has no home yet")]
    assert [wind async for wind in watch.wind()] == []


def stream(*samples: Telemetry) -> Callable[[float], AsyncGenerator[Telemetry, None]]:
    async def telemetry(_interval_s: float) -> AsyncGenerator[Telemetry, None]:
        for one in samples:
            yield one

    return telemetry


def text_sample(time_s: int, **texts: int) -> Telemetry:
    """Return a sample with texts and their times in seconds. A text with the time -1 has none."""
    message = mobility_pb2.Telemetry()
    message.time.FromSeconds(time_s)
    for text, received_s in texts.items():
        sent = message.texts.add(severity=2, text=text)
        if received_s >= 0:
            sent.time.FromSeconds(received_s)
    return Telemetry.from_proto(message)


async def status_texts(*samples: Telemetry) -> list[tuple[str, float]]:
    return [(text.text, text.time.timestamp()) async for text in Watch(stream(*samples)).status_texts()]


async def test_status_texts_start_at_the_subscription_and_have_times() -> None:
    samples = text_sample(100, early=40, earlier=99), text_sample(110, later=104), text_sample(120, last=120)
    assert await status_texts(*samples) == [("later", 104.0), ("last", 120.0)]


async def test_status_texts_are_not_repeated_when_the_stream_is_opened_again() -> None:
    reopened = text_sample(120, early=40, seen=104, missed=115)
    assert await status_texts(text_sample(100, early=40), text_sample(110, seen=104), reopened) == [
        ("seen", 104.0),
        ("missed", 115.0),
    ]


async def test_status_texts_are_not_lost_when_the_clock_is_set_back() -> None:
    assert await status_texts(text_sample(1000), text_sample(20, after=19)) == [("after", 19.0)]


async def test_status_texts_of_a_service_without_times_have_the_time_of_the_sample() -> None:
    assert await status_texts(text_sample(100, early=-1), text_sample(110, later=-1)) == [("later", 110.0)]


def test_unknown_gps_fix_type_counts_as_3d_fix() -> None:
    message = mobility_pb2.Telemetry()
    message.gps.fix_type = 42
    gps = Telemetry.from_proto(message).gps
    assert gps is not None
    assert gps.fix is Fix.FIX_3D
