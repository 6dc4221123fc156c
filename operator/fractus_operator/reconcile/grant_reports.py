"""What the node of a Grant says of it, as the status of the Grant."""

from __future__ import annotations

from fractus_core.api.grants import ENDED, ReportedGrant

from fractus_operator.cluster.kinds import Body


def reported_status(grant: Body, report: ReportedGrant) -> Body | None:
    """The status to give a Grant; None where it has that already. An end that was reported once is not taken back.

    Args:
        grant: As it is at the API server.
        report: What the agent of its node says of it by now.
    """
    known = grant.get("status") or {}
    said: Body = {"phase": report.phase, "message": report.message}
    if known.get("phase") in ENDED:
        said = {"phase": known["phase"], "message": known.get("message") or ""}
    said["observedGeneration"] = report.observed_generation
    return None if all(known.get(field) == value for field, value in said.items()) else said
