"""Command of a scenario: fly its runs with simulated vehicles or with a running autopilot, and write the report."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

import click

from fractus_sim.command_line import command_errors, exit_with_expectations
from fractus_sim.errors import ExperimentError
from fractus_sim.report.report_files import Expectation, remove_report
from fractus_sim.scenarios.scenario_evidence import Evidence
from fractus_sim.scenarios.scenario_flight import Autopilot, ScenarioRun, drone_setup, find_parked_vehicle
from fractus_sim.scenarios.scenario_site import Position, ScenarioSite
from fractus_sim.testbeds.borrowed_autopilot import BorrowedAutopilot, default_state

Site = TypeVar("Site", bound=ScenarioSite)


@dataclass(frozen=True)
class Scenario(Generic[Site]):
    """A scenario whose runs one drone flies.

    Attributes:
        name: Name in the command `make scenario-NAME`.
        runs: Runs, in the order in which they are flown.
        read_site: Returns the site at a home position. None: the position of the manifests.
        fly: Flies a run into a folder, and returns its evidence.
        evaluate: Returns the expectations of a run.
        write_report: Writes the report. Arguments: site, evidence of the runs, expectations, description of the vehicle, folder.
    """

    name: str
    description: str
    runs: Sequence[ScenarioRun]
    read_site: Callable[[Position | None], Site]
    fly: Callable[[ScenarioRun, Site, Autopilot, Path, Callable[[str], None]], Evidence]
    evaluate: Callable[[Site, Evidence], list[Expectation]]
    write_report: Callable[[Site, Sequence[Evidence], Sequence[Expectation], str, Path], None]


def scenario_command(scenario: Scenario[Site]) -> click.Command:
    """Return the command line of a scenario."""

    @click.command(
        help=f"""{scenario.description}

    Exit code: 0 if all expectations hold, 2 if an expectation does not hold, 1 if the scenario could not be flown.
    """
    )
    @click.option(
        "--out", type=click.Path(path_type=Path), default=Path("out", scenario.name), show_default=True,
        help="Output folder of the report.",
    )  # fmt: skip
    @click.option(
        "--autopilot",
        metavar="tcp:HOST:PORT",
        help="Fly with a running ArduCopter (SITL or a vehicle) instead of simulated vehicles.",
    )
    @click.option(
        "--speedup",
        type=click.FloatRange(0.2, 8.0),
        default=3.0,
        show_default=True,
        help="Factor of real time. For a running autopilot: its actual factor.",
    )
    @click.option(
        "--state", type=click.Path(file_okay=False, path_type=Path), metavar="DIR",
        help="Directory that keeps the settings of a running autopilot's owner until they are restored; by default in ~/.local/state/fractus.",
    )  # fmt: skip
    @click.option(
        "--restore", is_flag=True, help="Only restore the settings that an interrupted run left in --autopilot."
    )
    @click.option(
        "--run", "names", multiple=True, type=click.Choice([run.name for run in scenario.runs]), help="Only these runs."
    )
    def command(
        *,
        out: Path,
        autopilot: str | None,
        speedup: float,
        state: Path | None,
        restore: bool,
        names: tuple[str, ...],
    ) -> None:
        if autopilot is None and (restore or state is not None):
            raise click.UsageError("--restore and --state need --autopilot")
        with command_errors():
            borrowed = None
            if autopilot is not None:
                borrowed = BorrowedAutopilot(autopilot, (state or default_state(autopilot)).absolute(), _report)
            if restore:
                _restore_interrupted(scenario, out, Autopilot(borrowed, speedup))
                return
            try:
                expectations = run_scenario(scenario, out, Autopilot(borrowed, speedup), names)
            finally:
                if borrowed is not None and borrowed.interrupted:
                    click.echo(
                        f"the vehicle at {autopilot} may still have settings of the experiment; the next run restores those of its owner,"
                        f" or the same command with --restore (make scenario-{scenario.name} AUTOPILOT=... RESTORE=1)",
                        err=True,
                    )
        exit_with_expectations(expectations, out)

    return command


def run_scenario(
    scenario: Scenario[Site], out: Path, autopilot: Autopilot, names: tuple[str, ...] = ()
) -> list[Expectation]:
    """Fly the runs, write the report, and return the expectations.

    A running autopilot gets the settings of its owner back after each run. Settings that an interrupted run left are restored first.

    Args:
        scenario: Scenario.
        out: Output folder.
        autopilot: Vehicle to fly.
        names: Names of the runs. Default: all runs.

    Raises:
        ExperimentError: A run could not be flown.
    """
    borrowed = autopilot.borrowed
    if borrowed is None:
        site = scenario.read_site(None)
        vehicle = "simulated vehicles"
    else:
        if borrowed.interrupted:
            _restore(scenario, borrowed, out, autopilot, forced=False)
        parked = find_parked_vehicle(borrowed.link, _report)
        site = scenario.read_site(parked.home)
        vehicle = f"vehicle {parked.system_id} at {borrowed.link}"
    out.mkdir(parents=True, exist_ok=True)
    remove_report(out)
    runs: list[Evidence] = []
    expectations: list[Expectation] = []
    for run in scenario.runs:
        if names and run.name not in names:
            continue
        click.echo(f"run: {run.title}")
        if borrowed is not None:
            borrowed.take()
        evidence = scenario.fly(run, site, autopilot, out / run.name, _report)
        expectations += scenario.evaluate(site, evidence)
        if borrowed is not None:
            expectations.append(_evaluate_owner(run.name, borrowed))
        runs.append(evidence)
    scenario.write_report(site, runs, expectations, vehicle, out)
    return expectations


def _restore_interrupted(scenario: Scenario[Site], out: Path, autopilot: Autopilot) -> None:
    """Restore the settings that an interrupted run left in a running autopilot.

    Raises:
        ExperimentError: They cannot be restored.
    """
    borrowed = autopilot.borrowed
    if borrowed is None or not borrowed.interrupted:
        _report("nothing to restore")
        return
    _restore(scenario, borrowed, out, autopilot, forced=True)


def _restore(
    scenario: Scenario[Site], borrowed: BorrowedAutopilot, out: Path, autopilot: Autopilot, *, forced: bool
) -> None:
    borrowed.restore(out / "restore", drone_setup(scenario.read_site(None), autopilot), forced=forced)


def _evaluate_owner(run: str, borrowed: BorrowedAutopilot) -> Expectation:
    """Give a running autopilot back, and evaluate if it has the settings of its owner again."""
    try:
        differences = borrowed.give_back()
    except ExperimentError as error:
        differences = [str(error)]
    return Expectation(
        "the vehicle has the parameters, the fence and the rally points of its owner again",
        not differences,
        "; ".join(differences) or "no difference",
        run,
    )


def _report(line: str) -> None:
    click.echo(f"  {line}")
