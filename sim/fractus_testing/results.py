"""Results analyzer: queries and assertions about the flights, calls and programs of a run.

    results = Results.read(Path("out/demo"))
    for violation in results.get_violations("drone-1"):
        print(violation.time_s, violation.type, violation.reason)
    results.check_app_status("drone-1", SUCCESS)

Every `check_*` method raises AssertionError with a sentence that states the expected and the observed value.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, is_dataclass
from pathlib import Path
from typing import Any, Literal, Self

from fractus_core.api.model import InvalidObject, quantity
from fractus_core.control.state import DRIVER_LOST_CODE, TaskKind
from fractus_sim.errors import ExperimentError
from fractus_sim.experiment.checks import Check, DataLevel
from fractus_sim.experiment.definition import NamedZone
from fractus_sim.report.flight_record import JudgedCall, judged_call
from fractus_sim.report.track import Place, Track
from fractus_sim.runner.check_evaluation import Evidence, evaluate_check
from fractus_sim.runner.telemetry_recording import Flight
from fractus_sim.testbeds.resource_meter import ProgramUsage
from fractus_sim.testbeds.testbed import Findings
from pydantic import TypeAdapter, ValidationError

from fractus_testing.flight_plan import Resources
from fractus_testing.records import JUDGED_KINDS, Entry, RunRecord, read_record

ViolationType = Literal["flight_path", "no_fly", "altitude", "speed", "camera", "access"]
AppStatus = Literal["running", "success", "failed", "aborted"]
RUNNING: AppStatus = "running"
SUCCESS: AppStatus = "success"
FAILED: AppStatus = "failed"
ABORTED: AppStatus = "aborted"

_TYPES: Mapping[str, ViolationType] = {
    "OutsideOperationArea": "flight_path", "OperationAreaBorderAhead": "flight_path",
    "OutsideInclusionZone": "flight_path", "LegOutsideInclusionZone": "flight_path",
    "TooCloseToInclusionBorder": "flight_path", "InclusionBorderAhead": "flight_path",
    "InsideExclusionZone": "no_fly", "LegThroughExclusionZone": "no_fly", "TooCloseToExclusionZone": "no_fly",
    "ExclusionZoneAhead": "no_fly",
    "AltitudeAboveLimit": "altitude", "AltitudeBelowLimit": "altitude", "AltitudeTooLow": "altitude",
    "SpeedAboveLimit": "speed",
    "PrivacyZone": "camera", "PrivacyFilter": "camera", "FilterUnavailable": "camera", "FacesNotFound": "camera",
    "MethodDenied": "access", "MethodNotGranted": "access", "MethodNotGrantedHere": "access", "NoGrant": "access",
}  # fmt: skip
"""Type of violation by the reason code of a verdict."""

_SHORTENED = frozenset({"LegShortened", "VelocityScaled"})
"""Codes of motions that were shortened at a fence of any kind."""

_LEAVING_WORDS = (" outside ", " leaves ", " border of ", "none of ")
"""Words in the reasons of fences that a drone must not leave."""

_ENDING_TAKEOVERS = frozenset(task.value for task in (TaskKind.RETURN, TaskKind.LAND, TaskKind.LAND_AT))
_PENDING_PHASES = frozenset({"", "Running", "Waiting", "Flying", "Returning", "Landed"})
_SAME_CAUSE_S = 2.0
"""A takeover within this time after a violation of the same reason is its effect, and not another violation."""

_CHECKS: TypeAdapter[Check] = TypeAdapter(Check)


@dataclass(frozen=True, slots=True)
class Violation:
    """A call or a motion that a policy forbids.

    Attributes:
        time_s: Seconds of the run.
        type: flight_path, no_fly, altitude, speed, camera or access.
        code: Reason code of the verdict, such as `InsideExclusionZone`.
        action: Reaction of the policy engine: `correct`, `deny`, `takeover`, or the action of the monitor.
        method: Called method, or the name of the system's action.
        policies: Names of the violated policies.
        requested: Requested position, if the call has one.
        position: Position of the drone.
    """

    time_s: float
    drone: str
    type: ViolationType
    code: str
    action: str
    caller: str
    method: str
    reason: str
    policies: tuple[str, ...]
    requested: Place | None
    position: Place | None


class Results:
    """Queries and assertions about a run. Drones are identified by name, in upper or lower case.

    Args:
        read: Returns the current record of the run.
        declared: Resources that the application of a drone declares, by node name.
        zones: Zones for checks, by name.
    """

    def __init__(
        self,
        read: Callable[[], RunRecord],
        declared: Mapping[str, Resources] | None = None,
        zones: Mapping[str, NamedZone] | None = None,
    ) -> None:
        self._read = read
        self._declared = declared or {}
        self._zones = zones or {}

    @classmethod
    def read(cls, folder: Path | str) -> Self:
        """Read the folder of an experiment or test, of `make demo`, or of `fractus report`.

        Raises:
            ExperimentError: The folder contains no run.
        """
        record = read_record(Path(folder))
        return cls(lambda: record)

    @property
    def drones(self) -> tuple[str, ...]:
        """Names of the drones."""
        return tuple(self._read().flights)

    def track(self, drone: str) -> Track:
        """Return the flight of a drone: positions, modes, battery, takeoff and landing."""
        return self._flight(drone).track

    def requests(self, drone: str, method: str | None = None) -> list[JudgedCall]:
        """Return the calls that components made, with their verdicts, in order.

        Args:
            drone: Drone.
            method: Method to select, such as `Goto`. None: all methods.

        Raises:
            ExperimentError: The drone has no audit log entries.
        """
        calls = [_judged(entry) for entry in self._entries(drone) if entry.get("kind") == "call"]
        return [call for call in calls if method in {None, call.method}]

    def get_violations(self, drone: str, type: ViolationType | None = None) -> list[Violation]:
        """Return calls and motions that policies forbid, in order.

        Args:
            drone: Drone.
            type: Type to select. None: all types.

        Raises:
            ExperimentError: The drone has no audit log entries.
        """
        violations: list[Violation] = []
        for entry in self._entries(drone):
            violation = _violation(drone, entry)
            if violation is None or type not in {None, violation.type}:
                continue
            if entry.get("kind") != "call" and any(_same_cause(earlier, violation) for earlier in violations):
                continue
            violations.append(violation)
        return violations

    def get_app_status(self, drone: str) -> AppStatus:
        """Return the status of the programs that a drone runs.

        Returns:
            `aborted` if the platform took the drone and ended the mission, `failed` if a program ended with an error, also if
            the platform then brought the drone home, `running` while a program runs, else `success`.

        Raises:
            ExperimentError: No program of the drone was started.
        """
        record = self._read()
        name = self._name(record, drone)
        phase = record.phases.get(name)
        codes = [code for program, code in record.programs.items() if self._runs_on(record, program, name)]
        if not codes and phase is None:
            raise ExperimentError(f"{drone} runs no program; call set_app() and start_app() first")
        endings = {str(entry.get("code")) for entry in record.entries.get(name, ()) if _ends_mission(entry)}
        if endings and not (any(codes) and endings == {DRIVER_LOST_CODE}):
            return ABORTED
        if phase is not None:
            status = SUCCESS if phase == "Completed" else FAILED
            return RUNNING if phase in _PENDING_PHASES else status
        if any(codes):
            return FAILED
        return RUNNING if None in codes else SUCCESS

    def get_app_resources(self, drone: str) -> ProgramUsage:
        """Return the resources that the programs of a drone used so far.

        Raises:
            ExperimentError: No program of the drone was measured.
        """
        record = self._read()
        name = self._name(record, drone)
        usages = [usage for usage in record.usages.values() if usage.vehicle == name]
        if not usages:
            raise ExperimentError(f"the record of {drone} contains no resources of programs")
        return ProgramUsage(
            name,
            sum(usage.cpu_s for usage in usages),
            max(usage.wall_s for usage in usages),
            sum(usage.mean_memory_mib for usage in usages),
            sum(usage.peak_memory_mib for usage in usages),
        )

    def get_data_sent(self, drone: str, level: DataLevel = "app") -> int:
        """Return the bytes that a drone or node sent so far.

        Args:
            drone: Drone or node.
            level: `app`: Ethernet frames that the programs sent. `runtime`: Ethernet frames that the services sent to the
                programs. Both need a network of `NetSim`. `autopilot`: MAVLink that the autopilot sent to the services.

        Raises:
            ExperimentError: The level was not measured.
        """
        record = self._read()
        name = next((name for name in record.data_sent if name.lower() == drone.lower()), None)
        sent = record.data_sent[name].get(level) if name is not None else None
        if sent is None:
            raise ExperimentError(
                f"the data that {drone} sent at level {level} was not measured; add the drone to a NetSim before start_app()"
            )
        return sent

    def compare(self, value: object, expected: object, tolerance: float = 0.1) -> None:
        """Require that a value equals the expected value. Numbers may differ by a share of the expected number.

        Args:
            value: A number, a mapping, or a dataclass such as `get_app_resources` returns.
            expected: Expected value. Of a mapping or dataclass, only the expected fields are compared.
            tolerance: Permitted difference, as a share of each expected number.

        Raises:
            AssertionError: A value differs.
        """
        __tracebackhide__ = True
        differences = list(_differences("", _plain(value), _plain(expected), tolerance))
        if differences:
            raise AssertionError("; ".join(differences))

    def check(self, check: str, drone: str | None = None, **fields: Any) -> None:
        """Require that a check of experiment files holds, for example `check("landed", near_home=3)`.

        Args:
            check: Type of the check, as in experiment files.
            drone: Drone to check. None: all drones.
            fields: Fields of the check.

        Raises:
            AssertionError: The check does not hold.
            ExperimentError: The check or one of its fields is unknown.
        """
        __tracebackhide__ = True
        record = self._read()
        content = {"check": check, **fields} | ({"vehicles": [self._name(record, drone)]} if drone else {})
        try:
            parsed = _CHECKS.validate_python(content)
        except ValidationError as error:
            raise ExperimentError(str(InvalidObject.from_pydantic(error))) from None
        zone = getattr(parsed, "zone", None)
        if zone is not None and zone not in self._zones:
            raise ExperimentError(f"unknown zone {zone}; known: {', '.join(sorted(self._zones)) or 'none'}")
        calls = [entry for log in record.entries.values() for entry in log if entry.get("kind") in JUDGED_KINDS]
        findings = Findings(
            dict(record.programs),
            data_sent={name: dict(sent) for name, sent in record.data_sent.items()},
            calls=calls,
            audit_problems=dict(record.audit_problems),
        )
        for verdict in evaluate_check(parsed, Evidence(record.flights, zones=self._zones, findings=findings)):
            if not verdict.holds:
                raise AssertionError(f"{verdict.vehicle or 'run'}: {verdict.check} does not hold: {verdict.observed}")

    def check_violations(self, drone: str, type: ViolationType | None = None, count: int | None = None) -> None:
        """Require violations of a type.

        Args:
            drone: Drone.
            type: Type of violation. None: any type.
            count: Exact number. None: at least one.

        Raises:
            AssertionError: The number differs.
            ExperimentError: The drone has no audit log entries.
        """
        __tracebackhide__ = True
        matching = self.get_violations(drone, type)
        if (count is None and matching) or len(matching) == count:
            return
        kind = f"violation of type {type}" if type else "violation"
        expected = f"at least one {kind}" if count is None else f"{count} {kind}{'' if count == 1 else 's'}"
        others = self.get_violations(drone)
        found = "; ".join(f"{v.type} at {v.time_s:.1f} s: {v.reason}" for v in others) or "no violation"
        raise AssertionError(f"{drone}: expected {expected}, observed {len(matching)}; all violations: {found}")

    def check_no_violations(self, drone: str) -> None:
        """Require that no policy was violated.

        Raises:
            AssertionError: A policy was violated.
            ExperimentError: The drone has no audit log entries.
        """
        __tracebackhide__ = True
        self.check_violations(drone, count=0)

    def check_app_status(self, drone: str, status: AppStatus) -> None:
        """Require the status of the programs of a drone.

        Raises:
            AssertionError: The status differs.
        """
        __tracebackhide__ = True
        observed = self.get_app_status(drone)
        if observed != status:
            raise AssertionError(f"{drone}: expected application status {status}, observed {observed}")

    def check_data_sent(self, drone: str, level: DataLevel = "app", *, max: int | None = None, min: int = 0) -> None:
        """Require that a drone sent an amount of data within limits.

        Args:
            drone: Drone.
            level: app, runtime or autopilot, as in `get_data_sent`.
            max: Maximum number of bytes. None: unlimited.
            min: Minimum number of bytes.

        Raises:
            AssertionError: The amount is outside of the limits.
            ExperimentError: The level was not measured.
        """
        __tracebackhide__ = True
        self.get_data_sent(drone, level)
        limits = {"min": min} if max is None else {"min": min, "max": max}
        self.check("dataSent", drone, level=level, **limits)

    def check_landed(self, drone: str, near_home: float | None = None) -> None:
        """Require that the drone flew, and is landed and disarmed.

        Args:
            drone: Drone.
            near_home: Maximum distance between landing and takeoff position, metres.

        Raises:
            AssertionError: The drone did not fly, is in the air or armed, or landed elsewhere.
        """
        __tracebackhide__ = True
        self.check("landed", drone, **({} if near_home is None else {"near_home": near_home}))

    def check_audit(self) -> None:
        """Require that the hash chains of all audit logs are valid.

        Raises:
            AssertionError: A log is invalid, or there is none.
        """
        __tracebackhide__ = True
        self.check("audit")

    def check_app_resources(self, drone: str, declared: Resources | None = None) -> None:
        """Require that the programs of a drone used no more resources than declared.

        Args:
            drone: Drone.
            declared: Declared resources. None: those of the drone's `setup`.

        Raises:
            AssertionError: The programs used more processor time or memory.
            ExperimentError: No resources are declared.
        """
        __tracebackhide__ = True
        limits = declared or self._declared.get(self._name(self._read(), drone))
        if limits is None:
            raise ExperimentError(f"{drone} declares no resources; pass `declared`")
        usage = self.get_app_resources(drone)
        cpu = float(quantity(limits.cpu))
        memory_mib = float(quantity(limits.memory)) / 2**20
        if usage.cpu > cpu:
            raise AssertionError(f"{drone}: the application used {usage.cpu:.2f} processor cores; declared: {cpu:g}")
        if usage.peak_memory_mib > memory_mib:
            raise AssertionError(
                f"{drone}: the application used {usage.peak_memory_mib:.0f} MiB of memory; declared: {memory_mib:.0f} MiB"
            )

    def _flight(self, drone: str) -> Flight:
        record = self._read()
        return record.flights[self._name(record, drone)]

    def _entries(self, drone: str) -> Sequence[Entry]:
        record = self._read()
        entries = record.entries.get(self._name(record, drone), ())
        if not entries:
            raise ExperimentError(
                f"{drone} has no audit log entries, so its calls are unknown; start its program first"
            )
        return entries

    def _name(self, record: RunRecord, drone: str) -> str:
        """Return the node name of a drone."""
        name = next((name for name in record.flights if name.lower() == drone.lower()), None)
        if name is None:
            raise ExperimentError(f"unknown drone {drone}; known: {', '.join(record.flights) or 'none'}")
        return name

    def _runs_on(self, record: RunRecord, program: str, drone: str) -> bool:
        usage = record.usages.get(program)
        return usage.vehicle == drone if usage is not None else len(record.flights) == 1 or program.startswith(drone)


def _judged(entry: Entry) -> JudgedCall:
    """Return the call of an audit log entry, with its time in seconds of the run."""
    call = judged_call(entry)
    return JudgedCall(
        float(entry["time_s"]), call.caller, call.method, call.action, call.code, call.reason, call.policies,
        call.requested, call.flown, call.position, call.arguments,
    )  # fmt: skip


def _violation(drone: str, entry: Entry) -> Violation | None:
    """Return the violation of an audit log entry. Return None for a permitted call and for other entries."""
    kind = entry.get("kind")
    action = str(entry.get("action", ""))
    stopped = kind == "control" and action == "brake"
    if (kind not in JUDGED_KINDS and not stopped) or (kind == "call" and action == "allow"):
        return None
    code = str(entry.get("code", ""))
    reason = str(entry.get("reason", ""))
    violation_type = _TYPES.get(code)
    if code in _SHORTENED:
        leaves = any(words in reason for words in _LEAVING_WORDS)
        violation_type = "flight_path" if leaves else "no_fly"
    if violation_type is None:
        return None
    call = _judged(entry)
    return Violation(
        call.time_s, drone, violation_type, code, action, call.caller, call.method, reason, call.policies,
        call.requested, call.position,
    )  # fmt: skip


def _same_cause(earlier: Violation, later: Violation) -> bool:
    return earlier.code == later.code and later.time_s - earlier.time_s < _SAME_CAUSE_S


def _ends_mission(entry: Entry) -> bool:
    return entry.get("kind") == "takeover" and entry.get("action") in _ENDING_TAKEOVERS


def _plain(value: object) -> object:
    if is_dataclass(value) and not isinstance(value, type):
        return asdict(value)
    return value


def _differences(name: str, value: object, expected: object, tolerance: float) -> Sequence[str]:
    label = name or "value"
    if isinstance(expected, Mapping):
        if not isinstance(value, Mapping):
            return [f"{label}: expected fields, observed {value!r}"]
        parts: list[str] = []
        for key, wanted in expected.items():
            if key not in value:
                parts.append(f"{label}: no field {key}; known: {', '.join(map(str, value))}")
            else:
                parts += _differences(str(key), _plain(value[key]), _plain(wanted), tolerance)
        return parts
    if isinstance(expected, int | float) and isinstance(value, int | float):
        if abs(value - expected) <= tolerance * abs(expected):
            return []
        return [f"{label}: expected {expected:g} within {tolerance:.0%}, observed {value:g}"]
    return [] if value == expected else [f"{label}: expected {expected!r}, observed {value!r}"]
