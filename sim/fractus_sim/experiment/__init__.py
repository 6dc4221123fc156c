"""Data model of experiment files. It starts nothing: `fractus_sim.runner` runs an experiment."""

from fractus_sim.errors import ExperimentError
from fractus_sim.experiment.definition import Experiment, load, parse

__all__ = ["Experiment", "ExperimentError", "load", "parse"]
