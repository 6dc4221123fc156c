"""Experiments: drones, services and programs on this machine, faults in time, checks, and a report.

from fractus_sim.experiment import load, run
outcome = run(load(Path("hello.yaml")), Path("out/hello"))
assert outcome.holds
"""

from fractus_sim.experiment.errors import ExperimentError
from fractus_sim.experiment.model import Experiment, load, parse
from fractus_sim.experiment.outcome import Outcome
from fractus_sim.experiment.runner import Progress, run

__all__ = ["Experiment", "ExperimentError", "Outcome", "Progress", "load", "parse", "run"]
