"""One chaos run: seeded schedule of faults, consecutive missions, and evaluation of the invariants."""

from __future__ import annotations

import itertools
import json
import random
import subprocess
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial

from fractus_cluster.errors import ClusterError
from fractus_cluster.manifests import is_ready
from fractus_core.api.grants import unpack

from fractus_sim.chaos import invariants
from fractus_sim.chaos.chaos_cluster import ChaosTarget, VehicleWatch
from fractus_sim.chaos.chaos_faults import FAULTS, inject
from fractus_sim.chaos.invariants import Violation
from fractus_sim.errors import ExperimentError
from fractus_sim.report.audit_log_reader import read_audit_logs
from fractus_sim.testbeds.embedded_cluster import TRAFFIC_EXAMPLE, read_objects
from fractus_sim.testbeds.kube_commands import NAMESPACE, Object

FIRST_FAULT_S = 10.0
"""Time of the first fault. At this time, the first mission is being deployed."""

MAX_FAULT_SHARE = 1 / 3
"""Maximum duration of a fault, as a share of the run."""

MAX_OVERLAP_S = 10.0
MAX_PAUSE_S = 25.0

CONCURRENT_MISSIONS = 2
MISSION_TIMEOUT_S = 480.0
CLEAN_UP_TIMEOUT_S = 120.0
RECOVERY_TIMEOUT_S = 120.0
ENDED_PHASES = frozenset({"Completed", "Failed", "Invalid"})
CHILDREN = "deployments,replicasets,services,secrets,endpointslices,poddisruptionbudgets,networkpolicies,pods"
"""Kinds of objects that the operator creates for an Application."""

_STEP_S = 0.5
_MAX_ERROR_LENGTH = 200
_CLUSTER_ERRORS = (ExperimentError, ClusterError, subprocess.SubprocessError, OSError)


@dataclass(frozen=True, slots=True)
class RunConfig:
    """Configuration of a run.

    Attributes:
        seed: Seed of the schedule.
        fault_time_s: Duration of fault injection, seconds.
        kinds: Fault types to inject.
    """

    seed: int
    fault_time_s: float
    kinds: Sequence[str]


@dataclass
class ChaosRun:
    """Results of a run.

    Attributes:
        began_s: Start of the run, Unix seconds.
        report: Called with progress lines.
        timeline: Events with seconds since the start of the run.
        missions: Phase and message of the missions.
        violations: Violated invariants.
        flown_s: Flight time, seconds.
        audit_entries: Number of entries in all audit logs.
    """

    seed: int
    began_s: float
    report: Callable[[str], None]
    timeline: list[tuple[float, str]] = field(default_factory=list)
    missions: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    violations: list[Violation] = field(default_factory=list)
    flown_s: float = 0.0
    audit_entries: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def record(self, text: str) -> None:
        """Add an event to the timeline and report it. This method may be called by several threads."""
        time_s = time.time() - self.began_s
        with self._lock:
            self.timeline.append((time_s, text))
        self.report(f"seed {self.seed}, {time_s:.1f} s: {text}")


def execute_run(target: ChaosTarget, watch: VehicleWatch, config: RunConfig, report: Callable[[str], None]) -> ChaosRun:
    """Inject the faults of a schedule while missions fly, then evaluate the invariants."""
    run = ChaosRun(config.seed, time.time(), report)
    durations = {kind: (FAULTS[kind].shortest_s, FAULTS[kind].longest_s) for kind in config.kinds}
    planned = create_schedule(config.seed, config.fault_time_s, durations)
    missions = Missions(target, f"chaos-{config.seed}", run.record)
    # Each fault has its own generator, so that its random values do not depend on the timing of the other faults.
    generators = [random.Random(f"{config.seed}/{number}") for number in range(len(planned))]  # noqa: S311 - repeatable
    # The threads are daemons, so that an interrupted run does not wait for the repair of faults. The run removes its
    # cluster anyway.
    threads = [
        threading.Thread(target=_inject_planned_fault, args=(target, fault, generator, run), daemon=True)
        for fault, generator in zip(planned, generators, strict=True)
    ]
    for thread in threads:
        thread.start()
    faults_end_s = run.began_s + config.fault_time_s
    while time.time() < faults_end_s or any(thread.is_alive() for thread in threads):
        missions.step(start_new=time.time() < faults_end_s)
        time.sleep(_STEP_S)
    run.record("all faults have ended")
    missions.wait_ended(MISSION_TIMEOUT_S)
    run.missions = {**missions.ended, **missions.active}
    run.violations += _wait_recovered(target, missions)
    run.violations += _evaluate_invariants(target, watch, run)
    return run


# -- Faults ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class PlannedFault:
    """A scheduled fault.

    Attributes:
        start_s: Seconds since the start of the run.
        kind: Fault type.
        duration_s: Duration, seconds. 0 for instantaneous faults.
    """

    start_s: float
    kind: str
    duration_s: float


