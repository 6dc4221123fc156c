"""Every pinned flight is flown as it was recorded: authority, streams, commands, calls, path and missions."""

from __future__ import annotations

import json
import sys
import tempfile
from itertools import pairwise
from pathlib import Path

import pytest
from control_courses import FLIGHTS, Course
from control_flights import Trace, trace_of
from control_wanderings import wandering
from depth import DEEP

GOLDEN = Path(__file__).parents[1] / "golden" / "control"
WANDERINGS = (*range(12), 361)
"""Seeds; in 361 a system task is stopped from within its own call, and must not fly against the tour that begins then."""


def courses() -> dict[str, Course]:
    """The flights by the name of their file."""
    return FLIGHTS | {f"wandering_{seed:02}": wandering(seed) for seed in WANDERINGS}


def shown(trace: Trace) -> set[tuple[str, ...]]:
    """What a flight shows: changes of authority, each with the one before, and its kinds of events, commands and outcomes."""
    changes = ["", *(" ".join(line.partition(" at ")[0].split()[1:]) for line in trace["authority"])]
    events = {("stream", *line.split()[2:3]) for line in trace["streams"]}
    commands = {("command", *line.split()[1:]) for line in trace["commands"]}
    return {*pairwise(changes), *events, *commands, *(("mission", line.split()[2]) for line in trace["missions"])}


def flown() -> list[str]:
    """Names of the flights to fly: all of them in a deep run; else a few short ones that show all that any flight shows."""
    if DEEP:
        return list(courses())
    traces: dict[str, Trace] = {path.stem: json.loads(path.read_text()) for path in sorted(GOLDEN.glob("*.json"))}
    shows = {name: shown(trace) for name, trace in traces.items()}
    missing, names = set().union(*shows.values()), list[str]()
    while missing:
        names.append(max(shows, key=lambda name: len(shows[name] & missing) / (1 + len(traces[name]["path"]))))
        missing -= shows[names[-1]]
    return names


@pytest.mark.parametrize("name", flown())
def test_golden_flight_matches_recorded_trace(tmp_path: Path, name: str) -> None:
    recorded = json.loads((GOLDEN / f"{name}.json").read_text())
    assert trace_of(tmp_path, courses()[name]).trace == recorded, "control_flights.py says how to record it again"


def test_golden_flights_and_recordings_have_the_same_names() -> None:
    assert {path.stem for path in GOLDEN.glob("*.json")} == set(courses())


def record() -> None:
    """Record every flight again; a change of behaviour shows in the review."""
    GOLDEN.mkdir(parents=True, exist_ok=True)
    for left in GOLDEN.glob("*.json"):
        left.unlink()
    for name, course in courses().items():
        with tempfile.TemporaryDirectory() as directory:
            trace = trace_of(Path(directory), course).trace
        (GOLDEN / f"{name}.json").write_text(json.dumps(trace, indent=1) + "\n")


if __name__ == "__main__":
    sys.exit(record())
