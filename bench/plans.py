"""Plans against a brute-force oracle: random fleets, applications, shared flights and policies, every plan worked out twice.

The oracle (tests/component/plan_oracle.py) knows neither index nor search: it looks at every drone and node, tries all assignments
of instances, samples flights, and floods a grid for ways around zones. Compared are the drone that flies, the first rule that
each other one fails, and the node of every instance.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "component"))

from plan_oracle import Undecided, deviation


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=100_000, help="plans to work out")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first plan; each plan has the next one")
    parser.add_argument("--quick", action="store_true", help="1000 cases")
    parser.add_argument("--json", type=Path, help="write the claims to a file")
    options = parser.parse_args()
    cases = 1000 if options.quick else options.cases
    wrong = 0
    undecided = 0
    begun = time.monotonic()
    for number in range(cases):
        seed = options.seed + number
        try:
            found = deviation(seed)
        except Undecided:
            undecided = undecided + 1
            found = None
        if found is not None:
            wrong += 1
            print(f"\nWRONG seed {seed}: {found}", flush=True)
        if number % 500 == 499 or number == cases - 1:
            left_s = (time.monotonic() - begun) / (number + 1) * (cases - number - 1)
            figures = f"{wrong} wrong, {undecided} undecided (rounding decides)"
            print(f"\r{number + 1:,} plans, {figures}; {left_s / 60:.0f} min left ", end="", flush=True)
    print()
    if options.json:
        claim = {
            "name": f"plans that differ from the oracle's, of {cases}", "ours": wrong, "theirs": None, "unit": "plans",
            "ratio": None, "target": 0, "holds": not wrong, "undecided": undecided,
        }  # fmt: skip
        options.json.write_text(json.dumps({"claims": [claim]}, indent=1))
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
