"""Expected results of the field experiment do not depend on the time at which pictures are taken."""

from __future__ import annotations

import shapely
from fractus_core.geo import LocalFrame
from fractus_sim.report.flight_record import JudgedCall
from fractus_sim.report.track import Place, Sample, Track
from fractus_sim.scenarios.field.field_flight import HOVER_S, PICTURE_INTERVAL_S, RUNS, navigator_environment
from fractus_sim.scenarios.field.field_report import draw_map
from fractus_sim.scenarios.field.field_site import ABOVE_STRIPE, EXAMPLE, VIEWER, FieldSite
from fractus_sim.scenarios.scenario_evidence import Evidence
from fractus_sim.scenarios.scenario_flight import ScenarioRun

SITE = FieldSite.read(EXAMPLE)
HOVER_ERROR_M = 3.0
"""Maximum deviation of a hovering drone from its position."""


def test_every_run_hovers_above_the_stripe_for_longer_than_the_picture_interval() -> None:
    lat, lon, _ = SITE.places[ABOVE_STRIPE]
    assert SITE.zone("no-photo").contains(shapely.Point(SITE.frame.xy(lat, lon)).buffer(HOVER_ERROR_M))
    for run in RUNS:
        detours = dict(part.split(":") for part in navigator_environment(run, SITE, HOVER_S)["DETOURS"].split(";"))
        at_lat, at_lon, _alt, hover_s = map(float, {k.strip(): v for k, v in detours.items()}["6"].split(","))
        assert LocalFrame(lat, lon).xy(at_lat, at_lon) == (0.0, 0.0) or abs(at_lat - lat) + abs(at_lon - lon) < 1e-6
        assert hover_s >= 1.5 * PICTURE_INTERVAL_S


def test_map_legend_shows_the_run_of_each_picture() -> None:
    runs = [_flown(run, east=10.0 * number) for number, run in enumerate(RUNS)]
    figure = draw_map(SITE, [], runs)
    (legend,) = figure.legends or [figure.axes[0].get_legend()]
    labels = {text.get_text() for text in legend.get_texts()}
    for run in RUNS:
        assert f"picture taken, {run.title}" in labels
        assert f"picture refused, {run.title}" in labels
    arrows = [text for text in figure.axes[0].texts if getattr(text, "arrow_patch", None) is not None]
    assert len(arrows) >= len(runs), "each path has an arrow in flight direction"


def _flown(run: ScenarioRun, east: float) -> Evidence:
    def place(north: float) -> Place:
        return Place(*SITE.frame.latlon(east, north), 10.0)

    samples = tuple(Sample(float(i), place(i * 2.0), 2.0, "GUIDED", True, 1.0) for i in range(50))
    calls = tuple(
        JudgedCall(5.0 + i, VIEWER, "CaptureImage", action, "", "", (), None, None, place(10.0 + i))
        for i, action in enumerate(("allow", "deny"))
    )
    return Evidence(run.name, run.title, run.policies, Track(run.title, samples), calls, ())
