"""The grants of Applications: compiled for a plan, and kept up to date with the policies between plans."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

from fractus_core.api import Application, Grant
from fractus_core.api.grants import GrantSpec
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.identity.grant_signer import GrantSigner
from fractus_core.planning.grant_compiler import compile_grants, refresh
from fractus_core.planning.inventory import Inventory, Settings

from fractus_operator.cluster.kinds import Key
from fractus_operator.cluster.store import Conflict, KubeError, NotFound
from fractus_operator.inventory.live import LiveInventory
from fractus_operator.inventory.observed import Observed
from fractus_operator.reconcile.children import Children

logger = logging.getLogger(__name__)

REFUSALS = frozenset({400, 403, 422})
"""HTTP statuses by which the API server refuses an object itself: the user has to change something."""

Inputs = tuple[object, ...]
"""The versions of what grants are compiled from, and of the grants themselves."""


@dataclass(frozen=True, slots=True)
class _Compiled:
    inputs: Inputs
    plan: DeploymentPlanSpec
    grants: tuple[GrantSpec, ...]


class ApplicationGrants:
    """Compiles and refreshes grants; remembers the last results, because most reconciles find nothing changed."""

    def __init__(self, live: LiveInventory, children: Children, signer: GrantSigner, settings: Settings) -> None:
        self._live = live
        self._children = children
        self._signer = signer
        self._settings = settings
        self._refreshed: dict[Key, Inputs] = {}
        self._compiled: dict[Key, _Compiled] = {}

    async def refresh(self, seen: Observed) -> None:
        """Bring the policies of what is granted up to date, whatever becomes of the application's next plan.

        Raises:
            KubeError: the API server cannot be reached.
        """
        valid = self._valid(seen)
        inputs = _inputs(seen.rules, valid)
        if self._refreshed.get(seen.key) == inputs:
            return
        inventory = self._live.snapshot(seen.key, seen.uid)
        grants = [(grant, refresh(grant.spec, inventory)) for grant in valid]
        stale = [(grant, spec) for grant, spec in grants if spec != grant.spec]
        if stale:
            self._refreshed.pop(seen.key, None)
        else:
            self._refreshed[seen.key] = inputs
        try:
            await self._children.refresh(stale)
        except KubeError as error:
            # The watch of grants brings a newer one, or the next reconcile finds it refused again.
            logger.warning("grants: not up to date (application=%s/%s): %s", *seen.key, error)
            if error.status not in REFUSALS and not isinstance(error, Conflict | NotFound):
                raise

    def compile(
        self, application: Application, plan: DeploymentPlanSpec, seen: Observed, inventory: Inventory
    ) -> tuple[GrantSpec, ...]:
        """The grants of a plan; those of the last reconcile while nothing changed.

        Raises:
            InvalidObject: nothing can be granted.
        """
        valid = self._valid(seen)
        inputs = _inputs(seen.rules, valid, application.metadata.uid, application.metadata.generation)
        known = self._compiled.get(seen.key)
        if known is not None and known.inputs == inputs and known.plan is plan:
            return known.grants
        present = {grant.spec.instance: grant.spec.unsigned for grant in valid}
        compiled = compile_grants(application, plan, inventory, self._settings, [grant.spec for grant in valid])
        # Areas have many points: a grant that equals the present one is that one, and not kept twice.
        grants = tuple(same if (same := present.get(spec.instance)) == spec else spec for spec in compiled)
        self._compiled[seen.key] = _Compiled(inputs, plan, grants)
        return grants

    def forget(self, key: Key) -> None:
        """Drop what is remembered of an application."""
        self._refreshed.pop(key, None)
        self._compiled.pop(key, None)

    def _valid(self, seen: Observed) -> list[Grant]:
        """The application's grants as the operator signed them: those of another one are never signed again."""
        own = (grant for grant in seen.grants if grant.spec.application.uid == seen.uid)
        return [grant for grant in own if self._signer.problem(grant) is None]


def _inputs(rules: int, grants: Sequence[Grant], *more: object) -> Inputs:
    versions = sorted((g.name, g.metadata.uid or "", g.metadata.resource_version or "") for g in grants)
    return (rules, *versions, *more)
