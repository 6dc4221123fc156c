"""The policy engine against an independent oracle: random policies, states and requests, every permitted one flown.

The oracle (tests/unit/policy_flights.py) integrates jerk-limited motion in steps of 50 ms, with wind, latency and position
errors inside the bounds that the engine is told, and looks for drones where a policy forbids them and for corrections
inside a margin. The motion monitor looks at each permitted flight, which it must let pass. A case is one request of one drone to one set of policies; each drone has three, the later ones in flight.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "unit"))

from policy_flights import Tally, flights

DRONES, REQUESTS = 500, 3
WATCH_EVERY = 8


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=1_000_000, help="requests to judge and fly")
    parser.add_argument("--seed", type=int, default=1, help="seed of the first batch; each batch has the next one")
    parser.add_argument("--quick", action="store_true", help="3000 cases")
    parser.add_argument("--json", type=Path, help="write the claims to a file, after every batch")
    options = parser.parse_args()
    cases = 3000 if options.quick else options.cases
    whole, seed, begun = Tally(), options.seed, time.monotonic()
    while whole.asked < cases:
        found = flights(seed, DRONES, requests=REQUESTS, watch_every=WATCH_EVERY)
        for name in ("asked", "permitted", "corrected", "braked", "taken", "shortened", "stopped"):
            setattr(whole, name, getattr(whole, name) + getattr(found, name))
        whole.wrong += found.wrong
        for line in found.wrong:
            print(f"\nWRONG {line}", flush=True)
        for line in found.stopped:
            print(f"\nSTOPPED {line}", flush=True)
        spent_s = time.monotonic() - begun
        left_s = spent_s / whole.asked * max(cases - whole.asked, 0)
        print(
            f"\rseed {seed}: {whole.asked:,} cases, {whole.permitted:,} permitted ({whole.corrected:,} corrected,"
            f" {whole.braked:,} after a stop), {whole.taken:,} takeovers, {len(whole.wrong)} wrong, {len(whole.stopped)} stopped; {left_s / 60:.0f} min left ",
            end="",
            flush=True,
        )
        seed += 1
        if options.json:
            options.json.write_text(json.dumps(claims(whole), indent=1))
    print()
    return 1 if whole.wrong or whole.stopped else 0


def claims(tally: Tally) -> dict[str, object]:
    """What was found, as other benchmarks write it."""
    claim = {
        "name": f"breaches and corrections inside a margin, in {tally.asked} random cases",
        "ours": len(tally.wrong), "theirs": None, "unit": "cases", "ratio": None, "target": 0,
        "holds": not tally.wrong, "permitted": tally.permitted, "corrected": tally.corrected, "braked": tally.braked,
        "takeovers": tally.taken,
    }  # fmt: skip
    stopped = {
        "name": f"permitted flights that the monitor stopped, {tally.shortened} of them legs that were shortened",
        "ours": len(tally.stopped), "theirs": None, "unit": "flights", "ratio": None, "target": 0,
        "holds": not tally.stopped,
    }  # fmt: skip
    return {"claims": [claim, stopped]}


if __name__ == "__main__":
    sys.exit(main())
