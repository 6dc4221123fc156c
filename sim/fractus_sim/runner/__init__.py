"""Runner of experiments: simulated vehicles with timed faults, checks and a report.

Run an experiment file and require that all its checks hold:

    outcome = run(load(Path("hello.yaml")), Path("out/hello"))
    assert outcome.holds
"""

from fractus_sim.progress import Progress
from fractus_sim.runner.experiment_runner import ExperimentRun, run
from fractus_sim.runner.outcome import Outcome

__all__ = ["ExperimentRun", "Outcome", "Progress", "run"]
