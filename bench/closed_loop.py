"""The whole mobility service on the simulated vehicle in virtual time: random flights on bad links, checked by an oracle.

Each seed is one flight (tests/component/closed_loop.py) with zones and limits, a vehicle of another owner, and wind.
The link delays frames by up to 0.25 s each way with jitter, loses up to 10 % of them, and is interrupted. The
position has a fault: a wrong GPS, a wrong second GPS, a jump of the estimate, a wrong barometer, or a slow drift. Some
zones and limits are added while the driver flies or during the return flight. The oracle knows the true position of the
vehicle. It reports every breach of a zone or limit that the documented guarantee rules out. A drift that no sign shows
may lead the drone into a zone by as much as the position is wrong.

With --repairs, each flight selects a repair (tests/component/repair_flights.py), and the oracle determines independently
where the drone must be in the end.
"""

from __future__ import annotations

import logging
import os
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "component"))

from closed_loop import Account, flight, parameters_of, weather_of
from harness import Progress, Report, parser
from repair_flights import repair_flight


def fly(seed: int) -> Account:
    """Fly the flight of a seed, with its files in a temporary directory."""
    logging.disable(logging.CRITICAL)
    with tempfile.TemporaryDirectory() as directory:
        return flight(seed, Path(directory))


def fly_repair(seed: int) -> Account:
    """Fly the repair flight of a seed, with its files in a temporary directory."""
    logging.disable(logging.CRITICAL)
    with tempfile.TemporaryDirectory() as directory:
        return repair_flight(seed, Path(directory))


def main() -> int:
    arguments = parser(__doc__, quick="20 flights")
    arguments.add_argument("--flights", type=int, default=500, help="number of flights")
    arguments.add_argument("--seed", type=int, default=1, help="seed of the first flight; each flight adds one")
    arguments.add_argument(
        "--repairs", action="store_true", help="fly repairs: suspension, abort with a landing place, lost contact"
    )
    arguments.add_argument("--events", action="store_true", help="print the events of each flight with a breach")
    options = arguments.parse_args()
    seeds = range(options.seed, options.seed + (20 if options.quick else options.flights))
    progress = Progress(len(seeds))
    breached = 0
    flew = 0
    deepest_m = 0.0
    with ProcessPoolExecutor(max_workers=os.cpu_count()) as pool:
        for done, account in enumerate(pool.map(fly_repair if options.repairs else fly, seeds), start=1):
            flew += account.flew
            deepest_m = max(deepest_m, account.depth_m)
            if account.wrong:
                breached += 1
                seed = account.seed
                print(f"\nWRONG seed {seed}: {'; '.join(account.wrong)}\n   {weather_of(seed)} {parameters_of(seed)}")
                if options.events:
                    print("\n".join(account.events))
            progress.show(done, f"{flew} in the air, {breached} with a breach")
    report = Report("closed_loop", options)
    report.add("breached", breached, valid=flew > len(seeds) // 2, flights=len(seeds), flew=flew, deepest_m=deepest_m)
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
