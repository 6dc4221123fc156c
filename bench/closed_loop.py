"""The whole mobility service on the simulated vehicle, in virtual time: random flights on bad links, watched by an oracle.

Each seed is a flight (tests/component/closed_loop.py): zones and limits, some of which appear at any moment of the driver's flight
and of the way home, another owner's vehicle, wind, up to 0.25 s of delay each way with jitter, up to 10 % of lost frames, a
link that is cut. The oracle knows the vehicle's true position. What it reports is a breach outside of the documented guarantee.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "component"))

from closed_loop import Account, flight, parameters_of, weather_of


def fly(seed: int) -> Account:
    """One flight, in a directory of its own."""
    logging.disable(logging.CRITICAL)
    with tempfile.TemporaryDirectory() as directory:
        return flight(seed, Path(directory))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1, help="of the first flight; each has the next one")
    parser.add_argument("--quick", action="store_true", help="20 flights")
    parser.add_argument("--tell", action="store_true", help="print what happened in each flight with a breach")
    parser.add_argument("--json", type=Path, help="write the claims to a file")
    options = parser.parse_args()
    seeds = range(options.seed, options.seed + (20 if options.quick else options.flights))
    wrong = 0
    flew = 0
    deepest_m = 0.0
    with ProcessPoolExecutor(max_workers=os.cpu_count()) as pool:
        for done, account in enumerate(pool.map(fly, seeds), start=1):
            flew += account.flew
            deepest_m = max(deepest_m, account.depth_m)
            if account.wrong:
                wrong += 1
                seed = account.seed
                print(f"\nWRONG seed {seed}: {'; '.join(account.wrong)}\n   {weather_of(seed)} {parameters_of(seed)}")
                if options.tell:
                    print("\n".join(account.events))
            print(f"\r{done} of {len(seeds)} flights, {flew} in the air, {wrong} wrong ", end="", flush=True)
    print()
    if options.json:
        claim = {
            "name": f"flights with a breach, of {len(seeds)} in closed loop", "ours": wrong, "theirs": None, "unit": "flights",
            "ratio": None, "target": 0, "holds": not wrong and flew > len(seeds) // 2, "flew": flew, "deepest_m": deepest_m,
        }  # fmt: skip
        options.json.write_text(json.dumps({"claims": [claim]}, indent=1))
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
