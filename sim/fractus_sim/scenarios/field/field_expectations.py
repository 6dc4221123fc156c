"""Expectations of the field experiment, evaluated on the evidence of a run."""

from __future__ import annotations

import math

import shapely
from fractus_core.api.geometry import Point
from fractus_core.api.methods import CONTROL_METHODS
from fractus_core.geo import geodesic_m

from fractus_sim.report.flight_record import JudgedCall
from fractus_sim.report.report_files import Expectation
from fractus_sim.report.track import Sample
from fractus_sim.scenarios.field.field_site import NAVIGATOR, FieldSite
from fractus_sim.scenarios.scenario_evidence import SYSTEM, Evidence
from fractus_sim.scenarios.scenario_site import Position

REACHED_M = 2.0
SAME_POSITION_M = 0.5
MIN_ALTITUDE_M = 5.0
MAX_ALTITUDE_M = 15.0
CRUISE_M = 10.0
CRUISE_TOLERANCE_M = 1.0
LIMIT_TOLERANCE_M = 0.6
"""Tolerance of altitude control and estimation."""

MAX_CORRECTION_MARGIN_M = 1.0
"""Maximum distance of a corrected altitude from the limit of the policy."""

LANDED_WITHIN_M = 3.0
MIN_PICTURES = 4
TAKEOVER_DELAY_S = 0.5
"""Time after a takeover in which calls may still be executed."""


def evaluate_run(site: FieldSite, run: Evidence) -> list[Expectation]:
    """Evaluate the expectations for a run. They depend on its name: normal, guarded or unguarded."""
    evaluation = RunEvaluation(site, run)
    evaluations = {
        "normal": evaluation.normal,
        "guarded": evaluation.guarded,
        "unguarded": evaluation.unguarded,
    }
    return evaluations[run.name]()


