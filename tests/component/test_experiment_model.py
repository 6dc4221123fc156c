"""An experiment's file: what it may say, and the sentence for what it may not."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from fractus_core.api.model import InvalidObject
from fractus_sim.experiment import Experiment, load, parse

EXAMPLES = Path(__file__).parents[2] / "examples" / "experiments"
HOME = {"lat": 50.0, "lon": 4.0, "alt": 20}


def content(**changes: Any) -> dict[str, Any]:
    return {"name": "x", "vehicles": [{"name": "d", "home": HOME}], **changes}


def test_experiment_runs_in_lockstep_unless_it_has_programs() -> None:
    program = {"name": "p", "command": ["python", "p.py"], "vehicle": "d"}
    assert parse(content()).pace == 0
    assert parse(content(programs=[program])).pace == 1
    assert parse(content(speedup=4)).pace == 4


def test_vehicle_row_is_expanded_with_spacing_and_consecutive_ids() -> None:
    row = {"name": "d", "count": 3, "spacing": 20, "bearing": 0, "home": HOME}
    found = parse(content(vehicles=[row, {"name": "last", "home": HOME}])).setups()
    assert [(s.name, s.system_id) for s in found] == [("d-1", 1), ("d-2", 2), ("d-3", 3), ("last", 4)]
    assert found[2].home is not None
    assert found[2].home.lat == pytest.approx(50.0 + 40 / 111_319.5, abs=2e-6)
    assert found[2].home.lon == 4.0


def test_experiment_is_unchanged_after_a_json_round_trip() -> None:
    once = load(EXAMPLES / "hello.yaml")
    assert parse(json.loads(json.dumps(once.to_dict()))) == once


@pytest.mark.parametrize("name", [path.name for path in sorted(EXAMPLES.glob("*.yaml"))])
def test_example_experiments_are_valid(name: str) -> None:
    found = load(EXAMPLES / name)
    assert found.checks
    assert found.faults


def test_experiment_schema_contains_every_fault_and_check() -> None:
    text = json.dumps(Experiment.model_json_schema())
    for word in ("gpsLoss", "linkLoss", "batteryDrop", "motorFailure", "windGust", "nodePowerOff", "separation"):
        assert f'"{word}"' in text


GUST = {"fault": "windGust", "speed": 8, "at": 3}
BAD: dict[str, tuple[dict[str, Any], str]] = {
    "no vehicle": ({"vehicles": []}, "vehicles"),
    "unknown field": ({"drones": 3}, "drones"),
    "no home": ({"vehicles": [{"name": "d"}]}, "vehicles[0].home"),
    "twice": ({"vehicles": [{"name": "d", "home": HOME}] * 2}, "the name d is used twice"),
    "no such fault": (
        {"faults": [{"fault": "gpsLos", "at": 1}]},
        "faults[0].fault: unknown value gpsLos; did you mean gpsLoss?",
    ),
    "no such check": (
        {"checks": [{"check": "x"}]},
        "checks[0].check: unknown value x; possible values: landed, neverFlew",
    ),
    "no fault named": ({"faults": [{"at": 1}]}, "faults[0].fault: is missing"),
    "fault without time": ({"faults": [{"fault": "gpsLoss"}]}, "at"),
    "fault for no one": ({"faults": [{**GUST, "vehicles": ["e"]}]}, "faults[0].vehicles: unknown vehicle e"),
    "link of another mode": ({"faults": [{"fault": "linkLoss", "at": 1, "link": "uplink"}]}, "use groundStation"),
    "no node to power off": ({"faults": [{"fault": "nodePowerOff", "at": 1}]}, "mode standalone or cluster"),
    "half a place": (
        {"vehicles": [{"name": "d", "home": HOME, "task": [{"do": "goto", "north": 3, "alt": 3}]}]},
        "give lat and lon, or north and east",
    ),
    "no such zone": ({"checks": [{"check": "outsideZone", "zone": "z"}]}, "unknown zone z; known: none"),
    "bad expression": ({"checks": [{"check": "statustext", "matches": "("}]}, "not a valid regular expression"),
    "fault never planned": (
        {"checks": [{"check": "mode", "mode": "RTL", "after": "gpsLoss"}]},
        "unknown fault gpsLoss",
    ),
    "calls of vehicles alone": (
        {"checks": [{"check": "call", "action": "deny"}]},
        "only supported in modes standalone and cluster",
    ),
    "no manifests": ({"mode": "standalone"}, "manifests: are required"),
    "no cluster": ({"mode": "cluster"}, "cluster: is required"),
    "lockstep with a program": (
        {"speedup": 0, "programs": [{"name": "p", "command": ["p"], "vehicle": "d"}]},
        "lockstep",
    ),
    "task of a drone with services": (
        {
            "mode": "standalone",
            "manifests": ["m"],
            "vehicles": [{"name": "d", "home": HOME, "task": [{"do": "land"}]}],
        },
        "applications fly the drone",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_invalid_experiment_is_rejected_with_the_field_name(case: str) -> None:
    changes, words = BAD[case]
    with pytest.raises(InvalidObject) as refusal:
        parse(content(**changes))
    assert words in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_missing_experiment_file_is_rejected_with_its_name(tmp_path: Path) -> None:
    with pytest.raises(InvalidObject, match="cannot read"):
        load(tmp_path / "none.yaml")
