"""`make scenario-monitor`: fly the monitor scenario and write figures, tables and results."""

from __future__ import annotations

from fractus_sim.scenarios.monitor.monitor_expectations import evaluate_run
from fractus_sim.scenarios.monitor.monitor_flight import RUNS, fly
from fractus_sim.scenarios.monitor.monitor_report import write_monitor_report
from fractus_sim.scenarios.monitor.monitor_site import EXAMPLE, MonitorSite
from fractus_sim.scenarios.scenario_command import Scenario, scenario_command

MONITOR = Scenario(
    "monitor",
    "Fly an unmodified DroneKit program four times: deviating from its course and on its course, with and without policies.",
    RUNS,
    lambda home: MonitorSite.read(EXAMPLE, home),
    fly,
    evaluate_run,
    write_monitor_report,
)

if __name__ == "__main__":
    scenario_command(MONITOR)(prog_name="scenario-monitor")
