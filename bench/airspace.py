"""4D volumes and decisions on flight plans against an independent oracle, and the duration of a decision.

The oracle (tests/component/airspace_oracle.py) compares the areas of random pairs of volumes with PROJ's geodesics: no
overlap may be missed, and areas that are more than a metre apart must not overlap. It also states the rules for random
histories of plans again, without geometry.

The duration is measured in an airspace of accepted plans around one city and within one day. The comparator is a spatial
index of shapely (STRtree), which is built for the decision, because each accepted plan changes the airspace.
"""

from __future__ import annotations

import random
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "component"))

import shapely
from airspace_oracle import NOW_S, history_deviation, pair_deviation
from fractus_core.airspace import Airspace, OperationalIntent, Volume4D, decide
from fractus_core.geo import LocalFrame
from harness import Progress, Report, parser, quantile

FRAME = LocalFrame(39.36, 22.93)
CITY_M = 15_000.0
DAY_S = 86_400.0
DECISIONS = 200
MOST_LIMITED = 10_000
"""Number of open plans up to which the duration of a decision has a limit."""


def main() -> int:
    arguments = parser(__doc__, quick="1,000 pairs, 200 histories, 1,000 open plans")
    arguments.add_argument("--pairs", type=int, default=100_000, help="number of pairs of volumes")
    arguments.add_argument("--histories", type=int, default=10_000, help="number of histories of plans")
    arguments.add_argument("--seed", type=int, default=0, help="first seed; each pair and each history adds one")
    options = arguments.parse_args()
    report = Report("airspace", options)
    pairs = 1000 if options.quick else options.pairs
    histories = 200 if options.quick else options.histories
    report.add("pairs", deviations(pair_deviation, pairs, options.seed), cases=pairs)
    report.add("histories", deviations(history_deviation, histories, options.seed), cases=histories)
    for count in (1000,) if options.quick else (1000, 10_000, 100_000):
        durations, tree_s = decisions(count)
        claim = "decision" if count <= MOST_LIMITED else "decision_many"
        report.add(claim, quantile(durations, 0.5) * 1000, tree_s * 1000, count=f"{count:,}")
    return report.finish()


def deviations(check, cases: int, first: int) -> int:
    """Return the number of seeds with a deviation, and print each of them."""
    progress = Progress(cases)
    wrong = 0
    for done in range(1, cases + 1):
        difference = check(first + done - 1)
        if difference is not None:
            wrong += 1
            print(f"\nWRONG seed {first + done - 1}: {difference}", flush=True)
        if done % 200 == 0 or done == cases:
            progress.show(done, f"{wrong} wrong")
    return wrong


def decisions(count: int) -> tuple[list[float], float]:
    """Return the durations of decisions among open plans, and that of building a tree of their areas, in seconds."""
    rng = random.Random(count)
    airspace = Airspace(plan(rng, f"plan-{i}") for i in range(count))
    durations = []
    for i in range(DECISIONS):
        new = plan(rng, f"new-{i}")
        start = time.perf_counter()
        decide(new, None, airspace, NOW_S)
        durations.append(time.perf_counter() - start)
    boxes = [shapely.box(*airspace[f"plan-{i}"].volumes[0].outline.bounds) for i in range(count)]
    start = time.perf_counter()
    shapely.STRtree(boxes).query(boxes[0])
    return durations, time.perf_counter() - start


def plan(rng: random.Random, name: str) -> OperationalIntent:
    """Return a plan of ten minutes at a random place and time. The area is a hull of a route of about a kilometre."""
    x = rng.uniform(-CITY_M, CITY_M)
    y = rng.uniform(-CITY_M, CITY_M)
    route = shapely.LineString([(x + rng.uniform(-500, 500), y + rng.uniform(-500, 500)) for _ in range(5)])
    begin_s = NOW_S + rng.uniform(0, DAY_S)
    volume = Volume4D.of_shape(
        FRAME, route.buffer(9.5).convex_hull, lower_m=0, upper_m=80, begin_s=begin_s, end_s=begin_s + 600
    )
    return OperationalIntent(name, "Accepted", volumes=(volume,))


if __name__ == "__main__":
    sys.exit(main())
