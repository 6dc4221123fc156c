"""Expectations of the monitor scenario, evaluated on the evidence of a run."""

from __future__ import annotations

import math

import shapely
from fractus_core.api.geometry import Point
from fractus_core.geo import geodesic_m
from pyproj import Transformer

from fractus_sim.report.flight_record import JudgedCall
from fractus_sim.report.report_files import Expectation
from fractus_sim.report.track import Place
from fractus_sim.scenarios.monitor.monitor_site import DECLARED, DEVIATING, DRIVER, MonitorSite
from fractus_sim.scenarios.scenario_evidence import Evidence

REACHED_M = 2.0
SAME_POSITION_M = 0.5
INTERSECTION_M = 0.5
"""Maximum distance between a corrected target and the independently computed intersection."""

CONTROL_DEVIATION_M = 1.0
"""Distance that the engine keeps from a border, in addition to the position error."""

MIN_POSITION_ERROR_M = 0.5
"""Lower position errors that a GPS receiver reports are not believed."""

LANDED_WITHIN_M = 3.0
FOOTPRINT_M = 25.0
"""Distance from which a picture surely does not show the zone.

It includes half the diagonal of the footprint at 15 m (10.4 m), the motion while the picture is taken, and the errors of
position, altitude and tilt.
"""

MONITORED_COURSE = ("WP1", "WP2", "C1", "WP3", "C2", "WP4")
CORRECTIONS = {"C1": "WP-E1", "C2": "WP-E2"}


def evaluate_run(site: MonitorSite, run: Evidence) -> list[Expectation]:
    """Evaluate the expectations for a run. They depend on its name: monitored, unmonitored, declared or pictures."""
    evaluation = RunEvaluation(site, run)
    evaluations = {
        "monitored": evaluation.monitored,
        "unmonitored": evaluation.unmonitored,
        "declared": evaluation.declared,
        "pictures": evaluation.pictures,
    }
    return evaluations[run.name]()


def border_intersection(site: MonitorSite, start: Place, target: Place, clearance_m: float) -> Place:
    """Return the last point of a straight leg that keeps a distance from the border of the course.

    The computation shares no code with the engine: it projects the manifest's polygon with PROJ.
    """
    project = Transformer.from_crs("EPSG:4326", f"+proj=aeqd +lat_0={start.lat} +lon_0={start.lon} +datum=WGS84")
    corners = next(z for z in site.objects("Zone") if z["metadata"]["name"] == "course")
    exterior = corners["spec"]["area"]["polygon"]["exterior"]
    permitted = shapely.Polygon([project.transform(c["lat"], c["lon"]) for c in exterior]).buffer(-clearance_m)
    leg = shapely.LineString([(0.0, 0.0), project.transform(target.lat, target.lon)])
    inside = leg.intersection(permitted)
    # The leg may touch the area again further on. The drone must not fly there, so only the first part counts.
    first = min(shapely.get_parts(inside), key=lambda part: part.distance(shapely.Point(0.0, 0.0)))
    x, y = first.coords[-1]
    lat, lon = project.transform(x, y, direction="INVERSE")
    return Place(lat, lon, target.alt_m)


