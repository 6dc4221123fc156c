"""Translation of failed gRPC calls to exceptions of the SDK."""

from __future__ import annotations

import re
from pathlib import Path

import grpc
import pytest
from fractus import Busy, ControlLost, FractusError, InvalidRequest, MissionEnded, PolicyDenied, StateError
from fractus.errors import translate
from fractus_core.control import Outcome, OutcomeKind
from fractus_core.control.state import ended_refusal
from fractus_core.policy.decision_types import Verdict
from fractus_services import errors
from fractus_services.error_details import abort
from fractus_services.errors import Refused, ResourceExhausted, denied


async def failed(refusal: Refused) -> grpc.aio.AioRpcError:
    """Return the gRPC error that a client receives if the service refuses a call."""
    seen: list[grpc.aio.AioRpcError] = []

    class Context:
        async def abort(self, code: grpc.StatusCode, text: str, metadata: tuple[tuple[str, bytes], ...]) -> None:
            trailing = grpc.aio.Metadata(*metadata)
            seen.append(grpc.aio.AioRpcError(code, grpc.aio.Metadata(), trailing, details=text))

    with pytest.raises(AssertionError):
        await abort(Context(), refusal)
    return seen[0]


@pytest.mark.parametrize("again_s", [0.25, 0.0])
async def test_busy_error_contains_retry_delay(again_s: float) -> None:
    reason = "more than 50 calls per second; slow down"
    error = await failed(ResourceExhausted("TooManyCalls", reason, retry_after_s=again_s))
    found = translate(error, "GetSpeed", "there")
    assert isinstance(found, Busy)
    assert str(found) == "GetSpeed: more than 50 calls per second; slow down"
    assert found.retry_after_s == (again_s or None)
    assert bool(found.remedy) == bool(again_s), "only an error with a retry delay has the remedy to wait"


async def test_policy_denied_contains_decision() -> None:
    verdict = Verdict("deny", None, "InsideExclusionZone", "the target is inside", ("no-fly",))
    found = translate(await failed(denied(verdict)), "Goto", "there")
    assert isinstance(found, PolicyDenied)
    assert (found.decision.code, found.decision.policies) == ("InsideExclusionZone", ("no-fly",))
    missing = errors.InvalidRequest("DeadlineMissing", "the call has no deadline; set a timeout, as the SDK does")
    found = translate(await failed(missing), "GetSpeed", "there")
    assert isinstance(found, InvalidRequest)
    assert "set a timeout" in str(found)


async def test_call_that_causes_a_takeover_raises_control_lost() -> None:
    verdict = Verdict("takeover", None, "InsideExclusionZone", "the target is inside", ("no-fly",), "hover")
    found = translate(await failed(denied(verdict)), "Goto", "there")
    assert type(found) is ControlLost
    assert str(found) == "the target is inside (by no-fly)"
    assert (found.decision.code, found.decision.policies) == ("InsideExclusionZone", ("no-fly",))


@pytest.mark.parametrize(
    ("code", "text", "remedy"),
    [
        (
            "UNAVAILABLE",
            "failed to connect: Hostname Verification Check failed.",
            "another node: correct FRACTUS_NODE",
        ),
        (
            "UNAVAILABLE",
            "Peer name d2.node.fractus.dev is not in peer certificate",
            "another node: correct FRACTUS_NODE",
        ),
        ("UNAVAILABLE", "SSL_ERROR_SSL: CERTIFICATE_VERIFY_FAILED: unable to get", "correct FRACTUS_TLS_DIR"),
        ("UNAVAILABLE", "SSL routines:OPENSSL_internal:WRONG_VERSION_NUMBER", "does not use TLS: correct the address"),
        (
            "UNIMPLEMENTED",
            "Method not found!",
            "another service or another version listens at this address: correct the address",
        ),
    ],
)
def test_grpc_error_text_gets_a_remedy(code: str, text: str, remedy: str) -> None:
    error = grpc.aio.AioRpcError(grpc.StatusCode[code], grpc.aio.Metadata(), grpc.aio.Metadata(), details=text)
    assert remedy in str(translate(error, "Goto", "there"))


ROOT = Path(__file__).parents[2]
RAISED = re.compile(r'PreconditionFailed\(\s*(?:\*ended_refusal|"([A-Z]\w+)")')


async def test_every_state_refusal_code_has_an_exception_type() -> None:
    sources = [path.read_text() for path in (ROOT / "services").rglob("*.py")]
    codes = {code for source in sources for code in RAISED.findall(source) if code} | {"AutopilotRefused"}
    assert {"NotArmed", "NotFlying", "NoLegalWay", "ControlHeld", "NotAtHome"} <= codes
    for code in codes:
        found = translate(await failed(errors.PreconditionFailed(code, "why")), "Goto", "there")
        assert type(found) not in {FractusError, StateError}, code
        assert found.remedy, code


async def test_mission_ended_names_remedy_for_another_flight() -> None:
    refusal = ended_refusal(Outcome(OutcomeKind.FAILED, "driver lost"))
    found = translate(await failed(errors.PreconditionFailed(*refusal)), "GetControl", "there")
    assert isinstance(found, MissionEnded)
    assert isinstance(found, ControlLost)
    assert "driver lost" in str(found)
    assert "another uid" in found.remedy