def create_schedule(
    seed: int, fault_time_s: float, durations: Mapping[str, tuple[float, float]]
) -> tuple[PlannedFault, ...]:
    """Return the faults of a run: all types in random order, again and again, with pauses or overlaps.

    A fault type never overlaps itself, and all faults end before the end of the run.

    Args:
        seed: Seed of all random values. The same seed gives the same schedule.
        fault_time_s: Duration of fault injection, seconds.
        durations: Minimum and maximum duration of each fault type, seconds.
    """
    generator = random.Random(seed)  # noqa: S311 - repeatable
    planned: list[PlannedFault] = []
    waiting: list[str] = []
    ends_s: dict[str, float] = {}
    start_s = FIRST_FAULT_S
    while durations:
        if not waiting:
            waiting = generator.sample(sorted(durations), len(durations))
        kind = waiting.pop()
        start_s = max(start_s, ends_s.get(kind, 0.0))
        shortest_s, longest_s = durations[kind]
        longest_s = max(shortest_s, min(longest_s, fault_time_s * MAX_FAULT_SHARE))
        duration_s = round(generator.uniform(shortest_s, longest_s), 1)
        if start_s + duration_s > fault_time_s:
            break
        planned.append(PlannedFault(round(start_s, 1), kind, duration_s))
        ends_s[kind] = start_s + duration_s
        start_s = max(start_s, ends_s[kind] - MAX_OVERLAP_S) + generator.uniform(0, MAX_PAUSE_S)
    return tuple(planned)


def _inject_planned_fault(target: ChaosTarget, planned: PlannedFault, generator: random.Random, run: ChaosRun) -> None:
    """Inject and repair one scheduled fault."""
    time.sleep(max(run.began_s + planned.start_s - time.time(), 0.0))
    injected = False
    try:
        with inject(FAULTS[planned.kind], target, generator) as description:
            injected = True
            duration = f" for {planned.duration_s:g} s" if planned.duration_s else ""
            run.record(f"{planned.kind}: {description}{duration}")
            time.sleep(planned.duration_s)
    except _CLUSTER_ERRORS as error:
        result = "not repaired" if injected else "not injected"
        run.record(f"{planned.kind}: {result}: {str(error)[-_MAX_ERROR_LENGTH:]}")
        if injected:
            run.violations.append(Violation("recovery", time.time(), f"{planned.kind} was not repaired: {error}"))
    else:
        if planned.duration_s:
            run.record(f"{planned.kind}: repaired")


# -- Missions -------------------------------------------------------------------------------------------------


def short_mission(name: str, namespace: str = NAMESPACE) -> Object:
    """Return an Application with only the Navigator of the example, which flies near the depot for about a minute."""
    application = read_objects(TRAFFIC_EXAMPLE / "application.yaml")[0]
    navigator = next(part for part in application["spec"]["components"] if part["name"] == "Navigator")
    navigator["controlPoints"][0]["path"] = [
        {"lat": 50.864239, "lon": 4.679068, "alt": 12},
        {"lat": 50.864800, "lon": 4.679300, "alt": 12},
        {"lat": 50.865228, "lon": 4.679352, "alt": 12},
    ]
    navigator["container"].pop("env", None)
    application["metadata"] = {"name": name, "namespace": namespace}
    application["spec"]["components"] = [navigator]
    return application


@dataclass
class Missions:
    """Missions of one run, started one after another. Two Applications at a time compete for one drone.

    Attributes:
        prefix: Prefix of the names of the Applications.
        report: Called with a text when the phase of a mission changes.
        ended: Phase and message of completed missions by name.
        active: Phase and message of active missions by name.
    """

    target: ChaosTarget
    prefix: str
    report: Callable[[str], None]
    ended: dict[str, tuple[str, str]] = field(default_factory=dict)
    active: dict[str, tuple[str, str]] = field(default_factory=dict)
    _count: int = 0

    def step(self, *, start_new: bool) -> None:
        """Update the missions, delete ended missions, and apply new missions. Errors of the API server are ignored."""
        with suppress(ExperimentError):
            self._update()
            while start_new and len(self.active) < CONCURRENT_MISSIONS:
                self._start_mission()

    def wait_ended(self, timeout_s: float) -> None:
        """Wait until the active missions have ended, or until the timeout."""
        deadline = time.monotonic() + timeout_s
        while self.active and time.monotonic() < deadline:
            self.step(start_new=False)
            time.sleep(_STEP_S)

    def orphans(self) -> list[Object]:
        """Return Applications that are being deleted, and objects and stored Grants of deleted Applications.

        Raises:
            ExperimentError: The API server did not respond.
        """
        applications = self.target.objects("applications.fractus.dev", "-A")
        in_deletion = [body for body in applications if "deletionTimestamp" in body["metadata"]]
        names = {body["metadata"]["name"] for body in applications}
        children = self.target.objects(CHILDREN, "-A", "-l", "fractus.dev/application")
        children += self.target.objects("grants.fractus.dev,directlinks.fractus.dev", "-A")
        children += self.target.objects("deploymentplans.fractus.dev", "-A")
        children += self._node_grants() + self._stored_grants()
        return in_deletion + [body for body in children if _application_name(body) not in names]

    def _node_grants(self) -> list[Object]:
        """Return the Grants in NodeGrants objects."""
        specs = [body["spec"] for body in self.target.objects("nodegrants.fractus.dev", "-A")]
        return [grant for spec in specs for grant in unpack(spec["packed"], spec["count"])]

    def _stored_grants(self) -> list[Object]:
        """Return the Grants on the disks of nodes."""
        grants = []
        for node in self.target.cluster.nodes:
            for path in (node.fractus_state / "grants").glob("*.json"):
                # The agent may remove a file during this loop.
                with suppress(FileNotFoundError):
                    grants.append(json.loads(path.read_bytes()))
        return grants

    def _update(self) -> None:
        applications = {
            body["metadata"]["name"]: body for body in self.target.objects("applications.fractus.dev", "-n", NAMESPACE)
        }
        for name in list(self.active):
            status = (applications.get(name) or {}).get("status") or {}
            phase = status.get("phase", "")
            message = status.get("message", "")
            if phase != self.active[name][0]:
                self.report(f"{name} is {phase}: {message}")
            self.active[name] = (phase, message)
            if phase in ENDED_PHASES:
                self.target.kubectl("delete", "application.fractus.dev", name, "-n", NAMESPACE, "--wait=false")
                self.ended[name] = self.active.pop(name)

    def _start_mission(self) -> None:
        name = f"{self.prefix}-{self._count + 1}"
        self.target.kube.apply([short_mission(name)], timeout_s=20.0)
        self._count += 1
        self.active[name] = ("", "")
        self.target.applied.set()
        self.target.applied.clear()


