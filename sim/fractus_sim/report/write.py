"""Output of all files of a report."""

from __future__ import annotations

import json
from pathlib import Path

import yaml

from fractus_sim.report.drawing import save
from fractus_sim.report.features import features
from fractus_sim.report.flightmap import draw_map
from fractus_sim.report.mission import profile_of, scene_of
from fractus_sim.report.page import write_page
from fractus_sim.report.profile import draw_profile
from fractus_sim.report.record import Record
from fractus_sim.report.summary import figures, summary


def write_report(record: Record, folder: Path) -> None:
    """Write summary.md, report.json, flight.geojson, plan.yaml, map.png and altitude.png into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "report.json").write_text(json.dumps(figures(record), indent=2) + "\n")
    (folder / "flight.geojson").write_text(json.dumps(features(record)) + "\n")
    if record.plan is not None:
        (folder / "plan.yaml").write_text(yaml.safe_dump(record.plan.to_dict(), sort_keys=False))
    save(draw_map(scene_of(record)), folder / "map.png")
    save(draw_profile(profile_of(record)), folder / "altitude.png")
    write_page(folder, summary(record))
