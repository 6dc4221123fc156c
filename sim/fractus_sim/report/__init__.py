"""Reports of recorded flights: summary page, figures and GeoJSON. The output is deterministic."""

from fractus_sim.report.flight_record import Record
from fractus_sim.report.mission_report import write_report

__all__ = ["Record", "write_report"]
