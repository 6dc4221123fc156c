"""Reports of recorded flights: summary page, figures and GeoJSON. The output is deterministic."""

from fractus_sim.report.record import Record
from fractus_sim.report.write import write_report

__all__ = ["Record", "write_report"]
