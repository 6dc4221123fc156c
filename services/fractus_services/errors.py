"""Why a call is not carried out: one hierarchy for both services, which only their gRPC side translates."""

from __future__ import annotations

from fractus_core.policy.decision_types import Verdict


class Refused(Exception):
    """A call that ends without being carried out, or not to its end.

    Args:
        code: a CamelCase word for programs.
        reason: a sentence for people.
        policies: names of those that decided.
        retry_after_s: when the caller may try again; 0: trying again as such does not help.
        verdict: of the engine, where that refuses.

    Attributes:
        verdict: the same as clients find it in the status details.
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
    """Policies forbid it."""


class InvalidRequest(Refused):
    """The request itself is wrong, whatever the state of the node."""


class NotAuthenticated(Refused):
    """The caller's certificate proves nothing (any more)."""

    def __init__(self, reason: str) -> None:
        super().__init__("NotAuthenticated", reason)


class PreconditionFailed(Refused):
    """The present state of the drone or the node forbids it."""


class Aborted(Refused):
    """It was carried out in part and then stopped."""


class Unavailable(Refused):
    """It cannot be served now and may be tried again."""


class ResourceExhausted(Refused):
    """The caller asks for more than its share, or the node is full."""


class NotFound(Refused):
    """It names something that does not exist."""


class InternalError(Refused):
    """The service itself failed."""


def denied(verdict: Verdict) -> Refused:
    """The refusal that a verdict of the engine stands for, which clients get as it is."""
    kind = InvalidRequest if verdict.code == "InvalidArgument" else PolicyDenied
    return kind(verdict.code, verdict.reason, verdict=verdict)


class AutopilotError(Exception):
    """The autopilot did not do what was asked; the text says what and why.

    Attributes:
        link: whether it was not heard, so that trying again may help.
        refused: whether it answered that it does not do this.
    """

    def __init__(self, reason: str, *, link: bool = False, refused: bool = False) -> None:
        super().__init__(reason)
        self.link = link
        self.refused = refused
