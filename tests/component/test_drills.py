"""Drills find nothing on the unmodified platform, and a sample of faults. `bench/platform_faults.py` tries all faults."""

from __future__ import annotations

from pathlib import Path

import pytest
from drill_faults import FAULTS, DrillError, Fault, finds
from drills import DRILLS, perform

SAMPLE = (
    "margin 0",
    "return replaced by landing",
    "removed Grants stay in force",
    "disarm in flight allowed",
    "Grant revocation ignored",
    "camera unfiltered",
)


@pytest.mark.parametrize("name", DRILLS)
def test_drill_finds_nothing_on_the_platform(name: str, tmp_path: Path) -> None:
    perform(DRILLS[name], tmp_path)


@pytest.mark.parametrize("fault", [fault for fault in FAULTS if fault.name in SAMPLE], ids=lambda fault: fault.name)
def test_drill_finds_a_fault(fault: Fault) -> None:
    assert finds(fault, fault.drill)


def test_error_of_a_fault_or_drill_is_not_a_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    unknown = Fault("unknown text", "fractus_core.policy.engine", "no such text", "", "wrong_numbers_are_refused")
    with pytest.raises(DrillError, match="contains the text 0 times, not once"):
        finds(unknown, unknown.drill)

    async def misspelt(_: Path) -> None:
        raise AttributeError("no such method")

    monkeypatch.setitem(DRILLS, "misspelt", misspelt)
    with pytest.raises(DrillError, match="AttributeError: no such method"):
        finds(None, "misspelt")


def test_each_fault_has_a_drill_and_a_name_of_its_own_and_each_drill_a_fault() -> None:
    assert {fault.drill for fault in FAULTS} == DRILLS.keys()
    assert len({fault.name for fault in FAULTS}) == len(FAULTS)
    assert len(FAULTS) >= 60
