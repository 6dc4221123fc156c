"""What can go wrong in a call, as types that programs can tell apart."""

from __future__ import annotations

from typing import Any

import grpc
from fractus_proto.v1 import types_pb2
from google.rpc import error_details_pb2
from grpc_status import rpc_status

from fractus.values import Action, Decision, Result


class FractusError(Exception):
    """Root of everything that the SDK raises; its text is one sentence for people.

    Attributes:
        remedy: what a program, or its author, does about it; empty where the text says so.
    """

    remedy = ""


class InvalidRequest(FractusError):
    """The service cannot make sense of an argument: a NaN, a latitude of 95, an unknown picture."""

    remedy = "correct the argument"


class StateError(FractusError):
    """The state of the drone, its autopilot or its node does not permit the call now; nothing of it was carried out.

    Attributes:
        code: CamelCase reason for programs.
    """

    def __init__(self, code: str, message: str) -> None:
        self.code = code
        super().__init__(message)


class NotReady(StateError):
    """The motors cannot be started yet: a check of the autopilot, its failsafes, its fence, the link, or a log."""

    remedy = "wait and try again; `control(progress=print)` tells what is waited for"


class NotAtHome(StateError):
    """The drone stands too far from the home of its Grant to begin there."""

    remedy = "carry the drone to its home, or correct the home"


class NotArmed(StateError):
    """The motors are off."""

    remedy = "`await drone.arm()` first"


class NotFlying(StateError):
    """The drone is on the ground."""

    remedy = "`await drone.takeoff(...)` first"


class NoLegalWay(StateError):
    """The system finds no way there that policies permit."""

    remedy = "ask for another place"


class ControlHeld(StateError):
    """Another application has the drone."""

    remedy = "try again when it is back; `fractus.run` does"


class AutopilotRefused(StateError):
    """The autopilot heard the command and refused it."""

    remedy = "see the reason; `drone.telemetry()` has its texts"


class CameraFixed(StateError):
    """The node's description says that its camera does not move."""

    remedy = "set services.camera.mount.gimbal of the Drone, if a gimbal turns its camera"


class PolicyDenied(FractusError):
    """Policies forbid the call and nothing of it was carried out: the drone hovers, and is still yours.

    Attributes:
        decision: what the policy checker answered.
        code: CamelCase reason for programs, such as `InsideExclusionZone`.
        reason: one sentence for people.
        policies: names of the policies that decided, most restrictive first.
    """

    remedy = "ask for something else, or go on without it; `drone.can_i` asks beforehand"

    def __init__(self, decision: Decision) -> None:
        self.decision = decision
        self.code = decision.code
        self.reason = decision.reason
        self.policies = decision.policies
        named = f" (by {', '.join(decision.policies)})" if decision.policies else ""
        super().__init__(f"{decision.reason or decision.code or 'not allowed'}{named}")


class Corrected(FractusError):
    """A policy changed the call's arguments and the client is strict.

    Attributes:
        result: what was carried out instead; a corrected motion is stopped.
    """

    def __init__(self, result: Result) -> None:
        self.result = result
        self.decision = result.decision
        super().__init__(f"corrected: {result.decision.reason}")


class ControlLost(FractusError):
    """The system or a human pilot took the drone, or this component never had it."""

    remedy = "ask for control again: it comes when the drone is free; `fractus.run` does"


class MissionEnded(ControlLost):
    """The mission is over before its end: a policy took the drone for good, its driver was lost, or its Grant was removed."""

    remedy = "apply the application again, or give the Grant another uid, for another flight"


class Interrupted(FractusError):
    """A motion was begun and then stopped before it was complete; the drone hovers, and is still yours.

    Attributes:
        decision: why, and by which policies, if any.
    """

    remedy = "ask for the motion again; `fractus.run` begins the program again"

    def __init__(self, message: str, decision: Decision | None) -> None:
        self.decision = decision or Decision(Action.UNSPECIFIED, reason=message)
        super().__init__(message)


class MissionComplete(FractusError):
    """Every control point of this component is done; the drone is home or on its way there."""

    remedy = "nothing is left to do"


class Unavailable(FractusError):
    """The service cannot be reached, or did not answer in time."""

    remedy = "see that the service runs, and begin again: the drone goes on where it was"


class Busy(FractusError):
    """The service takes no more of this component now: too many calls, or no room for another picture.

    Attributes:
        retry_after_s: in how many seconds to try again; None where waiting alone does not help: the message says what does.
    """

    remedy = "wait for `retry_after_s`, and call less often"

    def __init__(self, message: str, retry_after_s: float | None = None) -> None:
        self.retry_after_s = retry_after_s
        if retry_after_s is None:
            self.remedy = ""
        super().__init__(message)


class NotConfigured(FractusError):
    """The environment lacks what Fractus gives the pods of a component; the message says what to set."""


