"""The field experiment takes a picture above the stripe in every run, and its map labels the runs."""

from __future__ import annotations

import shapely
from fractus_core.geo import LocalFrame
from fractus_sim.report.track import Place, Sample, Track
from fractus_sim.scenarios.field.field_evidence import Call, Evidence
from fractus_sim.scenarios.field.field_flight import PERIOD_S, RUNS, STAY_S, Run, _environment
from fractus_sim.scenarios.field.field_report import draw_ground
from fractus_sim.scenarios.field.field_site import ABOVE_STRIPE, EXAMPLE, VIEWER, Field

FIELD = Field.read(EXAMPLE)
DEVIATION_M = 3.0
"""Maximum horizontal deviation of a hovering drone, in metres."""


def test_field_run_hovers_above_the_stripe_longer_than_the_picture_period() -> None:
    lat, lon, _ = FIELD.places[ABOVE_STRIPE]
    assert FIELD.zone("no-photo").contains(shapely.Point(FIELD.frame.xy(lat, lon)).buffer(DEVIATION_M))
    for run in RUNS:
        detours = dict(part.split(":") for part in _environment(run, FIELD, STAY_S)["DETOURS"].split(";"))
        at_lat, at_lon, _alt, stay_s = map(float, {k.strip(): v for k, v in detours.items()}["6"].split(","))
        assert LocalFrame(lat, lon).xy(at_lat, at_lon) == (0.0, 0.0) or abs(at_lat - lat) + abs(at_lon - lon) < 1e-6
        assert stay_s >= 1.5 * PERIOD_S


def test_field_map_legend_names_run_of_each_picture() -> None:
    runs = [_flown(run, east=10.0 * number) for number, run in enumerate(RUNS)]
    figure = draw_ground(FIELD, [], runs)
    (legend,) = figure.legends or [figure.axes[0].get_legend()]
    words = {text.get_text() for text in legend.get_texts()}
    for run in RUNS:
        assert f"picture taken, {run.title}" in words
        assert f"picture refused, {run.title}" in words
    arrows = [text for text in figure.axes[0].texts if text.arrow_patch is not None]
    assert len(arrows) >= len(runs), "each route has an arrow in the direction of flight"


def _flown(run: Run, east: float) -> Evidence:
    def place(north: float) -> Place:
        return Place(*FIELD.frame.latlon(east, north), 10.0)

    samples = tuple(Sample(float(i), place(i * 2.0), 2.0, "GUIDED", True, 1.0) for i in range(50))
    calls = tuple(
        Call(5.0 + i, VIEWER, "CaptureImage", action, "", "", (), None, None, place(10.0 + i))
        for i, action in enumerate(("allow", "deny"))
    )
    return Evidence(run.name, run.title, run.policies, Track(run.title, samples), calls, ())
