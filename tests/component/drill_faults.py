"""Faults of the platform that the drills must find. `bench/platform_faults.py` applies each of them in a process of its own.

A fault replaces text in one function of a module. Only the code of this function changes, so modules need not be imported
again, and the fault ends with its process.
"""

from __future__ import annotations

import importlib
import os
import signal
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import pytest
from drills import DRILLS, perform
from fractus_services.errors import Refused

MAX_S = 60
"""Real time of a drill. A drill takes less than a second of processor time."""

FINDINGS = (AssertionError, Refused, TimeoutError, pytest.fail.Exception)
"""Exceptions of a drill that mean a broken promise of the platform. Others are errors of the drill or of the fault."""

CORE = "fractus_core"
SERVICES = "fractus_services"


@dataclass(frozen=True)
class Fault:
    """A fault.

    Attributes:
        name: Short description.
        module: Module whose source contains `old` exactly once.
        old: Text to replace.
        new: Replacement.
        drill: Drill that must find the fault.
    """

    name: str
    module: str
    old: str
    new: str
    drill: str


_ENGINE = f"{CORE}.policy.engine"
_GOTO = f"{CORE}.policy.goto_rules"
_VERTICAL = f"{CORE}.policy.takeoff_landing_rules"
_VELOCITY = f"{CORE}.policy.velocity_rules"
_FENCES = f"{CORE}.policy.geofences"
_LIMITS = f"{CORE}.policy.limits"
_MONITORING = f"{CORE}.policy.monitoring"
_PICTURES = f"{CORE}.policy.picture_rules"
_MACHINE = f"{CORE}.control.machine"
_AUTHORIZATION = f"{SERVICES}.mobility.flight.authorization"
_MONITOR = f"{SERVICES}.mobility.flight.monitor"
_FLIGHT = f"{SERVICES}.mobility.flight.service"
_ARMING = f"{SERVICES}.mobility.authority.arming"
_CONTROL = f"{SERVICES}.mobility.authority.control_store"
_VERIFIER = f"{SERVICES}.grant_verifier"
_CAPTURE = f"{SERVICES}.camera.image_capture"
_FILTERS = f"{SERVICES}.camera.filter_pipeline"
_STORED = f"{SERVICES}.camera.stored_images"
_VIEW = f"{SERVICES}.camera.image_authorization"

_REFUSALS_OF_STREAMS = """    if (lease is not None and lease.key != event.key) or update.state.armed_for_other(event.key):
        reason = "another application has the drone; try again when the flight of that application has ended"
        update.act(RefuseStream(event.lease_id, "ControlHeld", reason))
        return
    if lease is not None:
        update.act(RefuseStream(event.lease_id, "ControlHeld", SECOND_STREAM))
        return
"""
"""Either refusal alone keeps a second application away."""

