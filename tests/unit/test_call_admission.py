"""Admission of calls: deadline, rate limit and number of open calls of each caller."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from contextlib import AsyncExitStack
from types import SimpleNamespace
from typing import Any, cast

import grpc
import pytest
from fractus_core.api.grants import GrantSpec
from fractus_core.policy.compiled_grant import compile_grant
from fractus_proto.v1 import types_pb2
from fractus_services import grpc_server
from fractus_services.auth import Caller
from fractus_services.errors import PolicyDenied
from fractus_services.grpc_server import CALL_BURST, MAX_OPEN_CALLS, URGENT_BURST, CallAdmission
from google.protobuf import any_pb2
from google.rpc import error_details_pb2, status_pb2


class Aborted(Exception):
    """Raised by the fake gRPC context when the service aborts the call."""

    def __init__(self, code: grpc.StatusCode, text: str, details: status_pb2.Status) -> None:
        super().__init__(f"{code.name}: {text}")
        self.details = details

    def find(self, kind: Any) -> Any:
        """Return the first status detail of the given type, or None."""
        for detail in self.details.details:
            if detail.Is(kind.DESCRIPTOR):
                unpacked = kind()
                cast("any_pb2.Any", detail).Unpack(unpacked)
                return unpacked
        return None


class Context:
    """Fake gRPC context of one call."""

    def __init__(self, remaining_s: float | None = 5.0) -> None:
        self.remaining_s = remaining_s

    def auth_context(self) -> dict[str, Any]:
        return {}

    def time_remaining(self) -> float | None:
        return self.remaining_s

    def invocation_metadata(self) -> tuple[tuple[str, str], ...]:
        return ()

    async def abort(self, code: grpc.StatusCode, text: str, metadata: Any) -> None:
        status = status_pb2.Status()
        status.ParseFromString(dict(metadata)["grpc-status-details-bin"])
        raise Aborted(code, text, status)


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> CallAdmission:
    known = Caller("spiffe://fractus.dev/a", math.inf)
    monkeypatch.setattr(grpc_server.Callers, "of", lambda _self, _context, _urgent: known)
    monkeypatch.setattr(grpc_server.time, "monotonic", lambda: 1.0)
    return CallAdmission(cast("Any", None), lambda: 0.0)


async def test_urgent_calls_have_separate_rate_limit(calls: CallAdmission) -> None:
    for _ in range(int(CALL_BURST)):
        async with calls.call(Context()):
            pass
    with pytest.raises(Aborted, match="RESOURCE_EXHAUSTED: more than 50 calls per second") as refusal:
        async with calls.call(Context()):
            pass
    assert refusal.value.find(error_details_pb2.RetryInfo).retry_delay.nanos == 20_000_000
    assert refusal.value.find(error_details_pb2.ErrorInfo).reason == "TooManyCalls"
    assert refusal.value.find(types_pb2.Decision).action == types_pb2.Decision.ACTION_DENY
    for _ in range(int(URGENT_BURST)):
        async with calls.call(Context(), urgent=True) as caller:
            assert caller.identity == "spiffe://fractus.dev/a"
    with pytest.raises(Aborted, match="RESOURCE_EXHAUSTED: more than 20 calls per second"):
        async with calls.call(Context(), urgent=True):
            pass


async def test_number_of_open_calls_is_limited(calls: CallAdmission) -> None:
    async with AsyncExitStack() as stack:
        for _ in range(MAX_OPEN_CALLS):
            await stack.enter_async_context(calls.call(Context(), lasting=True))
        with pytest.raises(Aborted, match=f"RESOURCE_EXHAUSTED: {MAX_OPEN_CALLS} calls are in progress"):
            async with calls.call(Context()):
                pass
        async with calls.call(Context(), urgent=True):
            pass
    async with calls.call(Context()):
        pass
    assert not calls._open


async def test_number_of_calls_waiting_for_request_is_limited(calls: CallAdmission) -> None:
    sent = asyncio.Event()

    class Slow(Context):
        async def read(self) -> Any:
            await sent.wait()
            return b"asked"

    async def echo(request: bytes, _context: Any) -> bytes:
        return request + b", answered"

    method = calls.wrap(
        "fractus.v1.Service/Method", grpc.unary_unary_rpc_method_handler(echo, lambda body: body)
    ).stream_unary
    waiting = [asyncio.create_task(method(None, Slow())) for _ in range(MAX_OPEN_CALLS)]
    await asyncio.sleep(0)
    with pytest.raises(Aborted, match="RESOURCE_EXHAUSTED: 32 calls of this method wait") as refusal:
        await method(None, Slow())
    assert refusal.value.find(error_details_pb2.RetryInfo).retry_delay.ToSeconds() == 1
    sent.set()
    assert await asyncio.gather(*waiting) == [b"asked, answered"] * MAX_OPEN_CALLS
    assert await method(None, Slow()) == b"asked, answered"


@pytest.mark.parametrize(("urgent", "lasting"), [(True, False), (False, True)])
async def test_call_without_deadline_is_refused(calls: CallAdmission, urgent: bool, lasting: bool) -> None:
    with pytest.raises(Aborted, match="INVALID_ARGUMENT: the call has no deadline; set a timeout") as refusal:
        async with calls.call(Context(None)):
            pass
    assert refusal.value.find(error_details_pb2.ErrorInfo).reason == "DeadlineMissing"
    assert refusal.value.find(error_details_pb2.RetryInfo) is None
    async with calls.call(Context(None), urgent, lasting):
        pass


@pytest.mark.parametrize("error", [ZeroDivisionError, RecursionError, MemoryError])
async def test_unexpected_error_refuses_call_and_is_reported(
    error: Callable[[], Exception], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(grpc_server.Callers, "of", lambda _self, _context, _urgent: Caller("a", math.inf))
    codes: list[str] = []
    calls = CallAdmission(cast("Any", None), lambda: 0.0, failed=lambda verdict: codes.append(verdict.code))
    with pytest.raises(Aborted, match="INTERNAL: the service failed; nothing was done"):
        async with calls.call(Context()):
            raise error()
    assert codes == ["InternalError"]
    assert not calls._open


def test_caller_without_grant_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    calls = CallAdmission(cast("Any", SimpleNamespace(active={})), lambda: 0.0)
    with pytest.raises(PolicyDenied):
        calls.grant_of(Caller("spiffe://fractus.dev/a", math.inf))
    (record,) = caplog.records
    assert (
        record.getMessage()
        == "policy: call refused because the caller has no Grant on this node (caller=spiffe://fractus.dev/a)"
    )
    assert record.limit_by == "spiffe://fractus.dev/a"  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("interfaces", "interface", "granted"),
    [
        (None, "grpc", True),
        (None, "mavlink", False),
        (["mavlink"], "grpc", False),
        (["mavlink"], "mavlink", True),
        (["grpc", "mavlink"], "mavlink", True),
    ],
)
def test_call_needs_its_interface_in_the_grant(interfaces: list[str] | None, interface: Any, granted: bool) -> None:
    request: dict[str, Any] = {"service": "mobility", "methods": ["Goto"]}
    if interfaces is not None:
        request["interfaces"] = interfaces
    spec = GrantSpec.model_validate(
        {
            "node": "d",
            "application": {"namespace": "n", "name": "a", "uid": "u"},
            "component": "C",
            "instance": "i",
            "services": [request],
        }
    )
    grants = SimpleNamespace(active={"a": SimpleNamespace(spec=spec, compiled=compile_grant(spec))})
    calls = CallAdmission(cast("Any", grants), lambda: 0.0, interface=interface)
    if granted:
        assert calls.grant_of(Caller("a", math.inf)).spec is spec
    else:
        with pytest.raises(PolicyDenied, match=f"over {interface}; add {interface} to the interfaces"):
            calls.grant_of(Caller("a", math.inf))
