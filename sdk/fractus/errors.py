"""Exceptions of the SDK, and the translation of gRPC errors."""

from __future__ import annotations

from typing import Any

import grpc
from fractus_proto.v1 import types_pb2
from google.rpc import error_details_pb2
from grpc_status import rpc_status

from fractus.values import Action, Decision, Result


class FractusError(Exception):
    """Base class of all exceptions of the SDK. The text is one sentence for people.

    Attributes:
        remedy: Recommended reaction of the program or its author; empty if the text already contains it.
    """

    remedy = ""


class InvalidRequest(FractusError):
    """An argument is invalid, for example NaN, a latitude of 95, or the name of an unknown picture."""

    remedy = "correct the argument"


class StateError(FractusError):
    """The state of the drone, the autopilot or the node does not permit the call now. Nothing was carried out.

    Attributes:
        code: Reason in CamelCase, for programs.
    """

    def __init__(self, code: str, message: str) -> None:
        self.code = code
        super().__init__(message)


class NotReady(StateError):
    """The motors cannot start yet: the autopilot, its link, a log of the service, or an awaited component is not ready."""

    remedy = "wait and retry; `control(progress=print)` prints the reason"


class NotAtHome(StateError):
    """The drone is too far from the home position of its Grant to take off."""

    remedy = "carry the drone to its home, or correct the home"


class NotArmed(StateError):
    """The motors are off."""

    remedy = "`await drone.arm()` first"


class NotFlying(StateError):
    """The drone is on the ground."""

    remedy = "`await drone.takeoff(...)` first"


class NoLegalWay(StateError):
    """The system found no route to the target that policies permit."""

    remedy = "choose another target"


class ControlHeld(StateError):
    """Another application, or another process of this component, controls the drone."""

    remedy = "retry when the drone is back; `fractus.run` does this"


class AutopilotRefused(StateError):
    """The autopilot refused the command."""

    remedy = "read the reason; `drone.telemetry()` contains the autopilot's texts"


class CameraFixed(StateError):
    """The node's description declares a fixed camera."""

    remedy = "set services.camera.mount.gimbal of the Drone if a gimbal turns its camera"


class PolicyDenied(FractusError):
    """Policies forbid the call. Nothing was carried out: the drone hovers, and this component keeps control.

    Attributes:
        decision: Decision of the policy engine.
        code: Reason in CamelCase, for programs, for example `InsideExclusionZone`.
        reason: Reason in one sentence, for people.
        policies: Names of the policies that decided, most restrictive first.
    """

    remedy = "change the request, or continue without it; `drone.can_i` checks a call in advance"

    def __init__(self, decision: Decision) -> None:
        self.decision = decision
        self.code = decision.code
        self.reason = decision.reason
        self.policies = decision.policies
        super().__init__(_text_of(decision, "not allowed"))


class Corrected(FractusError):
    """A policy changed the call's arguments, and the client is strict.

    Attributes:
        result: The corrected call that was carried out. A corrected motion is stopped.
    """

    def __init__(self, result: Result) -> None:
        self.result = result
        self.decision = result.decision
        super().__init__(f"corrected: {result.decision.reason}")


class ControlLost(FractusError):
    """The system or a human pilot took the drone, or this component never had control.

    Attributes:
        decision: Reason, and the policies that demanded the takeover, if any.
    """

    remedy = "request control again: it is granted when the drone is free; `fractus.run` does this"

    def __init__(self, message: str, decision: Decision | None = None) -> None:
        self.decision = decision or Decision(Action.UNSPECIFIED, reason=message)
        super().__init__(_text_of(decision, message) if decision is not None else message)


class MissionEnded(ControlLost):
    """The mission ended early: a policy took the drone permanently, the driver was lost, or the Grant was removed."""

    remedy = "for another flight, apply the application again, or give the Grant another uid"


class Interrupted(FractusError):
    """A motion was stopped before it was complete. The drone hovers, and this component keeps control.

    Attributes:
        decision: Reason, and the policies that decided, if any.
    """

    remedy = "request the motion again; `fractus.run` restarts the program"

    def __init__(self, message: str, decision: Decision | None) -> None:
        self.decision = decision or Decision(Action.UNSPECIFIED, reason=message)
        super().__init__(message)


class MissionComplete(FractusError):
    """All control points of this component are complete. The drone is at home or on its return flight."""

    remedy = "for another flight, apply the application again, or give the Grant another uid"


class Unavailable(FractusError):
    """The service is unreachable or did not respond in time."""

    remedy = "check that the service runs, and restart the program: the mission continues at its current waypoint"


class Busy(FractusError):
    """The service accepts no more calls or pictures of this component now.

    Attributes:
        retry_after_s: Seconds after which a retry may succeed; None if waiting alone does not help. The message then
            contains the remedy.
    """

    remedy = "wait for `retry_after_s`, and call less often"

    def __init__(self, message: str, retry_after_s: float | None = None) -> None:
        self.retry_after_s = retry_after_s
        if retry_after_s is None:
            self.remedy = ""
        super().__init__(message)


