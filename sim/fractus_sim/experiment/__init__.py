"""Experiments: simulated vehicles with timed faults, checks and a report.

Run an experiment file and require that all its checks hold:

    outcome = run(load(Path("hello.yaml")), Path("out/hello"))
    assert outcome.holds
"""

from fractus_sim.experiment.errors import ExperimentError
from fractus_sim.experiment.model import Experiment, load, parse
from fractus_sim.experiment.outcome import Outcome
from fractus_sim.experiment.runner import Progress, run

__all__ = ["Experiment", "ExperimentError", "Outcome", "Progress", "load", "parse", "run"]
