"""Execution of an experiment, from its definition to the verdicts and the report."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Self

from fractus_sim.errors import ExperimentError
from fractus_sim.experiment.definition import Experiment, Program
from fractus_sim.progress import Progress
from fractus_sim.report.flight_record import policy_decisions
from fractus_sim.report.report_files import EXPERIMENT_FILES, remove_report
from fractus_sim.runner.check_evaluation import Evidence, Verdict, evaluate_check
from fractus_sim.runner.fault_injection import FaultInjector
from fractus_sim.runner.outcome import Event, Outcome
from fractus_sim.runner.task_execution import TaskFailed, fly_task
from fractus_sim.runner.telemetry_recording import Flight, McapLog, Recorder
from fractus_sim.testbeds.testbed import Moment, Testbed
from fractus_sim.testbeds.vehicle_testbed import VehicleTestbed

READY_TIMEOUT_S = 90.0
LANDED_TIMEOUT_S = 5.0
"""Time on the ground after which the task of a vehicle is aborted."""

SHOW_INTERVAL_S = 0.2
MAX_SHOWN_VEHICLES = 4
_SET_UP_OFFSET_S = 1e6
"""Offset that makes experiment time negative during the set-up. The time then increases when the experiment begins."""


@dataclass
class _Session:
    """State of a running experiment."""

    experiment: Experiment
    testbed: Testbed
    flights: dict[str, Flight]
    log: McapLog
    progress: Progress
    recorders: dict[str, Recorder] = field(init=False)
    injector: FaultInjector = field(init=False)
    tasks: dict[str, Generator[None, None, None]] = field(default_factory=dict)
    events: list[Event] = field(default_factory=list)
    start: Moment = field(default_factory=lambda: Moment(0.0, 0))
    moment: Moment = field(default_factory=lambda: Moment(0.0, 0))
    begun: bool = False
    calm_since_s: float | None = None
    on_ground_since_s: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.recorders = {name: Recorder(flight, self.log) for name, flight in self.flights.items()}

    @property
    def now_s(self) -> float:
        """Seconds of the experiment. Negative before the vehicles are ready."""
        return self.moment.time_s - self.start.time_s if self.begun else self.moment.time_s - _SET_UP_OFFSET_S

    def report(self, vehicle: str, text: str) -> None:
        """Record an event and report it as progress."""
        self.events.append(Event(self.now_s, vehicle, text))
        prefix = f"{vehicle}: " if vehicle else ""
        self.progress.report(f"{self.now_s:6.1f} s  {prefix}{text}")
        content = {"time_s": round(self.now_s, 3), "text": text}
        self.log.write("/events", "fractus.Event", self.moment.unix_us * 1000, content)

    def begin(self) -> None:
        """Start the clock of the experiment, and prepare faults and tasks."""
        self.start = self.moment
        self.begun = True
        self.injector = FaultInjector(self.experiment.faults, self.testbed, self.report)
        for setup in self.experiment.setups():
            if setup.entry.task:
                pilot = self.testbed.pilots[setup.name]
                self.tasks[setup.name] = fly_task(pilot, setup.entry.task, partial(self.report, setup.name))
        self.report("", "vehicles are ready")

    def poll(self) -> None:
        """Advance time by one tick, and process the messages of the vehicles."""
        self.moment = self.testbed.tick()
        for station in self.testbed.pilots.values():
            station.poll(self.now_s, self.moment.unix_us)
        for name, observer in self.testbed.observers.items():
            messages = observer.poll(self.now_s, self.moment.unix_us)
            if self.begun:
                self.recorders[name].record(observer, messages, self.now_s, self.moment.unix_us)

    def step_tasks(self) -> None:
        """Resume every task. Abort the task of a vehicle that has landed without a command."""
        for name, task in self.tasks.items():
            if self.flights[name].task:
                continue
            state = self.testbed.observers[name].state
            if state.armed or state.flying or name not in self.injector.takeoffs_s:
                self.on_ground_since_s.pop(name, None)
            elif self.now_s - self.on_ground_since_s.setdefault(name, self.now_s) > LANDED_TIMEOUT_S:
                self._abort_task(name, "the vehicle landed without a command")
                continue
            try:
                next(task)
            except StopIteration:
                self.flights[name].task = "done"
                self.report(name, "task done")
            except TaskFailed as failure:
                self._abort_task(name, str(failure))

    def _abort_task(self, name: str, reason: str) -> None:
        self.flights[name].task = reason
        self.report(name, f"task aborted: {reason}")

    def over(self) -> bool:
        """Return True if all flights, tasks, programs and faults have ended and the settle time has passed."""
        states = [observer.state for observer in self.testbed.observers.values()]
        required = self.testbed.required_flights
        tasks_running = any(not self.flights[name].task for name in self.tasks)
        flight_missing = bool(required) and not any(name in self.injector.takeoffs_s for name in required)
        moving = any(state.armed or state.flying for state in states)
        if tasks_running or flight_missing or moving or self.testbed.busy or self.injector.active:
            self.calm_since_s = None
            return False
        if self.calm_since_s is None:
            self.calm_since_s = self.now_s
        return self.now_s - self.calm_since_s >= self.experiment.settle


class ExperimentRun:
    """An experiment that its caller advances step by step. Use it as a context manager.

        with ExperimentRun(experiment, Path("out/hello")) as run:
            run.start()
            run.begin()
            while not run.over:
                run.advance(1.0)
            outcome = run.result()

    Attributes:
        experiment: Experiment that runs.
        out: Output folder.
        testbed: Vehicles and their environment.
        flights: Recordings by vehicle, up to the current time.
        over: True if the experiment has completed or was aborted.
        problem: Reason why the experiment was aborted. Empty while it runs and if it completed.
    """

    def __init__(
        self, experiment: Experiment, out: Path, *, base: Path | None = None, progress: Progress | None = None
    ) -> None:
        """Prepare the output folder without starting anything.

        Args:
            experiment: Experiment to run. `fractus_sim.experiment.load` reads a file.
            out: Output folder. Files of an earlier run are overwritten.
            base: Base directory of relative paths in the experiment. Default: the working directory.
            progress: Callbacks for progress.

        Raises:
            ExperimentError: The experiment is invalid.
            OSError: A file could not be written.
        """
        self.experiment = experiment
        self.out = out
        self.over = False
        self.problem = ""
        self._progress = progress or Progress()
        self._began_s = time.monotonic()
        self._shown_s = 0.0
        out.mkdir(parents=True, exist_ok=True)
        (out / "logs").mkdir(exist_ok=True)
        remove_report(out, *EXPERIMENT_FILES)
        with ExitStack() as resources:
            self.testbed = _create_testbed(experiment, out, base or Path.cwd(), self._progress)
            resources.enter_context(closing(self.testbed))
            log = resources.enter_context(closing(McapLog(out / "logs" / f"{experiment.name}.mcap")))
            self._resources = resources.pop_all()
        self.flights = {setup.name: Flight(setup.name) for setup in experiment.setups()}
        self._session = _Session(experiment, self.testbed, self.flights, log, self._progress)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def now_s(self) -> float:
        """Seconds since all vehicles were ready."""
        return self._session.now_s

    @property
    def events(self) -> Sequence[Event]:
        """Events of tasks and faults so far, in order."""
        return self._session.events

    def start(self) -> None:
        """Start all parts, and wait until the vehicles are ready. Tasks and faults begin.

        Raises:
            ExperimentError: A part did not start, or a vehicle was not ready in time.
        """
        self.testbed.set_up()
        for name, endpoint in self.testbed.endpoints.items():
            self._progress.report(f"{name}: connect QGroundControl, Mission Planner or MAVProxy to {endpoint}")
        _wait_ready(self._session)
        self._session.begin()

    def begin(self, program: Program | None = None) -> None:
        """Start one program, or by default all programs and Applications. An error aborts the experiment."""
        with self._aborted_by_errors():
            self.testbed.begin(program)

    def advance(self, seconds: float) -> bool:
        """Run for an experiment time, or until the experiment is over.

        Args:
            seconds: Seconds of the experiment. The clock of the vehicles may run faster or slower than real time.

        Returns:
            True while the experiment is not over.
        """
        end_s = self.now_s + seconds
        with self._aborted_by_errors():
            while not self.over and self.now_s < end_s:
                if self.now_s >= self.experiment.timeout:
                    self._abort(f"not completed within {self.experiment.timeout:g} s")
                    break
                self._session.poll()
                self._session.injector.step(self.now_s)
                self._session.step_tasks()
                self.over = self._session.over()
                self._show_status()
        return not self.over

    def report(self, vehicle: str, text: str) -> None:
        """Record an event. `vehicle` is empty for an event of the whole experiment."""
        self._session.report(vehicle, text)

    def in_experiment_time(self, unix_s: float) -> float:
        """Convert Unix time to seconds of the experiment."""
        return (unix_s - self._session.start.unix_us / 1e6) * (self.experiment.pace or 1.0)

    def result(self) -> Outcome:
        """Stop all parts, collect the results, and evaluate the checks. The run is over after this call.

        Raises:
            OSError: A log could not be written or read.
        """
        self.over = True
        for vehicle, title in self._session.injector.missed:
            self.report(vehicle, f"{title}: not injected, because the experiment ended earlier")
        self.testbed.collect()
        self.close()
        return _outcome(self, self._session, time.monotonic() - self._began_s)

    def close(self) -> None:
        """Stop all parts. A run that was not completed leaves its logs."""
        self._resources.close()

    @contextmanager
    def _aborted_by_errors(self) -> Iterator[None]:
        try:
            yield
        except ExperimentError as error:
            self.report("", str(error))
            self._abort(str(error))

    def _abort(self, problem: str) -> None:
        self.problem = problem
        self.over = True

    def _show_status(self) -> None:
        if time.monotonic() - self._shown_s > SHOW_INTERVAL_S:
            self._shown_s = time.monotonic()
            self._progress.show(_status_line(self._session))


def run(experiment: Experiment, out: Path, *, base: Path | None = None, progress: Progress | None = None) -> Outcome:
    """Run an experiment, and write logs, tracks, figures and the report to a folder.

    Args:
        experiment: Experiment to run. `fractus_sim.experiment.load` reads a file.
        out: Output folder. Files of an earlier run are overwritten.
        base: Base directory of relative paths in the experiment. Default: the working directory.
        progress: Callbacks for progress.

    Raises:
        ExperimentError: The experiment could not be set up. The message says what to do.
        OSError: A file could not be written.
    """
    # matplotlib is imported here, because it takes a second and not every caller of ExperimentRun draws figures.
    from fractus_sim.runner.experiment_report import write_outcome  # noqa: PLC0415

    with ExperimentRun(experiment, out, base=base, progress=progress) as experiment_run:
        experiment_run.start()
        experiment_run.begin()
        experiment_run.advance(math.inf)
        outcome = experiment_run.result()
    write_outcome(outcome)
    return outcome


def _create_testbed(experiment: Experiment, out: Path, base: Path, progress: Progress) -> Testbed:
    """Return the testbed for the mode of the experiment.

    Modules of other modes are not imported, because this is slow.
    """
    testbed: Callable[[Experiment, Path, Path, Callable[[str], None]], Testbed] = VehicleTestbed
    if experiment.mode == "standalone":
        from fractus_sim.testbeds.standalone_testbed import StandaloneTestbed  # noqa: PLC0415

        testbed = StandaloneTestbed
    elif experiment.mode == "cluster":
        from fractus_sim.testbeds.cluster_testbed import ClusterTestbed  # noqa: PLC0415

        testbed = ClusterTestbed
    return testbed(experiment, out, base, progress.report)


def _wait_ready(session: _Session) -> None:
    """Poll until every vehicle is ready to arm.

    Raises:
        ExperimentError: A vehicle was not ready before the timeout.
    """
    slowest_s = max(setup.entry.ready_after for setup in session.experiment.setups())
    timeout_s = READY_TIMEOUT_S + slowest_s
    while True:
        session.poll()
        waiting = [name for name, observer in session.testbed.observers.items() if not observer.state.ready]
        if not waiting:
            return
        if session.moment.time_s > timeout_s:
            detail = session.testbed.observers[waiting[0]].state.last_text
            raise ExperimentError(f"{waiting[0]} was not ready to arm within {timeout_s:.0f} s: {detail}")


def _status_line(session: _Session) -> str:
    parts = [f"{session.now_s:5.0f} s"]
    observers = session.testbed.observers
    for name, observer in list(observers.items())[:MAX_SHOWN_VEHICLES]:
        state = observer.state
        parts.append(f"{name} {state.mode} {state.alt_m:.0f} m {state.speed_mps:.0f} m/s {state.battery:.0%}")
    if len(observers) > MAX_SHOWN_VEHICLES:
        parts.append(f"and {len(observers) - MAX_SHOWN_VEHICLES} more")
    return "   ".join(parts)


def _outcome(experiment_run: ExperimentRun, session: _Session, wall_s: float) -> Outcome:
    findings = session.testbed.findings
    experiment = session.experiment
    zones = {zone.name: zone for zone in experiment.zones}
    evidence = Evidence(session.flights, session.injector.occurrences, zones, findings)
    verdicts: Sequence[Verdict] = [
        verdict for check in experiment.checks for verdict in evaluate_check(check, evidence)
    ]
    return Outcome(
        experiment,
        experiment_run.out,
        session.flights,
        tuple(session.injector.occurrences),
        tuple(verdicts),
        findings,
        tuple(session.events),
        tuple(
            replace(call, time_s=experiment_run.in_experiment_time(call.time_s))
            for call in policy_decisions(findings.calls)
        ),
        session.now_s,
        wall_s,
        experiment_run.problem,
    )
