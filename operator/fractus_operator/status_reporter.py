"""Writes the status of Applications when it changed, and an Event for each transition of a condition."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from datetime import datetime

from fractus_core.api import Condition
from fractus_core.api.conditions import ConditionUpdate, merge_conditions
from fractus_core.api.plans import DeploymentPlanSpec

from fractus_operator import kinds
from fractus_operator.kinds import Body, Key, key_of
from fractus_operator.parsing import SETTLED, Submitted
from fractus_operator.status import STAGES, StatusUpdate, apply_failed, queued_rollout
from fractus_operator.store import Conflict, Informer, KubeError, Store

log = logging.getLogger(__name__)

_BUSY_ROLLOUTS = 5
"""With this number of concurrent rollouts, a further rollout takes seconds, so its Application is reported as
queued."""
_MIN_FAILURES = 3
"""Number of successive failed reconciliations after which the status reports the failure.

A single failure causes no additional request to a busy API server. A webhook that does not respond is reported.
"""
_WITHOUT_EVENT = frozenset({"MissionWaiting", "PodsNotReady", "OperatorBusy"})
"""Reasons without an Event, because they are only reported as progress in the status."""


class StatusReporter:
    """Reports the status of Applications."""

    def __init__(self, store: Store, applications: Informer[Submitted], clock: Callable[[], datetime]) -> None:
        self._store = store
        self._applications = applications
        self._clock = clock
        self._written: dict[Key, tuple[str, Body]] = {}

    def last(self, submitted: Submitted) -> Body:
        """Return the status of an Application that this reporter wrote last, otherwise the observed status."""
        uid, status = self._written.get(submitted.key, ("", {}))
        return status if uid and uid == submitted.uid else dict(submitted.body.get("status") or {})

    def forget(self, key: Key) -> None:
        """Drop the state of a deleted Application."""
        self._written.pop(key, None)

    async def report_queued(self, submitted: Submitted, plan: DeploymentPlanSpec, others: int) -> None:
        """Report that a new Application is planned, if many others are being rolled out. Failures are logged.

        Args:
            submitted: The Application.
            plan: Its plan.
            others: Number of other Applications that are being rolled out.
        """
        if others >= _BUSY_ROLLOUTS and not self.last(submitted):
            try:
                await self.report(submitted, queued_rollout(plan, others))
            except KubeError as error:
                log.warning("status reporter: status not written (application=%s/%s error=%s)", *submitted.key, error)

    async def report_failure(self, submitted: Submitted | None, attempts: int, error: KubeError) -> None:
        """Report that an Application cannot be reconciled, if this persists. If the report fails, the next failure repeats it.

        Args:
            submitted: The Application, or None if it does not exist any more.
            attempts: Number of successive failures.
            error: The latest failure.
        """
        if submitted is None or submitted.metadata.deletion_timestamp or attempts < _MIN_FAILURES:
            return
        last = self.last(submitted)
        # Report the failure only once. A status change starts a reconciliation, and the error text may differ each time.
        reported = any((c["type"], c["status"]) == ("Deployed", "False") for c in last.get("conditions") or ())
        if reported or last.get("phase") in SETTLED:
            return
        with contextlib.suppress(KubeError):
            await self.report(submitted, apply_failed(last, error.reason, str(error)))

    async def report(self, submitted: Submitted, update: StatusUpdate, generation: int | None = None) -> None:
        """Write the status if it changed, and then an Event for each transition.

        Args:
            submitted: The Application.
            update: Its new status.
            generation: Generation that the status belongs to. Default: the current one.

        Raises:
            KubeError: The API server refused the status, or could not be reached.
        """
        now = self._clock()
        before = self.last(submitted)
        generation = submitted.metadata.generation if generation is None else generation
        previous = [Condition.model_validate(c) for c in before.get("conditions") or ()]
        conditions, transitions = merge_conditions(previous, update.conditions, generation, now)
        status: Body = {
            "observedGeneration": generation,
            "phase": update.phase,
            "message": update.message,
            "conditions": [condition.to_dict() for condition in conditions],
        }
        facts = {"drone": update.drone, "controller": update.controller, "pods": update.pods}
        status |= {name: value for name, value in facts.items() if value is not None}
        present = self._applications.get(submitted.key)
        # Compare with the observed status, because a user may have edited it since the last report.
        if present is not None and present.uid == submitted.uid and present.body.get("status") == status:
            return
        namespace, name = submitted.key
        # The uid prevents a write to a later Application of this name.
        body = {**kinds.APPLICATION.header(name, namespace, uid=submitted.uid), "status": status}
        try:
            applied = await self._store.apply(kinds.APPLICATION, body, subresource="status")
            if applied.get("status") != status:
                # An apply does not remove fields that a user added.
                applied = await self._store.replace_status(kinds.APPLICATION, applied, status)
        except Conflict:
            present = self._applications.get(submitted.key)
            if present is not None and present.uid == submitted.uid:
                # Do not ignore the conflict: the status may be the only record of a mission's outcome.
                raise
            return
        self._applications.record_write(key_of(applied), applied)
        self._written[submitted.key] = (submitted.uid, status)
        await create_events(self._store, submitted.body, transition_events(transitions), now)


async def create_events(store: Store, regarding: Body, updates: Iterable[ConditionUpdate], now: datetime) -> None:
    """Create an Event about an object for each update. Failures are logged, because the conditions have the same content."""
    namespace, name = key_of(regarding)
    for update in updates:
        try:
            await store.create_event(
                regarding,
                reason=update.reason,
                message=update.message,
                warning=update.warning,
                name=f"{name}.{int(now.timestamp()):x}.{update.reason.lower()}",
                now=now,
            )
        except KubeError as error:
            log.warning(
                "status reporter: Event not created (kind=%s namespace=%s name=%s reason=%s error=%s)",
                regarding["kind"],
                namespace,
                name,
                update.reason,
                error,
            )


def transition_events(transitions: Sequence[ConditionUpdate]) -> Iterator[ConditionUpdate]:
    """Return the Events for transitions: one for each reason, because several conditions often share a reason.

    Stages that are reached at the same time have one Event with the reason of the first one.
    """
    seen = set(_WITHOUT_EVENT)
    reached = [update for update in transitions if update.type in STAGES and not update.warning and not update.progress]
    if len(reached) > 1:
        seen |= {update.reason for update in reached}
        yield replace(reached[0], message="; ".join(update.message for update in reached if update.message))
    for update in transitions:
        if update.reason not in seen:
            seen.add(update.reason)
            yield update
