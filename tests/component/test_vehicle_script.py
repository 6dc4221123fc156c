"""Responses of the simulated vehicle compared with a real ArduCopter 4.6.3, played from one script."""

from __future__ import annotations

import pytest
from vehicle_script import SimulatedConnection, Step, compare, matches, steps


def test_every_script_step_is_played_or_has_a_reason():
    assert len({step.name for step in steps()}) == len(steps())
    assert [step.name for step in steps() if not step.action and not step.note] == []


def test_vehicle_responses_match_real_ardupilot():
    differing: list[str] = []

    def report(step: Step, response: str, verdict: str) -> None:
        if verdict == "differs":
            differing.append(f"{step.name}: recorded {step.recorded}, simulated {response}")

    assert compare(SimulatedConnection(), report, steps()) == 0, differing


@pytest.mark.parametrize(
    ("recorded", "response", "expected"),
    [
        ("ACCEPTED -> 4", "ACCEPTED -> 4", True),
        ("ACCEPTED -> 4", "ACCEPTED -> 6", False),
        ("s=5.0~10% mode=6", "s=4.6 mode=6", True),
        ("s=5.0~10% mode=6", "s=4.4 mode=6", False),
        ("N=0~0.5", "N=-0.4", True),
        ("N=0~0.5", "E=0.1", False),
        ("s=5.0~10%", "nothing", False),
    ],
)
def test_script_tolerances_apply_to_single_numbers(recorded: str, response: str, expected: bool):
    assert matches(recorded, response) is expected
