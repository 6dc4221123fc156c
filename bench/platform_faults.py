"""Drills against faults: the drills must find nothing on the unmodified platform, and every fault of a table.

The drills (tests/component/drills.py) attack the services in virtual time. Each fault (tests/component/drill_faults.py)
is a change of one place of the platform, such as a margin of 0 or an ignored revocation. It is applied in a process of
its own. With --all, every drill is performed for each fault, so the table shows all drills that find it.
"""

from __future__ import annotations

import argparse
import logging
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "component"))

from drill_faults import FAULTS, DrillError, Fault, finds
from drills import DRILLS


def main() -> int:
    """Print a table. Return 1 if a fault was not found, or if a drill failed without a fault."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", metavar="WORD", default="", help="faults and drills whose name contains this word")
    parser.add_argument("--all", action="store_true", help="perform every drill for each fault")
    options = parser.parse_args()
    logging.disable(logging.CRITICAL)
    failed = 0
    for name in DRILLS:
        if options.only in name and (problem := finds(None, name)):
            failed += 1
            print(f"without fault: {name}: {problem[:200]}", flush=True)
    chosen = [fault for fault in FAULTS if options.only in fault.name]
    found = 0
    print("| Fault | Module | Found by |\n|---|---|---|")
    for fault in chosen:
        names = list(DRILLS) if options.all else [fault.drill]
        finders = [name for name in names if _finds(fault, name)]
        found += bool(finders)
        print(f"| {fault.name} | {fault.module} | {', '.join(finders) or '**none**'} |", flush=True)
    print(f"\n{found} of {len(chosen)} faults found; {failed} of {len(DRILLS)} drills failed without a fault")
    return 0 if found == len(chosen) and not failed else 1


def _finds(fault: Fault, name: str) -> bool:
    """Return True if a drill finds a fault. A drill that ends with another error finds nothing; the error is printed."""
    try:
        return bool(finds(fault, name))
    except DrillError as error:
        print(f"not counted: {error}", file=sys.stderr, flush=True)
        return False


if __name__ == "__main__":
    sys.exit(main())