class NotConfigured(FractusError):
    """Environment variables of a component's pod are missing or invalid. The message names the variables to set."""


def _text_of(decision: Decision, text: str) -> str:
    """Return the reason of a decision with the names of the policies, or `text` if the decision has no reason."""
    named = f" (by {', '.join(decision.policies)})" if decision.policies else ""
    return f"{decision.reason or decision.code or text}{named}"


def decision_of(error: Any) -> Decision | None:
    """Return the policy engine's decision from the status details of a failed call, or None."""
    message = types_pb2.Decision()
    return Decision.from_proto(message) if _detail(error, message) else None


def _retry_after_s(error: Any) -> float | None:
    """Return the delay in seconds after which a failed call may be retried, or None if the status contains no delay."""
    message = error_details_pb2.RetryInfo()
    if not _detail(error, message):
        return None
    return float(message.retry_delay.seconds + message.retry_delay.nanos / 1e9)


def _detail(error: Any, message: Any) -> bool:
    """Unpack the status detail of the message's type into `message`. Return False if there is no such detail."""
    if error.trailing_metadata() is None:
        return False
    try:
        status = rpc_status.from_call(error)
    except ValueError:  # the details contradict the status, so a Fractus service did not send them
        return False
    details = status.details if status is not None else ()
    return any(detail.Is(message.DESCRIPTOR) and detail.Unpack(message) for detail in details)


def translate(error: Any, method: str, address: str) -> FractusError:
    """Convert a failed gRPC call to an exception of the SDK.

    Args:
        error: The `grpc.aio.AioRpcError`.
        method: Name of the method.
        address: Address of the service.
    """
    code = error.code()
    text = error.details() or ""
    decision = decision_of(error)
    if code in {grpc.StatusCode.PERMISSION_DENIED, grpc.StatusCode.FAILED_PRECONDITION}:
        return _refusal(code, text, method, decision)
    if code is grpc.StatusCode.ABORTED:
        return Interrupted(f"{method}: {text}", decision)
    if code in {grpc.StatusCode.INVALID_ARGUMENT, grpc.StatusCode.NOT_FOUND, grpc.StatusCode.OUT_OF_RANGE}:
        return InvalidRequest(f"{method}: {text}")
    if code in {grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.DEADLINE_EXCEEDED}:
        answer = text if decision is not None else f"no response from {address} ({text or code.name}){_remedy(text)}"
        return Unavailable(f"{method}: {answer}")
    if code is grpc.StatusCode.RESOURCE_EXHAUSTED:
        return Busy(f"{method}: {text or code.name}", _retry_after_s(error))
    return FractusError(f"{method}: {text or code.name}{_remedy(text)}")


def _remedy(text: str) -> str:
    return next((f"; {remedy}" for sign, remedy in _REMEDIES.items() if sign in text.lower()), "")


def _refusal(code: grpc.StatusCode, text: str, method: str, decision: Decision | None) -> FractusError:
    if (decision is not None and decision.code == "MissionComplete") or "mission is complete" in text:
        return MissionComplete(text)
    if decision is not None and decision.code == "MissionEnded":
        return MissionEnded(decision.reason or text)
    if decision is not None and decision.action is Action.TAKEOVER:
        return ControlLost(text, decision)
    if decision is not None and decision.code in _CONTROL_CODES:
        return ControlLost(decision.reason or text)
    if code is grpc.StatusCode.PERMISSION_DENIED:
        return PolicyDenied(decision or Decision(Action.DENY, reason=text or f"{method} is not allowed"))
    state = decision.code if decision is not None else ""
    return _STATE_ERRORS.get(state, StateError)(state, f"{method}: {text}")


_FOREIGN = "another authority signed its certificate: correct FRACTUS_TLS_DIR, or the address"
_REMEDIES = {
    "hostname verification": "the certificate belongs to another node: correct FRACTUS_NODE or the address",
    "not in peer certificate": "the certificate belongs to another node: correct FRACTUS_NODE or the address",
    "certificate_verify_failed": _FOREIGN,
    "certificate signature failure": _FOREIGN,
    "create security handshaker": "tls.crt and tls.key do not match: correct FRACTUS_TLS_DIR",
    "socket closed": "the service may not trust the authority of this component's certificate: see its log, and correct FRACTUS_TLS_DIR",
    "wrong_version_number": "the server does not use TLS: correct the address",
    "method not found": "another service or another version listens at this address: correct the address",
}
"""Remedies for failed connections, by a part of gRPC's error text."""

_CONTROL_CODES = frozenset({"NotInControl", "ControlLost", "NoControl"})
"""Codes of refusals because of the control authority, not because of a policy."""

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
"""Exceptions for refusals because of the drone's state, by code."""