class RunEvaluation:
    """Evaluates the expectations on one run."""

    def __init__(self, site: MonitorSite, run: Evidence) -> None:
        self._site = site
        self._run = run
        self._expectations: list[Expectation] = []

    def monitored(self) -> list[Expectation]:
        """Return the expectations of the deviating program under policies (Fig. 7.8, blue line)."""
        positions: dict[str, Place | None] = {name: self._named(name) for name in DECLARED}
        for corrected, requested in CORRECTIONS.items():
            positions[corrected] = self._corrected(corrected, requested)
        self._visited([positions[name] for name in MONITORED_COURSE], MONITORED_COURSE)
        self._aborted("WP-E3")
        distance_m = self._closest_to("city-hall")
        self._expect("the drone never enters the no-fly zone", distance_m > 0.0, f"closest {distance_m:.1f} m")
        outside_m = self._furthest_outside()
        self._expect("the drone never leaves the course", outside_m == 0.0, f"{outside_m:.1f} m outside")
        self._landed_at("WP4")
        return self._expectations

    def unmonitored(self) -> list[Expectation]:
        """Return the expectations of the deviating program without policies (Fig. 7.8, red line)."""
        self._visited([self._named(name) for name in DEVIATING], DEVIATING)
        self._expect("the drone enters the no-fly zone", self._closest_to("city-hall") == 0.0, "")
        self._landed_at("WP4")
        return self._expectations

    def declared(self) -> list[Expectation]:
        """Return the expectations of the declared course under policies (Fig. 7.9)."""
        self._declared_course()
        above = self._above_zone(self._pictures(taken=True))
        self._expect("no picture is taken above the no-photo zone", not above, f"{len(above)} taken")
        refused = self._pictures(taken=False)
        suppressed = self._above_zone(refused)
        self._expect("pictures above the no-photo zone are suppressed", bool(suppressed), f"{len(suppressed)} refused")
        wrong = [call for call in refused if self._from_zone_m(call) > FOOTPRINT_M]
        kept = [call for call in self._pictures(taken=True) if self._from_zone_m(call) > FOOTPRINT_M]
        observed = f"{len(kept)} kept, {len(wrong)} refused"
        self._expect("all other pictures are kept", bool(kept) and not wrong, observed)
        return self._expectations

    def pictures(self) -> list[Expectation]:
        """Return the expectations of the declared course without policies (Fig. 7.9)."""
        self._declared_course()
        above = self._above_zone(self._pictures(taken=True))
        self._expect("pictures of the no-photo zone are taken", bool(above), f"{len(above)} taken above it")
        refused = self._pictures(taken=False)
        self._expect("no picture is suppressed", not refused, f"{len(refused)} refused")
        return self._expectations

    def _declared_course(self) -> None:
        self._visited([self._named(name) for name in DECLARED], DECLARED)
        taken = self._run.takeover()
        self._expect("the system does not take control", taken is None, taken.reason if taken is not None else "")
        self._landed_at("WP4")

    def _expect(self, text: str, holds: bool, observed: str) -> None:
        self._expectations.append(Expectation(text, holds, observed, self._run.name))

    def _named(self, name: str) -> Place:
        return Place(*self._site.places[name])

    def _requests(self, name: str) -> list[JudgedCall]:
        """Return the Goto calls of the program to a named position."""
        place = self._named(name)
        calls = [call for call in self._run.gotos() if call.caller == DRIVER]
        return [call for call in calls if call.requested and distance_m(call.requested, place) < SAME_POSITION_M]

    def _corrected(self, name: str, requested: str) -> Place | None:
        """Expect that a request is corrected to the independently computed intersection. Return the position that was flown."""
        call = next((c for c in self._requests(requested) if c.action == "correct"), None)
        if call is None or call.flown is None or call.position is None or call.requested is None:
            self._expect(f"{requested} is corrected to {name}", False, "not corrected")
            return None
        errors_m = [error_m for time_s, error_m in self._run.position_errors if time_s <= call.time_s]
        clearance_m = CONTROL_DEVIATION_M + max([*errors_m[-1:], MIN_POSITION_ERROR_M])
        expected = border_intersection(self._site, call.position, call.requested, clearance_m)
        error_m = distance_m(call.flown, expected)
        self._expect(
            f"{name}, flown instead of {requested}, is within {INTERSECTION_M} m of the intersection of leg and border",
            error_m <= INTERSECTION_M,
            f"{error_m:.2f} m",
        )
        return call.flown

    def _visited(self, places: list[Place | None], names: tuple[str, ...]) -> None:
        """Expect that the drone comes to the positions in this order."""
        samples = iter(self._run.track.samples)
        reached = []
        for name, place in zip(names, places, strict=True):
            if place is None or not any(distance_m(s.place, place) < REACHED_M for s in samples):
                break
            reached.append(name)
        text = f"the drone flies {', '.join(names)}"
        self._expect(text, len(reached) == len(names), f"reached {', '.join(reached) or 'none'}")

    def _aborted(self, name: str) -> None:
        """Expect that a request ends the access of the program, and that the system lands the drone."""
        calls = self._requests(name)
        taken = self._run.takeover()
        self._expect(
            f"the request for {name} aborts the program",
            bool(calls) and all(call.refused for call in calls) and taken is not None and taken.method == "landAt",
            calls[0].reason if calls else "never requested",
        )

    def _landed_at(self, name: str) -> None:
        last = self._run.track.samples[-1]
        away_m = distance_m(last.place, self._named(name))
        landed = not last.in_air and away_m < LANDED_WITHIN_M
        self._expect(f"the drone lands at {name}", landed, f"{away_m:.1f} m from {name}")

    def _pictures(self, *, taken: bool) -> list[JudgedCall]:
        """Return the pictures that were requested after WP2, where the drone flies above the zone."""
        since_s = min((call.time_s for call in self._requests("WP3")), default=math.inf)
        return [call for call in self._run.pictures(taken=taken) if call.time_s >= since_s]

    def _above_zone(self, calls: list[JudgedCall]) -> list[JudgedCall]:
        return [call for call in calls if self._from_zone_m(call) == 0.0]

    def _from_zone_m(self, call: JudgedCall) -> float:
        """Return the horizontal distance in metres between the drone and the no-photo zone at the time of a picture."""
        if call.position is None:
            return math.inf
        return float(
            self._site.zone("no-photo").distance(
                shapely.Point(self._site.frame.xy(call.position.lat, call.position.lon))
            )
        )

    def _path(self) -> shapely.LineString:
        frame = self._site.frame
        return shapely.LineString([frame.xy(s.place.lat, s.place.lon) for s in self._run.track.samples if s.in_air])

    def _closest_to(self, zone: str) -> float:
        """Return the minimum distance in metres between the flown path and a zone. It is 0 if they intersect."""
        return float(self._site.zone(zone).distance(self._path()))

    def _furthest_outside(self) -> float:
        """Return the largest distance in metres of the flown path from the course."""
        course = self._site.zone("course")
        return max(float(course.distance(shapely.Point(point))) for point in self._path().coords)


def distance_m(one: Place, other: Place) -> float:
    """Return the horizontal distance of two positions in metres."""
    return geodesic_m(Point(lat=one.lat, lon=one.lon), Point(lat=other.lat, lon=other.lon))
