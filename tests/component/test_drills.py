"""Drills find nothing on the unmodified platform, and a sample of faults. `bench/platform_faults.py` tries all faults."""

from __future__ import annotations

from pathlib import Path

import pytest
from drill_faults import FAULTS, Fault, finds
from drills import DRILLS, perform

SAMPLE = ("margin 0", "disarm in flight allowed", "Grant revocation ignored", "camera unfiltered")


@pytest.mark.parametrize("name", DRILLS)
def test_drill_finds_nothing_on_the_platform(name: str, tmp_path: Path) -> None:
    perform(DRILLS[name], tmp_path)


@pytest.mark.parametrize("fault", [fault for fault in FAULTS if fault.name in SAMPLE], ids=lambda fault: fault.name)
def test_drill_finds_a_fault(fault: Fault) -> None:
    assert finds(fault, fault.drill)


def test_each_fault_has_a_drill_and_a_name_of_its_own() -> None:
    assert {fault.drill for fault in FAULTS} <= DRILLS.keys()
    assert len({fault.name for fault in FAULTS}) == len(FAULTS)
    assert len(FAULTS) >= 60
