"""Controller of ApplicationTemplates: reports if the present generation of a template is approved."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime

from fractus_core.api import ApplicationTemplate, InvalidObject
from fractus_core.api.conditions import ConditionUpdate, merge_conditions
from fractus_core.planning.flight_parameters import check_parameter_schema

from fractus_operator.cache import ClusterCache
from fractus_operator.kinds import APPLICATION_TEMPLATE, Key
from fractus_operator.status_reporter import create_events
from fractus_operator.store import Conflict, NotFound, Store


class TemplateController:
    """Writes the condition Ready of ApplicationTemplates."""

    def __init__(self, store: Store, cache: ClusterCache, clock: Callable[[], datetime]) -> None:
        self._store = store
        self._cache = cache
        self._clock = clock

    async def reconcile(self, key: Key) -> None:
        """Write the condition of one template if it changed.

        Raises:
            KubeError: The API server refused the write, or could not be reached.
        """
        template = self._cache.templates.get(key)
        if template is None:
            return
        before = template.status.conditions if template.status is not None else ()
        generation = template.metadata.generation
        now = self._clock()
        conditions, transitions = merge_conditions(before, [_readiness(template)], generation, now)
        if conditions == before:
            return
        header = APPLICATION_TEMPLATE.header(template.name, uid=template.metadata.uid)
        status = {"observedGeneration": generation, "conditions": [each.to_dict() for each in conditions]}
        try:
            await self._store.apply(APPLICATION_TEMPLATE, {**header, "status": status}, subresource="status")
        except (Conflict, NotFound):
            return
        await create_events(self._store, header, transitions, now)


def _readiness(template: ApplicationTemplate) -> ConditionUpdate:
    approval = template.status.approval if template.status is not None else None
    generation = template.metadata.generation
    try:
        check_parameter_schema(template.spec.parameters)
    except InvalidObject as error:
        message = f"spec.{error}"
        return ConditionUpdate("Ready", "False", "InvalidSchema", message)
    if approval is not None and template.approved:
        return ConditionUpdate("Ready", "True", "Approved", f"{approval.by} has approved generation {generation}")
    message = (
        f"generation {generation} is not approved, so no flight plan can use it; ask the authority for an approval"
    )
    if approval is not None:
        message += f" of the change since generation {approval.generation}"
    return ConditionUpdate("Ready", "False", "NotApproved", message, progress=True)