class RunEvaluation:
    """Evaluates the expectations on one run."""

    def __init__(self, site: FieldSite, run: Evidence) -> None:
        self._site = site
        self._run = run
        self._expectations: list[Expectation] = []
        self._control_spans = self._read_control_spans()

    def normal(self) -> list[Expectation]:
        """Return the expectations of the program without violations."""
        for number in range(1, 10):
            self._reached(f"WP{number}")
        guided = [s for s in self._run.track.samples if s.in_air and s.mode == "GUIDED"]
        cruise = [s.place.alt_m for s in guided if self._in_control(s)]
        self._expect(
            f"the waypoints are flown at {CRUISE_M:.0f} m",
            bool(cruise) and all(abs(alt - CRUISE_M) < CRUISE_TOLERANCE_M for alt in cruise),
            f"{min(cruise, default=math.nan):.1f} to {max(cruise, default=math.nan):.1f} m",
        )
        self._expect("the system does not take control", self._run.takeover() is None, self._takeover_reason())
        self._pictures()
        self._landed()
        return self._expectations

    def guarded(self) -> list[Expectation]:
        """Return the expectations of the violating program under policies."""
        for name, requested_m, limit_m in (
            ("WP1", 20.0, MAX_ALTITUDE_M),
            ("WP3", 20.0, MAX_ALTITUDE_M),
            ("WP6", 4.0, MIN_ALTITUDE_M),
        ):
            self._corrected(name, requested_m, limit_m)
        heights = [s.place.alt_m for s in self._run.track.samples if s.in_air and s.mode == "GUIDED"]
        self._expect(
            f"the drone never flies above {MAX_ALTITUDE_M:.0f} m",
            max(heights, default=math.nan) <= MAX_ALTITUDE_M + LIMIT_TOLERANCE_M,
            f"at most {max(heights, default=math.nan):.1f} m",
        )
        low = [s.place.alt_m for s in self._run.track.samples if s.mode == "GUIDED" and self._in_control(s)]
        self._expect(
            f"the drone never flies below {MIN_ALTITUDE_M:.0f} m between its waypoints",
            min(low, default=math.nan) >= MIN_ALTITUDE_M - LIMIT_TOLERANCE_M,
            f"at least {min(low, default=math.nan):.1f} m",
        )
        self._discarded("WP-E1", then="WP3")
        self._stopped_for("WP-E2")
        closest = self._closest_to("no-fly")
        self._expect("the drone never enters the no-fly zone", closest > 0.0, f"closest {closest:.1f} m")
        self._pictures()
        self._landed()
        return self._expectations

    def unguarded(self) -> list[Expectation]:
        """Return the expectations of the violating program without policies."""
        for name, alt_m in (("WP1", 20.0), ("WP3", 20.0), ("WP6", 4.0)):
            self._reached(name, alt_m)
        self._reached("WP-E1")
        self._reached("WP-E2")
        self._expect("the drone enters the no-fly zone", self._closest_to("no-fly") == 0.0, "")
        above = self._above_stripe(taken=True)
        self._expect("pictures of the no-photo stripe are taken", bool(above), f"{len(above)} taken above it")
        self._landed()
        return self._expectations

    def _expect(self, text: str, holds: bool, observed: str) -> None:
        self._expectations.append(Expectation(text, holds, observed, self._run.name))

    def _gotos(self, name: str) -> list[JudgedCall]:
        """Return the Goto calls of the Navigator to a named position."""
        place = self._site.places[name]
        return [
            c
            for c in self._run.gotos()
            if c.caller == NAVIGATOR
            and c.requested is not None
            and _distance_m((c.requested.lat, c.requested.lon), place) < SAME_POSITION_M
        ]

    def _reached(self, name: str, alt_m: float | None = None) -> None:
        lat, lon, default_m = self._site.places[name]
        target_m = default_m if alt_m is None else alt_m
        closest_m = min(
            math.hypot(_distance_m((s.place.lat, s.place.lon), (lat, lon)), s.place.alt_m - target_m)
            for s in self._run.track.samples
        )
        self._expect(f"{name} is reached, at {target_m:.0f} m", closest_m < REACHED_M, f"within {closest_m:.1f} m")

    def _corrected(self, name: str, requested_m: float, limit_m: float) -> None:
        call = next((c for c in self._gotos(name) if c.requested and abs(c.requested.alt_m - requested_m) < 0.1), None)
        flown = call.flown.alt_m if call is not None and call.flown is not None else math.nan
        margin_m = limit_m - flown if limit_m == MAX_ALTITUDE_M else flown - limit_m
        self._expect(
            f"{name}, requested at {requested_m:.0f} m, is flown at {limit_m:.0f} m",
            call is not None and call.action == "correct" and -0.01 <= margin_m <= MAX_CORRECTION_MARGIN_M,
            f"{call.action} to {flown:.1f} m by {', '.join(call.policies)}" if call else "never requested",
        )
        self._reached(name, flown if math.isfinite(flown) else limit_m)

    def _discarded(self, name: str, then: str) -> None:
        calls = self._gotos(name)
        self._expect(
            f"{name} is discarded with an error",
            bool(calls) and all(c.refused for c in calls),
            calls[0].reason if calls else "never requested",
        )
        later = [c for c in self._gotos(then) if calls and c.time_s > calls[0].time_s and not c.refused]
        self._expect(f"the mission continues to {then} after {name}", bool(later), f"{len(later)} calls")

    def _stopped_for(self, name: str) -> None:
        calls = self._gotos(name)
        taken = self._run.takeover()
        self._expect(
            f"the request for {name} revokes the control of the program",
            bool(calls) and all(c.refused for c in calls) and taken is not None,
            calls[0].reason if calls else "never requested",
        )
        since = taken.time_s if taken is not None else math.inf
        # The SDK may request control again. The service does not grant it, so all later calls must be denied.
        later = [
            c
            for c in self._run.calls
            if c.caller == NAVIGATOR
            and c.time_s > since + TAKEOVER_DELAY_S
            and not c.refused
            and c.method not in CONTROL_METHODS
        ]
        self._expect(
            "no call of the program is executed after the takeover",
            taken is not None and not later,
            f"{len(later)} calls",
        )

    def _pictures(self) -> None:
        taken = self._run.pictures(taken=True)
        refused = self._run.pictures(taken=False)
        above = self._above_stripe(taken=True)
        self._expect("pictures are taken", len(taken) >= MIN_PICTURES, f"{len(taken)}")
        self._expect("no picture is taken above the no-photo stripe", not above, f"{len(above)} taken")
        by_policy = [c for c in refused if "no-pictures-of-the-stripe" in c.policies]
        self._expect("pictures of the stripe are refused", bool(by_policy), f"{len(by_policy)} refused")

    def _landed(self) -> None:
        last = self._run.track.samples[-1].place
        distance_m = _distance_m((last.lat, last.lon), self._site.home)
        landed = self._run.track.landing_error_m is not None and distance_m < LANDED_WITHIN_M
        self._expect("the drone lands at home", landed, f"{distance_m:.1f} m from home")

    def _above_stripe(self, *, taken: bool) -> list[JudgedCall]:
        stripe = self._site.zone("no-photo")
        frame = self._site.frame
        return [
            c
            for c in self._run.pictures(taken=taken)
            if c.position is not None and stripe.contains(shapely.Point(frame.xy(c.position.lat, c.position.lon)))
        ]

    def _closest_to(self, zone: str) -> float:
        """Return the minimum distance in metres between the flown path and a zone. It is 0 if they intersect."""
        shape = self._site.zone(zone)
        frame = self._site.frame
        path = shapely.LineString([frame.xy(s.place.lat, s.place.lon) for s in self._run.track.samples])
        return float(shape.distance(path))

    def _in_control(self, sample: Sample) -> bool:
        """Return True if the program had control at the time of a sample."""
        return any(begin <= sample.time_s <= end for begin, end in self._control_spans)

    def _read_control_spans(self) -> list[tuple[float, float]]:
        """Return the time spans in which the program had control."""
        begin_s: float | None = None
        spans = []
        for call in self._run.calls:
            if call.caller == SYSTEM and call.method == "granted":
                begin_s = call.time_s
            elif begin_s is not None and (call.method == "ReturnControl" or (call.caller == SYSTEM and call.code)):
                spans.append((begin_s, call.time_s))
                begin_s = None
        return spans

    def _takeover_reason(self) -> str:
        taken = self._run.takeover()
        return "" if taken is None else taken.reason


def _distance_m(one: tuple[float, float], other: tuple[float, float] | Position) -> float:
    return geodesic_m(Point(lat=one[0], lon=one[1]), Point(lat=other[0], lon=other[1]))
