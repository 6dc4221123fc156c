"""Results of a run: pictures, uses of links, and the gain over the cloud path compared with other rules."""

from __future__ import annotations

import bisect
import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from fractus_core.linking import LocalPosition

from fractus_sim.report.report_files import Expectation
from fractus_sim.scenarios.links.link_rules import (
    STEP_S,
    RecordedFlight,
    best_gain,
    gain_of_rule,
    planner_rule,
    thesis_rule,
)
from fractus_sim.scenarios.links.links_evidence import Evidence, LinkUse
from fractus_sim.scenarios.links.links_site import Site

PLANNED_GAP_S = 1.5
"""Maximum time between two receptions, except at the loss of a link."""

ABRUPT_GAP_S = 2.5
"""Maximum time between two receptions at the loss of a link."""

MIN_SHARE = 0.95
"""Minimum gain of Fractus over the cloud path, as a share of the maximum possible gain."""

MIN_ALTITUDE_M = 15.0
"""Minimum altitude of the evaluated part of the flight."""

ARRIVED_M = 3.0
"""Distance to a waypoint at which it counts as reached."""


@dataclass(frozen=True, slots=True)
class Gain:
    """Gain of a rule over the cloud path on the recorded flight.

    Attributes:
        gain_mbit: Gain in Mbit.
        share: Share of the maximum possible gain.
        links: Number of links.
    """

    name: str
    gain_mbit: float
    share: float
    links: int


def recorded_flight(site: Site, run: Evidence) -> tuple[RecordedFlight, float]:
    """Return the part of the flight in which pictures were sent, and its start in Unix seconds."""
    last_s = max((p.sent_s for p in run.pictures), default=math.inf)
    flown = [(time_s, place) for time_s, place in run.track if place[2] >= MIN_ALTITUDE_M and time_s <= last_s]
    times = np.array([time_s for time_s, _ in flown])
    grid = np.arange(times[0], times[-1], STEP_S)
    places = np.array([place for _, place in flown])
    columns = [np.interp(grid, times, places[:, axis]) for axis in range(3)]
    positions: list[LocalPosition] = [(float(x), float(y), float(z)) for x, y, z in zip(*columns, strict=True)]
    remaining = list(site.path[1:])
    waypoints = []
    for position in positions:
        if len(remaining) > 1 and math.dist(position, remaining[0]) <= ARRIVED_M:
            remaining.pop(0)
        waypoints.append(tuple(remaining))
    speed = float(
        np.median([math.dist(a, b) / STEP_S for a, b in zip(positions[::10], positions[1::10], strict=False)])
    )
    direct = site.peers[0].offers.ingress_mbps
    return RecordedFlight(positions, waypoints, speed, site.peers, site.cloud, site.factor, direct), float(times[0])


def flown_gain(flight: RecordedFlight, begin_s: float, run: Evidence) -> float:
    """Return the actual gain over the cloud path in Mbit. Only times with traffic on a peer in range count."""
    peers = {peer.name: peer for peer in flight.peers}
    spans = sorted((begin, math.inf if end is None else end, s.peer) for s in run.link_uses for begin, end in s.spans)
    begins = [span[0] for span in spans]
    gain = 0.0
    for step in range(len(flight.positions)):
        time_s = begin_s + step * STEP_S
        index = bisect.bisect_right(begins, time_s) - 1
        if index < 0 or time_s >= spans[index][1]:
            continue
        if flight.rate(step, peers[spans[index][2]]) > 0:
            gain += flight.gain_mbps * STEP_S
    return gain


def gains(site: Site, run: Evidence) -> list[Gain]:
    """Return the gain of the actual run, and of the modelled rules on the same flight."""
    flight, begin_s = recorded_flight(site, run)
    best = best_gain(flight)
    rows = [("flown", flown_gain(flight, begin_s, run), sum(s.up_s is not None for s in run.link_uses))]
    rows.append(("rule of Fractus, modelled", *gain_of_rule(flight, planner_rule)))
    rows.append(("rule of the thesis, modelled", *gain_of_rule(flight, thesis_rule)))
    rows += [("maximum", best, 0), ("cloud only", 0.0, 0)]
    return [Gain(name, round(gain, 1), round(gain / best, 4) if best else 0.0, links) for name, gain, links in rows]


def evaluate_run(run: Evidence, gains_by_rule: list[Gain]) -> list[Expectation]:
    """Return the expectations of the scenario."""
    counts = run.counts()
    flown = gains_by_rule[0]
    used = {use.peer for use in run.link_uses if use.redirected_s is not None}
    used_names = ", ".join(sorted(used)) or "none"
    return [
        Expectation("no picture is lost", counts["lost"] == 0 and counts["sent"] > 0, f"{counts['lost']} of {counts['sent']}"),
        Expectation("no instance receives a picture twice", counts["doubled"] == 0, f"{counts['doubled']}"),
        Expectation(f"two pictures are never received more than {PLANNED_GAP_S:g} s apart, except at a lost link", run.gap_s(abrupt=False) < PLANNED_GAP_S, f"{run.gap_s(abrupt=False):.2f} s"),
        Expectation(f"two pictures are never received more than {ABRUPT_GAP_S:g} s apart at a lost link", run.gap_s(abrupt=True) < ABRUPT_GAP_S, f"{run.gap_s(abrupt=True):.2f} s"),
        Expectation(f"at least {MIN_SHARE:.0%} of the maximum possible gain", flown.share >= MIN_SHARE, f"{flown.share:.1%}"),
        Expectation("edge-2 (no WiFi) and edge-5 (out of range) receive nothing", not used & {"edge-2", "edge-5"}, used_names),
        Expectation("at least three edge nodes receive pictures by WiFi", len(used) >= 3, used_names),
    ]  # fmt: skip


def links_results(
    site: Site, run: Evidence, gains_by_rule: list[Gain], expectations: list[Expectation]
) -> dict[str, Any]:
    """Return the results as JSON-compatible values."""
    begin_s = run.pictures[0].sent_s if run.pictures else 0.0
    return {
        "holds": all(expectation.holds for expectation in expectations),
        "range_factor": site.factor,
        "checks": [expectation.to_dict() for expectation in expectations],
        "pictures": run.counts() | {"longest_gap_s": round(run.longest_gap_s, 3), "by_node": run.by_node()},
        "switches": [_link_use(use, begin_s) for use in run.link_uses],
        "gain": [{"who": g.name, "gain_mbit": g.gain_mbit, "share": g.share, "links": g.links} for g in gains_by_rule],
    }


def _link_use(use: LinkUse, begin_s: float) -> dict[str, Any]:
    """Return the use of a link with times in seconds since the first picture."""

    def relative(time_s: float | None) -> float | None:
        return None if time_s is None else round(time_s - begin_s, 3)

    content = {key: relative(value) if key.endswith("_s") else value for key, value in asdict(use).items()}
    return content | {"spans": [[relative(begin), relative(end)] for begin, end in use.spans]}
