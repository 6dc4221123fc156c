"""Records of runs that the analyzer reads: a running test, the folder of an experiment, or the folder of a report."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from fractus_runtime.audit_chain import entries
from fractus_sim.errors import ExperimentError
from fractus_sim.experiment.checks import DataLevel
from fractus_sim.report.audit_log_reader import read_audit_logs
from fractus_sim.report.flight_record import AUDIT, OBJECTS, FlightRecord
from fractus_sim.report.report_files import RESULTS
from fractus_sim.report.track import Place, Sample
from fractus_sim.runner import ExperimentRun
from fractus_sim.runner.telemetry_recording import Flight, Text
from fractus_sim.testbeds.resource_meter import ProgramUsage
from fractus_sim.testbeds.testbed import AUDIT_LOGS
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader

JUDGED_KINDS = frozenset({"call", "monitor", "takeover"})
Entry = Mapping[str, Any]


@dataclass(frozen=True)
class RunRecord:
    """Data of a run, as the analyzer has read it. Times are seconds of the run.

    Attributes:
        folder: Folder of the run.
        flights: Recordings by drone.
        entries: Audit log entries by drone, in order. Each has its time in the field `time_s`.
        programs: Exit codes by program. None while a program runs, or if it had to be stopped.
        usages: Resources by program.
        data_sent: Bytes that each drone or node sent, by level. Unmeasured levels are missing.
        phases: Phase of each Application, by drone. Only known for clusters.
        audit_problems: First violation of the hash chain, by log. Empty if the log is valid.
    """

    folder: Path
    flights: Mapping[str, Flight]
    entries: Mapping[str, Sequence[Entry]] = field(default_factory=dict)
    programs: Mapping[str, int | None] = field(default_factory=dict)
    usages: Mapping[str, ProgramUsage] = field(default_factory=dict)
    data_sent: Mapping[str, Mapping[DataLevel, int]] = field(default_factory=dict)
    phases: Mapping[str, str] = field(default_factory=dict)
    audit_problems: Mapping[str, str] = field(default_factory=dict)


def record_of_run(run: ExperimentRun) -> RunRecord:
    """Return the record of a run up to now. The run continues."""
    findings = run.testbed.findings
    programs = dict(findings.programs)
    processes = run.testbed.processes
    if processes is not None and not programs:
        names = [program.name for program in run.experiment.programs if processes.started(program.name)]
        programs = {name: processes.exit_code(name) for name in names}
    logs, problems = _drone_logs(run.out, run.flights)
    return RunRecord(
        run.out,
        run.flights,
        {drone: [_timed(entry, run.in_experiment_time) for entry in log] for drone, log in logs.items()},
        programs,
        dict(findings.usages),
        dict(findings.data_sent),
        audit_problems=problems,
    )


def read_record(folder: Path) -> RunRecord:
    """Read the folder of an experiment, of `make demo` or of `fractus report`.

    Raises:
        ExperimentError: The folder contains no run.
    """
    if (folder / OBJECTS).exists():
        return _read_report(folder)
    recordings = sorted((folder / "logs").glob("*.mcap"))
    if len(recordings) != 1:
        raise ExperimentError(
            f"{folder} contains neither {OBJECTS} of a report nor one logs/*.mcap of an experiment; specify the"
            " output folder of a run"
        )
    return _read_experiment(folder, recordings[0])


def _read_experiment(folder: Path, recording: Path) -> RunRecord:
    flights, clock = _read_recording(recording)
    logs, problems = _drone_logs(folder, flights)
    results = json.loads((folder / RESULTS).read_text()) if (folder / RESULTS).exists() else {}
    usages = {
        name: ProgramUsage(
            usage["vehicle"] or "",
            usage["cpu_s"],
            usage["wall_s"],
            usage["mean_memory_mib"],
            usage["peak_memory_mib"],
        )
        for name, usage in results.get("resources", {}).items()
    }
    return RunRecord(
        folder,
        flights,
        {drone: [_timed(entry, clock.run_time) for entry in log] for drone, log in logs.items()},
        results.get("programs", {}),
        usages,
        results.get("data_sent", {}),
        audit_problems=problems,
    )


def _read_report(folder: Path) -> RunRecord:
    """Read a report of a cluster's flight. Its times are seconds since the Application was applied."""
    record = FlightRecord.read(folder)
    samples = record.samples
    begin_s = record.times.get("applied", samples[0].time_s if samples else 0.0)
    name = record.track.name
    flight = Flight(name, [replace(sample, time_s=sample.time_s - begin_s) for sample in samples])
    for sample in flight.samples:
        if not flight.modes or flight.modes[-1][1] != sample.mode:
            flight.modes.append((sample.time_s, sample.mode))
    log: list[Entry] = []
    for path in sorted((folder / AUDIT).glob("*.jsonl")):
        with path.open("rb") as file:
            log += [_timed(entry, lambda unix_s: unix_s - begin_s) for entry in entries(file)]
    body = next(body for body in json.loads((folder / OBJECTS).read_text())["objects"] if body["kind"] == "Application")
    return RunRecord(
        folder,
        {name: flight},
        {name: sorted(log, key=lambda entry: float(entry["time_s"]))},
        phases={name: str((body.get("status") or {}).get("phase", ""))},
        audit_problems={AUDIT: str(record.audit.get("problem", ""))},
    )


