"""Execution of an experiment, from its file to the verdicts."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path

from fractus_sim.errors import ExperimentError
from fractus_sim.experiment.definition import Experiment, VehicleSetup
from fractus_sim.report.flight_record import Judgement, judgements_of
from fractus_sim.runner.check_evaluation import Evidence, Verdict, judge
from fractus_sim.runner.fault_injection import Injector, Occurrence
from fractus_sim.runner.task_execution import TaskFailed, fly
from fractus_sim.runner.telemetry_recording import Flight, McapLog, Recorder
from fractus_sim.testbeds.testbed import Findings, Moment, Testbed
from fractus_sim.testbeds.vehicle_testbed import VehicleTestbed

READY_S = 90.0
LONG_AGO_S = 1e6
DOWN_S = 5.0
SHOW_EVERY_S = 0.2


def _silent(_line: str) -> None:
    """Ignore a progress line."""


@dataclass
class Progress:
    """Callbacks for progress of a run.

    Attributes:
        tell: Called with one line per event.
        show: Called with the current state a few times per second.
    """

    tell: Callable[[str], None] = _silent
    show: Callable[[str], None] = _silent


@dataclass
class _Session:
    """State of a running experiment."""

    experiment: Experiment
    testbed: Testbed
    flights: dict[str, Flight]
    recorders: dict[str, Recorder]
    log: McapLog
    progress: Progress
    injector: Injector = field(init=False)
    tasks: dict[str, Generator[None, None, None]] = field(default_factory=dict)
    events: list[tuple[float, str, str]] = field(default_factory=list)
    start: Moment = field(default_factory=lambda: Moment(0.0, 0))
    moment: Moment = field(default_factory=lambda: Moment(0.0, 0))
    begun: bool = False
    calm_since_s: float | None = None
    down_since_s: dict[str, float] = field(default_factory=dict)

    @property
    def now_s(self) -> float:
        """Seconds of the experiment. Negative before the vehicles are ready."""
        return self.moment.time_s - self.start.time_s if self.begun else self.moment.time_s - LONG_AGO_S

    def tell(self, vehicle: str, text: str) -> None:
        self.events.append((self.now_s, vehicle, text))
        self.progress.tell(f"{self.now_s:6.1f} s  {vehicle + ': ' if vehicle else ''}{text}")
        content = {"time_s": round(self.now_s, 3), "text": text}
        self.log.write("/events", "fractus.Event", self.moment.unix_us * 1000, content)

    def poll(self) -> None:
        """Advance time by one tick, and process the messages of the vehicles."""
        self.moment = self.testbed.tick()
        for station in self.testbed.pilots.values():
            station.poll(self.now_s, self.moment.unix_us)
        for name, observer in self.testbed.observers.items():
            messages = observer.poll(self.now_s, self.moment.unix_us)
            if self.begun:
                self.recorders[name].take(observer, messages, self.now_s, self.moment.unix_us)

    def step_tasks(self) -> None:
        """Resume every task. Abort the task of a vehicle that has landed without a command."""
        for name, task in self.tasks.items():
            if self.flights[name].task:
                continue
            state = self.testbed.observers[name].state
            if state.armed or state.flying or name not in self.injector.takeoffs_s:
                self.down_since_s.pop(name, None)
            elif self.now_s - self.down_since_s.setdefault(name, self.now_s) > DOWN_S:
                self.flights[name].task = "the vehicle landed without a command"
                self.tell(name, f"task aborted: {self.flights[name].task}")
                continue
            try:
                next(task)
            except StopIteration:
                self.flights[name].task = "done"
                self.tell(name, "task done")
            except TaskFailed as failure:
                self.flights[name].task = str(failure)
                self.tell(name, f"task aborted: {failure}")

    def over(self) -> bool:
        """Return True if everything has ended and the settle time has passed."""
        states = {name: observer.state for name, observer in self.testbed.observers.items()}
        flown = self.injector.takeoffs_s
        waiting = any(not self.flights[name].task for name in self.tasks)
        idle = self.testbed.flies and not any(name in flown for name in self.testbed.flies)
        moving = any(state.armed or state.flying for state in states.values())
        if waiting or idle or moving or self.testbed.busy or self.injector.pending:
            self.calm_since_s = None
            return False
        self.calm_since_s = self.now_s if self.calm_since_s is None else self.calm_since_s
        return self.now_s - self.calm_since_s >= self.experiment.settle


def run(experiment: Experiment, out: Path, *, base: Path | None = None, progress: Progress | None = None) -> Outcome:
    """Run an experiment, and write logs, tracks, figures and the report to a folder.

    Args:
        experiment: Experiment to run. `fractus_sim.experiment.definition.load` reads a file.
        out: Output folder. Files of an earlier run are overwritten.
        base: Base directory of relative paths in the experiment. Default: the working directory.
        progress: Callbacks for progress.

    Raises:
        ExperimentError: The experiment could not be set up. The message says what to do.
        OSError: A file could not be written.
    """
    from fractus_sim.runner.experiment_report import remove_report, write_outcome  # noqa: PLC0415 - matplotlib is slow

    progress = progress or Progress()
    out.mkdir(parents=True, exist_ok=True)
    (out / "logs").mkdir(exist_ok=True)
    remove_report(out)
    began_s = time.monotonic()
    with (
        closing(_testbed(experiment, out, base or Path.cwd(), progress)) as testbed,
        closing(McapLog(out / "logs" / f"{experiment.name}.mcap")) as log,
    ):
        flights = {setup.name: Flight(setup.name) for setup in experiment.setups()}
        session = _Session(
            experiment, testbed, flights, {n: Recorder(f, log) for n, f in flights.items()}, log, progress
        )
        problem = _run_session(session)
    outcome = _outcome(session, out, problem, time.monotonic() - began_s)
    write_outcome(outcome)
    return outcome


def _testbed(experiment: Experiment, out: Path, base: Path, progress: Progress) -> Testbed:
    if experiment.mode == "vehicles":
        return VehicleTestbed(experiment, out, base, progress.tell)
    if experiment.mode == "standalone":
        from fractus_sim.testbeds.standalone_testbed import ServiceTestbed  # noqa: PLC0415 - imports most of Fractus

        return ServiceTestbed(experiment, out, base, progress.tell)
    from fractus_sim.testbeds.cluster_testbed import ClusterTestbed  # noqa: PLC0415 - imports the embedded cluster

    return ClusterTestbed(experiment, out, base, progress.tell)


def _run_session(session: _Session) -> str:
    """Set up the testbed, wait until the vehicles are ready, and fly.

    Returns:
        The reason why the experiment was aborted, or an empty string.

    Raises:
        ExperimentError: The experiment could not be set up.
    """
    testbed = session.testbed
    experiment = session.experiment
    progress = session.progress
    testbed.set_up()
    for name, endpoint in testbed.endpoints.items():
        progress.tell(f"{name}: connect QGroundControl, Mission Planner or MAVProxy to {endpoint}")
    _wait_ready(session)
    session.start = session.moment
    session.begun = True
    session.injector = Injector(experiment.faults, testbed, lambda text: _tell_fault(session, text))
    for setup in experiment.setups():
        if setup.entry.task:
            session.tasks[setup.name] = fly(testbed.pilots[setup.name], setup.entry.task, _teller(session, setup))
    session.tell("", "vehicles are ready")
    try:
        testbed.begin()
        problem = _until_over(session)
    except ExperimentError as error:
        problem = str(error)
        session.tell("", problem)
    for vehicle, title in session.injector.missed:
        session.tell(vehicle, f"{title}: not injected, the experiment ended before")
    testbed.collect()
    return problem


def _wait_ready(session: _Session) -> None:
    slowest_s = max(setup.entry.ready_after for setup in session.experiment.setups())
    deadline_s = READY_S + slowest_s
    while True:
        session.poll()
        waiting = [name for name, observer in session.testbed.observers.items() if not observer.state.ready]
        if not waiting:
            return
        if session.moment.time_s > deadline_s:
            texts = session.testbed.observers[waiting[0]].state.texts
            detail = texts[-1][2] if texts else "no STATUSTEXT received"
            raise ExperimentError(f"{waiting[0]} was not ready to arm within {deadline_s:.0f} s: {detail}")


def _until_over(session: _Session) -> str:
    shown_s = 0.0
    while session.now_s < session.experiment.timeout:
        session.poll()
        session.injector.step(session.now_s)
        session.step_tasks()
        if session.over():
            return ""
        if time.monotonic() - shown_s > SHOW_EVERY_S:
            shown_s = time.monotonic()
            session.progress.show(_status(session))
    return f"not completed within {session.experiment.timeout:g} s"


def _status(session: _Session) -> str:
    words = [f"{session.now_s:5.0f} s"]
    for name, observer in list(session.testbed.observers.items())[:4]:
        state = observer.state
        words.append(f"{name} {state.mode} {state.alt_m:.0f} m {state.speed_mps:.0f} m/s {state.battery:.0%}")
    more = len(session.testbed.observers) - 4
    return "   ".join([*words, *([f"and {more} more"] if more > 0 else [])])


def _teller(session: _Session, setup: VehicleSetup) -> Callable[[str], None]:
    return lambda text: session.tell(setup.name, text)


def _tell_fault(session: _Session, text: str) -> None:
    vehicle, _, words = text.partition(": ")
    session.tell("" if vehicle == "cluster" else vehicle, words)


def _outcome(session: _Session, out: Path, problem: str, wall_s: float) -> Outcome:
    findings = session.testbed.findings
    experiment = session.experiment
    evidence = Evidence(
        session.flights,
        session.injector.occurrences,
        {zone.name: zone for zone in experiment.zones},
        findings,
    )
    verdicts: Sequence[Verdict] = [verdict for check in experiment.checks for verdict in judge(check, evidence)]
    return Outcome(
        experiment,
        out,
        session.flights,
        tuple(session.injector.occurrences),
        tuple(verdicts),
        findings,
        tuple(session.events),
        tuple(_since_start(judged, session) for judged in judgements_of(findings.calls)),
        session.now_s,
        wall_s,
        problem,
    )


def _since_start(judged: Judgement, session: _Session) -> Judgement:
    """Return a judgement with its time converted to seconds of the experiment."""
    return replace(judged, time_s=(judged.time_s - session.start.unix_us / 1e6) * (session.experiment.pace or 1.0))


@dataclass(frozen=True)
class Outcome:
    """Result of an experiment. Times are seconds of the experiment.

    Attributes:
        problem: Reason why the experiment was aborted. Empty if it completed.
        duration_s: Duration in simulated time.
        wall_s: Duration in real time.
        events: (seconds, vehicle or empty, text) of tasks and faults.
        judgements: Calls that policies corrected or denied.
    """

    experiment: Experiment
    folder: Path
    flights: dict[str, Flight]
    occurrences: tuple[Occurrence, ...]
    verdicts: tuple[Verdict, ...]
    findings: Findings
    events: tuple[tuple[float, str, str], ...]
    judgements: tuple[Judgement, ...]
    duration_s: float
    wall_s: float
    problem: str = ""

    @property
    def holds(self) -> bool:
        """True if the experiment completed and every check holds."""
        return not self.problem and all(verdict.holds for verdict in self.verdicts)
