"""Steps of flight plans: the decision on a plan, its activation, and its state during the flight. Pure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

from fractus_core.airspace import Airspace, OperationalIntent, Volume4D, decide, standing_overlaps
from fractus_core.airspace.decide import MAX_LISTED
from fractus_core.airspace.lifecycle import OFF_NOMINAL
from fractus_core.airspace.plan_status import PRIORITIES, intent_of, plan_finding, reserved_volume
from fractus_core.airspace.volumes import utc
from fractus_core.api import Application, ApplicationTemplate, FlightPlan, InvalidObject
from fractus_core.api.conditions import ConditionUpdate
from fractus_core.api.flight_plans import (
    PARAMETERS_INVALID,
    FlightPlanStatus,
    PlanFinding,
    PlanRestriction,
    PlanState,
    ReservedVolume,
)
from fractus_core.api.plans import Alternative, Rejection
from fractus_core.planning.flight_parameters import check_parameters
from fractus_core.planning.inventory import Inventory, Settings

from fractus_operator.flight_matching import POLICY_CONFLICT, SOON_S, Match, Unfit, application_of, match_flight
from fractus_operator.flight_progress import FlownMission, flight_progress, off_nominal_volumes

START_GRACE_S = 120.0
"""Seconds after the start of its window for which a plan waits for a suitable drone."""

RETRY_S = 5.0
"""Seconds until a plan without a suitable drone is matched again, unless an input changes earlier."""

RECHECK_S = 300.0
"""Maximum seconds until the next step of a plan. The clock may jump, so no step waits until a distant time."""

FLYING: frozenset[PlanState] = frozenset({"Activated", "Nonconforming", "Contingent"})
"""States of a plan whose Application exists or is created next."""

STARTED = "Started"
"""Condition of a plan whose Application was created. It is never created again."""


@dataclass(frozen=True, slots=True)
class PlanSituation:
    """A flight plan with the inputs of its next step, all read at the same time.

    Attributes:
        plan: The plan.
        template: Its template, or None if the template does not exist.
        inventory: Returns the inventory for a flight in the window of the plan.
        settings: Settings of planning.
        airspace: Operational intents of all plans.
        mission: The Application of the plan.
        now_s: Time in seconds since 1970 UTC.
        original: Plan whose change a dry run decides, if it exists. `mission` is then its Application.
        rules_changed: True if policies or zones at the place of the plan have changed since they were judged.
    """

    plan: FlightPlan
    template: ApplicationTemplate | None
    inventory: Callable[[], Inventory]
    settings: Settings
    airspace: Airspace
    mission: FlownMission
    now_s: float
    original: FlightPlan | None = None
    rules_changed: bool = False

    @property
    def name(self) -> str:
        """namespace/name of the plan, or of the plan whose change a dry run decides.

        The plan does not conflict with the reservation under this name.
        """
        return f"{self.plan.metadata.namespace or 'default'}/{self.plan.spec.change_of or self.plan.name}"

    @property
    def status(self) -> FlightPlanStatus:
        """Status of the plan, empty if the plan has none."""
        return self.plan.status or FlightPlanStatus()

    @property
    def state(self) -> PlanState:
        """State of the plan."""
        return self.status.state or "Draft"

    @property
    def changed(self) -> bool:
        """True if the present version of the plan was not considered yet."""
        return self.status.observed_generation != self.plan.metadata.generation

    @property
    def closing(self) -> bool:
        """True if the user ends the plan."""
        return self.plan.spec.use == "Closed" or self.plan.metadata.deletion_timestamp is not None

    @property
    def may_start(self) -> bool:
        """True if the user permits the takeoff at the start of the window."""
        return self.plan.spec.use == "InUse" or self.plan.spec.auto_activate

    @property
    def end_s(self) -> float:
        """End of the window in force in seconds since 1970 UTC."""
        ends = [volume.end.timestamp() for volume in self.status.volumes]
        return max(ends, default=self.plan.spec.window.end_s)


@dataclass(frozen=True, slots=True)
class PlanStep:
    """The next step of a plan.

    Attributes:
        status: Its new status. The conditions are in `conditions`.
        conditions: The conditions of the plan.
        start: Application to create after the status is stored.
        end: True to delete the Application.
        next_s: Seconds until the next step, unless an input changes earlier.
    """

    status: FlightPlanStatus
    conditions: tuple[ConditionUpdate, ...]
    start: Application | None = None
    end: bool = False
    next_s: float = RECHECK_S


def plan_step(now: PlanSituation) -> PlanStep:
    """Return the next step of a plan."""
    if now.plan.spec.dry_run and now.state in {"Accepted", "Rejected", "Ended"}:
        # A dry run reserves nothing and is never flown.
        return _decide_new(now) if now.changed else _keep(now)
    match now.state:
        case "Draft":
            step = _decide_new(now)
        case "Rejected":
            step = _decide_new(now) if now.changed and not now.closing else _keep(now)
        case "Accepted":
            step = _follow_accepted(now)
        case "Activated" | "Nonconforming" | "Contingent":
            step = _follow_flight(now)
        case "Ended":
            step = _keep(now)
    return replace(step, next_s=max(min(step.next_s, RECHECK_S), 0.1))


# -- decision --


def _decide_new(now: PlanSituation) -> PlanStep:
    """Decide on a plan that is not in force: Accepted, Rejected, or Draft while the user must select actions."""
    if now.closing:
        return _rejected(now, Unfit("Closed", "the plan was closed before it was accepted"))
    if now.plan.spec.change_of is not None:
        step = _check_change(now)
        if step is not None:
            return step
    try:
        match = _match(now)
    except Unfit as unfit:
        return _rejected(now, unfit)
    if message := match.choices_problem:
        status = _status_of(now, match, "Draft", message).model_copy(
            update={"drone": None, "volumes": (), "decided_for": None}
        )
        needed = ConditionUpdate("ActionNeeded", "True", "ChoicesMissing", message, adverse=True)
        return PlanStep(status, (needed,))
    intent = _intent(now, "Accepted", match.volumes)
    refusals = _refusals(now, intent, None)
    if refusals:
        return _rejected(now, Unfit(refusals[0].reason, refusals[0].message), refusals, match.candidates)
    return _accepted(now, match, intent)


def _refusals(
    now: PlanSituation, intent: OperationalIntent, before: OperationalIntent | None
) -> tuple[PlanFinding, ...]:
    """Return why a plan for which a drone was found is refused: its parameters, and conflicts with other plans."""
    findings = tuple(map(plan_finding, decide(intent, before, now.airspace, now.now_s).refusals))
    assert now.template is not None, "a drone was found for an application of the template"
    try:
        check_parameters(now.plan, now.template)
    except InvalidObject as error:
        return (PlanFinding(reason=PARAMETERS_INVALID, message=str(error)), *findings)
    return findings


def _check_change(now: PlanSituation) -> PlanStep | None:
    """Decide on a dry run of a change. Return None if the change is decided like a new plan, because no flight has begun."""
    original = now.original
    if original is None:
        message = f"there is no FlightPlan {now.plan.spec.change_of}; correct spec.changeOf"
        return _rejected(now, Unfit("PlanMissing", message))
    present = original.status or FlightPlanStatus()
    if present.state == "Ended":
        return _rejected(now, Unfit("ChangeNotPermitted", "the plan has ended; create another flight plan"))
    if present.state not in FLYING:
        return None
    spec = now.plan.spec.model_copy(update={"dry_run": False, "change_of": None})
    step = _change_in_flight(replace(now, plan=original.model_copy(update={"spec": spec})))
    refusals = step.status.refusals if step is not None else ()
    if refusals:
        return _rejected(now, Unfit(refusals[0].reason, refusals[0].message), refusals)
    status = FlightPlanStatus(
        observed_generation=now.plan.metadata.generation,
        decided_for=now.plan.metadata.generation,
        state="Accepted",
        message=f"the flight of {present.drone} can be changed",
        priority_class=spec.priority_class,
        drone=present.drone,
        volumes=step.status.volumes if step is not None else present.volumes,
        restrictions=present.restrictions,
    )
    return PlanStep(status, _conditions(status))


def _accepted(now: PlanSituation, match: Match, intent: OperationalIntent) -> PlanStep:
    status = _status_of(now, match, "Accepted", f"{match.drone} is reserved")
    status = status.model_copy(update={"advisories": match.advisories + _overlaps(intent, now)})
    return PlanStep(status, _conditions(status), next_s=_until_start_s(now))


def _rejected(
    now: PlanSituation,
    unfit: Unfit,
    refusals: tuple[PlanFinding, ...] = (),
    candidates: tuple[Alternative, ...] = (),
) -> PlanStep:
    refusals = refusals or (PlanFinding(reason=unfit.reason, message=unfit.message),)
    status = FlightPlanStatus(
        observed_generation=now.plan.metadata.generation,
        decided_for=now.plan.metadata.generation,
        state="Rejected",
        message=unfit.message,
        priority_class=now.plan.spec.priority_class,
        candidates=candidates if now.plan.spec.dry_run else (),
        rejected=unfit.rejected,
        refusals=refusals,
    )
    return PlanStep(status, (ConditionUpdate("Accepted", "False", unfit.reason, unfit.message),))


# -- before the flight --


def _follow_accepted(now: PlanSituation) -> PlanStep:
    """Follow a plan until its start: consider changes, match it again if its drone is lost, and activate it."""
    if now.closing:
        return _ended(now, "the plan was closed before its flight")
    begin_s = now.plan.spec.window.begin_s
    if now.may_start and begin_s <= now.now_s <= now.plan.spec.window.end_s:
        return _activate(now)
    if now.changed:
        return _redecide(now)
    if now.now_s > now.end_s:
        return _ended(now, "the window ended without a flight")
    soon = begin_s - SOON_S <= now.now_s
    if soon or not now.mission.drone_exists or now.rules_changed:
        return _rematch(now, soon=soon)
    return replace(_keep(now), next_s=_until_start_s(now))


def _redecide(now: PlanSituation) -> PlanStep:
    """Decide on a changed plan. If the change is refused, the earlier version stays in force."""
    before = intent_of(now.plan)
    try:
        match = _match(now)
    except Unfit as unfit:
        return _refuse_change(now, (PlanFinding(reason=unfit.reason, message=unfit.message),))
    if message := match.choices_problem:
        return _refuse_change(now, (PlanFinding(reason="ChoicesMissing", message=message),))
    intent = _intent(now, "Accepted", match.volumes)
    refusals = _refusals(now, intent, before)
    if refusals:
        return _refuse_change(now, refusals)
    return _accepted(now, match, intent)


def _refuse_change(now: PlanSituation, refusals: tuple[PlanFinding, ...]) -> PlanStep:
    status = now.status.model_copy(update={"observed_generation": now.plan.metadata.generation, "refusals": refusals})
    return PlanStep(status, _conditions(status, now), next_s=_until_start_s(now))


def _rematch(now: PlanSituation, *, soon: bool) -> PlanStep:
    """Check that the drone is suitable and the policies allow the flight. Select another drone if the reserved one is not.

    Policies may change again before the flight, so a plan that they no longer allow stays accepted until its start.
    """
    try:
        match = _match(now)
    except Unfit as unfit:
        if soon or not now.mission.drone_exists:
            return _without_drone(now, unfit)
        if unfit.reason == POLICY_CONFLICT:
            return _judged(now, (PlanFinding(reason=unfit.reason, message=unfit.message),), now.status.restrictions)
        # The drone and the template may change again before the flight.
        return replace(_keep(now), next_s=_until_start_s(now))
    if match.drone == now.status.drone:
        findings = match.advisories
        if message := match.choices_problem:
            findings += (PlanFinding(reason="ChoicesMissing", message=message),)
        return _judged(now, findings, match.restrictions)
    intent = _intent(now, "Accepted", match.volumes)
    decision = decide(intent, intent_of(now.plan), now.airspace, now.now_s)
    if not decision.accepted:
        finding = decision.refusals[0]
        return _not_startable(now, finding.reason, finding.message)
    return _accepted(now, match, intent)


def _without_drone(now: PlanSituation, unfit: Unfit) -> PlanStep:
    """Report why an accepted plan cannot start. Reject the plan if it should have started."""
    if now.now_s > now.plan.spec.window.begin_s + START_GRACE_S and now.may_start:
        return _rejected(now, unfit)
    return _not_startable(now, unfit.reason, unfit.message, unfit.rejected)


def _judged(
    now: PlanSituation, findings: tuple[PlanFinding, ...], restrictions: tuple[PlanRestriction, ...]
) -> PlanStep:
    """Keep an accepted plan, with its conflicts with the present policies and their restrictions."""
    status = now.status.model_copy(update={"advisories": findings, "restrictions": restrictions})
    plan = now.plan.model_copy(update={"status": status})
    return replace(_keep(replace(now, plan=plan)), next_s=_until_start_s(now))


def _activate(now: PlanSituation) -> PlanStep:
    """Activate a plan whose window has begun. Everything is decided again, because its inputs may have changed.

    The reservation lasts for the rest of the window, in which the flight must fit.
    """
    try:
        match = _match(now)
    except Unfit as unfit:
        permanent = unfit.reason in {"Invalid", "TemplateMissing"}
        late = now.now_s > now.plan.spec.window.begin_s + START_GRACE_S
        if now.state == "Accepted" and (permanent or late):
            return _rejected(now, unfit)
        return _not_startable(now, unfit.reason, unfit.message, unfit.rejected)
    intent = _intent(now, "Activated", match.volumes)
    refusals = _refusals(now, intent, intent_of(now.plan))
    if message := match.choices_problem:
        return _not_startable(now, "ChoicesMissing", message)
    if refusals and refusals[0].reason == PARAMETERS_INVALID and now.state == "Accepted":
        return _rejected(now, Unfit(refusals[0].reason, refusals[0].message), refusals)
    if refusals:
        return _not_startable(now, refusals[0].reason, refusals[0].message)
    status = _status_of(now, match, "Activated", f"{match.drone} starts the flight").model_copy(
        update={"application": match.application.name, "advisories": match.advisories + _overlaps(intent, now)}
    )
    return PlanStep(status, _conditions(status), start=match.application, next_s=RETRY_S)


def _not_startable(now: PlanSituation, reason: str, message: str, rejected: tuple[Rejection, ...] = ()) -> PlanStep:
    status = now.status.model_copy(update={"message": message, "rejected": rejected or now.status.rejected})
    startable = ConditionUpdate("Startable", "False", reason, message)
    return PlanStep(status, (*_conditions(status, now), startable), next_s=RETRY_S)


# -- flight --


def _follow_flight(now: PlanSituation) -> PlanStep:
    """Follow the flight of an activated plan."""
    if not now.mission.started:
        if now.closing or now.now_s > now.end_s:
            return _ended(now, "the plan ended before its Application was created")
        return _activate(now)
    if now.changed and not now.closing:
        step = _change_in_flight(now)
        if step is not None:
            return step
    progress = flight_progress(now.mission, now.state, now.status, closing=now.closing, now_s=now.now_s)
    if progress.state == "Ended":
        return _ended(now, progress.message)
    off_nominal: tuple[ReservedVolume, ...] = ()
    if progress.state in OFF_NOMINAL:
        off_nominal = off_nominal_volumes(now.mission, now.status, now.now_s)
    status = now.status
    if now.changed and not now.closing:
        # The present version describes the flight, also if an earlier change was refused.
        status = status.model_copy(update={"decided_for": now.plan.metadata.generation, "refusals": ()})
    status = status.model_copy(
        update={
            "observed_generation": now.plan.metadata.generation,
            "state": progress.state,
            "message": progress.message,
            "off_nominal_volumes": off_nominal,
        }
    )
    intent = intent_of(now.plan.model_copy(update={"status": status}))
    status = status.model_copy(update={"advisories": _policy_advisories(status) + _overlaps(intent, now)})
    next_s = RETRY_S if progress.state in OFF_NOMINAL else now.end_s - now.now_s
    return PlanStep(status, _conditions(status, now), end=progress.end, next_s=max(next_s, 1.0))


def _change_in_flight(now: PlanSituation) -> PlanStep | None:
    """Decide on a changed plan whose flight has begun. Only the end of its window may change.

    Returns:
        None if nothing of the flight changes.
    """
    try:
        digest = application_of(now.plan, now.template).spec.mission_digest
    except (InvalidObject, Unfit) as error:
        return _refuse_change(now, (PlanFinding(reason="Invalid", message=str(error)),))
    if digest != now.mission.digest:
        message = (
            "the flight has begun, so its place, actions and parameters cannot change; undo the change, or create another"
            " flight plan"
        )
        return _refuse_change(now, (PlanFinding(reason="ChangeNotPermitted", message=message),))
    before = intent_of(now.plan)
    end_s = now.plan.spec.window.end_s
    if end_s == now.end_s:
        return None
    if now.state != "Activated" or end_s < now.now_s:
        message = f"the window cannot change while the plan is {now.state}"
        if end_s < now.now_s:
            message = "the changed window is over; set spec.use: Closed to end the flight"
        return _refuse_change(now, (PlanFinding(reason="ChangeNotPermitted", message=message),))
    intent = replace(before, volumes=tuple(replace(volume, end_s=end_s) for volume in before.volumes))
    decision = decide(intent, before, now.airspace, now.now_s)
    refusals = tuple(map(plan_finding, decision.refusals)) or _drone_conflicts(now, end_s)
    if refusals:
        return _refuse_change(now, refusals)
    status = now.status.model_copy(
        update={
            "observed_generation": now.plan.metadata.generation,
            "decided_for": now.plan.metadata.generation,
            "volumes": tuple(map(reserved_volume, intent.volumes)),
            "refusals": (),
        }
    )
    return PlanStep(status, _conditions(status, now), next_s=RETRY_S)


def _drone_conflicts(now: PlanSituation, end_s: float) -> tuple[PlanFinding, ...]:
    """Return the reservations of the drone by other plans until the later end of a window."""
    if end_s <= now.end_s:
        return ()
    drone = now.status.drone or ""
    return tuple(
        PlanFinding(
            reason="DroneBusy",
            message=f"flight plan {each.holder} has reserved {drone} from {utc(each.begin_s)}; choose an earlier end",
            plan=each.holder,
        )
        for each in now.inventory().reservations.get(drone, ())
        if each.begin_s <= end_s and each.end_s >= now.now_s
    )[:MAX_LISTED]


def _ended(now: PlanSituation, message: str) -> PlanStep:
    status = now.status.model_copy(
        update={
            "observed_generation": now.plan.metadata.generation,
            "state": "Ended",
            "message": message,
            "off_nominal_volumes": (),
            "advisories": (),
        }
    )
    return PlanStep(status, _conditions(status, now))


# -- parts --


def _match(now: PlanSituation) -> Match:
    status = now.original.status if now.original is not None else now.plan.status
    preferred = status.drone if status is not None else None
    return match_flight(now.plan, now.template, now.inventory(), now.settings, now.now_s, preferred=preferred)


def _intent(now: PlanSituation, state: PlanState, volumes: tuple[Volume4D, ...]) -> OperationalIntent:
    return OperationalIntent(now.name, state, PRIORITIES[now.plan.spec.priority_class], volumes)


def _overlaps(intent: OperationalIntent, now: PlanSituation) -> tuple[PlanFinding, ...]:
    return tuple(map(plan_finding, standing_overlaps(intent, now.airspace)))


def _policy_advisories(status: FlightPlanStatus) -> tuple[PlanFinding, ...]:
    return tuple(each for each in status.advisories if each.plan is None)


def _status_of(now: PlanSituation, match: Match, state: PlanState, message: str) -> FlightPlanStatus:
    generation = now.plan.metadata.generation
    return FlightPlanStatus(
        observed_generation=generation,
        decided_for=generation,
        state=state,
        message=message,
        priority_class=now.plan.spec.priority_class,
        drone=match.drone,
        candidates=match.candidates if now.plan.spec.dry_run else (),
        rejected=match.rejected,
        volumes=tuple(map(reserved_volume, match.volumes)),
        restrictions=match.restrictions,
        advisories=match.advisories,
    )


def _keep(now: PlanSituation) -> PlanStep:
    """Keep the state of a plan, and update its overlaps with other plans."""
    status = now.status.model_copy(update={"observed_generation": now.plan.metadata.generation})
    if now.state == "Accepted":
        status = status.model_copy(
            update={
                "advisories": _policy_advisories(status) + _overlaps(replace(intent_of(now.plan), name=now.name), now),
                "message": f"{status.drone} is reserved",
            }
        )
    return PlanStep(status, _conditions(status, now))


def _conditions(status: FlightPlanStatus, now: PlanSituation | None = None) -> tuple[ConditionUpdate, ...]:
    """Return the conditions of a plan with a status, from the status and the Application."""
    value: Literal["True", "False"] = "False" if status.state == "Rejected" else "True"
    reason = status.refusals[0].reason if status.state == "Rejected" and status.refusals else str(status.state)
    updates = [ConditionUpdate("Accepted", value, reason, status.message or "")]
    if status.state != "Rejected" and status.refusals:
        refusal = status.refusals[0]
        message = f"the earlier version stays in force: {refusal.message}"
        updates.append(ConditionUpdate("ChangeRefused", "True", refusal.reason, message, adverse=True))
    conflicts = [
        each for each in status.advisories if each.reason in {"OverlapsHigherPriority", "OverlapsEqualPriority"}
    ]
    if conflicts:
        updates.append(
            ConditionUpdate("ConflictArose", "True", conflicts[0].reason, conflicts[0].message, adverse=True)
        )
    restricted = _policy_advisories(status)
    if status.state == "Accepted" and restricted:
        updates.append(ConditionUpdate("Restricted", "True", restricted[0].reason, restricted[0].message, adverse=True))
    if now is not None and now.mission.started:
        updates.append(
            ConditionUpdate(STARTED, "True", "ApplicationCreated", f"Application {status.application} flies")
        )
    return tuple(updates)


def _until_start_s(now: PlanSituation) -> float:
    """Return the seconds until the preparation, the start or the end of an accepted plan, whichever is next."""
    window = now.plan.spec.window
    times = (window.begin_s - SOON_S, window.begin_s, max(window.end_s, now.end_s))
    left = [time - now.now_s for time in times if time > now.now_s]
    return min(left, default=1.0)
