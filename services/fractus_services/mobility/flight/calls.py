"""Calls in their order, and the verdicts on them: what a caller may do before anything is carried out."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

from fractus_core.policy.decision_types import DENY_POSITION_UNKNOWN, Call, Verdict

from fractus_services.errors import Aborted, Unavailable, denied
from fractus_services.grant_files import ActiveGrant
from fractus_services.mobility.authority.control_store import ControlStore
from fractus_services.mobility.flight.guard import Guard

REST_FACTORS = {True: 1.0, False: 4.0}
"""How long the next judgement waits, in times of what the last one took: for the driver that has the drone, and for all
other callers together. A flood of calls so never takes more than a part of the event loop, which the monitor needs."""

RETRY_AFTER_S = 0.5
"""When a call is tried again whose drone has no position at the moment."""

MOVING = frozenset(
    {
        "Arm",
        "Disarm",
        "Takeoff",
        "Land",
        "Goto",
        "ReturnToLaunch",
        "Hover",
        "SetSpeed",
        "SetVelocity",
        "ReturnControl",
        "PointGimbal",
    }
)
"""Methods that only a driver may call."""


class CallJudge:
    """Gives calls their turn and judges them.

    Args:
        control: who has the drone; takeovers that a verdict asks for happen there.
        guard: asks the policy engine.
        require: refuses a caller that does not have the drone.
    """

    def __init__(self, control: ControlStore, guard: Guard, require: Callable[[ActiveGrant], object]) -> None:
        self._control = control
        self._guard = guard
        self._require = require
        self._free_at = {True: 0.0, False: 0.0}
        self._motions = 0

    async def turn(self, grant: ActiveGrant) -> None:
        """Wait until the event loop has had time for the flight since the last judgement of this kind of caller."""
        left_s = self._wait_s(grant)
        while left_s > 0:
            await asyncio.sleep(left_s)
            # Others that waited may have gone first, and the caller may have got or lost the drone: look again.
            left_s = self._wait_s(grant)

    async def turn_to_move(self, grant: ActiveGrant) -> None:
        """Wait as `turn` does, before a call that moves the drone.

        Raises:
            Aborted: the driver has made a later such call meanwhile.
        """
        number = self.supersede(grant)
        await self.turn(grant)
        if self._drives(grant) and number != self._motions:
            raise Aborted("Replaced", "a later call came before this one's turn")

    def supersede(self, grant: ActiveGrant) -> int:
        """Number a call that moves the drone, which voids those that wait; callers without the drone void none."""
        self._motions += self._drives(grant)
        return self._motions

    def _wait_s(self, grant: ActiveGrant) -> float:
        return self._free_at[self._drives(grant)] - self._control.autopilot.now

    def _drives(self, grant: ActiveGrant) -> bool:
        lease = self._control.lease
        return lease is not None and lease.key == grant.key

    def allow(self, call: Call, grant: ActiveGrant) -> Verdict:
        """Judge a call that moves nothing.

        Raises:
            Refused: by policy.
        """
        verdict = self._guard.judge(call, grant)
        if not verdict.permits:
            raise denied(verdict)
        return verdict

    def check(self, call: Call, grant: ActiveGrant) -> Verdict:
        """The verdict on a call that is not carried out."""
        if grant.spec.class_ != "driver" and call.method in MOVING:
            return self._not_a_driver(call, grant, kind="check")
        return self._judge(call, grant, kind="check")

    def allow_motion(self, call: Call, grant: ActiveGrant, known: Verdict | None = None) -> Verdict:
        """Judge a call that moves the drone, of a driver that has it; a takeover happens here.

        Raises:
            Refused: by policy, or the caller does not have the drone.
        """
        if grant.spec.class_ != "driver":
            raise denied(self._not_a_driver(call, grant))
        verdict = self._judge(call, grant, known=known)
        if verdict.code == "MethodNotGranted":
            raise denied(verdict)
        # Before the verdict has consequences: a call of a driver that waits for the drone must neither brake it nor take
        # it from the one that has it.
        self._require(grant)
        if verdict.action == "takeover":
            self._control.take_over(verdict)
            raise denied(verdict)
        if verdict.code == DENY_POSITION_UNKNOWN.code and verdict.action == "deny":
            raise Unavailable("AutopilotUnavailable", verdict.reason, retry_after_s=RETRY_AFTER_S)
        if not verdict.permits:
            if verdict.takeover is not None:
                self._control.brake(verdict)
            raise denied(verdict)
        return verdict

    def _judge(self, call: Call, grant: ActiveGrant, *, kind: str = "call", known: Verdict | None = None) -> Verdict:
        drives, begun = self._drives(grant), time.perf_counter()
        try:
            return self._guard.judge(call, grant, kind=kind, known=known)
        finally:
            rest_s = (time.perf_counter() - begun) * REST_FACTORS[drives]
            self._free_at[drives] = max(self._free_at[drives], self._control.autopilot.now + rest_s)

    def _not_a_driver(self, call: Call, grant: ActiveGrant, *, kind: str = "call") -> Verdict:
        verdict = Verdict("deny", None, "NotADriver", f"passengers ride along; only a driver may {call.method}")
        self._guard.record(call, grant.identity, verdict, self._guard.situation(), kind=kind)
        return verdict
