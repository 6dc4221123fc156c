"""Expectations for each run: description, result and observed value."""

from __future__ import annotations

import math
from dataclasses import dataclass

import shapely
from fractus_core.api.geometry import Point
from fractus_core.api.methods import CONTROL_METHODS
from fractus_core.geo import geodesic_m

from fractus_sim.report.track import Sample
from fractus_sim.scenarios.field.field_evidence import SYSTEM, Call, Evidence
from fractus_sim.scenarios.field.field_site import NAVIGATOR, Field
from fractus_sim.scenarios.field.field_site import Place as Spot

NEAR_M = 2.0
SAME_M = 0.5
LOWEST_M = 5.0
HIGHEST_M = 15.0
CRUISE_M = 10.0
LIMIT_SLACK_M = 0.6  # # tolerance of altitude control and estimation
CORRECTED_WITHIN_M = 1.0  # # a correction may keep a margin to its limit
LANDED_WITHIN_M = 3.0
FEWEST_PICTURES = 4


@dataclass(frozen=True, slots=True)
class Check:
    """One expectation."""

    run: str
    text: str
    holds: bool
    seen: str


class Judge:
    """Evaluates the expectations on one run."""

    def __init__(self, field: Field, run: Evidence) -> None:
        self._field = field
        self._run = run
        self._checks: list[Check] = []
        self._held = self._holds()

    def normal(self) -> list[Check]:
        """Return the checks of the program without violations."""
        for number in range(1, 10):
            self._reached(f"WP{number}")
        in_control = [s for s in self._run.track.samples if s.in_air and s.mode == "GUIDED"]
        cruise = [s.place.alt_m for s in in_control if self._inside(s)]
        self._check(
            f"it flies its waypoints at {CRUISE_M:.0f} m",
            bool(cruise) and all(abs(alt - CRUISE_M) < 1.0 for alt in cruise),
            f"{min(cruise, default=math.nan):.1f} to {max(cruise, default=math.nan):.1f} m",
        )
        self._check("the system keeps its hands off", self._run.takeover() is None, self._taken())
        self._pictures()
        self._landed()
        return self._checks

    def guarded(self) -> list[Check]:
        """Return the checks of the violating program under policies."""
        for name, asked, flown in (("WP1", 20.0, HIGHEST_M), ("WP3", 20.0, HIGHEST_M), ("WP6", 4.0, LOWEST_M)):
            self._corrected(name, asked, flown)
        heights = [s.place.alt_m for s in self._run.track.samples if s.in_air and s.mode == "GUIDED"]
        self._check(
            f"it never flies above {HIGHEST_M:.0f} m",
            max(heights, default=math.nan) <= HIGHEST_M + LIMIT_SLACK_M,
            f"at most {max(heights, default=math.nan):.1f} m",
        )
        low = [s.place.alt_m for s in self._run.track.samples if s.mode == "GUIDED" and self._inside(s)]
        self._check(
            f"nor below {LOWEST_M:.0f} m between its waypoints",
            min(low, default=math.nan) >= LOWEST_M - LIMIT_SLACK_M,
            f"at least {min(low, default=math.nan):.1f} m",
        )
        self._discarded("WP-E1", then="WP3")
        self._stopped_for("WP-E2")
        closest = self._closest_to("no-fly")
        self._check("it never enters the no-fly zone", closest > 0.0, f"{closest:.1f} m away at the nearest")
        self._pictures()
        self._landed()
        return self._checks

    def unguarded(self) -> list[Check]:
        """Return the checks of the violating program without policies."""
        for name, alt_m in (("WP1", 20.0), ("WP3", 20.0), ("WP6", 4.0)):
            self._reached(name, alt_m)
        self._reached("WP-E1")
        self._reached("WP-E2")
        self._check("it enters the no-fly zone", self._closest_to("no-fly") == 0.0, "")
        above = self._above_stripe(taken=True)
        self._check("pictures of the no-photo stripe are taken", bool(above), f"{len(above)} taken above it")
        self._landed()
        return self._checks

    # # -- Evaluation -------------------------------------------------------------------------------------

    def _check(self, text: str, holds: bool, seen: str) -> None:
        self._checks.append(Check(self._run.name, text, holds, seen))

    def _gotos(self, name: str) -> list[Call]:
        place = self._field.places[name]
        mine = [c for c in self._run.gotos() if c.who == NAVIGATOR and c.asked is not None]
        return [c for c in mine if c.asked is not None and _apart_m((c.asked.lat, c.asked.lon), place) < SAME_M]

    def _reached(self, name: str, alt_m: float | None = None) -> None:
        lat, lon, usual_m = self._field.places[name]
        wanted = usual_m if alt_m is None else alt_m
        best = min(
            (math.hypot(_apart_m((s.place.lat, s.place.lon), (lat, lon)), s.place.alt_m - wanted))
            for s in self._run.track.samples
        )
        self._check(f"{name} is reached, at {wanted:.0f} m", best < NEAR_M, f"within {best:.1f} m")

    def _corrected(self, name: str, asked_m: float, limit_m: float) -> None:
        call = next((c for c in self._gotos(name) if c.asked and abs(c.asked.alt_m - asked_m) < 0.1), None)
        flown = call.flown.alt_m if call is not None and call.flown is not None else math.nan
        inside = limit_m - flown if limit_m == HIGHEST_M else flown - limit_m
        self._check(
            f"{name}, requested at {asked_m:.0f} m, is flown at {limit_m:.0f} m",
            call is not None and call.action == "correct" and -0.01 <= inside <= CORRECTED_WITHIN_M,
            f"{call.action} to {flown:.1f} m by {', '.join(call.policies)}" if call else "never requested",
        )
        self._reached(name, flown if math.isfinite(flown) else limit_m)

    def _discarded(self, name: str, then: str) -> None:
        calls = self._gotos(name)
        self._check(
            f"{name} is discarded with an error",
            bool(calls) and all(c.refused for c in calls),
            calls[0].reason if calls else "never requested",
        )
        after = [c for c in self._gotos(then) if calls and c.time_s > calls[0].time_s and not c.refused]
        self._check(f"and the mission continues to {then}", bool(after), f"{len(after)} calls")

    def _stopped_for(self, name: str) -> None:
        calls = self._gotos(name)
        taken = self._run.takeover()
        self._check(
            f"{name} revokes access",
            bool(calls) and all(c.refused for c in calls) and taken is not None,
            calls[0].reason if calls else "never requested",
        )
        since = taken.time_s if taken is not None else math.inf
        # The SDK may request control again. It is not granted, so all following calls are denied.
        later = [
            c
            for c in self._run.calls
            if c.who == NAVIGATOR and c.time_s > since + 0.5 and not c.refused and c.method not in CONTROL_METHODS
        ]
        self._check("after that the program moves nothing", taken is not None and not later, f"{len(later)} calls")

    def _pictures(self) -> None:
        taken = self._run.pictures(taken=True)
        refused = self._run.pictures(taken=False)
        above = self._above_stripe(taken=True)
        self._check("pictures are taken", len(taken) >= FEWEST_PICTURES, f"{len(taken)}")
        self._check("none of them above the no-photo stripe", not above, f"{len(above)} above it")
        by_policy = [c for c in refused if "no-pictures-of-the-stripe" in c.policies]
        self._check("pictures of the stripe are refused", bool(by_policy), f"{len(by_policy)} refused")

    def _landed(self) -> None:
        miss = self._run.track.miss_m
        home = self._field.home
        last = self._run.track.samples[-1].place
        away = _apart_m((last.lat, last.lon), (home[0], home[1]))
        landed = miss is not None and away < LANDED_WITHIN_M
        self._check("it lands at home", landed, f"{away:.1f} m from it")

    def _above_stripe(self, *, taken: bool) -> list[Call]:
        stripe = self._field.zone("no-photo")
        frame = self._field.frame
        return [
            c
            for c in self._run.pictures(taken=taken)
            if c.at is not None and stripe.contains(shapely.Point(frame.xy(c.at.lat, c.at.lon)))
        ]

    def _closest_to(self, zone: str) -> float:
        """Return the distance in metres between the flown path and a zone. 0 if they intersect."""
        shape = self._field.zone(zone)
        frame = self._field.frame
        way = shapely.LineString([frame.xy(s.place.lat, s.place.lon) for s in self._run.track.samples])
        return float(shape.distance(way))

    def _inside(self, sample: Sample) -> bool:
        """Return True if a sample is between the times when the program received and lost or released control."""
        return any(begin <= sample.time_s <= end for begin, end in self._held)

    def _holds(self) -> list[tuple[float, float]]:
        begun: float | None = None
        spans = []
        for call in self._run.calls:
            if call.who == SYSTEM and call.method == "granted":
                begun = call.time_s
            elif begun is not None and (call.method == "ReturnControl" or (call.who == SYSTEM and call.code)):
                spans.append((begun, call.time_s))
                begun = None
        return spans

    def _taken(self) -> str:
        taken = self._run.takeover()
        return "" if taken is None else taken.reason


def _apart_m(one: tuple[float, float], other: tuple[float, float] | Spot) -> float:
    return geodesic_m(Point(lat=one[0], lon=one[1]), Point(lat=other[0], lon=other[1]))
