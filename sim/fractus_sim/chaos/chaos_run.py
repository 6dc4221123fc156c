"""One chaos run: missions, scheduled faults, and evaluation of the invariants."""

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

import yaml
from fractus_cluster.errors import ClusterError
from fractus_cluster.manifests import is_ready
from fractus_core.api.grants import unpack
from fractus_runtime.audit_chain import entries, logs, read_lines, verify

from fractus_sim.chaos import invariants
from fractus_sim.chaos.chaos_cluster import Stage, Watch
from fractus_sim.chaos.chaos_faults import FAULTS, broken
from fractus_sim.chaos.invariants import Broken
from fractus_sim.demo.demo_clusters import EXAMPLE, documents
from fractus_sim.errors import ExperimentError
from fractus_sim.testbeds.kube_commands import NAMESPACE, Object

END_TIMEOUT_S = 480.0
CLEAN_TIMEOUT_S = 120.0
RECOVER_TIMEOUT_S = 120.0
_STEP_S = 0.5
_ERRORS = (ExperimentError, ClusterError, subprocess.SubprocessError, OSError)


@dataclass
class Run:
    """Results of a run.

    Attributes:
        timeline: Events with seconds since the start of the run.
        ended: Phase and message of the missions.
        broken: Violated invariants.
        flown_s: Flight time, seconds.
        entries: Number of entries in all audit logs.
    """

    seed: int
    began_s: float
    say: Callable[[str], None]
    timeline: list[tuple[float, str]] = field(default_factory=list)
    ended: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    broken: list[Broken] = field(default_factory=list)
    flown_s: float = 0.0
    entries: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def note(self, text: str) -> None:
        """Add a line to the timeline and report it."""
        at_s = time.time() - self.began_s
        with self._lock:
            self.timeline.append((at_s, text))
        self.say(f"seed {self.seed}, {at_s:.1f} s: {text}")


@dataclass(frozen=True, slots=True)
class Task:
    """Configuration of a run: seed of the schedule, duration of fault injection in seconds, and fault types."""

    seed: int
    run_s: float
    kinds: Sequence[str]


def fly(stage: Stage, watch: Watch, task: Task, say: Callable[[str], None]) -> Run:
    """Run the schedule of a seed and evaluate the invariants."""
    run = Run(task.seed, time.time(), say)
    durations = {kind: (FAULTS[kind].shortest_s, FAULTS[kind].longest_s) for kind in task.kinds}
    planned = schedule(task.seed, task.run_s, durations)
    missions = Missions(stage, f"chaos-{task.seed}", run.note)
    chances = [random.Random(f"{task.seed}/{at}") for at in range(len(planned))]  # noqa: S311 - chosen to repeat
    threads = [
        # # Daemon threads: an interrupted run does not wait for faults because its cluster is removed.
        threading.Thread(target=_happen, args=(stage, each, chance, run), daemon=True)
        for each, chance in zip(planned, chances, strict=True)
    ]
    for thread in threads:
        thread.start()
    while time.time() < run.began_s + task.run_s or any(thread.is_alive() for thread in threads):
        missions.step(more=time.time() < run.began_s + task.run_s)
        time.sleep(_STEP_S)
    run.note("all faults have ended")
    missions.finish(END_TIMEOUT_S)
    run.ended = {**missions.ended, **missions.present}
    run.broken += _settle(stage, missions)
    run.broken += _judge(stage, watch, run)
    return run


def _happen(stage: Stage, planned: Planned, chance: random.Random, run: Run) -> None:
    """Inject and repair one scheduled fault."""
    time.sleep(max(run.began_s + planned.at_s - time.time(), 0.0))
    begun = False
    try:
        with broken(FAULTS[planned.fault], stage, chance) as description:
            begun = True
            run.note(
                f"{planned.fault}: {description}" + (f" for {planned.duration_s:g} s" if planned.duration_s else "")
            )
            time.sleep(planned.duration_s)
    except _ERRORS as error:
        run.note(f"{planned.fault}: {'not repaired' if begun else 'not injected'}: {str(error)[-200:]}")
        if begun:
            run.broken.append(Broken("all recovers", time.time(), f"{planned.fault} was not repaired: {error}"))
    else:
        if planned.duration_s:
            run.note(f"{planned.fault}: over")


