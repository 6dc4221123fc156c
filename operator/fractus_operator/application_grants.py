"""Grants of Applications: compiled for a plan, and updated when policies change between plans."""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass

from fractus_core.api import Application, Grant
from fractus_core.api.grants import GrantSpec
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.identity.grant_signer import GrantSigner
from fractus_core.planning.grant_compiler import compile_grants, refresh
from fractus_core.planning.inventory import Inventory, Settings

from fractus_operator.cache import ClusterCache, ObservedApplication
from fractus_operator.child_objects import ChildObjects
from fractus_operator.kinds import Key
from fractus_operator.pods import PlanPods
from fractus_operator.store import Conflict, KubeError, NotFound

log = logging.getLogger(__name__)

REFUSALS = frozenset({400, 403, 422})
"""HTTP statuses with which the API server refuses the content of an object. A retry helps only after a change by the user."""

Inputs = tuple[object, ...]
"""Versions of the inputs of Grants, and of the Grants themselves."""


@dataclass(frozen=True, slots=True)
class _Compiled:
    inputs: Inputs
    plan: DeploymentPlanSpec
    grants: tuple[GrantSpec, ...]


class ApplicationGrants:
    """Compiles and updates Grants. Results are cached, because most reconciliations find no changed input."""

    def __init__(self, cache: ClusterCache, objects: ChildObjects, signer: GrantSigner, settings: Settings) -> None:
        self._cache = cache
        self._objects = objects
        self._signer = signer
        self._settings = settings
        self._refreshed: dict[Key, Inputs] = {}
        self._compiled: dict[Key, _Compiled] = {}

    async def refresh(self, observed: ObservedApplication) -> None:
        """Update the policies and the awaited components in existing Grants, even if the Application cannot be planned.

        Raises:
            KubeError: The API server cannot be reached.
        """
        valid, versions = self._valid_grants(observed)
        application = observed.submitted.application
        awaits: tuple[str, ...] | None = None
        if application is not None and observed.plan is not None:
            awaits = PlanPods(observed.plan, observed.pods, application.spec.start).awaited
        inputs = (observed.rules, awaits, *versions)
        if self._refreshed.get(observed.key) == inputs:
            return
        inventory = self._cache.snapshot(observed.key, observed.uid)
        grants = [(grant, refresh(grant.spec, inventory, awaits)) for grant in valid]
        stale = [(grant, spec) for grant, spec in grants if spec != grant.spec]
        if not stale:
            self._refreshed[observed.key] = inputs
            return
        self._refreshed.pop(observed.key, None)
        writes = (self._objects.refresh_grant(grant, spec) for grant, spec in stale)
        results = await asyncio.gather(*writes, return_exceptions=True)
        failure = next((result for result in results if result is not None), None)
        if failure is not None:
            # A logged error is sufficient. Either the watch will report a newer Grant, or the next attempt will fail again.
            log.warning("application grants: Grants not updated (application=%s/%s error=%s)", *observed.key, failure)
            refused = isinstance(failure, KubeError) and failure.status in REFUSALS
            if not refused and not isinstance(failure, Conflict | NotFound):
                raise failure

    def compile(
        self,
        application: Application,
        plan: DeploymentPlanSpec,
        observed: ObservedApplication,
        inventory: Inventory,
    ) -> tuple[GrantSpec, ...]:
        """Return the Grants of a plan.

        Raises:
            InvalidObject: Nothing can be granted.
        """
        valid, versions = self._valid_grants(observed)
        awaits = PlanPods(plan, observed.pods, application.spec.start).awaited
        inputs = (observed.rules, awaits, *versions, application.metadata.uid, application.metadata.generation)
        known = self._compiled.get(observed.key)
        if known is not None and known.inputs == inputs and known.plan is plan:
            return known.grants
        present = [grant.spec for grant in valid]
        grants = compile_grants(application, plan, inventory, self._settings, present, awaits=awaits)
        self._compiled[observed.key] = _Compiled(inputs, plan, tuple(grants))
        return tuple(grants)

    def forget(self, key: Key) -> None:
        """Drop the cached results of a deleted Application."""
        self._refreshed.pop(key, None)
        self._compiled.pop(key, None)

    def _valid_grants(self, observed: ObservedApplication) -> tuple[list[Grant], Inputs]:
        """Return the Grants that the operator signed for this Application, and their versions.

        Grants for another uid are excluded, so that they are never signed again.
        """
        grants = (grant for grant in observed.grants if grant.spec.application.uid == observed.uid)
        valid = [grant for grant in grants if self._signer.problem(grant) is None]
        return valid, tuple(sorted((g.name, g.metadata.uid or "", g.metadata.resource_version or "") for g in valid))
