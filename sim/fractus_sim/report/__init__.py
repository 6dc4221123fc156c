"""From what was recorded of a flight to one page, pictures and GeoJSON; the same record gives the same files."""

from fractus_sim.report.record import Record
from fractus_sim.report.write import write_report

__all__ = ["Record", "write_report"]
