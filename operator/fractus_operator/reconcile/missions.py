"""How the mission of an application ended, as the nodes report it in its grants."""

from __future__ import annotations

from collections.abc import Iterable
from typing import assert_never

from fractus_core.api import Grant
from fractus_core.control import Outcome, OutcomeKind


def mission_outcome(uid: str | None, grants: Iterable[Grant]) -> Outcome | None:
    """How the mission of the application with this uid ended; None while it goes on.

    The node of its driver reports it, or that of the component which the system flies its tour for.
    """
    for grant in grants:
        spec, status = grant.spec, grant.status
        leads = spec.class_ == "driver" or spec.tour
        if not leads or spec.application.uid != uid or status is None:
            continue
        match status.phase:
            case "Complete":
                return Outcome(OutcomeKind.COMPLETE, status.message or f"{spec.component} finished its mission")
            case "Failed":
                return Outcome(OutcomeKind.FAILED, status.message or f"the mission of {spec.component} failed")
            case "Revoked":
                message = status.message or f"the control of {spec.component} was revoked"
                return Outcome(OutcomeKind.REVOKED, message)
            case "Pending" | "Active" | None:
                continue
            case _:
                assert_never(status.phase)
    return None
