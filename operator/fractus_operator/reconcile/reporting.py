"""Writes the status of objects where it changed, and an Event for each transition."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from datetime import datetime

from fractus_core.api import Condition
from fractus_core.api.plans import DeploymentPlanSpec

from fractus_operator.cluster import kinds
from fractus_operator.cluster.kinds import Body, Key, key_of
from fractus_operator.cluster.reading import SETTLED, Submitted
from fractus_operator.cluster.store import Conflict, KubeError, Reflector, Store
from fractus_operator.reconcile.conditions import ConditionUpdate, merge
from fractus_operator.reconcile.status import STAGES, StatusUpdate, in_queue, stalled

logger = logging.getLogger(__name__)

_MANY = 5
"""Applications that are rolled out at a time, from which on a further one waits for seconds until all it needs is there."""
_TOLD_AFTER = 3
"""Reconciles that fail one after the other, from which on the status says so: an API server that is busy for a moment gets no more
to do, but a webhook that does not answer is told of."""
_SILENT = frozenset({"MissionWaiting", "PodsNotReady", "OperatorBusy"})
"""Reasons without an Event: what is merely in progress is in the status."""


class StatusReporter:
    """Reports the status of Applications."""

    def __init__(self, store: Store, applications: Reflector[Submitted], clock: Callable[[], datetime]) -> None:
        self._store = store
        self._applications = applications
        self._clock = clock
        self._written: dict[Key, tuple[str, Body]] = {}

    def last(self, submitted: Submitted) -> Body:
        """The status of an application: as last written here, for the watch may be behind, else as it was read."""
        uid, status = self._written.get(submitted.key, ("", {}))
        return status if uid and uid == submitted.uid else dict(submitted.body.get("status") or {})

    def forget(self, key: Key) -> None:
        """Drop what is remembered of an application."""
        self._written.pop(key, None)

    async def planned(self, submitted: Submitted, plan: DeploymentPlanSpec, before: int) -> None:
        """Say of an application that has no status yet that it is planned, where many others are rolled out before.

        Where few are, its first status comes soon enough, and the request is saved. One that fails stops nothing.

        Args:
            submitted: The application.
            plan: Its plan.
            before: How many others are being rolled out.
        """
        if before >= _MANY and not self.last(submitted):
            try:
                await self.report(submitted, in_queue(plan, before))
            except KubeError as error:
                logger.warning("reporting: status not written (application=%s/%s): %s", *submitted.key, error)

    async def failed(self, submitted: Submitted | None, attempts: int, error: KubeError) -> None:
        """Say of an application that it cannot be reconciled, where that lasts; what fails here is said the next time.

        Args:
            submitted: The application; None where it is gone.
            attempts: How often it failed in a row.
            error: Why.
        """
        if submitted is None or submitted.metadata.deletion_timestamp or attempts < _TOLD_AFTER:
            return
        last = self.last(submitted)
        # Said once: each change of the status is a reason to reconcile at once, and the API server's words may differ each time.
        said = any((c["type"], c["status"]) == ("Deployed", "False") for c in last.get("conditions") or ())
        if said or last.get("phase") in SETTLED:
            return
        with contextlib.suppress(KubeError):
            await self.report(submitted, stalled(last, error.reason, str(error)))

    async def report(self, submitted: Submitted, update: StatusUpdate, generation: int | None = None) -> None:
        """Write the status if it differs from the present one, then an Event for each transition.

        Args:
            submitted: The application.
            update: What is to be said of it.
            generation: Of which generation that is true; None: the present one.
        """
        now = self._clock()
        before = self.last(submitted)
        generation = submitted.metadata.generation if generation is None else generation
        previous = [Condition.model_validate(c) for c in before.get("conditions") or ()]
        conditions, transitions = merge(previous, update.conditions, generation, now)
        status: Body = {
            "observedGeneration": generation,
            "phase": update.phase,
            "message": update.message,
            "conditions": [condition.to_dict() for condition in conditions],
        }
        facts = {"drone": update.drone, "controller": update.controller, "pods": update.pods}
        status |= {name: value for name, value in facts.items() if value is not None}
        if status == before:
            return
        namespace, name = submitted.key
        # With the uid: a later application of this name is not written to.
        body = {**kinds.APPLICATION.header(name, namespace, uid=submitted.uid), "status": status}
        try:
            applied = await self._store.apply(kinds.APPLICATION, body, subresource="status")
        except Conflict:
            present = self._applications.get(submitted.key)
            if present is not None and present.uid == submitted.uid:
                # What the caller does next may rely on it: the outcome of a mission has no other record.
                raise
            return
        self._applications.note(key_of(applied), applied)
        self._written[submitted.key] = (submitted.uid, status)
        await record_events(self._store, submitted.body, announced(transitions), now)


async def record_events(store: Store, regarding: Body, updates: Iterable[ConditionUpdate], now: datetime) -> None:
    """Post an Event about an object for each update; one that is refused is logged, for the conditions say the same."""
    namespace, name = key_of(regarding)
    for update in updates:
        try:
            await store.record_event(
                regarding,
                reason=update.reason,
                message=update.message,
                warning=update.warning,
                name=f"{name}.{int(now.timestamp()):x}.{update.reason.lower()}",
                now=now,
            )
        except KubeError as error:
            where = (regarding["kind"], namespace, name, update.reason)
            logger.warning("reporting: Event not written (kind=%s namespace=%s name=%s reason=%s): %s", *where, error)


def announced(transitions: Sequence[ConditionUpdate]) -> Iterator[ConditionUpdate]:
    """What Events tell: the first transition for each reason, for several conditions often share one.

    Stages that are reached together are told together, under the first one's reason: each Event is a request.
    """
    seen = set(_SILENT)
    reached = [update for update in transitions if update.type in STAGES and not update.warning and not update.progress]
    if len(reached) > 1:
        seen |= {update.reason for update in reached}
        yield replace(reached[0], message="; ".join(update.message for update in reached if update.message))
    for update in transitions:
        if update.reason not in seen:
            seen.add(update.reason)
            yield update
