"""Compare each golden flight with its recorded trace: authority, streams, commands, calls, path and missions."""

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
"""Seeds of random flights. In 361 a system task is stopped from within its own call while a POI mission begins."""


def courses() -> dict[str, Course]:
    """Return all flights by the names of their recordings."""
    return FLIGHTS | {f"wandering_{seed:02}": wandering(seed) for seed in WANDERINGS}


def features(trace: Trace) -> set[tuple[str, ...]]:
    """Return the features of a flight: pairs of authority changes, stream events, commands and mission outcomes."""
    changes = ["", *(" ".join(line.partition(" at ")[0].split()[1:]) for line in trace["authority"])]
    events = {("stream", *line.split()[2:3]) for line in trace["streams"]}
    commands = {("command", *line.split()[1:]) for line in trace["commands"]}
    return {*pairwise(changes), *events, *commands, *(("mission", line.split()[2]) for line in trace["missions"])}


def selected_flights() -> list[str]:
    """Return the flights to fly: all in a deep run, else a small subset that covers the features of all."""
    if DEEP:
        return list(courses())
    traces: dict[str, Trace] = {path.stem: json.loads(path.read_text()) for path in sorted(GOLDEN.glob("*.json"))}
    shows = {name: features(trace) for name, trace in traces.items()}
    missing = set().union(*shows.values())
    names = list[str]()
    while missing:
        names.append(max(shows, key=lambda name: len(shows[name] & missing) / (1 + len(traces[name]["path"]))))
        missing -= shows[names[-1]]
    return names


@pytest.mark.parametrize("name", selected_flights())
def test_golden_flight_matches_recorded_trace(tmp_path: Path, name: str) -> None:
    recorded = json.loads((GOLDEN / f"{name}.json").read_text())
    assert trace_of(tmp_path, courses()[name]).trace == recorded, "see control_flights.py to record it again"


def test_golden_flights_and_recordings_have_the_same_names() -> None:
    assert {path.stem for path in GOLDEN.glob("*.json")} == set(courses())


def record() -> None:
    """Record all flights again. Changes of behaviour appear in the diff."""
    GOLDEN.mkdir(parents=True, exist_ok=True)
    for left in GOLDEN.glob("*.json"):
        left.unlink()
    for name, course in courses().items():
        with tempfile.TemporaryDirectory() as directory:
            trace = trace_of(Path(directory), course).trace
        (GOLDEN / f"{name}.json").write_text(json.dumps(trace, indent=1) + "\n")


if __name__ == "__main__":
    sys.exit(record())
