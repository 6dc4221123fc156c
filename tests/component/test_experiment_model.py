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


def test_vehicles_alone_run_in_lockstep_and_programs_need_a_pace() -> None:
    program = {"name": "p", "command": ["python", "p.py"], "vehicle": "d"}
    assert parse(content()).pace == 0
    assert parse(content(programs=[program])).pace == 1
    assert parse(content(speedup=4)).pace == 4


def test_a_row_of_vehicles_is_spread_out_with_ids_of_its_own() -> None:
    row = {"name": "d", "count": 3, "spacing": 20, "bearing": 0, "home": HOME}
    found = parse(content(vehicles=[row, {"name": "last", "home": HOME}])).setups()
    assert [(s.name, s.system_id) for s in found] == [("d-1", 1), ("d-2", 2), ("d-3", 3), ("last", 4)]
    assert found[2].home is not None
    assert found[2].home.lat == pytest.approx(50.0 + 40 / 111_319.5, abs=2e-6)
    assert found[2].home.lon == 4.0


def test_a_file_says_the_same_after_a_round_trip() -> None:
    once = load(EXAMPLES / "hello.yaml")
    assert parse(json.loads(json.dumps(once.to_dict()))) == once


@pytest.mark.parametrize("name", [path.name for path in sorted(EXAMPLES.glob("*.yaml"))])
def test_the_examples_are_understood(name: str) -> None:
    found = load(EXAMPLES / name)
    assert found.checks
    assert found.faults


def test_the_schema_names_every_fault_and_check() -> None:
    text = json.dumps(Experiment.model_json_schema())
    for word in ("gpsLoss", "linkLoss", "batteryDrop", "motorFailure", "windGust", "nodePowerOff", "separation"):
        assert f'"{word}"' in text


GUST = {"fault": "windGust", "speed": 8, "at": 3}
BAD: dict[str, tuple[dict[str, Any], str]] = {
    "no vehicle": ({"vehicles": []}, "vehicles"),
    "unknown field": ({"drones": 3}, "drones"),
    "no home": ({"vehicles": [{"name": "d"}]}, "vehicles[0].home"),
    "twice": ({"vehicles": [{"name": "d", "home": HOME}] * 2}, "the name d is given twice"),
    "no such fault": (
        {"faults": [{"fault": "gpsLos", "at": 1}]},
        "faults[0].fault: there is no gpsLos; did you mean gpsLoss?",
    ),
    "no such check": ({"checks": [{"check": "x"}]}, "checks[0].check: there is no x; there are landed, neverFlew"),
    "no fault named": ({"faults": [{"at": 1}]}, "faults[0].fault: is missing"),
    "fault without time": ({"faults": [{"fault": "gpsLoss"}]}, "at"),
    "fault for no one": ({"faults": [{**GUST, "vehicles": ["e"]}]}, "faults[0].vehicles: there is no vehicle e"),
    "link of another mode": ({"faults": [{"fault": "linkLoss", "at": 1, "link": "uplink"}]}, "use groundStation"),
    "no node to power off": ({"faults": [{"fault": "nodePowerOff", "at": 1}]}, "mode standalone or cluster"),
    "half a place": (
        {"vehicles": [{"name": "d", "home": HOME, "task": [{"do": "goto", "north": 3, "alt": 3}]}]},
        "give lat and lon, or north and east",
    ),
    "no such zone": ({"checks": [{"check": "outsideZone", "zone": "z"}]}, "there is no zone z; there are: none"),
    "bad expression": ({"checks": [{"check": "statustext", "matches": "("}]}, "no regular expression"),
    "fault never planned": ({"checks": [{"check": "mode", "mode": "RTL", "after": "gpsLoss"}]}, "no fault gpsLoss"),
    "calls of vehicles alone": ({"checks": [{"check": "call", "action": "deny"}]}, "judge nothing"),
    "no manifests": ({"mode": "standalone"}, "manifests: are needed"),
    "no cluster": ({"mode": "cluster"}, "cluster: is needed"),
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
def test_what_is_wrong_is_named(case: str) -> None:
    changes, words = BAD[case]
    with pytest.raises(InvalidObject) as refusal:
        parse(content(**changes))
    assert words in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_file_that_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(InvalidObject, match="cannot read"):
        load(tmp_path / "none.yaml")
