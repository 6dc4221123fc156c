"""Check that the test of an application finds each of its known faults, and nothing in the unmodified program.

The faults and the checks of the test are in tests/integration/inspection_faults.py. Each fault is flown on a virtual drone
with real services. A flight takes about half a minute.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from fractus_testing import Scene

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "integration"))

from inspection_faults import FAULTS, PROGRAM, findings


def main() -> int:
    """Print a table. Return 1 if a fault was not found, or if a check failed without a fault."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", metavar="WORD", default="", help="faults whose name contains this word")
    parser.add_argument("--speedup", type=float, default=4.0, help="factor of real time [4]")
    options = parser.parse_args()
    problems = _findings(PROGRAM, options.speedup)
    for name, problem in problems.items():
        print(f"without fault: {name}: {problem[:200]}", flush=True)
    chosen = [fault for fault in FAULTS if options.only in fault.name]
    found = 0
    print("| Fault | Module | Found by |\n|---|---|---|", flush=True)
    for fault in chosen:
        finders = _findings(fault.program(), options.speedup)
        found += fault.check in finders
        print(f"| {fault.name} | application | {', '.join(finders) or '**none**'} |", flush=True)
        if fault.check not in finders:
            print(f"not found by {fault.check}: {fault.name}", file=sys.stderr, flush=True)
    print(f"\n{found} of {len(chosen)} faults found; {len(problems)} checks failed without a fault")
    return 0 if found == len(chosen) and not problems else 1


def _findings(program: str, speedup: float) -> dict[str, str]:
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder,
        Scene(Path(folder) / "flight", speedup=speedup) as scene,
    ):
        return findings(scene, program)


if __name__ == "__main__":
    sys.exit(main())