def decision_of(error: Any) -> Decision | None:
    """The policy checker's decision in the status details of a failed call, if it carries one."""
    message = types_pb2.Decision()
    return Decision.from_proto(message) if _detail(error, message) else None


def _retry_after_s(error: Any) -> float | None:
    """In how many seconds a failed call may be tried again, if it says so."""
    message = error_details_pb2.RetryInfo()
    if not _detail(error, message):
        return None
    return float(message.retry_delay.seconds + message.retry_delay.nanos / 1e9)


def _detail(error: Any, message: Any) -> bool:
    """Fill in the detail of the message's kind that a failed call carries; False if it carries none."""
    if error.trailing_metadata() is None:
        return False
    try:
        status = rpc_status.from_call(error)
    except ValueError:  # the details contradict the status: not ours
        return False
    found = status.details if status is not None else ()
    return any(detail.Is(message.DESCRIPTOR) and detail.Unpack(message) for detail in found)


def translate(error: Any, what: str, address: str) -> FractusError:
    """Turn a failed gRPC call into one of our types.

    Args:
        error: the `grpc.aio.AioRpcError`.
        what: the method, as the user knows it.
        address: where the call went.
    """
    code, text = error.code(), error.details() or ""
    decision = decision_of(error)
    if code in {grpc.StatusCode.PERMISSION_DENIED, grpc.StatusCode.FAILED_PRECONDITION}:
        return _refusal(code, text, what, decision)
    if code is grpc.StatusCode.ABORTED:
        return Interrupted(f"{what}: {text}", decision)
    if code in {grpc.StatusCode.INVALID_ARGUMENT, grpc.StatusCode.NOT_FOUND, grpc.StatusCode.OUT_OF_RANGE}:
        return InvalidRequest(f"{what}: {text}")
    if code in {grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.DEADLINE_EXCEEDED}:
        return Unavailable(f"{what}: no answer from {address} ({text or code.name}){_remedy(text)}")
    if code is grpc.StatusCode.RESOURCE_EXHAUSTED:
        return Busy(f"{what}: {text or code.name}", _retry_after_s(error))
    return FractusError(f"{what}: {text or code.name}{_remedy(text)}")


def _remedy(text: str) -> str:
    return next((f"; {remedy}" for sign, remedy in _REMEDIES.items() if sign in text.lower()), "")


def _refusal(code: grpc.StatusCode, text: str, what: str, decision: Decision | None) -> FractusError:
    if (decision is not None and decision.code == "MissionComplete") or "mission is complete" in text:
        return MissionComplete(text)
    if decision is not None and decision.code == "MissionEnded":
        return MissionEnded(decision.reason or text)
    if decision is not None and decision.code in _CONTROL_CODES:
        return ControlLost(decision.reason or text)
    if code is grpc.StatusCode.PERMISSION_DENIED:
        return PolicyDenied(decision or Decision(Action.DENY, reason=text or f"{what} is not allowed"))
    state = decision.code if decision is not None else ""
    return _STATE_ERRORS.get(state, StateError)(state, f"{what}: {text}")


_FOREIGN = "another authority signed its certificate: correct FRACTUS_TLS_DIR, or the address"
_REMEDIES = {
    "hostname verification": "it is another node's: correct FRACTUS_NODE, or the address",
    "not in peer certificate": "it is another node's: correct FRACTUS_NODE, or the address",
    "certificate_verify_failed": _FOREIGN,
    "certificate signature failure": _FOREIGN,
    "create security handshaker": "tls.crt and tls.key are no pair: correct FRACTUS_TLS_DIR",
    "socket closed": "it may not know the authority of our certificate: see its log, and correct FRACTUS_TLS_DIR",
    "wrong_version_number": "it speaks no TLS: correct the address",
    "method not found": "another service listens there, or another version: correct the address",
}
"""What to correct, by what gRPC says of a connection that failed."""

_CONTROL_CODES = frozenset({"NotInControl", "ControlLost", "NoControl"})
"""Codes of refusals that say who flies, not what is forbidden."""

_STATE_ERRORS: dict[str, type[StateError]] = {
    **dict.fromkeys(
        (
            "NotReady", "PositionUnknown", "FailsafesNotVerified", "FenceNotRaised", "ReturnNotLimited", "LinkTooSlow",
            "AuditUnavailable", "JournalUnavailable",
        ),
        NotReady,
    ),
    **dict.fromkeys(("NoLegalWay", "ControlPointUnreachable", "NoStart", "TerrainUnknown"), NoLegalWay),
    "NotAtHome": NotAtHome,
    "NotArmed": NotArmed,
    "NotFlying": NotFlying,
    "ControlHeld": ControlHeld,
    "CameraFixed": CameraFixed,
    "AutopilotRefused": AutopilotRefused,
}  # fmt: skip
"""Refusals by the state of the drone, by their code."""
