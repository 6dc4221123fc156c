"""The testbed and the runner of an experiment close everything that they have started after any error."""

from __future__ import annotations

import errno
import io
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner
from fractus_sim import command_line, experiment_command
from fractus_sim.errors import ExperimentError
from fractus_sim.experiment.definition import Experiment, Program, parse
from fractus_sim.interruption import uninterrupted
from fractus_sim.report.report_files import write_page
from fractus_sim.report.track import Place, Sample
from fractus_sim.runner import ExperimentRun, Outcome, experiment_report, experiment_runner, run
from fractus_sim.runner.telemetry_recording import Flight
from fractus_sim.testbeds import process_guard
from fractus_sim.testbeds.testbed import Findings, Moment, Testbed


class Resource:
    """A resource that records its closing, and can fail to close."""

    def __init__(self, error: BaseException | None = None) -> None:
        self.closed = False
        self._error = error

    def close(self) -> None:
        self.closed = True
        if self._error is not None:
            raise self._error


class EmptyTestbed(Testbed):
    """A testbed without vehicles."""

    def set_up(self) -> None:
        """Start nothing."""

    def tick(self) -> Moment:
        raise AssertionError("never reached")

    def begin(self, program: Program | None = None) -> None:
        """Start nothing."""

    collect = set_up

    def set_link(self, vehicle: str, *, connected: bool) -> None:
        """Ignore the call."""


def disk_full() -> OSError:
    return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.fixture
def experiment() -> Experiment:
    vehicle = {"name": "d", "home": {"lat": 50.0, "lon": 4.0}}
    return parse({"name": "test", "mode": "vehicles", "timeout": 10, "vehicles": [vehicle]})


@pytest.fixture
def testbed(experiment: Experiment, tmp_path: Path) -> EmptyTestbed:
    return EmptyTestbed(experiment, tmp_path, tmp_path, print)


@pytest.mark.parametrize("error", [disk_full(), KeyboardInterrupt()], ids=["disk full", "Ctrl-C"])
def test_testbed_closes_remaining_resources_after_a_close_error(testbed: EmptyTestbed, error: BaseException) -> None:
    first = testbed.keep(Resource())
    last = Resource(error)
    order = list[str]()
    testbed.at_end(lambda: order.append("done"))
    testbed.keep(last)
    with pytest.raises(type(error)):
        testbed.close()
    assert (first.closed, last.closed, order) == (True, True, ["done"])


