"""`make scenario-field`: fly the field experiment and write figures, tables and results."""

from __future__ import annotations

from fractus_sim.scenarios.field.field_expectations import evaluate_run
from fractus_sim.scenarios.field.field_flight import RUNS, fly
from fractus_sim.scenarios.field.field_report import write_field_report
from fractus_sim.scenarios.field.field_site import EXAMPLE, FieldSite
from fractus_sim.scenarios.scenario_command import Scenario, scenario_command

FIELD = Scenario(
    "field",
    "Fly the field experiment three times: normally, with violations under policies, and without policies.",
    RUNS,
    lambda home: FieldSite.read(EXAMPLE, home),
    fly,
    evaluate_run,
    write_field_report,
)

if __name__ == "__main__":
    scenario_command(FIELD)(prog_name="scenario-field")
