"""Verdicts and failures as gRPC speaks of them."""

from __future__ import annotations

from typing import Any, NoReturn

import grpc
from fractus_core.policy.values import Verdict
from fractus_proto.v1 import types_pb2
from google.protobuf import any_pb2
from google.rpc import code_pb2, error_details_pb2, status_pb2  # type: ignore[import-untyped]
from grpc_status import rpc_status  # type: ignore[import-untyped]

DOMAIN = "fractus.dev"

_ACTIONS = {
    "allow": types_pb2.Decision.ACTION_ALLOW,
    "correct": types_pb2.Decision.ACTION_CORRECT,
    "deny": types_pb2.Decision.ACTION_DENY,
    "takeover": types_pb2.Decision.ACTION_TAKEOVER,
}


class Refused(Exception):
    """A call that ends without being carried out.

    Attributes:
        status: the gRPC status code.
        verdict: what clients find in the status details.
        again_s: in how many seconds the caller may try again; 0: trying again as such does not help.
    """

    def __init__(self, status: grpc.StatusCode, verdict: Verdict, again_s: float = 0.0) -> None:
        super().__init__(verdict.reason)
        self.status = status
        self.verdict = verdict
        self.again_s = again_s


def refused(verdict: Verdict) -> Refused:
    """A refusal by policy."""
    invalid = verdict.code == "InvalidArgument"
    return Refused(grpc.StatusCode.INVALID_ARGUMENT if invalid else grpc.StatusCode.PERMISSION_DENIED, verdict)


def precondition(code: str, reason: str) -> Refused:
    """A call that the drone's present state forbids."""
    return Refused(grpc.StatusCode.FAILED_PRECONDITION, Verdict("deny", None, code, reason))


def aborted(code: str, reason: str, policies: tuple[str, ...] = ()) -> Refused:
    """A call that was carried out in part and then stopped."""
    return Refused(grpc.StatusCode.ABORTED, Verdict("deny", None, code, reason, policies))


def unavailable(reason: str) -> Refused:
    """A call that cannot be served now and may be tried again."""
    return Refused(grpc.StatusCode.UNAVAILABLE, Verdict("deny", None, "AutopilotUnavailable", reason))


def decision(verdict: Verdict) -> types_pb2.Decision:
    """The verdict as replies carry it."""
    return types_pb2.Decision(
        action=_ACTIONS[verdict.action], reason=verdict.reason, code=verdict.code, policies=verdict.policies
    )


async def abort(context: Any, refusal: Refused) -> NoReturn:
    """End a call with the structured details of a refusal."""
    details = [decision(refusal.verdict), _error_info(refusal.verdict)]
    if refusal.again_s:
        again = error_details_pb2.RetryInfo()
        again.retry_delay.FromNanoseconds(int(refusal.again_s * 1e9))
        details.append(again)
    number = code_pb2.Code.Value(refusal.status.name)
    status = status_pb2.Status(code=number, message=refusal.verdict.reason, details=map(_packed, details))
    rich = rpc_status.to_status(status)
    await context.abort(rich.code, rich.details, rich.trailing_metadata)
    raise AssertionError("abort always raises")


def _error_info(verdict: Verdict) -> Any:
    policies = {"policies": ",".join(verdict.policies)}
    return error_details_pb2.ErrorInfo(reason=verdict.code, domain=DOMAIN, metadata=policies)


def _packed(message: Any) -> any_pb2.Any:
    packed = any_pb2.Any()
    packed.Pack(message)
    return packed
