"""Every pinned flight is flown as it was recorded: authority, streams, commands, calls, path and missions."""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

import pytest
from control_courses import FLIGHTS, Course
from control_flights import trace_of
from control_wanderings import wandering

GOLDEN = Path(__file__).parents[1] / "golden" / "control"
WANDERINGS = (*range(12), 361)
"""Seeds; in 361 a system task is stopped from within its own call, and must not fly against the tour that begins then."""


def courses() -> dict[str, Course]:
    """The flights by the name of their file."""
    return FLIGHTS | {f"wandering_{seed:02}": wandering(seed) for seed in WANDERINGS}


@pytest.mark.parametrize("name", courses())
def test_a_flight_is_flown_as_it_was_recorded(tmp_path: Path, name: str) -> None:
    recorded = json.loads((GOLDEN / f"{name}.json").read_text())
    assert trace_of(tmp_path, courses()[name]).trace == recorded, "see CONTRIBUTING.md, Golden flights"


def test_every_recorded_flight_is_flown() -> None:
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
