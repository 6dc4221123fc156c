"""Golden flights: each flight must reproduce its recorded trace.

A trace contains authority changes, stream events, commands, calls, path and missions.
"""

from __future__ import annotations

import json
import sys
import tempfile
from itertools import pairwise
from pathlib import Path

import pytest
from control_flights import Trace, fly_script
from control_random_flights import random_flight
from control_scripts import FLIGHTS, Script
from depth import DEEP

GOLDEN = Path(__file__).parents[1] / "golden" / "control"
RANDOM_SEEDS = (*range(12), 361)
"""Seeds of random flights. Seed 361 covers a system task that stops itself while a POI mission begins."""


def scripts() -> dict[str, Script]:
    """Return all flights by the names of their recordings."""
    return FLIGHTS | {f"random_{seed:02}": random_flight(seed) for seed in RANDOM_SEEDS}


def features(trace: Trace) -> set[tuple[str, ...]]:
    """Return the features of a trace: pairs of authority changes, stream events, commands and mission outcomes."""
    changes = ["", *(" ".join(line.partition(" at ")[0].split()[1:]) for line in trace["authority"])]
    events = {("stream", *line.split()[2:3]) for line in trace["streams"]}
    commands = {("command", *line.split()[1:]) for line in trace["commands"]}
    return {*pairwise(changes), *events, *commands, *(("mission", line.split()[2]) for line in trace["missions"])}


def selected_flights() -> list[str]:
    """Return the flights to compare.

    A deep run compares all flights, any other run a subset that covers all features.
    """
    if DEEP:
        return list(scripts())
    traces: dict[str, Trace] = {path.stem: json.loads(path.read_text()) for path in sorted(GOLDEN.glob("*.json"))}
    features_of = {name: features(trace) for name, trace in traces.items()}
    missing = set().union(*features_of.values())
    names = list[str]()
    while missing:
        names.append(
            max(features_of, key=lambda name: len(features_of[name] & missing) / (1 + len(traces[name]["path"])))
        )
        missing -= features_of[names[-1]]
    return names


@pytest.mark.parametrize("name", selected_flights())
def test_golden_flight_matches_recorded_trace(tmp_path: Path, name: str) -> None:
    recorded = json.loads((GOLDEN / f"{name}.json").read_text())
    assert fly_script(tmp_path, scripts()[name]).trace == recorded, "see control_flights.py to record it again"


def test_golden_flights_and_recordings_have_the_same_names() -> None:
    assert {path.stem for path in GOLDEN.glob("*.json")} == set(scripts())


def record() -> None:
    """Record all flights again. Changes of behaviour appear in the diff."""
    GOLDEN.mkdir(parents=True, exist_ok=True)
    for recording in GOLDEN.glob("*.json"):
        recording.unlink()
    for name, script in scripts().items():
        with tempfile.TemporaryDirectory() as directory:
            trace = fly_script(Path(directory), script).trace
        (GOLDEN / f"{name}.json").write_text(json.dumps(trace, indent=1) + "\n")


if __name__ == "__main__":
    sys.exit(record())
