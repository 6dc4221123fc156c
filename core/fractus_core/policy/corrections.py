"""Corrections that hold: what is corrected passes the whole judgement, as if it had been asked for, or is denied."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from fractus_core.policy.values import Call, Verdict, deny, distinct

MAX_ROUNDS = 8
"""Corrections of a correction at most: each climbs or sinks into the limits of further zones, and few zones are stacked."""


def settled(call: Call, first: Verdict, judge: Callable[[Call], Verdict]) -> Verdict:
    """A correction carried on until nothing is left to correct.

    An altitude that is corrected may lie in the band of another zone, whose limits of altitude and speed were not looked
    at before. So whatever comes out is judged like a call that asks for it.

    Args:
        call: what was asked for.
        first: the correction of it.
        judge: the whole judgement of a call, in the same situation and under the same grant.

    Returns:
        A correction to arguments that are allowed as they are; or the denial of limits that cannot be met together. It is
        never a takeover: the application did not ask for what its call was corrected to.
    """
    done = [first]
    for _ in range(MAX_ROUNDS):
        verdict = judge(replace(call, args=done[-1].args))
        if verdict.action == "allow":
            return _summed_up(done, verdict)
        if verdict.action != "correct":
            return conflicting(done, verdict)
        done.append(verdict)
    return conflicting(done[:-1], done[-1])


def _summed_up(done: Sequence[Verdict], allowed: Verdict) -> Verdict:
    return replace(
        done[0],
        args=allowed.args,
        reason="; ".join(step.reason for step in done),
        policies=distinct(name for step in done for name in step.policies),
        brake_first=allowed.brake_first or any(step.brake_first for step in done),
    )


def caused(problem: Verdict, asked: Verdict | None, correction: Verdict) -> Verdict:
    """The verdict on a call of which only the correction is objected to, or both it and what was asked for.

    Args:
        problem: the objection to what the call was corrected to.
        asked: the objection to what was asked for; None when there is none.
        correction: what was done to the call.
    """
    if asked is None:
        return conflicting((correction,), problem)
    # A drone is taken over for what its application asked for, not for what its call was corrected to.
    return asked if problem.action == "takeover" else problem


def conflicting(done: Sequence[Verdict], problem: Verdict) -> Verdict:
    """The denial of a call whose corrections lead to another objection."""
    names = distinct(name for step in (*done, problem) for name in step.policies)
    what = (
        f"policies {', '.join(names)}" if len(names) > 1 else f"the limits of policy {names[0]}" if names else "limits"
    )
    # The last correction is what the objection is about; those before it led there.
    reason = f"{what} cannot be met together: {done[-1].reason}, and then {problem.reason}; ask for something else"
    return deny("ConflictingLimits", reason, names)
