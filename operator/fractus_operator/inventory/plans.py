"""The plan in force of each Application: as it was decided in this process, or else as it is stored."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.planning.candidates import requests

from fractus_operator.cluster.kinds import Body, Key
from fractus_operator.cluster.labels import labelled
from fractus_operator.cluster.pods import PlannedRequest
from fractus_operator.cluster.reading import Copies, OwnedPlan, Submitted, read_plan


class Plans:
    """Plans by application.

    Args:
        applications: All Applications.
        wake: Wakes an application: it shares the flight of one whose plan changed or went.
    """

    def __init__(self, applications: Copies[Submitted], wake: Callable[[Key], None]) -> None:
        self._applications = applications
        self._wake = wake
        self._decided: dict[Key, OwnedPlan] = {}
        self._stored: dict[Key, OwnedPlan] = {}
        self._requests: dict[Key, tuple[OwnedPlan, Submitted, tuple[PlannedRequest, ...]]] = {}

    def in_force(self) -> dict[Key, OwnedPlan]:
        """The plan of every application whose mission is not over."""
        return {key: plan for key, plan in (self._stored | self._decided).items() if self._is_in_force(key, plan)}

    def get(self, key: Key, uid: str) -> DeploymentPlanSpec | None:
        """The plan of the application with this uid, unless the mission it was made for is over."""
        plan = self._last(key, uid)
        return plan.spec if plan is not None and self._is_in_force(key, plan) else None

    def last(self, key: Key, uid: str) -> DeploymentPlanSpec | None:
        """The plan of the application with this uid that was made last, also when its mission is over."""
        plan = self._last(key, uid)
        return plan.spec if plan is not None else None

    def host_of(self, plan: DeploymentPlanSpec | None) -> tuple[Submitted | None, DeploymentPlanSpec | None]:
        """The application whose flight a plan shares, and that one's plan; None each, if there is none any more."""
        if plan is None or plan.drone is None or plan.drone.shared_with is None:
            return None, None
        namespace, _, name = plan.drone.shared_with.partition("/")
        key = (namespace, name)
        host = self._applications.get(key)
        return host, self.get(key, host.uid) if host is not None else None

    def wake_sharing(self, host: Key) -> None:
        """Wake the applications that share the flight of another one, by their plans: they may have lost it."""
        name = "/".join(host)
        for key, plan in (self._stored | self._decided).items():
            if plan.spec.drone is not None and plan.spec.drone.shared_with == name:
                self._wake(key)

    def decide(self, key: Key, uid: str, plan: DeploymentPlanSpec) -> None:
        """Note a plan as soon as it is made, so that the next one already sees its claims and bookings."""
        self._decided[key] = OwnedPlan(uid, plan)
        self.wake_sharing(key)

    def forget(self, key: Key) -> bool:
        """Drop what was decided for an application; True if there was anything."""
        known = self._decided.pop(key, None) is not None
        if known:
            self.wake_sharing(key)
        return known

    def stored(self, key: Key, body: Body | None) -> None:
        """Follow a DeploymentPlan object that appeared, changed or went (None)."""
        plan = read_plan(body) if body is not None else None
        if plan is None:
            self._stored.pop(key, None)
        else:
            self._stored[key] = plan
        self.wake_sharing(key)

    def requests(self) -> Iterator[PlannedRequest]:
        """Each planned instance on a node, with what it asks for; computed again only where a plan changed."""
        plans = self.in_force()
        for gone in self._requests.keys() - plans.keys():
            del self._requests[gone]
        for key, plan in plans.items():
            submitted = self._applications.get(key)
            if submitted is None:
                continue
            known = self._requests.get(key)
            if known is None or known[0] is not plan or known[1] is not submitted:
                known = self._requests[key] = (plan, submitted, tuple(_requests(key, plan, submitted)))
            yield from known[2]

    def _last(self, key: Key, uid: str) -> OwnedPlan | None:
        plan = self._decided.get(key) or self._stored.get(key)
        return plan if plan is not None and plan.uid == uid else None

    def _is_in_force(self, key: Key, plan: OwnedPlan) -> bool:
        submitted = self._applications.get(key)
        if submitted is None or submitted.uid != plan.uid:
            return False
        over = submitted.settled_generation
        return over is None or (plan.spec.application_generation or 0) > over


def _requests(key: Key, plan: OwnedPlan, submitted: Submitted) -> Iterator[PlannedRequest]:
    components = {c.name: c for c in submitted.application.spec.components} if submitted.application else {}
    for placed in plan.spec.placements:
        if placed.node is not None and placed.component in components:
            yield labelled(key), placed.instance, placed.node, requests(components[placed.component])
