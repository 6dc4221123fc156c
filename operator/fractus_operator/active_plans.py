"""The active plan of each Application: the plan decided in this process, otherwise the stored DeploymentPlan."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

from fractus_core.api.plans import DeploymentPlanSpec
from fractus_core.planning.candidates import requests

from fractus_operator.kinds import Body, Key
from fractus_operator.labels import label_key
from fractus_operator.parsing import CachedObjects, OwnedPlan, Submitted, parse_plan
from fractus_operator.pods import PlannedRequest


class PlanListener(Protocol):
    """An index that depends on plans."""

    def plan_changed(self, key: Key, old: OwnedPlan | None, new: OwnedPlan | None) -> None:
        """Handle a change of the active plan of an Application. A plan is None if there is no active plan."""

    def mission_returns(self, key: Key, plan: OwnedPlan) -> None:
        """Handle the plan of an Application whose mission is over and whose drone has not landed yet."""


class ActivePlans:
    """The active plans by Application. A plan is active until it records the outcome of its mission.

    The status of an Application is not used, because everybody who may edit the status could otherwise end a flight.

    Args:
        applications: All Applications. `application_changed` must be called for each change.
        wake: Wakes an Application after the plan of the Application whose flight it shares has changed.
        listener: Notified of each change of an active plan.
        on_requests: Called with the label key of an Application and the requests of its active plan when either changes.
    """

    def __init__(
        self,
        applications: CachedObjects[Submitted],
        wake: Callable[[Key], None],
        listener: PlanListener,
        on_requests: Callable[[Key, Sequence[PlannedRequest]], None],
    ) -> None:
        self._applications = applications
        self._wake = wake
        self._listener = listener
        self._on_requests = on_requests
        self._decided: dict[Key, OwnedPlan] = {}
        self._stored: dict[Key, OwnedPlan] = {}
        self._active: dict[Key, OwnedPlan] = {}
        self._hosts: dict[Key, str] = {}
        self._guests: dict[str, set[Key]] = {}

    def active(self, key: Key) -> OwnedPlan | None:
        """Return the active plan of an Application, if any."""
        return self._active.get(key)

    def get(self, key: Key, uid: str) -> DeploymentPlanSpec | None:
        """Return the active plan of the Application with this uid, if any."""
        plan = self._active.get(key)
        return plan.spec if plan is not None and plan.uid == uid else None

    def latest(self, key: Key, uid: str) -> DeploymentPlanSpec | None:
        """Return the latest plan of the Application with this uid, even if its mission is over."""
        plan = self._latest(key)
        return plan.spec if plan is not None and plan.uid == uid else None

    def flight_host(self, plan: DeploymentPlanSpec | None) -> tuple[Submitted | None, DeploymentPlanSpec | None]:
        """Return the Application whose flight a plan shares, and its latest plan, even if its mission is over.

        The Application or plan is None if it does not exist.
        """
        if plan is None or plan.drone is None or plan.drone.shared_with is None:
            return None, None
        namespace, _, name = plan.drone.shared_with.partition("/")
        key = (namespace, name)
        host = self._applications.get(key)
        return host, self.latest(key, host.uid) if host is not None else None

    def wake_guests(self, host: Key) -> None:
        """Wake the Applications that share the flight of `host`, because that flight may have ended or changed."""
        for key in self._guests.get("/".join(host), ()):
            self._wake(key)

    def decide(self, key: Key, uid: str, plan: DeploymentPlanSpec) -> None:
        """Make a new plan active at once, so that its claims and bookings count when the next Application is planned."""
        self._decided[key] = OwnedPlan(uid, plan)
        self.application_changed(key)
        self.wake_guests(key)

    def forget(self, key: Key) -> bool:
        """Drop the plan that was decided for an Application. Return True if such a plan existed."""
        known = self._decided.pop(key, None) is not None
        if known:
            self.application_changed(key)
            self.wake_guests(key)
        return known

    def plan_object_changed(self, key: Key, body: Body | None) -> None:
        """Handle a change or deletion (None) of a DeploymentPlan object."""
        plan = parse_plan(body) if body is not None else None
        if plan is None:
            self._stored.pop(key, None)
        else:
            self._stored[key] = plan
        self.application_changed(key)
        self.wake_guests(key)

    def application_changed(self, key: Key) -> None:
        """Update the active plan and the requests of its instances after a change of the Application or its plan."""
        latest = self._latest(key)
        self._index_host(key, latest)
        new = latest if latest is not None and self._is_active(key, latest) else None
        old = self._active.pop(key, None)
        if new is not None:
            self._active[key] = new
        if old is not new:
            self._listener.plan_changed(key, old, new)
        submitted = self._applications.get(key)
        if latest is not None and latest.spec.is_over and self._is_current(latest, submitted):
            assert latest.spec.flown is not None
            if not latest.spec.flown.landed:
                self._listener.mission_returns(key, latest)
        if old is not None or new is not None:
            planned = _requests(new, submitted) if new is not None and submitted is not None else ()
            self._on_requests(label_key(key), planned)

    def _index_host(self, key: Key, latest: OwnedPlan | None) -> None:
        """Update the index of shared flights with the latest plan of an Application."""
        known = self._hosts.pop(key, None)
        if known is not None:
            self._guests[known].discard(key)
            if not self._guests[known]:
                del self._guests[known]
        host = latest.spec.drone.shared_with if latest is not None and latest.spec.drone is not None else None
        if host is not None:
            self._hosts[key] = host
            self._guests.setdefault(host, set()).add(key)

    def _latest(self, key: Key) -> OwnedPlan | None:
        return self._decided.get(key) or self._stored.get(key)

    def _is_active(self, key: Key, plan: OwnedPlan) -> bool:
        return self._is_current(plan, self._applications.get(key)) and not plan.spec.is_over

    def _is_current(self, plan: OwnedPlan, submitted: Submitted | None) -> bool:
        """Return True if a plan belongs to the Application that exists now under its name."""
        return submitted is not None and submitted.uid == plan.uid


def _requests(plan: OwnedPlan, submitted: Submitted) -> tuple[PlannedRequest, ...]:
    if submitted.application is None:
        return ()
    components = {component.name: component for component in submitted.application.spec.components}
    return tuple(
        PlannedRequest(placed.instance, placed.node, requests(components[placed.component]))
        for placed in plan.spec.placements
        if placed.node is not None and placed.component in components
    )