def _application_name(body: Object) -> str:
    """Return the name of the Application that an object belongs to."""
    label = body["metadata"].get("labels", {}).get("fractus.dev/application")
    reference = (body.get("spec") or {}).get("application") or {}
    return str(label or reference.get("name") or body["metadata"]["name"])


# -- Evaluation -----------------------------------------------------------------------------------------------


def _wait_recovered(target: ChaosTarget, missions: Missions) -> list[Violation]:
    """Delete all Applications, and wait until their objects are removed and all nodes are ready.

    Return a violation for each of these conditions that is not true after its timeout.
    """

    def applications_deleted() -> bool:
        target.kubectl("delete", "applications.fractus.dev", "--all", "-n", NAMESPACE, "--wait=false")
        return not missions.orphans()

    violations = []
    if not _wait_until(applications_deleted, CLEAN_UP_TIMEOUT_S):
        violations += invariants.orphans(missions.orphans())
    for description, kind in (
        ("every node is Ready", "nodes"),
        ("the drone is Ready", "drones.fractus.dev"),
        ("every edge node is Ready", "edgenodes.fractus.dev"),
    ):
        if not _wait_until(partial(_all_ready, target, kind), RECOVERY_TIMEOUT_S):
            text = f"not true after {RECOVERY_TIMEOUT_S:.0f} s: {description}"
            violations.append(Violation("recovery", 0.0, text))
    return violations


def _all_ready(target: ChaosTarget, kind: str) -> bool:
    return all(map(is_ready, target.objects(kind)))


def _evaluate_invariants(target: ChaosTarget, watch: VehicleWatch, run: ChaosRun) -> list[Violation]:
    """Evaluate all invariants on audit logs and telemetry since the start of the run."""
    samples = [sample for sample in watch.samples if sample.time_s >= run.began_s]
    run.flown_s = sum(b.time_s - a.time_s for a, b in itertools.pairwise(samples) if a.flying)
    violations = list(invariants.unfinished_missions(run.missions))
    if watch.home is None or watch.failure:
        reason = watch.failure or "position unknown"
        violations.append(Violation("watched", 0.0, f"no vehicle telemetry: {reason}"))
    else:
        violations += invariants.landings_away_from_home(samples, watch.home)
    boot_time_s = time.time() - time.clock_gettime(time.CLOCK_BOOTTIME)
    for node in target.cluster.nodes:
        folder = node.fractus_state / "audit"
        for log in read_audit_logs([folder] if folder.is_dir() else []):
            run.audit_entries += log.length
            if log.problem:
                text = f"{node.name}/{log.path.name}: {log.problem}"
                violations.append(Violation("one writer of each audit log", 0.0, text))
            entries = list(invariants.with_corrected_times(log.entries, boot_time_s))
            if log.path.stem == "mobility":
                violations += invariants.flights_without_authority(samples, entries)
                violations += invariants.flights_of_several_applications(entries, watch.grants)
            if node.name == target.drone:
                violations += invariants.forbidden_calls(entries, watch.grants, watch.home)
    return [violation for violation in violations if not violation.time_s or violation.time_s >= run.began_s]


def _wait_until(condition: Callable[[], bool], timeout_s: float) -> bool:
    """Return True if the condition becomes true before the timeout. Errors of the cluster count as false."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        with suppress(*_CLUSTER_ERRORS):
            if condition():
                return True
        time.sleep(_STEP_S)
    return False
