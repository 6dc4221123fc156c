"""Converts verdicts and refusals to gRPC messages, status codes and error details."""

from __future__ import annotations

from typing import Any, NoReturn

import grpc
from fractus_core.exhaustive import exhaustive
from fractus_core.policy.decision_types import Action, Verdict
from fractus_proto.v1 import types_pb2
from fractus_runtime import tracing
from google.protobuf import any_pb2
from google.rpc import code_pb2, error_details_pb2, status_pb2
from grpc_status import rpc_status
from opentelemetry import trace

from fractus_services.errors import (
    Aborted,
    InternalError,
    InvalidRequest,
    NotAuthenticated,
    NotFound,
    PolicyDenied,
    PreconditionFailed,
    Refused,
    ResourceExhausted,
    Unavailable,
)

DOMAIN = "fractus.dev"

_ACTIONS: dict[Action, types_pb2.Decision.Action] = exhaustive(
    Action,
    {
        "allow": types_pb2.Decision.ACTION_ALLOW,
        "correct": types_pb2.Decision.ACTION_CORRECT,
        "deny": types_pb2.Decision.ACTION_DENY,
        "takeover": types_pb2.Decision.ACTION_TAKEOVER,
    },
)


STATUS: dict[type[Refused], grpc.StatusCode] = {
    PolicyDenied: grpc.StatusCode.PERMISSION_DENIED,
    InvalidRequest: grpc.StatusCode.INVALID_ARGUMENT,
    NotAuthenticated: grpc.StatusCode.UNAUTHENTICATED,
    PreconditionFailed: grpc.StatusCode.FAILED_PRECONDITION,
    Aborted: grpc.StatusCode.ABORTED,
    Unavailable: grpc.StatusCode.UNAVAILABLE,
    ResourceExhausted: grpc.StatusCode.RESOURCE_EXHAUSTED,
    NotFound: grpc.StatusCode.NOT_FOUND,
    InternalError: grpc.StatusCode.INTERNAL,
    Refused: grpc.StatusCode.UNKNOWN,
}


def decision(verdict: Verdict) -> types_pb2.Decision:
    """Convert a verdict to its message."""
    tracing.set_verdict(trace.get_current_span(), verdict.action, verdict.code, verdict.policies)
    return types_pb2.Decision(
        action=_ACTIONS[verdict.action], reason=verdict.reason, code=verdict.code, policies=verdict.policies
    )


async def abort(context: Any, refusal: Refused) -> NoReturn:
    """End a call with the status and the error details of a refusal."""
    details = [decision(refusal.verdict), _error_info(refusal.verdict)]
    if refusal.retry_after_s:
        retry = error_details_pb2.RetryInfo()
        retry.retry_delay.FromNanoseconds(int(refusal.retry_after_s * 1e9))
        details.append(retry)
    status = next(STATUS[kind] for kind in type(refusal).__mro__ if kind in STATUS)
    number = code_pb2.Code.Value(status.name)
    tracing.set_status(trace.get_current_span(), number)
    rich = rpc_status.to_status(
        status_pb2.Status(code=number, message=refusal.verdict.reason, details=map(_packed, details))
    )
    await context.abort(rich.code, rich.details, rich.trailing_metadata)
    raise AssertionError("abort always raises")


def _error_info(verdict: Verdict) -> Any:
    policies = {"policies": ",".join(verdict.policies)}
    return error_details_pb2.ErrorInfo(reason=verdict.code, domain=DOMAIN, metadata=policies)


def _packed(message: Any) -> any_pb2.Any:
    packed = any_pb2.Any()
    packed.Pack(message)
    return packed
