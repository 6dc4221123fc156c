"""Status of an Application: phase, message and conditions, from its plan, pods, Grants and drone. Pure functions."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from types import MappingProxyType
from typing import Any, Literal, assert_never

from fractus_core.api import Condition, Drone, Grant
from fractus_core.api.conditions import ConditionUpdate
from fractus_core.api.grants import ReportedPictures, ReportedWaypoints
from fractus_core.api.plans import DeploymentPlanSpec, MissionRecord
from fractus_core.control import Outcome, OutcomeKind, WaypointCounts

from fractus_operator.parsing import SETTLED
from fractus_operator.pods import PlanPods, PodView

FlightPhase = Literal["Waiting", "TakingOff", "Flying", "Returning", "Landed", "Unknown"]
Phase = Literal["Pending", "Queued", "Deploying", "Running", FlightPhase, "Completed", "Failed", "Invalid"]

STAGES = ("Planned", "Granted", "Deployed")
"""Conditions that an Application reaches one after the other."""
MISSION_BEGUN = "MissionBegun"
OutcomeName = Literal["Complete", "Revoked", "Failed"]
_OUTCOMES: Mapping[OutcomeKind, OutcomeName] = {
    OutcomeKind.COMPLETE: "Complete",
    OutcomeKind.REVOKED: "Revoked",
    OutcomeKind.FAILED: "Failed",
}
_REASONS: Mapping[OutcomeName, str] = {
    "Complete": "MissionComplete",
    "Revoked": "MissionRevoked",
    "Failed": "MissionFailed",
}
_MAX_NAMED = 3
"""Maximum number of instances that a message names. For further instances, the message contains only their number."""
_ACTIVITY = {
    "unknown": "in an unknown state",
    "inactive": "on the ground",
    "charging": "charging",
    "takingOff": "taking off",
    "flying": "flying",
    "landing": "landing",
}


@dataclass(frozen=True, slots=True)
class StatusUpdate:
    """The new status of an Application.

    Attributes:
        message: One sentence.
        conditions: In the order of the status.
    """

    phase: Phase
    message: str
    conditions: tuple[ConditionUpdate, ...]
    drone: str | None = None
    pods: str | None = None
    controller: str | None = None


class Blocked(Exception):
    """An Application cannot proceed at present.

    Attributes:
        phase: Invalid, Pending or Queued.
        stage: Condition that is not reached.
        reason: CamelCase.
        message: One sentence.
        retry_s: Seconds until the next step if no input changes.
        full: Nodes that would be suitable if they had free capacity.
    """

    def __init__(
        self,
        phase: Phase,
        stage: str,
        reason: str,
        message: str,
        *,
        retry_s: float = 30.0,
        full: Collection[str] = frozenset(),
    ) -> None:
        self.phase = phase
        self.stage = stage
        self.reason = reason
        self.message = message
        self.retry_s = retry_s
        self.full = full
        super().__init__(message)


# -- flight and mission --


@dataclass(frozen=True, slots=True)
class FlightStatus:
    """The flight of an Application that has a drone.

    Attributes:
        phase: Waiting before the takeoff, Landed after it, Unknown while the drone does not report.
        activity: Sentence about the drone.
        controller: Control authority while the drone is in the air: system, pilot, or a component.
        begun: True if the drone has taken off for the Application.
    """

    phase: FlightPhase
    activity: str
    controller: str | None
    begun: bool


def flight(name: str, drone: Drone | None, *, took_off: bool) -> FlightStatus:
    """Return the status of a flight.

    Args:
        name: Name of the drone of the plan.
        drone: The drone, or None if its object does not exist.
        took_off: True if the plan records that the drone has taken off for the Application.
    """
    status = drone.status if drone is not None else None
    in_air = status is not None and status.in_air
    begun = in_air or took_off
    if status is None or status.flight_state == "unknown":
        last = "on the ground"
        if status is not None and status.last_flight_state:
            last = _ACTIVITY[status.last_flight_state]
        return FlightStatus("Unknown", f"{name} is in an unknown state (at its last report: {last})", None, begun)
    if not in_air:
        if begun:
            return FlightStatus("Landed", f"{name} has landed", None, begun)
        return FlightStatus("Waiting", f"{name} is on the ground and its mission has not begun", None, begun)
    controller = status.controller
    flown_by = f", flown by {controller}" if controller else ""
    phase: FlightPhase = "TakingOff" if status.flight_state == "takingOff" else "Flying"
    return FlightStatus(phase, f"{name} is {_ACTIVITY[status.flight_state]}{flown_by}", controller, begun)


def mission_outcome(uid: str | None, grants: Iterable[Grant]) -> Outcome | None:
    """Return the mission outcome of the Application with this uid, or None while its mission continues.

    The node of the driver reports the outcome. If there is no driver, the node of the component with points of interest reports
    the outcome.
    """
    for grant in grants:
        spec = grant.spec
        status = grant.status
        if not reports_outcome(uid, grant) or status is None:
            continue
        waypoints = _counts(status.waypoints)
        match status.phase:
            case "Complete":
                message = status.message or f"{spec.component} finished its mission"
                return Outcome(OutcomeKind.COMPLETE, message, waypoints)
            case "Failed":
                message = status.message or f"the mission of {spec.component} failed"
                return Outcome(OutcomeKind.FAILED, message, waypoints)
            case "Revoked":
                message = status.message or f"the control of {spec.component} was revoked"
                return Outcome(OutcomeKind.REVOKED, message, waypoints)
            case "Pending" | "Active" | None:
                continue
            case _:
                assert_never(status.phase)
    return None


def reports_outcome(uid: str | None, grant: Grant) -> bool:
    """Return True if the node of a Grant reports the outcome of the mission of the Application with this uid."""
    spec = grant.spec
    return spec.application.uid == uid and (spec.class_ == "driver" or bool(spec.tour))


def reported_pictures(uid: str | None, grants: Iterable[Grant]) -> ReportedPictures | None:
    """Return the pictures of the Application with this uid, which the node that reports its outcome has counted."""
    reports = (grant.status for grant in grants if reports_outcome(uid, grant))
    return next((report.pictures for report in reports if report is not None and report.pictures is not None), None)


def mission_record(
    outcome: Outcome, pods: Sequence[PodView] = (), pictures: ReportedPictures | None = None
) -> MissionRecord:
    """Return the record of a mission that is over.

    Args:
        outcome: Outcome of the mission.
        pods: Pods of the Application. After an incomplete mission, their problems are recorded because the pods are deleted now.
        pictures: Pictures that the Application requested, if any.
    """
    problems = "" if outcome.kind is OutcomeKind.COMPLETE else _problems(pods)
    photographed = f"{pictures.taken} pictures taken, {pictures.refused} refused" if pictures is not None else ""
    message = "; ".join(filter(None, (outcome.reason, str(outcome.waypoints), photographed, problems)))
    counts = ReportedWaypoints(**asdict(outcome.waypoints)) if str(outcome.waypoints) else None
    return MissionRecord(outcome=_OUTCOMES[outcome.kind], message=message, waypoints=counts, pictures=pictures)


def _counts(reported: ReportedWaypoints | None) -> WaypointCounts:
    return WaypointCounts(**reported.model_dump()) if reported is not None else WaypointCounts()


def reported_record(reported: Mapping[str, Any], generation: int) -> MissionRecord | None:
    """Return the record of a mission from a status, or None if the status does not report that this mission is over.

    Only for missions of a release that recorded the outcome in the status only.

    Args:
        reported: Status of the Application.
        generation: Generation of the plan.
    """
    if reported.get("phase") not in SETTLED or generation > int(reported.get("observedGeneration") or 0):
        return None
    conditions: Iterable[Mapping[str, Any]] = reported.get("conditions") or ()
    mission: Mapping[str, Any] = next((c for c in conditions if c["type"] == "MissionComplete"), {})
    outcome: OutcomeName = "Complete" if mission.get("status") == "True" else "Failed"
    if mission.get("reason") == _REASONS["Revoked"]:
        outcome = "Revoked"
    return MissionRecord(outcome=outcome, message=mission.get("message") or reported.get("message"))


# -- status updates --


def deployed(
    plan: DeploymentPlanSpec,
    pods: Sequence[PodView],
    granted: int,
    flown: FlightStatus | None = None,
    refused: Mapping[str, str] = MappingProxyType({}),
    *,
    waits: bool = False,
) -> StatusUpdate:
    """Return the status of an Application whose child objects are all applied.

    Args:
        plan: The active plan.
        pods: Its current pods.
        granted: Number of instances with Grants.
        flown: Status of the flight, if the plan has a drone.
        refused: Reason why pods cannot be created, by instance. Empty if all pods can be created.
        waits: True if the takeoff waits until all pods are ready.
    """
    running = PlanPods(plan, pods)
    missing = [placed.instance for placed in running.unready]
    desired = sum(placed.replicas for placed in plan.placements)
    if missing:
        more = f" and {len(missing) - _MAX_NAMED} more" if len(missing) > _MAX_NAMED else ""
        message = f"waiting for {', '.join(missing[:_MAX_NAMED])}{more}"
        waiting = [pod for pod in pods if pod.instance in missing and not pod.finished and not pod.ready]
        failed = any(pod.failure for pod in waiting if not pod.terminating)
        problems = _problems(pod for pod in waiting if not pod.terminating or pod.eviction)
        named = sorted(name for name in missing if refused.get(name))[:_MAX_NAMED]
        refusals = "; ".join(f"pods of {name} cannot be created: {refused[name]}" for name in named)
        message += "".join(f"; {text}" for text in (refusals, problems) if text)
        reason = "PodsNotReady"
        if refusals:
            reason = "PodsRefused"
        elif failed:
            reason = "ComponentFailed"
        # A pod that was evicted or has no node yet is replaced or placed soon, so no Event reports it.
        readiness = ConditionUpdate("Ready", "False", reason, message, progress=not failed and not refusals)
    else:
        message = f"all {desired} pods are ready"
        readiness = ConditionUpdate("Ready", "True", "PodsReady", message)
    phase: Phase = "Deploying" if missing else "Running"
    if flown is not None:
        message = f"{message}; {flown.activity}"
        if waits:
            message += "; the mission begins when all components are ready"
        # A drone in the air is more important than a restarting pod.
        if not missing or flown.phase not in {"Waiting", "Landed"}:
            phase = flown.phase
        if flown.phase == "Unknown":
            readiness = ConditionUpdate("Ready", "Unknown", "TelemetryLost", flown.activity)
    conditions = [
        ConditionUpdate("Planned", "True", "Planned", _plan_summary(plan)),
        ConditionUpdate("Granted", "True", "Granted", f"{granted} instances may use services of their nodes"),
        ConditionUpdate("Deployed", "True", "Deployed", f"{len(plan.placements)} instances are deployed"),
        readiness,
    ]
    if plan.drone is not None and plan.drone.policy_conflict is not None:
        conditions.append(_policy_conflict(plan.drone.policy_conflict))
    if flown is not None and flown.begun:
        text = "the drone has taken off"
        conditions.append(ConditionUpdate("MissionComplete", "False", MISSION_BEGUN, text, progress=True))
    elif flown is not None:
        text = "the drone has not taken off yet"
        conditions.append(ConditionUpdate("MissionComplete", "False", "MissionWaiting", text, progress=True))
    drone = plan.drone.node if plan.drone is not None else None
    controller = flown.controller if flown is not None else None
    return StatusUpdate(
        phase, message, tuple(conditions), drone, f"{sum(running.ready.values())}/{desired}", controller
    )


def queued_rollout(plan: DeploymentPlanSpec, others: int) -> StatusUpdate:
    """Return the status of a planned Application while the operator is rolling out many others.

    Args:
        plan: Its plan.
        others: Number of the other Applications.
    """
    message = f"{_plan_summary(plan)}; {others} other Applications are being rolled out"
    return StatusUpdate(
        "Pending", message, (ConditionUpdate("Ready", "False", "OperatorBusy", message, progress=True),)
    )


def apply_failed(reported: Mapping[str, Any], reason: str, error: str) -> StatusUpdate:
    """Return the status of an Application whose child objects cannot be applied: its last status with the error.

    Args:
        reported: Last reported status, or empty.
        reason: CamelCase.
        error: Error message of the API server.
    """
    message = f"cannot apply child objects, retrying: {error}"
    known = (Condition.model_validate(c) for c in reported.get("conditions") or ())
    # Conditions of reached stages stay True. The state of the other stages is unknown, so their conditions are removed.
    kept = [
        ConditionUpdate(c.type, c.status, c.reason, c.message)
        for c in known
        if c.type != "Deployed" and (c.status != "False" or c.type not in {*STAGES, "Ready"})
    ]
    failing = [ConditionUpdate("Deployed", "False", reason, message)]
    if all(each.type != "Ready" for each in kept):
        failing.append(ConditionUpdate("Ready", "False", reason, message))
    present = {name: reported.get(name) for name in ("drone", "pods", "controller")}
    phase: Phase = "Pending" if reported.get("phase") in {None, "Queued", "Invalid"} else reported["phase"]
    return StatusUpdate(phase, message, (*kept, *failing), **present)


def waiting_for_landing(present: StatusUpdate, drone: str) -> StatusUpdate:
    """Return the status of an Application whose changed manifest is applied after its drone has landed."""
    message = (
        f"the changed manifest is applied when {drone} has landed; set spec.updatePolicy: Immediate to apply it at once"
    )
    update = ConditionUpdate("Updated", "False", "WaitsForLanding", message, progress=True)
    return replace(present, message=f"{present.message}; {message}", conditions=(*present.conditions, update))


def waiting_for_components(present: StatusUpdate) -> StatusUpdate:
    """Return the status of a finished mission after which a changed manifest waits for the components of the flight.

    The phase is not Completed or Failed, because the Application has another mission to fly.
    """
    message = (
        "the changed manifest is applied when the components that end with the flight have stopped, spec.afterFlight seconds after"
        " the landing; set spec.updatePolicy: Immediate to apply it at once"
    )
    update = ConditionUpdate("Updated", "False", "WaitsForComponents", message, progress=True)
    phase: Phase = present.phase if present.phase == "Returning" else "Landed"
    return replace(
        present, phase=phase, message=f"{present.message}; {message}", conditions=(*present.conditions, update)
    )


def over(record: MissionRecord, name: str | None, drone: Drone | None) -> StatusUpdate:
    """Return the status of an Application whose mission is over, even if its drone is still returning.

    Args:
        record: Record of the mission, with its outcome.
        name: Name of the drone.
        drone: The drone, if it exists.
    """
    assert record.outcome is not None
    complete = record.outcome == "Complete"
    reason = _REASONS[record.outcome]
    message = record.message or ""
    conditions: tuple[ConditionUpdate, ...] = (
        ConditionUpdate("Ready", "False", reason, message, progress=complete),
        ConditionUpdate("MissionComplete", "True" if complete else "False", reason, message),
    )
    if complete and record.waypoints is not None and record.waypoints.skipped:
        counts = str(_counts(record.waypoints))
        text = f"{counts}: their legs were refused, or the driver omitted them; `fractus audit show` names the verdicts"
        conditions = (*conditions, ConditionUpdate("Partial", "True", "WaypointsSkipped", text, adverse=True))
    phase: Phase = "Completed" if complete else "Failed"
    controller = None
    if not record.landed and drone is not None and drone.status is not None and drone.in_air:
        phase = "Returning"
        if drone.status.flight_state == "unknown":
            message += f"; {name} was returning at its last report"
        else:
            message += f"; {name} is returning"
        controller = drone.status.controller
    return StatusUpdate(phase, message, conditions, drone=name, controller=controller)


def without_record() -> StatusUpdate:
    """Return the status of an Application whose status reports a finished mission while its plan, the record, is missing.

    The mission may have been flown. To fly it again without a decision of a person would be wrong.
    """
    message = (
        "the status reports a finished mission, but the DeploymentPlan with its record is missing, so the outcome is unknown;"
        " to fly the mission, delete the Application and create it again"
    )
    conditions = (
        ConditionUpdate("Ready", "False", "RecordMissing", message),
        ConditionUpdate("MissionComplete", "Unknown", "RecordMissing", message),
    )
    return StatusUpdate("Failed", message, conditions)


def blocked(by: Blocked, present: StatusUpdate | None) -> StatusUpdate:
    """Return the status of an Application that cannot proceed, with the status of its deployed part."""
    queued = by.phase == "Queued"
    conditions = (
        *(ConditionUpdate(stage, "True", stage) for stage in STAGES[: STAGES.index(by.stage)]),
        ConditionUpdate(by.stage, "False", by.reason, by.message, progress=queued),
        ConditionUpdate("Ready", "False", by.reason, by.message, progress=queued),
    )
    if by.reason == "PolicyConflict":
        conditions = (*conditions, _policy_conflict(by.message))
    kept = (present.drone, present.pods, present.controller) if present is not None else ()
    return StatusUpdate(by.phase, by.message, conditions, *kept)


def _policy_conflict(message: str) -> ConditionUpdate:
    return ConditionUpdate("PolicyConflict", "True", "PolicyConflict", message, adverse=True)


def _plan_summary(plan: DeploymentPlanSpec) -> str:
    nodes = len({placed.node for placed in plan.placements if placed.node is not None})
    summary = f"{len(plan.placements)} instances on {nodes} drone and edge nodes and in the cloud"
    return f"{plan.drone.node} flies; {summary}" if plan.drone is not None else summary


def _problems(pods: Iterable[PodView]) -> str:
    return "; ".join(sorted({pod.problem for pod in pods if pod.problem})[:_MAX_NAMED])
