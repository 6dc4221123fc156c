"""The planner against a brute-force oracle: random fleets, applications, shared flights and policies.

The oracle (tests/component/plan_oracle.py) uses no index and no search. It examines every drone and node, tries all
assignments of instances, samples flights, and floods a grid to find routes around zones. The planner and the oracle
must agree on the selected drone, on the first rule that each rejected drone violates, and on the node of every
instance.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "component"))

from harness import Progress, Report, parser
from plan_oracle import Undecided, deviation


def main() -> int:
    arguments = parser(__doc__, quick="1,000 cases")
    arguments.add_argument("--cases", type=int, default=100_000, help="number of plans to compute")
    arguments.add_argument("--seed", type=int, default=0, help="seed of the first plan; each plan adds one")
    options = arguments.parse_args()
    cases = 1000 if options.quick else options.cases
    progress = Progress(cases)
    wrong = 0
    undecided = 0
    for done in range(1, cases + 1):
        seed = options.seed + done - 1
        try:
            difference = deviation(seed)
        except Undecided:
            undecided += 1
            difference = None
        if difference is not None:
            wrong += 1
            print(f"\nWRONG seed {seed}: {difference}", flush=True)
        if done % 500 == 0 or done == cases:
            progress.show(done, f"{wrong} wrong, {undecided} undecided because the result depends on rounding")
    report = Report("plans", options)
    report.add("wrong", wrong, cases=cases, undecided=undecided)
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