FAULTS: tuple[Fault, ...] = (
    # Access and arguments
    Fault("methods of the Grant ignored", _ENGINE, "if method not in grant.methods:", "if False:", "method_that_is_not_granted_is_refused"),
    Fault("denial of a policy ignored", _ENGINE, "denied = judge_denials(method, now, grant)\n", "denied = None\n", "method_that_a_policy_denies_is_refused_in_its_zone"),
    Fault("bounds of arguments ignored", _ENGINE, "if value is not None and not (math.isfinite(value) and lower <= value <= upper):", "if False:", "wrong_numbers_are_refused"),
    Fault("NaN accepted", _ENGINE, "not (math.isfinite(value) and lower <= value <= upper)", "(value < lower or value > upper)", "wrong_numbers_are_refused"),
    Fault("legs to the ground accepted", _GOTO, "if height.value < MIN_LEG_ALTITUDE_M - ROUNDING_SLACK and not allows_low_altitude(bounds):", "if False:", "wrong_numbers_are_refused"),
    Fault("failing engine allows", _AUTHORIZATION, 'verdict = Verdict("deny", None, "InternalError", reason, (), "hover")', 'verdict = Verdict("allow", call.args)', "failing_engine_denies_and_stops"),
    # Fences
    Fault("margin 0", f"{CORE}.policy.decision_types", "return self.position_error_m + self.airframe.tracking_m", "return 0.0", "target_at_the_border_is_refused"),
    Fault("margin without tracking error at zones", _FENCES, "for zone in grant.exclusions.near(air, now, grant.flat_terrain):\n        breaches +=", "air = AirVolume(leg.ground, 0.0, air.lower_m, air.upper_m)\n    for zone in grant.exclusions.near(air, now, grant.flat_terrain):\n        breaches +=", "leg_beside_a_zone_keeps_its_margin"),
    Fault("fences of legs ignored", _GOTO, "    breaches = find_breaches(leg, now, grant, now.margin_m, now.height_margin_m)\n    adjustable", "    breaches = []\n    adjustable", "leg_through_a_zone_is_refused"),
    Fault("operation area ignored", _FENCES, "breaches = list(_check_operation_area(leg, now, grant, margin_m))", "breaches = []", "target_outside_the_area_is_refused"),
    Fault("zones ignored", _FENCES, "breaches += _check_exclusion(zone, leg, now, grant, air)", "pass", "leg_through_a_zone_is_refused"),
    Fault("inclusion zones ignored", _FENCES, "breaches += _check_inclusion(fence, leg, now, grant, air)", "pass", "adjusted_leg_ends_before_the_border"),
    Fault("action adjust ignored", _GOTO, "adjustable = adjusting and bool(breaches) and all(b.action == \"adjust\" for b in breaches)", "adjustable = False", "adjusted_leg_ends_before_the_border"),
    Fault("adjusted leg keeps its target", _GOTO, "    if any(note.code == \"LegShortened\" for note in notes):", "    if False:", "adjusted_leg_ends_before_the_border"),
    Fault("adjusted leg without margin", _GOTO, "return along(low - 0.01 / length_m) if low * length_m >= MIN_LEG_M else None", "return along(min(low + 1.5 / length_m, 1.0))", "adjusted_leg_ends_before_the_border"),
    Fault("takeovers of actions ignored", _FENCES, "takeover = TAKEOVERS[worst.action] if worst.enters else None", "takeover = None", "hover_action_takes_the_drone"),
    Fault("return replaced by landing", _FENCES, "takeover = TAKEOVERS[worst.action] if worst.enters else None", 'takeover = {**TAKEOVERS, "returnToLaunch": "land"}[worst.action] if worst.enters else None', "return_action_brings_the_drone_home"),
    Fault("every takeover hovers", _FENCES, '{_EFFECTS[takeover]}", names, takeover)', '{_EFFECTS[takeover]}", names, "hover")', "revoke_action_ends_the_mission"),
    Fault("way home not checked", _GOTO, "problem = check_straight_return(target, altitude_m, now, grant, margin=now.margin_m, slack=now.height_margin_m)", "problem = None", "target_without_legal_return_is_refused"),
    Fault("schedules ignored", f"{CORE}.policy.compiled_grant", "return active_between(self.schedule, first_s, min(time_s, self.rule.valid_until_s))", "return not self.schedule", "scheduled_zone_applies_when_it_begins"),
    Fault("velocities not checked against fences", _VELOCITY, "problem = _correct_to_fences(setpoint) or _return_problem(setpoint)", "problem = None", "velocities_do_not_press_through_a_border"),
    # Limits
    Fault("altitude of legs not limited", _GOTO, 'height = clamp("Altitude", "m above home", aim.altitude_m, bounds)', 'height = clamp("Altitude", "m above home", aim.altitude_m, [])', "altitude_limit_is_kept"),
    Fault("altitude of takeoffs not limited", _VERTICAL, 'clamped = clamp("Altitude", "m above home", args.altitude_m, bounds)', 'clamped = clamp("Altitude", "m above home", args.altitude_m, [])', "takeoff_above_the_limit_is_corrected"),
    Fault("altitude limits that refuse only correct", _LIMITS, "refusing = [b for b in (*above, *below) if b.refuses]", "refusing = []", "altitude_limit_with_refusal_refuses"),
    Fault("maximum altitude of the drone ignored", _LIMITS, "if grant.max_altitude_m is not None:", "if False:", "altitude_of_the_drone_is_limited_without_policies"),
    Fault("altitude limits of policies ignored", _LIMITS, "for rule, zone in _in_force(limits, now, limiting_zones(limits, grant, now, air, height_margin_m)):", "for rule, zone in ():", "altitude_limit_is_kept"),
    Fault("speed limits of policies ignored", _LIMITS, "for rule, _ in _in_force(grant.speed_limits, now, zones):", "for rule, _ in ():", "speed_limit_is_kept"),
    Fault("speed of legs not limited", _GOTO, 'speed = clamp("Speed", "m/s", unchanged_mps, speed_bounds(grant, now, air, now.height_margin_m))', 'speed = clamp("Speed", "m/s", unchanged_mps, [])', "speed_limit_is_kept"),
    Fault("SetSpeed not limited", _VELOCITY, 'clamped = clamp("Speed", "m/s", args.speed_mps, bounds)\n', 'clamped = clamp("Speed", "m/s", args.speed_mps, [])\n', "speed_limit_is_kept"),
    Fault("velocities not limited", _VELOCITY, "problem = _correct_speed(setpoint) or _correct_altitude(setpoint)", "problem = _correct_altitude(setpoint)", "speed_limit_is_kept"),
    # Monitor
    Fault("monitor switched off", _MONITOR, "verdict, by_system = self._judge(compiled) if compiled is not None else (None, False)", "verdict, by_system = (None, False)", "drone_that_is_blown_into_a_zone_is_taken"),
    Fault("monitor ignores takeovers", _MONITOR, "            control.take_over(verdict)\n", "            pass\n", "drone_that_is_blown_into_a_zone_is_taken"),
    Fault("monitor ignores fences", _MONITORING, "    worst = _worst(\n        _fence_reactions(now, grant, _stopping_path(now, start, ahead, margin, level_m), system_flies=system_flies)\n    )", "    worst = None", "drone_that_is_blown_into_a_zone_is_taken"),
    Fault("monitor ignores altitudes", _MONITORING, "return correction or _check_speed(now, grant, start)", "return _check_speed(now, grant, start)", "altitude_above_a_new_limit_is_reduced_in_flight"),
    Fault("monitor ignores speeds", _MONITORING, "return correction or _check_speed(now, grant, start)", "return correction", "speed_above_a_new_limit_is_reduced_in_flight"),
    Fault("monitor does not carry out corrections", _MONITOR, "self._control.tasks.spawn(self._carry_out(verdict, self._control.motion, self._permits(), compiled))", "pass", "altitude_above_a_new_limit_is_reduced_in_flight"),
    Fault("monitor does not notice changed fences", _MONITOR, "changed = self._has_changed(compiled.fences_in_force(now.time_s))", "changed = False", "zone_added_in_flight_stops_the_leg"),
    Fault("monitor ignores an unknown position", _MONITORING, 'return Verdict("takeover", None, "PositionUnknown", "the drone\'s position is unknown", (), "hover")', "return None", "unknown_position_stops_the_drone"),
    Fault("old positions count as known", _AUTHORIZATION, "if not fresh or not math.isfinite(latency_s) or control.home_moved:", "if False:", "unknown_position_stops_the_drone"),
    # Authority
    Fault("disarm in flight allowed", _VERTICAL, "    if now.in_air:\n", "    if False:\n", "disarm_in_flight_is_refused"),
    Fault("motions without control", _CONTROL, "if lease is None or lease.key != grant.key or not state.drives:", "if lease is None:", "call_without_control_is_refused"),
    Fault("passengers may fly", _AUTHORIZATION, '        if grant.spec.class_ != "driver":\n            raise denied(self._deny_passenger(call, grant))\n', "", "passenger_cannot_fly"),
    Fault("denied motions are flown", _AUTHORIZATION, "        if not verdict.permits:\n            if verdict.takeover is not None:", "        if False:\n            if verdict.takeover is not None:", "target_outside_the_area_is_refused"),
    Fault("takeover of a call not carried out", _AUTHORIZATION, "            self._control.take_over(verdict)\n", "            pass\n", "land_action_lands_the_drone"),
    Fault("corrected leg does not suspend", _AUTHORIZATION, "            self._suspend(call, grant, suspension)\n", "            pass\n", "driver_waits_until_its_corrected_leg_ends"),
    Fault("motions on the ground", _FLIGHT, '        verdict = self.calls.allow_motion(Call("Goto", args), grant)\n        _require_in_air(self._autopilot)\n', '        verdict = self.calls.allow_motion(Call("Goto", args), grant)\n', "goto_on_the_ground_is_refused"),
    Fault("corrected arguments not used", _FLIGHT, "target = final.args if isinstance(final.args, GotoArgs) else args\n", "target = args\n", "altitude_limit_is_kept"),
    Fault("verdicts not recorded", _AUTHORIZATION, "            self.record(call, grant.identity, verdict, situation, kind=kind)\n", "            pass\n", "verdicts_are_in_the_audit_log"),
    Fault("Grant revocation ignored", _MACHINE, '        update.seize(TaskKind.RETURN, "GrantRevoked", GRANT_REMOVED, (), OutcomeKind.REVOKED)\n', "        pass\n", "removed_grant_takes_the_drone_at_once"),
    Fault("removed Grants not reported", _CONTROL, "        self.dispatch(GrantChanged(_reference(old), _reference(new)))\n", "", "removed_grant_takes_the_drone_at_once"),
    Fault("removed Grants stay in force", _CONTROL, "        self.dispatch(GrantChanged(_reference(old), _reference(new)))\n", "        if new is None and old is not None:\n            self._grants.active[old.identity] = old\n            return\n        self.dispatch(GrantChanged(_reference(old), _reference(new)))\n", "call_with_a_removed_grant_is_refused"),
    Fault("Grant not renewed", _CONTROL, "                lease.grant = new\n", "                pass\n", "replaced_grant_applies_to_the_next_call"),
    Fault("second application gets control", _MACHINE, _REFUSALS_OF_STREAMS, "", "second_application_does_not_get_the_drone"),
    Fault("lost driver keeps the drone", _MACHINE, '    _leave_driver(update, lease.key, "the driver\'s stream broke", reason, ends=bool(repeated))\n', "", "lost_driver_is_followed_by_a_return"),
    Fault("lost driver is waited for without end", _MACHINE, "    if not ends:\n        update.begin_grace(mission, reason)\n", "", "lost_driver_is_followed_by_a_return"),
    Fault("ended mission begins again", _MACHINE, "        update.act(RefuseStream(event.lease_id, *ended_refusal(mission.outcome)))\n        return\n", "        update.update_mission(mission, outcome=None)\n", "ended_mission_does_not_begin_again"),
    Fault("mission does not end with its last control point", _MACHINE, "    last = mission.points_done >= event.control_points\n", "    last = False\n", "ended_mission_does_not_begin_again"),
    Fault("pilot is not noticed", f"{CORE}.control.vehicle_events", "def _on_foreign_mode(update: StateUpdate) -> None:\n", "def _on_foreign_mode(update: StateUpdate) -> None:\n    return\n", "pilot_keeps_the_drone"),
    # Arming
    Fault("unverified failsafes accepted", _ARMING, "if status is None or status.problem or (chosen is not None and status is not chosen):", "if status is None:", "drone_is_not_armed_without_its_failsafes"),
    Fault("fence not raised", _ARMING, "                await self._safeguards.fence.raise_around(grant.spec, retraces=self._control.retraces)\n", "                pass\n", "drone_is_not_armed_without_its_fence"),
    Fault("broken audit log accepted", _ARMING, "if self._control.audit.failure:", "if False:", "drone_is_not_armed_without_its_audit_log"),
    Fault("home far away accepted", _ARMING, "if distance_m > SETTINGS.max_home_distance_m:", "if False:", "drone_far_from_its_home_does_not_arm"),
    # Grants
    Fault("signature not checked", _VERIFIER, "issued_at = _iso(verify(grant, self._authorities))", "issued_at = _iso(datetime.now(UTC))", "changed_grant_is_rejected"),
    Fault("replaced Grants accepted", _VERIFIER, "if issued_at <= latest:", "if False:", "replaced_and_revoked_grants_are_rejected"),
    Fault("revoked Grants accepted", _VERIFIER, "self._seen[identity] = replace(seen, revoked=True)", "pass", "replaced_and_revoked_grants_are_rejected"),
    Fault("revoked Grant counts as latest", _VERIFIER, "return seen is not None and seen.digest == digest and not seen.revoked", "return True", "replaced_and_revoked_grants_are_rejected"),
    # Pictures
    Fault("action refuse of pictures ignored", _PICTURES, "    if refusing:\n", "    if False:\n", "picture_of_a_private_zone_is_refused"),
    Fault("privacy policies ignored", _PICTURES, "rules = rules_in_view(grant.privacy, now, grant) if grant.privacy else []", "rules = []", "picture_of_a_private_zone_is_refused"),
    Fault("denied pictures are taken", _VIEW, "        if not verdict.permits:\n            raise denied(verdict)\n", "", "picture_of_a_private_zone_is_refused"),
    Fault("view of the camera ignored", _PICTURES, "        if zone.rule.name not in rules and view.shows(", "        if False and view.shows(", "picture_beside_a_private_zone_is_judged_by_its_view"),
    Fault("exposure not judged", _CAPTURE, "verdict = combine_verdicts([recorded, *self._authorize_exposure(call, grant, before, after)])", "verdict = recorded", "picture_is_judged_again_after_its_exposure"),
    Fault("camera unfiltered", _CAPTURE, "filtered = apply_filters(sized, plan, self._detector, face_px, upright=upright, fixed=camera.fixed)", "filtered = sized[len(sized) // 2]", "black_filter_is_applied"),
    Fault("filter black without effect", _FILTERS, "                picture = blacken(picture)\n", "                pass\n", "black_filter_is_applied"),
    Fault("filter blurAverage without effect", _FILTERS, "                picture = blur_average(picture)\n", "                pass\n", "blur_filter_is_applied"),
    Fault("faces not hidden", _FILTERS, "                picture = hide_faces(picture, detector.detect(picture, face_px, upright=upright), planned.faces)\n", "                pass\n", "faces_are_hidden"),
    Fault("small faces not hidden", _FILTERS, "if blur_faces is None or face_px >= detector.min_px:", "if True:", "small_faces_are_hidden_by_the_fallback"),
    Fault("mildest filter wins", _PICTURES, '        return (Filter("black"),)\n', '        required.pop("black") if len(required) > 1 else None\n', "strictest_of_two_filters_is_applied"),
    Fault("stored pictures not judged again", _VIEW, "return combine_verdicts([verdict, self.authorize_view(call, grant, situation_of(poses, now))])", "return verdict", "new_policy_applies_to_a_stored_picture"),
    Fault("one owner of all pictures", f"{SERVICES}.camera.image_store", "return self._directory / hashlib.sha256(owner.encode()).hexdigest()[:32]", 'return self._directory / "all"', "picture_of_another_owner_is_not_found"),
)  # fmt: skip