def _settle(stage: Stage, missions: Missions) -> list[Broken]:
    """Wait until deleted objects are gone and all nodes are ready. Return what is not after the timeout."""

    def deleted() -> bool:
        stage.kubectl("delete", "applications.fractus.dev", "--all", "-n", NAMESPACE, "--wait=false")
        return not missions.left_over()

    left = _awaited(deleted, CLEAN_TIMEOUT_S)
    found = invariants.left_over(missions.left_over()) if not left else []
    for what, holds in (
        ("every node is Ready", lambda: all(map(is_ready, stage.objects("nodes")))),
        ("the drone is Ready", lambda: all(map(is_ready, stage.objects("drones.fractus.dev")))),
        ("every edge node is Ready", lambda: all(map(is_ready, stage.objects("edgenodes.fractus.dev")))),
    ):
        if not _awaited(holds, RECOVER_TIMEOUT_S):
            found.append(Broken("all recovers", 0.0, f"after {RECOVER_TIMEOUT_S:.0f} s not true: {what}"))
    return found


def _judge(stage: Stage, watch: Watch, run: Run) -> list[Broken]:
    """Evaluate all invariants on audit logs and telemetry since the start of the run."""
    seen = [sample for sample in watch.seen if sample.time_s >= run.began_s]
    run.flown_s = sum(b.time_s - a.time_s for a, b in itertools.pairwise(seen) if a.flying)
    found = list(invariants.not_ended(run.ended))
    if watch.home is None or watch.failure:
        found.append(Broken("watched", 0.0, f"no vehicle telemetry: {watch.failure or 'position unknown'}"))
    else:
        found += invariants.landed_elsewhere(seen, watch.home)
    started_s = time.time() - time.clock_gettime(time.CLOCK_BOOTTIME)
    for node in stage.cluster.nodes:
        folder = node.own_state / "audit"
        for log, files in logs([folder] if folder.is_dir() else []).items():
            lines = [line for _, _, line in read_lines(files)]
            finding = verify(lines)
            run.entries += finding.entries
            if finding.problem:
                what = f"{node.name}/{log.name}: line {finding.line} {finding.problem}"
                found.append(Broken("one writer of each audit log", 0.0, what))
            log_entries = list(invariants.steadily_timed(entries(lines), started_s))
            if log.stem == "mobility":
                found += invariants.without_authority(seen, log_entries)
                found += invariants.in_two_applications(log_entries, watch.grants)
            if node.name == stage.drone:
                found += invariants.forbidden_calls(log_entries, watch.grants, watch.home)
    return [each for each in found if not each.time_s or each.time_s >= run.began_s]


