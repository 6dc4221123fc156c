"""Fuzz a connection of the MAVLink gateway: no exception, bounded state, and only calls that programs may make."""

from __future__ import annotations

import sys

import atheris

with atheris.instrument_imports(include=["fractus_services.gateway", "fractus_services.mavlink_server"]):
    from gateway_frames import check_call
    from mavlink_frames import MESSAGE_CLASSES, frame_v2
    from pymavlink.dialects.v20 import ardupilotmega as mavlink
    from test_gateway_session import World

RESULTS = (mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_DENIED, mavlink.MAV_RESULT_TEMPORARILY_REJECTED)
MAX_PAYLOAD_BYTES = 255


def fuzz_one(data: bytes) -> None:
    """Send the input as a sequence of frames, most of them with a correct checksum."""
    provider = atheris.FuzzedDataProvider(data)
    world = World(granted=provider.ConsumeBool())
    while provider.remaining_bytes():
        for call in world.session.receive(_frame(provider), world.now):
            check_call(call)
            if provider.ConsumeIntInRange(0, 3):
                world.session.finish(call, RESULTS[provider.ConsumeIntInRange(0, 2)], "text", world.now)
        world.now += provider.ConsumeFloatInRange(0.0, 2.0)
        assert {(message.sysid, message.compid) for message in world.sent()} <= {(1, 1)}
    assert len(world.session.take_refusals()) <= len(data)


def _frame(provider: atheris.FuzzedDataProvider) -> bytes:
    if not provider.ConsumeIntInRange(0, 9):
        return bytes(provider.ConsumeBytes(provider.ConsumeIntInRange(1, 64)))
    kind = MESSAGE_CLASSES[provider.ConsumeIntInRange(0, len(MESSAGE_CLASSES) - 1)]
    source = (provider.ConsumeIntInRange(0, 255), provider.ConsumeIntInRange(0, 255))
    payload = provider.ConsumeBytes(provider.ConsumeIntInRange(0, min(kind.unpacker.size, MAX_PAYLOAD_BYTES)))
    return frame_v2(kind, bytes(payload), source=source)


if __name__ == "__main__":
    atheris.Setup(sys.argv, fuzz_one)
    atheris.Fuzz()
