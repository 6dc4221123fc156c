"""One chaos run: missions, scheduled faults, and evaluation of the invariants."""

from __future__ import annotations

import itertools
import random
import subprocess
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

from fractus_cluster.errors import ClusterError
from fractus_cluster.manifests import is_ready
from fractus_runtime.audit_chain import entries, logs, read_lines, verify

from fractus_sim.chaos import invariants
from fractus_sim.chaos.faults import FAULTS, broken
from fractus_sim.chaos.invariants import Broken
from fractus_sim.chaos.missions import Missions
from fractus_sim.chaos.schedule import Planned, schedule
from fractus_sim.chaos.stage import Stage
from fractus_sim.chaos.watching import Watch
from fractus_sim.demo.kube import NAMESPACE, DemoError

END_TIMEOUT_S = 480.0
CLEAN_TIMEOUT_S = 120.0
RECOVER_TIMEOUT_S = 120.0
_STEP_S = 0.5
_ERRORS = (DemoError, ClusterError, subprocess.SubprocessError, OSError)


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