def _awaited(holds: Callable[[], bool], timeout_s: float) -> bool:
    """Return True if the condition becomes true before the timeout."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        with suppress(*_ERRORS):
            if holds():
                return True
        time.sleep(_STEP_S)
    return False


ENDED = frozenset({"Completed", "Failed", "Invalid"})
AT_A_TIME = 2
CHILDREN = "deployments,replicasets,services,secrets,endpointslices,poddisruptionbudgets,networkpolicies,pods"
Say = Callable[[str], None]


def flight(name: str, namespace: str = NAMESPACE) -> Object:
    """Return the Navigator of the example on a short path near the depot, about one minute of flight."""
    app = documents(EXAMPLE / "application.yaml")[0]
    navigator = next(each for each in app["spec"]["components"] if each["name"] == "Navigator")
    navigator["controlPoints"][0]["path"] = [
        {"lat": 50.864239, "lon": 4.679068, "alt": 12},
        {"lat": 50.864800, "lon": 4.679300, "alt": 12},
        {"lat": 50.865228, "lon": 4.679352, "alt": 12},
    ]
    navigator["container"].pop("env", None)
    app["metadata"] = {"name": name, "namespace": namespace}
    app["spec"]["components"] = [navigator]
    return app


@dataclass
class Missions:
    """Missions of one run.

    Attributes:
        prefix: Prefix of their names.
        ended: Phase and message of completed missions by name.
        present: Phase and message of active missions by name.
    """

    stage: Stage
    prefix: str
    say: Say
    ended: dict[str, tuple[str, str]] = field(default_factory=dict)
    present: dict[str, tuple[str, str]] = field(default_factory=dict)
    _count: int = 0

    def step(self, *, more: bool) -> None:
        """Update the missions, delete ended ones and apply new ones. Errors of the API server are ignored."""
        try:
            self._look()
            while more and len(self.present) < AT_A_TIME:
                self._apply()
        except ExperimentError:
            return

    def finish(self, timeout_s: float) -> None:
        """Wait until the missions have ended."""
        deadline = time.monotonic() + timeout_s
        while self.present and time.monotonic() < deadline:
            self.step(more=False)
            time.sleep(0.5)

    def left_over(self) -> list[Object]:
        """Return Applications in deletion, and remaining objects and stored Grants of deleted Applications.

        Raises:
            ExperimentError: The API server did not respond.
        """
        applications = self.stage.objects("applications.fractus.dev", "-A")
        leaving = [body for body in applications if "deletionTimestamp" in body["metadata"]]
        names = {body["metadata"]["name"] for body in applications}
        found = self.stage.objects(CHILDREN, "-A", "-l", "fractus.dev/application")
        found += self.stage.objects("grants.fractus.dev,directlinks.fractus.dev", "-A")
        found += self.stage.objects("deploymentplans.fractus.dev", "-A")
        found += self._carried() + self._stored()
        return leaving + [body for body in found if _application(body) not in names]

    def _carried(self) -> list[Object]:
        """Return the Grants in NodeGrant objects."""
        specs = [body["spec"] for body in self.stage.objects("nodegrants.fractus.dev", "-A")]
        return [grant for spec in specs for grant in unpack(spec["packed"], spec["count"])]

    def _stored(self) -> list[Object]:
        """Return the Grants on the disks of nodes."""
        stored = []
        for node in self.stage.cluster.nodes:
            for path in (node.own_state / "grants").glob("*.json"):
                with suppress(FileNotFoundError):  # # removed in the meantime
                    stored.append(json.loads(path.read_bytes()))
        return stored

    def _look(self) -> None:
        found = {
            body["metadata"]["name"]: body for body in self.stage.objects("applications.fractus.dev", "-n", NAMESPACE)
        }
        for name in list(self.present):
            status = (found.get(name) or {}).get("status") or {}
            now = (status.get("phase", ""), status.get("message", ""))
            if now[0] != self.present[name][0]:
                self.say(f"{name} is {now[0]}: {now[1]}")
            self.present[name] = now
            if now[0] in ENDED:
                self.stage.kubectl("delete", "application.fractus.dev", name, "-n", NAMESPACE, "--wait=false")
                self.ended[name] = self.present.pop(name)

    def _apply(self) -> None:
        name = f"{self.prefix}-{self._count + 1}"
        self.stage.kube.run("apply", "-f", "-", stdin=yaml.safe_dump(flight(name)), timeout_s=20.0)
        self._count += 1
        self.present[name] = ("", "")
        self.stage.applied.set()
        self.stage.applied.clear()


def _application(body: Object) -> str:
    """Return the name of the Application of an object."""
    label = body["metadata"].get("labels", {}).get("fractus.dev/application")
    reference = (body.get("spec") or {}).get("application") or {}
    return str(label or reference.get("name") or body["metadata"]["name"])


FIRST_S = 10.0
"""Time of the first fault. The first mission is being deployed then."""

MAX_SHARE = 1 / 3
"""Maximum share of the run that a fault lasts."""

OVERLAP_S = 10.0
PAUSE_S = 25.0


@dataclass(frozen=True, slots=True)
class Planned:
    """A scheduled fault.

    Attributes:
        at_s: Seconds since the start of the run.
        fault: Name of the fault type.
        duration_s: Duration, seconds. 0 for instantaneous faults.
    """

    at_s: float
    fault: str
    duration_s: float


def schedule(seed: int, run_s: float, durations: Mapping[str, tuple[float, float]]) -> tuple[Planned, ...]:
    """Return the faults of a run: all types in random order, repeated, with pauses or overlaps.

    A fault type never overlaps itself, and all faults end before the run.

    Args:
        seed: Seed of all random values.
        run_s: Duration of the run, seconds.
        durations: Minimum and maximum duration of each fault type, seconds.
    """
    chance = random.Random(seed)  # noqa: S311 - chosen to repeat
    planned: list[Planned] = []
    waiting: list[str] = []
    ends: dict[str, float] = {}
    at_s = FIRST_S
    while durations:
        if not waiting:
            waiting = chance.sample(sorted(durations), len(durations))
        fault = waiting.pop()
        at_s = max(at_s, ends.get(fault, 0.0))
        shortest, longest = durations[fault]
        duration_s = round(chance.uniform(shortest, max(shortest, min(longest, run_s * MAX_SHARE))), 1)
        if at_s + duration_s > run_s:
            break
        planned.append(Planned(round(at_s, 1), fault, duration_s))
        ends[fault] = at_s + duration_s
        at_s = max(at_s, ends[fault] - OVERLAP_S) + chance.uniform(0, PAUSE_S)
    return tuple(planned)