def test_testbed_is_closed_and_old_report_removed_if_the_disk_is_full_at_start(
    experiment: Experiment, testbed: EmptyTestbed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    resource = testbed.keep(Resource())

    def fail_to_open(_path: Path) -> None:
        raise disk_full()

    monkeypatch.setattr(experiment_runner, "_create_testbed", lambda *_: testbed)
    monkeypatch.setattr(experiment_runner, "McapLog", fail_to_open)
    (tmp_path / "summary.md").write_text("All checks hold.")
    with pytest.raises(OSError, match="No space left"):
        experiment_runner.run(experiment, tmp_path)
    assert resource.closed
    assert not (tmp_path / "summary.md").exists()


def test_testbed_is_closed_if_the_disk_is_full_at_the_end(
    experiment: Experiment, testbed: EmptyTestbed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    resource = testbed.keep(Resource())
    monkeypatch.setattr(experiment_runner, "_create_testbed", lambda *_: testbed)
    monkeypatch.setattr(experiment_runner, "McapLog", lambda _: Resource(disk_full()))
    with pytest.raises(OSError, match="No space left"), ExperimentRun(experiment, tmp_path):
        pass
    assert resource.closed


def test_run_that_is_advanced_in_steps_equals_a_whole_run(tmp_path: Path) -> None:
    task = [{"do": "takeoff", "alt": 3}, {"do": "land"}]
    vehicle = {"name": "d", "home": {"lat": 50.0, "lon": 4.0}, "readyAfter": 1, "task": task}
    experiment = parse({"name": "test", "settle": 0, "vehicles": [vehicle], "checks": [{"check": "landed"}]})
    with ExperimentRun(experiment, tmp_path / "steps") as stepped:
        stepped.start()
        stepped.begin()
        assert stepped.advance(1.0)
        assert stepped.now_s == pytest.approx(1.0, abs=0.03)
        assert not stepped.over
        while stepped.advance(2.5):
            assert stepped.flights["d"].samples[-1].time_s <= stepped.now_s
        assert stepped.result().holds
    assert run(experiment, tmp_path / "whole").holds
    logs = [(tmp_path / name / "logs" / "test.mcap").read_bytes() for name in ("steps", "whole")]
    assert logs[0] == logs[1]


def test_run_is_aborted_at_its_timeout_in_any_step(experiment: Experiment, tmp_path: Path) -> None:
    grounded = parse({**experiment.to_dict(), "timeout": 3, "settle": 30})
    with ExperimentRun(grounded, tmp_path) as stepped:
        stepped.start()
        stepped.begin()
        assert stepped.advance(2.0)
        assert not stepped.advance(2.0)
        outcome = stepped.result()
    assert outcome.problem == "not completed within 3 s"
    assert not outcome.holds


def test_grants_cannot_be_reissued_without_services(testbed: EmptyTestbed) -> None:
    with pytest.raises(ExperimentError, match="cannot be reissued in mode vehicles; use mode standalone"):
        testbed.reissue([])


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Install the default handler of SIGINT. A background job of a shell would ignore SIGINT otherwise."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_signals_are_deferred_until_the_end_of_an_uninterrupted_block() -> None:
    steps = []
    with pytest.raises(KeyboardInterrupt):
        with uninterrupted():
            signal.raise_signal(signal.SIGINT)
            steps.append("inside")
        steps.append("after")
    assert steps == ["inside"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_guard_kills_process_groups_that_were_not_released(monkeypatch: pytest.MonkeyPatch) -> None:
    killed: list[int] = []
    monkeypatch.setattr(process_guard.os, "killpg", lambda group, _signal: killed.append(group))
    process_guard.guard(io.StringIO("41\n42\n43\n-42\n"))
    assert killed == [41, 43]


def test_summary_page_is_absent_after_an_incomplete_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def write_half(path: Path, text: str) -> None:
        path.write_bytes(text[:3].encode())
        raise disk_full()

    write_page(tmp_path, "# Whole")
    assert [path.name for path in tmp_path.iterdir()] == ["summary.md"]
    (tmp_path / "summary.md").unlink()
    monkeypatch.setattr(Path, "write_text", write_half)
    with pytest.raises(OSError, match="No space left"):
        write_page(tmp_path, "# Flight")
    assert not list(tmp_path.iterdir())


def test_report_is_written_first_then_figures_then_the_page(
    experiment: Experiment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail_to_draw(_content: object) -> None:
        raise disk_full()

    samples = [Sample(float(t), Place(50.0, 4.0, float(t)), 5.0, "GUIDED", t > 0, 0.8) for t in range(3)]
    flights = {"d": Flight("d", samples)}
    outcome = Outcome(experiment, tmp_path, flights, (), (), Findings(), (), (), 2.0, 2.0)
    monkeypatch.setattr(experiment_report, "draw_map", fail_to_draw)
    with pytest.raises(OSError, match="No space left"):
        experiment_report.write_outcome(outcome)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["report.json", "tracks.geojson"]


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (OSError(errno.ENOSPC, "No space left on device", "out/x/map.png"), "cannot read or write out/x/map.png: No"),
        (disk_full(), "aborted: No space left on device"),
        (TimeoutError("no answer"), "aborted: no answer"),
        (ConnectionResetError(), "aborted: ConnectionResetError"),
    ],
)
def test_experiment_command_reports_a_write_error_only_if_the_error_names_a_file(
    experiment: Experiment, error: OSError, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **_more: object) -> None:
        raise error

    monkeypatch.setattr(command_line, "interrupt_on_signals", lambda: None)
    monkeypatch.setattr(experiment_command, "load", lambda _file: experiment)
    monkeypatch.setattr(experiment_command, "run", fail)
    result = CliRunner().invoke(experiment_command.experiment, ["run", "x.yaml", "--out", "out"])
    assert result.exit_code == 1
    assert expected in result.output
    assert "None" not in result.output
