"""An application and what its next step depends on, read at one moment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fractus_core.api import Grant
from fractus_core.api.plans import DeploymentPlanSpec

from fractus_operator.cluster.kinds import Key
from fractus_operator.cluster.pods import PodView
from fractus_operator.cluster.reading import Submitted


@dataclass(frozen=True, slots=True)
class Observed:
    """An application, its plan, and what runs of it. Good until something is awaited.

    Attributes:
        plan: the plan in force, unless the mission it was made for is over.
        grants: all under its name, also of an application that had the name before.
        host: the application whose flight it shares, and the plan of that one.
        in_flight: the drone of its plan while it flies.
        rules: the revision of what grants are compiled from.
    """

    submitted: Submitted
    plan: DeploymentPlanSpec | None
    pods: Sequence[PodView]
    grants: Sequence[Grant]
    host: tuple[Submitted | None, DeploymentPlanSpec | None]
    in_flight: str | None
    rules: int

    @property
    def key(self) -> Key:
        """(namespace, name) of the application."""
        return self.submitted.key

    @property
    def uid(self) -> str:
        """The uid of the application."""
        return self.submitted.uid
