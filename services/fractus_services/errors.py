"""Reasons to refuse a call: one exception hierarchy for both services. `error_details` converts it to gRPC."""

from __future__ import annotations

from fractus_core.policy.decision_types import Verdict


class Refused(Exception):
    """A call is refused, or aborted before its end.

    Args:
        code: CamelCase code for programs.
        reason: Sentence for people.
        policies: Names of the policies that decided.
        retry_after_s: Time after which the caller may retry, in seconds. 0 means that a retry does not help.
        verdict: Verdict of the policy engine, if the engine refused.

    Attributes:
        verdict: The refusal as a verdict, which clients receive in the status details.
    """

    def __init__(
        self,
        code: str,
        reason: str,
        policies: tuple[str, ...] = (),
        *,
        retry_after_s: float = 0.0,
        verdict: Verdict | None = None,
    ) -> None:
        super().__init__(reason)
        self.verdict = verdict or Verdict("deny", None, code, reason, policies)
        self.retry_after_s = retry_after_s


class PolicyDenied(Refused):
    """Policies forbid the call."""


class InvalidRequest(Refused):
    """The request is invalid in any state of the node."""


class NotAuthenticated(Refused):
    """The caller's certificate is missing, invalid or expired."""

    def __init__(self, reason: str) -> None:
        super().__init__("NotAuthenticated", reason)


class PreconditionFailed(Refused):
    """The current state of the drone or the node forbids the call."""


class Aborted(Refused):
    """The call was stopped before its end."""


class Unavailable(Refused):
    """The call cannot be served now. The caller may retry."""


class ResourceExhausted(Refused):
    """The caller exceeds a limit, or the node is full."""


class NotFound(Refused):
    """The requested object does not exist."""


class InternalError(Refused):
    """The service failed."""


def denied(verdict: Verdict) -> Refused:
    """Return the refusal for a verdict of the policy engine. Clients receive the verdict unchanged."""
    kind = InvalidRequest if verdict.code == "InvalidArgument" else PolicyDenied
    return kind(verdict.code, verdict.reason, verdict=verdict)


class AutopilotError(Exception):
    """An autopilot command failed. The message contains the command and the reason.

    Attributes:
        link: True if the autopilot sent no reply, so that a retry may help.
        refused: True if the autopilot rejected the command.
    """

    def __init__(self, reason: str, *, link: bool = False, refused: bool = False) -> None:
        super().__init__(reason)
        self.link = link
        self.refused = refused
