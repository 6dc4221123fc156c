"""The plan in force of each Application: as it was decided in this process, or else as it is stored."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Protocol

from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.planning.candidates import requests

from fractus_operator.cluster.kinds import Body, Key
from fractus_operator.cluster.labels import labelled
from fractus_operator.cluster.pods import PlannedRequest
from fractus_operator.cluster.reading import Copies, OwnedPlan, Submitted, read_plan


class Follower(Protocol):
    """What is made of the plans in force."""

    def plan_changed(self, key: Key, old: OwnedPlan | None, new: OwnedPlan | None) -> None:
        """Follow the plan in force of an application; None: there is none."""


class Plans:
    """Plans by application, kept current one plan and one application at a time.

    Args:
        applications: All Applications; each change of one has to be told, too.
        wake: Wakes an application: it shares the flight of one whose plan changed or went.
        follower: Is told of each plan that comes into force, or is so no more.
        planned: Is told which instances an application's plan in force has on nodes: its key as labelled, and these.
    """

    def __init__(
        self,
        applications: Copies[Submitted],
        wake: Callable[[Key], None],
        follower: Follower,
        planned: Callable[[Key, Sequence[PlannedRequest]], None],
    ) -> None:
        self._applications = applications
        self._wake = wake
        self._follower = follower
        self._planned = planned
        self._decided: dict[Key, OwnedPlan] = {}
        self._stored: dict[Key, OwnedPlan] = {}
        self._in_force: dict[Key, OwnedPlan] = {}
        self._hosts: dict[Key, str] = {}
        self._guests: dict[str, set[Key]] = {}

    def in_force(self, key: Key) -> OwnedPlan | None:
        """The plan of an application, unless its mission is over."""
        return self._in_force.get(key)

    def get(self, key: Key, uid: str) -> DeploymentPlanSpec | None:
        """The plan of the application with this uid, unless the mission it was made for is over."""
        plan = self._in_force.get(key)
        return plan.spec if plan is not None and plan.uid == uid else None

    def last(self, key: Key, uid: str) -> DeploymentPlanSpec | None:
        """The plan of the application with this uid that was made last, also when its mission is over."""
        plan = self._last(key)
        return plan.spec if plan is not None and plan.uid == uid else None

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
        for key in self._guests.get("/".join(host), ()):
            self._wake(key)

    def decide(self, key: Key, uid: str, plan: DeploymentPlanSpec) -> None:
        """Note a plan as soon as it is made, so that the next one already sees its claims and bookings."""
        self._decided[key] = OwnedPlan(uid, plan)
        self.application_changed(key)
        self.wake_sharing(key)

    def forget(self, key: Key) -> bool:
        """Drop what was decided for an application; True if there was anything."""
        known = self._decided.pop(key, None) is not None
        if known:
            self.application_changed(key)
            self.wake_sharing(key)
        return known

    def stored(self, key: Key, body: Body | None) -> None:
        """Follow a DeploymentPlan object that appeared, changed or went (None)."""
        plan = read_plan(body) if body is not None else None
        if plan is None:
            self._stored.pop(key, None)
        else:
            self._stored[key] = plan
        self.application_changed(key)
        self.wake_sharing(key)

    def application_changed(self, key: Key) -> None:
        """Follow an Application: it tells whether its plan is in force, and what its instances ask for."""
        last = self._last(key)
        self._note_host(key, last.spec.drone.shared_with if last is not None and last.spec.drone is not None else None)
        new = last if last is not None and self._is_in_force(key, last) else None
        old = self._in_force.pop(key, None)
        if new is not None:
            self._in_force[key] = new
        if old is not new:
            self._follower.plan_changed(key, old, new)
        submitted = self._applications.get(key)
        if old is not None or new is not None:
            asked = _requests(new, submitted) if new is not None and submitted is not None else ()
            self._planned(labelled(key), tuple(asked))

    def _note_host(self, key: Key, host: str | None) -> None:
        """Note whose flight an application shares by the plan that was made last."""
        known = self._hosts.pop(key, None)
        if known is not None:
            self._guests[known].discard(key)
            if not self._guests[known]:
                del self._guests[known]
        if host is not None:
            self._hosts[key] = host
            self._guests.setdefault(host, set()).add(key)

    def _last(self, key: Key) -> OwnedPlan | None:
        return self._decided.get(key) or self._stored.get(key)

    def _is_in_force(self, key: Key, plan: OwnedPlan) -> bool:
        submitted = self._applications.get(key)
        if submitted is None or submitted.uid != plan.uid:
            return False
        over = submitted.settled_generation
        return over is None or (plan.spec.application_generation or 0) > over


def _requests(plan: OwnedPlan, submitted: Submitted) -> Iterator[PlannedRequest]:
    components = {c.name: c for c in submitted.application.spec.components} if submitted.application else {}
    for placed in plan.spec.placements:
        if placed.node is not None and placed.component in components:
            yield PlannedRequest(placed.instance, placed.node, requests(components[placed.component]))
