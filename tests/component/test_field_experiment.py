"""Expected results of the field experiment do not depend on the time at which pictures are taken."""

from __future__ import annotations

import shapely
from fractus_core.geo import LocalFrame
from fractus_sim.report.track import Place, Sample, Track
from fractus_sim.scenarios.field.drawing import draw_ground
from fractus_sim.scenarios.field.evidence import Call, Evidence
from fractus_sim.scenarios.field.flight import PERIOD_S, RUNS, STAY_S, Run, _environment
from fractus_sim.scenarios.field.place import ABOVE_STRIPE, EXAMPLE, VIEWER, Field

FIELD = Field.read(EXAMPLE)
STRAY_M = 3.0
"""How far a hovering drone strays at most."""


def test_every_run_hovers_above_the_stripe_for_longer_than_between_two_pictures() -> None:
    lat, lon, _ = FIELD.places[ABOVE_STRIPE]
    assert FIELD.zone("no-photo").contains(shapely.Point(FIELD.frame.xy(lat, lon)).buffer(STRAY_M))
    for run in RUNS:
        detours = dict(part.split(":") for part in _environment(run, FIELD, STAY_S)["DETOURS"].split(";"))
        at_lat, at_lon, _alt, stay_s = map(float, {k.strip(): v for k, v in detours.items()}["6"].split(","))
        assert LocalFrame(lat, lon).xy(at_lat, at_lon) == (0.0, 0.0) or abs(at_lat - lat) + abs(at_lon - lon) < 1e-6
        assert stay_s >= 1.5 * PERIOD_S


def test_the_map_says_which_run_took_which_picture() -> None:
    runs = [_flown(run, east=10.0 * number) for number, run in enumerate(RUNS)]
    figure = draw_ground(FIELD, [], runs)
    (legend,) = figure.legends or [figure.axes[0].get_legend()]
    words = {text.get_text() for text in legend.get_texts()}
    for run in RUNS:
        assert f"picture taken, {run.title}" in words
        assert f"picture refused, {run.title}" in words
    arrows = [text for text in figure.axes[0].texts if text.arrow_patch is not None]
    assert len(arrows) >= len(runs), "each way says in which direction it was flown"


def _flown(run: Run, east: float) -> Evidence:
    def place(north: float) -> Place:
        return Place(*FIELD.frame.latlon(east, north), 10.0)

    samples = tuple(Sample(float(i), place(i * 2.0), 2.0, "GUIDED", True, 1.0) for i in range(50))
    calls = tuple(
        Call(5.0 + i, VIEWER, "CaptureImage", action, "", "", (), None, None, place(10.0 + i))
        for i, action in enumerate(("allow", "deny"))
    )
    return Evidence(run.name, run.title, run.policies, Track(run.title, samples), calls, ())