@dataclass(frozen=True)
class _Clock:
    """Relation of Unix time and the time of a run, from two records of its recording."""

    unix_s: float
    time_s: float
    pace: float

    def run_time(self, unix_s: float) -> float:
        return self.time_s + (unix_s - self.unix_s) * self.pace


def _read_recording(path: Path) -> tuple[dict[str, Flight], _Clock]:
    flights: dict[str, Flight] = {}
    places: dict[str, tuple[float, float]] = {}
    stamps: list[tuple[float, float]] = []
    for topic, unix_s, content in _messages(path):
        drone, _, kind = topic.strip("/").partition("/")
        if not kind:
            continue
        flight = flights.setdefault(drone, Flight(drone))
        match kind:
            case "location":
                places[drone] = (content["latitude"], content["longitude"])
            case "state" if drone in places:
                stamps = [*stamps[:1], (unix_s, content["time_s"])]
                _add_state(flight, places[drone], content)
            case "text" if stamps:
                time_s = stamps[-1][1]
                flight.texts.append(Text(time_s, content.get("level", 0), content.get("message", "")))
    if len(stamps) < 2 or stamps[1][0] <= stamps[0][0]:
        return flights, _Clock(0.0, 0.0, 1.0)
    (first_unix_s, first_s), (last_unix_s, last_s) = stamps
    return flights, _Clock(first_unix_s, first_s, (last_s - first_s) / (last_unix_s - first_unix_s))


def _add_state(flight: Flight, place: tuple[float, float], content: Mapping[str, Any]) -> None:
    flight.samples.append(
        Sample(
            content["time_s"],
            Place(*place, content["altitude_m"]),
            content["speed_mps"],
            content["mode"],
            content["in_air"],
            content["battery_percent"] / 100,
            content["voltage_v"],
        )
    )
    flight.armed_at_end = content["armed"]
    if not flight.modes or flight.modes[-1][1] != content["mode"]:
        flight.modes.append((content["time_s"], content["mode"]))


def _messages(path: Path) -> Iterator[tuple[str, float, Mapping[str, Any]]]:
    """Yield topic, Unix seconds and content of each readable message. The file of a killed run ends in the middle."""
    with path.open("rb") as file:
        try:
            for _, channel, message in NonSeekingReader(file).iter_messages(log_time_order=False):
                yield channel.topic, message.log_time / 1e9, json.loads(message.data)
        except McapError:
            return


def _drone_logs(folder: Path, drones: Mapping[str, Flight]) -> tuple[dict[str, list[Entry]], dict[str, str]]:
    """Return the audit log entries of each drone in order, and the problem of each log."""
    logs: dict[str, list[Entry]] = {}
    problems: dict[str, str] = {}
    for drone in drones:
        paths = [folder / drone / name for name in AUDIT_LOGS if (folder / drone / name).exists()]
        content: list[Entry] = []
        for log in read_audit_logs(paths):
            content += log.entries
            problems[f"{drone}/{log.path.name}"] = log.problem
        logs[drone] = sorted(content, key=lambda entry: str(entry.get("time", "")))
    return logs, problems


def _timed(entry: Entry, run_time: Callable[[float], float]) -> Entry:
    unix_s = datetime.fromisoformat(str(entry["time"])).timestamp()
    return {**entry, "time_s": run_time(unix_s)}
