"""The test of an application finds nothing in it, and a sample of faults. `bench/application_faults.py` tries all faults."""

from __future__ import annotations

import pytest
from fractus_testing import Scene
from inspection_faults import CHECKS, FAULTS, PROGRAM, ApplicationFault, findings

SAMPLE = ("latitude and longitude exchanged", "refusal ends the program", "lands at the last place")


@pytest.mark.slow
@pytest.mark.fractus(speedup=2)
def test_test_finds_nothing_in_an_application_without_fault(fractus: Scene) -> None:
    assert findings(fractus, PROGRAM) == {}


@pytest.mark.slow
@pytest.mark.fractus(speedup=2)
@pytest.mark.parametrize("fault", [fault for fault in FAULTS if fault.name in SAMPLE], ids=lambda fault: fault.name)
def test_test_finds_a_fault_of_the_application(fractus: Scene, fault: ApplicationFault) -> None:
    assert fault.check in findings(fractus, fault.program())


def test_each_fault_changes_the_program_and_each_check_has_a_fault() -> None:
    programs = {fault.program() for fault in FAULTS}
    assert len(programs) == len({fault.name for fault in FAULTS}) == len(FAULTS)
    assert PROGRAM not in programs
    assert {fault.check for fault in FAULTS} == CHECKS.keys()
