"""The policy engine against an independent oracle that flies every permitted random request.

Policies, vehicles, states and requests are random. The oracle (tests/component/policy_flights.py) integrates
jerk-limited motion in steps of 50 ms, with wind, latency and position errors inside the bounds given to the engine. It
reports drones where a policy forbids them, and corrections that are not allowed unchanged or lie inside a margin.
Vehicles differ in acceleration and return altitude, and other stations change these in flight. Afterwards the system
flies some drones home, as the service decides it, and the autopilots of others return without the system
(tests/component/homeward_flights.py). The motion monitor checks one flight in twelve, which it must not stop.

A case is one request of one drone under one set of policies. Each drone makes three requests, the later ones in flight.
In addition, vehicles with lost, absent and odd parameters are armed (tests/component/parameter_faults.py).
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "component"))

from homeward_flights import WaysHome
from parameter_faults import parameter_faults
from policy_flights import Tally, flights

DRONES = 500
REQUESTS = 3
WATCH_EVERY = 8
WATCHED = 12
HOME_EVERY = 8
VEHICLES = 100


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=1_000_000, help="requests to judge and fly")
    parser.add_argument("--seed", type=int, default=1, help="seed of the first batch; each batch has the next one")
    parser.add_argument("--quick", action="store_true", help="3000 cases")
    parser.add_argument("--json", type=Path, help="write the claims to a file, after every batch")
    options = parser.parse_args()
    cases = 3000 if options.quick else options.cases
    whole = Tally()
    vehicles = 0
    seed = options.seed
    begun = time.monotonic()
    while whole.asked < cases:
        ways_home = WaysHome(seed, HOME_EVERY)
        found = flights(seed, DRONES, requests=REQUESTS, watch_every=WATCH_EVERY, watched=WATCHED, returns=ways_home)
        found.wrong += parameter_faults(seed, VEHICLES)
        vehicles += VEHICLES
        whole.add(found)
        for line in found.wrong:
            print(f"\nWRONG {line}", flush=True)
        for line in found.stopped:
            print(f"\nSTOPPED seed {seed}, {line}", flush=True)
        left_s = (time.monotonic() - begun) / whole.asked * max(cases - whole.asked, 0)
        figures = (
            f"{whole.asked:,} cases, {whole.permitted:,} permitted ({whole.corrected:,} corrected, {whole.braked:,} after a"
            f" stop), {whole.taken:,} takeovers, {whole.homeward:,} ways home ({whole.straight:,} alone), {vehicles:,}"
            f" arming requests, {len(whole.wrong)} wrong, {len(whole.stopped)} stopped"
        )
        print(f"\rseed {seed}: {figures}; {left_s / 60:.0f} min left ", end="", flush=True)
        seed += 1
        if options.json:
            options.json.write_text(json.dumps(claims(whole, vehicles), indent=1))
    print()
    return 1 if whole.wrong or whole.stopped else 0


def claims(tally: Tally, vehicles: int) -> dict[str, object]:
    """Return the results in the format of the other benchmarks."""
    claim = {
        "name": f"violations and invalid corrections in {tally.asked} random cases",
        "ours": len(tally.wrong), "theirs": None, "unit": "cases", "ratio": None, "target": 0,
        "holds": not tally.wrong, "permitted": tally.permitted, "corrected": tally.corrected, "braked": tally.braked,
        "takeovers": tally.taken, "changed": tally.changed, "homeward": tally.homeward, "alone": tally.straight,
        "vehicles": vehicles,
    }  # fmt: skip
    stopped = {
        "name": f"permitted flights that the monitor stopped, {tally.shortened} of them legs that were shortened",
        "ours": len(tally.stopped), "theirs": None, "unit": "flights", "ratio": None, "target": 0,
        "holds": not tally.stopped,
    }  # fmt: skip
    return {"claims": [claim, stopped]}


if __name__ == "__main__":
    sys.exit(main())
