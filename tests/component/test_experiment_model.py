"""Experiment files: valid content, and the error messages for invalid content."""

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
    setups = parse(content(vehicles=[row, {"name": "last", "home": HOME}])).setups()
    assert [(s.name, s.system_id) for s in setups] == [("d-1", 1), ("d-2", 2), ("d-3", 3), ("last", 4)]
    assert setups[2].home is not None
    assert setups[2].home.lat == pytest.approx(50.0 + 40 / 111_319.5, abs=2e-6)
    assert setups[2].home.lon == 4.0


def test_experiment_is_unchanged_after_a_json_round_trip() -> None:
    experiment = load(EXAMPLES / "hello.yaml")
    assert parse(json.loads(json.dumps(experiment.to_dict()))) == experiment


@pytest.mark.parametrize("name", [path.name for path in sorted(EXAMPLES.glob("*.yaml"))])
def test_example_experiments_are_valid(name: str) -> None:
    experiment = load(EXAMPLES / name)
    assert experiment.checks
    assert experiment.faults


def test_experiment_schema_contains_every_fault_and_check() -> None:
    text = json.dumps(Experiment.model_json_schema())
    for word in ("gpsLoss", "linkLoss", "batteryDrop", "motorFailure", "windGust", "nodePowerOff", "separation"):
        assert f'"{word}"' in text


GUST = {"fault": "windGust", "speed": 8, "at": 3}
INVALID: dict[str, tuple[dict[str, Any], str]] = {
    "no vehicle": ({"vehicles": []}, "vehicles"),
    "unknown field": ({"drones": 3}, "drones"),
    "no home": ({"vehicles": [{"name": "d"}]}, "vehicles[0].home"),
    "duplicate name": ({"vehicles": [{"name": "d", "home": HOME}] * 2}, "the name d is used twice"),
    "unknown fault": (
        {"faults": [{"fault": "gpsLos", "at": 1}]},
        "faults[0].fault: unknown value gpsLos; did you mean gpsLoss?",
    ),
    "unknown check": (
        {"checks": [{"check": "x"}]},
        "checks[0].check: unknown value x; possible values: landed, neverFlew",
    ),
    "missing fault type": ({"faults": [{"at": 1}]}, "faults[0].fault: is missing"),
    "fault without time": ({"faults": [{"fault": "gpsLoss"}]}, "at"),
    "fault for an unknown vehicle": (
        {"faults": [{**GUST, "vehicles": ["e"]}]},
        "faults[0].vehicles: unknown vehicle e",
    ),
    "link of another mode": ({"faults": [{"fault": "linkLoss", "at": 1, "link": "uplink"}]}, "use groundStation"),
    "power fault without nodes": ({"faults": [{"fault": "nodePowerOff", "at": 1}]}, "mode standalone or cluster"),
    "incomplete position": (
        {"vehicles": [{"name": "d", "home": HOME, "task": [{"do": "goto", "north": 3, "alt": 3}]}]},
        "requires lat and lon, or north and east",
    ),
    "unknown zone": ({"checks": [{"check": "outsideZone", "zone": "z"}]}, "unknown zone z; known: none"),
    "invalid regular expression": (
        {"checks": [{"check": "statustext", "matches": "("}]},
        "not a valid regular expression",
    ),
    "check after an undefined fault": (
        {"checks": [{"check": "mode", "mode": "RTL", "after": "gpsLoss"}]},
        "unknown fault gpsLoss",
    ),
    "call check without services": (
        {"checks": [{"check": "call", "action": "deny"}]},
        "only supported in modes standalone and cluster",
    ),
    "no manifests": ({"mode": "standalone"}, "manifests: are required"),
    "no cluster": ({"mode": "cluster"}, "cluster: is required"),
    "lockstep with a program": (
        {"speedup": 0, "programs": [{"name": "p", "command": ["p"], "vehicle": "d"}]},
        "lockstep",
    ),
    "network without services": (
        {"networks": [{"name": "wifi", "participants": ["d"]}]},
        "networks: are only supported in mode standalone",
    ),
    "unknown participant": (
        {"mode": "standalone", "manifests": ["m"], "networks": [{"name": "wifi", "participants": ["d", "edge"]}]},
        "networks[0].participants: unknown vehicle or node edge; known: d",
    ),
    "node with the name of a vehicle": (
        {"mode": "standalone", "manifests": ["m"], "nodes": [{"name": "d"}]},
        "nodes: the name d is used twice",
    ),
    "program on an unknown node": (
        {
            "mode": "standalone",
            "manifests": ["m"],
            "programs": [{"name": "p", "command": ["p"], "component": "C", "node": "edge"}],
        },
        "programs[0].node: unknown node edge; known: none",
    ),
    "loss of all packets": (
        {
            "mode": "standalone",
            "manifests": ["m"],
            "networks": [{"name": "wifi", "participants": ["d"], "loss": 1}],
        },
        "networks[0].loss",
    ),
    "data of programs without networks": (
        {"mode": "standalone", "manifests": ["m"], "checks": [{"check": "dataSent", "level": "app"}]},
        "checks[0].level: app is only measured with `networks`",
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


@pytest.mark.parametrize("case", INVALID)
def test_invalid_experiment_is_rejected_with_the_field_name(case: str) -> None:
    changes, message = INVALID[case]
    with pytest.raises(InvalidObject) as error:
        parse(content(**changes))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_missing_experiment_file_is_rejected_with_its_name(tmp_path: Path) -> None:
    with pytest.raises(InvalidObject, match="cannot read"):
        load(tmp_path / "none.yaml")


@pytest.mark.parametrize(
    ("mode", "vehicle", "problem"),
    [
        ("vehicles", {"home": {"lat": 1, "lon": 2}}, "cannot be set for a running autopilot in mode vehicles"),
        ("standalone", {}, "is required in mode standalone"),
        ("cluster", {}, "is not supported in mode cluster"),
    ],
)
def test_running_autopilot_needs_a_home_only_for_the_services(
    mode: str, vehicle: dict[str, object], problem: str
) -> None:
    parts = {"cluster": {"cluster": {"file": "c.yaml", "apply": ["a.yaml"]}}, "standalone": {"manifests": ["a.yaml"]}}
    vehicles = [{"name": "d", "connection": "tcp:127.0.0.1:5760", **vehicle}]
    with pytest.raises(InvalidObject, match=problem):
        parse({"name": "x", "mode": mode, "vehicles": vehicles, **parts.get(mode, {})})
    home = {"home": {"lat": 1, "lon": 2}} if mode == "standalone" else {}
    if mode != "cluster":
        parse({"name": "x", "mode": mode, "vehicles": [{**vehicles[0], "home": None, **home}], **parts.get(mode, {})})
