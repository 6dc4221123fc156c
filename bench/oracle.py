"""The policy engine against an independent oracle that flies every permitted random request.

Policies, vehicles, states and requests are random. The oracle (tests/component/policy_flights.py) integrates
jerk-limited motion in steps of 50 ms, with wind, latency and position errors inside the bounds given to the engine. It
reports drones in forbidden places. It also reports a corrected target if the engine would not allow it unchanged, or if
it lies inside a margin. Vehicles differ in acceleration and return altitude, and ground stations change both parameters
in flight. After the requests, some drones return under the system like in the mobility service, and some under their
autopilot (tests/component/return_flights.py). The motion monitor checks some of the flights and must not stop them. The position
of some drones fails on a leg: GPS, second GPS or barometer wrong, a jump of the estimate, or a drift of GPS or barometer, which
no sign shows (tests/component/position_fault_flights.py).

A case is one request of one drone under one set of policies. Each drone makes three requests, two of them in flight. In
addition, vehicles with missing, absent and unusual parameters are armed (tests/component/parameter_faults.py).
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "component"))

from harness import Progress, Report, parser
from mavlink_requests import MavlinkRequests
from parameter_faults import parameter_faults
from policy_flights import Tally, flights
from position_fault_flights import PositionFaultFlights
from return_flights import ReturnFlights

DRONES = 500
REQUESTS = 3
WATCH_EVERY = 8
WATCHED = 12
HOME_EVERY = 8
FAULT_EVERY = 5
VEHICLES = 100


def main() -> int:
    arguments = parser(__doc__, quick="3,000 cases")
    arguments.add_argument("--cases", type=int, default=1_000_000, help="number of requests to evaluate and fly")
    arguments.add_argument("--seed", type=int, default=1, help="seed of the first batch of drones; each batch adds one")
    arguments.add_argument(
        "--mavlink",
        action="store_true",
        help="send the requests as MAVLink messages in random frames and masks through the gateway, and compare each request"
        " with the meaning of its message",
    )
    options = arguments.parse_args()
    cases = 3000 if options.quick else options.cases
    progress = Progress(cases)
    total = Tally()
    vehicles = 0
    seed = options.seed
    while total.requests < cases:
        returns = ReturnFlights(seed, HOME_EVERY)
        faults = PositionFaultFlights(seed, FAULT_EVERY)
        source = MavlinkRequests() if options.mavlink else None
        batch = flights(
            seed, DRONES, requests=REQUESTS, watch_every=WATCH_EVERY, watched=WATCHED, returns=returns, faults=faults,
            source=source,
        )  # fmt: skip
        if source is not None:
            batch.wrong += source.wrong
            batch.requests += source.refused
        batch.wrong += parameter_faults(seed, VEHICLES)
        vehicles += VEHICLES
        total.add(batch)
        for line in batch.wrong:
            print(f"\nWRONG {line}", flush=True)
        for line in batch.stopped:
            print(f"\nSTOPPED seed {seed}, {line}", flush=True)
        progress.show(
            total.requests,
            f"{total.permitted:,} permitted ({total.corrected:,} corrected, {total.braked:,} after a stop), {total.taken:,} takeovers,"
            f" {total.system_returns:,} flights home ({total.autopilot_returns:,} by the autopilot), {total.position_faults:,} position faults, {vehicles:,} arming requests,"
            f" {len(total.wrong)} wrong, {len(total.stopped)} stopped (seed {seed})",
        )
        seed += 1
    report = Report("oracle", options)
    report.add(
        "wrong", len(total.wrong), cases=total.requests, permitted=total.permitted, corrected=total.corrected,
        braked=total.braked, takeovers=total.taken, changed=total.changed, homeward=total.system_returns,
        alone=total.autopilot_returns, faults=total.position_faults, vehicles=vehicles,
    )  # fmt: skip
    report.add("stopped", len(total.stopped), shortened=total.shortened)
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
