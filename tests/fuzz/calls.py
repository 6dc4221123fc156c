"""Fuzz requests to the mobility service: each is refused with a reason, or judged by the engine."""

from __future__ import annotations

import sys

import atheris

with atheris.instrument_imports(include=["fractus_services.mobility.rpc", "fractus_core.policy"]):
    from fractus_core.policy.decision_types import Call
    from fractus_core.policy.engine import judge
    from fractus_services.errors import Refused
    from fractus_services.mobility.rpc import proto_conversion
from fractus_proto.v1 import mobility_pb2
from google.protobuf.message import DecodeError
from policy_world import HOME, altitude, at, box, compiled, exclusion, speed
from wire import number

GRANT = compiled(exclusion(box(20, 20, 60, 60)), altitude(upperLimit=60), speed(upperLimit=8))
SITUATIONS = (at(), at(40, 10, 30.0), at(40, 40, 30.0))
REPLIES = {"allow", "correct", "deny"}


def wire(message: bytes) -> Call:
    """Decode a message into the call that it requests."""
    return proto_conversion.call_of(mobility_pb2.CheckCallRequest.FromString(message))


def numbers(data_provider: atheris.FuzzedDataProvider) -> Call:
    """Return a call with arbitrary numbers, NaN and infinity included."""
    kind = data_provider.ConsumeIntInRange(0, 2)
    if kind == 0:
        request = mobility_pb2.GotoRequest(
            acceptance_radius_m=number(data_provider, 10), speed_mps=number(data_provider, 20)
        )
        request.target.altitude_reference = data_provider.ConsumeIntInRange(0, 5)
        request.target.latitude_deg = HOME.lat + number(data_provider, 0.002)
        request.target.longitude_deg = HOME.lon + number(data_provider, 0.002)
        request.target.altitude_m = number(data_provider, 100)
        if data_provider.ConsumeBool():
            request.yaw_deg = number(data_provider, 360)
        return Call("Goto", proto_conversion.goto_args(request))
    if kind == 1:
        velocity = mobility_pb2.SetVelocityRequest(hold_s=number(data_provider, 2))
        velocity.velocity.north_mps = number(data_provider, 20)
        velocity.velocity.east_mps = number(data_provider, 20)
        velocity.velocity.down_mps = number(data_provider, 5)
        return Call("SetVelocity", proto_conversion.velocity_args(velocity))
    check = mobility_pb2.CheckCallRequest()
    check.takeoff.altitude_m = number(data_provider, 100)
    return proto_conversion.call_of(check)


def fuzz_one(data: bytes) -> None:
    """Judge one request. It is decoded from the input, or built from numbers that the input selects."""
    try:
        call = wire(data[1:]) if data[:1] < b"\x40" else numbers(atheris.FuzzedDataProvider(data[1:]))
    except (DecodeError, Refused):
        return
    for situation in SITUATIONS:
        verdict = judge(call, situation, GRANT)
        assert verdict.action in REPLIES
        assert verdict.code != "InternalError", verdict
        proto_conversion.check_call_response(verdict).SerializeToString()


if __name__ == "__main__":
    atheris.Setup(sys.argv, fuzz_one)
    atheris.Fuzz()