def apply(fault: Fault) -> None:
    """Apply a fault to this process.

    Raises:
        ValueError: The module does not contain the text exactly once, or no function changes.
    """
    module = importlib.import_module(fault.module)
    path = Path(str(module.__file__))
    source = path.read_text()
    if source.count(fault.old) != 1:
        raise ValueError(f"{fault.name}: {fault.module} contains the text {source.count(fault.old)} times, not once")
    before = _codes(compile(source, str(path), "exec"))
    after = _codes(compile(source.replace(fault.old, fault.new), str(path), "exec"))
    changed = 0
    for function in _functions(module):
        code = after.get(function.__code__.co_qualname)
        if code is not None and _text(code) != _text(before[function.__code__.co_qualname]):
            function.__code__ = code
            changed += 1
    if not changed:
        raise ValueError(f"{fault.name}: no function of {fault.module} changes")


def _codes(code: CodeType) -> dict[str, CodeType]:
    """Return the code of all functions and methods of a module by qualified name."""
    found: dict[str, CodeType] = {}
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            found[constant.co_qualname] = constant
            found |= _codes(constant)
    return found


def _text(code: CodeType) -> tuple[Any, ...]:
    """Return what distinguishes the code of two versions of a function. Positions of lines are not part of it."""
    constants = tuple(_text(each) if isinstance(each, CodeType) else each for each in code.co_consts)
    return code.co_code, constants, code.co_names


