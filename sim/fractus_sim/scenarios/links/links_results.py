"""Results of a run: pictures, switches, and the gain over the cloud path compared with other rules."""

from __future__ import annotations

import bisect
import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from fractus_core.linking import LocalPosition

from fractus_sim.scenarios.links.link_rules import STEP_S, Scene, carried, oracle, ours, thesis
from fractus_sim.scenarios.links.links_evidence import Evidence, Switch
from fractus_sim.scenarios.links.links_site import Site

PLANNED_GAP_S = 1.5
ABRUPT_GAP_S = 2.5
SHARE = 0.95
MIN_HEIGHT_M = 15.0
ARRIVED_M = 3.0


@dataclass(frozen=True, slots=True)
class Expectation:
    """An expectation."""

    text: str
    holds: bool
    seen: str


@dataclass(frozen=True, slots=True)
class Gain:
    """Gain of a rule over the cloud path on the recorded flight in Mbit, and number of links."""

    who: str
    gain_mbit: float
    share: float
    links: int


def scene_of(site: Site, run: Evidence) -> tuple[Scene, float]:
    """Return the recorded flight while pictures were sent, and its start in Unix seconds."""
    last_s = max((p.sent_s for p in run.pictures), default=math.inf)
    flown = [(at, position) for at, position in run.track if position[2] >= MIN_HEIGHT_M and at <= last_s]
    times = np.array([at for at, _ in flown])
    grid = np.arange(times[0], times[-1], STEP_S)
    places = np.array([position for _, position in flown])
    columns = [np.interp(grid, times, places[:, axis]) for axis in range(3)]
    positions: list[LocalPosition] = [(float(x), float(y), float(z)) for x, y, z in zip(*columns, strict=True)]
    coming = list(site.path[1:])
    waypoints = []
    for position in positions:
        if len(coming) > 1 and math.dist(position, coming[0]) <= ARRIVED_M:
            coming.pop(0)
        waypoints.append(tuple(coming))
    speed = float(
        np.median([math.dist(a, b) / STEP_S for a, b in zip(positions[::10], positions[1::10], strict=False)])
    )
    direct = site.peers[0].offers.ingress_mbps
    return Scene(positions, waypoints, speed, site.peers, site.cloud, site.factor, direct), float(times[0])


def flown_gain(scene: Scene, begin_s: float, run: Evidence) -> float:
    """Return the gain over the cloud path in Mbit, counting times with traffic on a peer that was actually in range."""
    peers = {peer.name: peer for peer in scene.peers}
    spans = sorted((begin, math.inf if end is None else end, s.peer) for s in run.switches for begin, end in s.spans)
    begins = [span[0] for span in spans]
    gain = 0.0
    for step in range(len(scene.positions)):
        at = begin_s + step * STEP_S
        found = bisect.bisect_right(begins, at) - 1
        if found >= 0 and at < spans[found][1] and scene.rate(step, peers[spans[found][2]]) > 0:
            gain += scene.gain_mbps * STEP_S
    return gain


def gains(site: Site, run: Evidence) -> list[Gain]:
    """Return the gain of the actual run, and of the modelled rules on the same flight."""
    scene, begin_s = scene_of(site, run)
    best = oracle(scene)
    rows = [("flown", flown_gain(scene, begin_s, run), sum(s.up_s is not None for s in run.switches))]
    rows += [
        (name, *carried(scene, rule))
        for name, rule in (("our rule, modelled", ours), ("thesis' rule, modelled", thesis))
    ]
    rows += [("oracle", best, 0), ("cloud only", 0.0, 0)]
    return [Gain(who, round(gain, 1), round(gain / best, 4) if best else 0.0, links) for who, gain, links in rows]


def expectations(run: Evidence, table: list[Gain]) -> list[Expectation]:
    """Return the expectations of the scenario."""
    counts = run.counts()
    flown = table[0]
    used = {s.peer for s in run.switches if s.redirected_s is not None}
    return [
        Expectation("no picture is lost", counts["lost"] == 0 and counts["sent"] > 0, f"{counts['lost']} of {counts['sent']}"),
        Expectation("no picture is doubled", counts["doubled"] == 0, f"{counts['doubled']}"),
        Expectation(f"pictures are never more than {PLANNED_GAP_S:g} s apart but at a lost link", run.gap_s(abrupt=False) < PLANNED_GAP_S, f"{run.gap_s(abrupt=False):.2f} s"),
        Expectation(f"nor more than {ABRUPT_GAP_S:g} s at a lost link", run.gap_s(abrupt=True) < ABRUPT_GAP_S, f"{run.gap_s(abrupt=True):.2f} s"),
        Expectation(f"at least {SHARE:.0%} of the oracle's gain", flown.share >= SHARE, f"{flown.share:.1%}"),
        Expectation("edge-2 (no WiFi) and edge-5 (out of the way) receive nothing", not used & {"edge-2", "edge-5"}, ", ".join(sorted(used)) or "none used"),
        Expectation("at least three edge nodes receive pictures by WiFi", len(used) >= 3, ", ".join(sorted(used)) or "none"),
    ]  # fmt: skip


def report(site: Site, run: Evidence, table: list[Gain], checks: list[Expectation]) -> dict[str, Any]:
    """Return the results as JSON-compatible values."""
    begin = run.pictures[0].sent_s if run.pictures else 0.0
    return {
        "holds": all(check.holds for check in checks),
        "range_factor": site.factor,
        "checks": [asdict(check) for check in checks],
        "pictures": run.counts() | {"longest_gap_s": round(run.longest_gap_s, 3), "by_node": run.by_node()},
        "switches": [_switch(s, begin) for s in run.switches],
        "gain": [asdict(row) for row in table],
    }


def _switch(switch: Switch, begin_s: float) -> dict[str, Any]:
    """Return a link with times in seconds since the first picture."""

    def at(seconds: float | None) -> float | None:
        return None if seconds is None else round(seconds - begin_s, 3)

    content = {key: at(value) if key.endswith("_s") else value for key, value in asdict(switch).items()}
    return content | {"spans": [[at(begin), at(end)] for begin, end in switch.spans]}