def _functions(module: ModuleType) -> Iterator[FunctionType]:
    """Yield the functions of a module, and the methods of its classes."""
    for value in vars(module).values():
        if getattr(value, "__module__", None) != module.__name__:
            continue
        members = vars(value).values() if isinstance(value, type) else (value,)
        for member in members:
            function = getattr(member, "fget", None) or getattr(member, "__func__", None) or member
            function = getattr(function, "__wrapped__", function)
            if isinstance(function, FunctionType):
                yield function


class DrillError(Exception):
    """A fault cannot be applied, or a drill ended with an error that is no finding."""


def finds(fault: Fault | None, drill: str) -> str:
    """Perform a drill in a process of its own, with a fault.

    Returns:
        The problem that the drill found. Empty if it found none.

    Raises:
        DrillError: The fault cannot be applied, or the drill ended with another exception than those of `FINDINGS`.
    """
    read_end, write_end = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(read_end)
        code = 1
        try:
            problem = _perform(fault, drill)
            code = 0
        except BaseException as error:
            problem = _describe(error)
        os.write(write_end, problem.encode()[:4000])
        os._exit(code)
    os.close(write_end)
    with os.fdopen(read_end, errors="replace") as answer:
        problem = answer.read()
    _, status = os.waitpid(child, 0)
    code = os.waitstatus_to_exitcode(status)
    if code == -signal.SIGALRM:
        return f"no end within {MAX_S} s"
    if code != 0:
        title = fault.name if fault is not None else "no fault"
        raise DrillError(f"{title}, {drill}: {problem or f'the process ended with exit code {code}'}")
    return problem


def _perform(fault: Fault | None, drill: str) -> str:
    signal.alarm(MAX_S)
    sys.stderr = Path(os.devnull).open("w")  # noqa: SIM115 - until the process ends
    if fault is not None:
        apply(fault)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        try:
            perform(DRILLS[drill], Path(folder))
        except FINDINGS as error:
            return _describe(error)
    return ""


def _describe(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
