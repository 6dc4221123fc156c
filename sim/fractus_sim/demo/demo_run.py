"""The steps of the demo: images, cluster, installation, mission, report and clean-up."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from fractus_core.api.nodes import GROUNDED
from rich.console import Console

from fractus_sim.demo.demo_clusters import EXAMPLE_IMAGE, CurrentCluster
from fractus_sim.demo.mission_data import RECORDINGS, collect_mission_data, extract_pictures, fetch_recordings
from fractus_sim.errors import ExperimentError
from fractus_sim.progress import Progress
from fractus_sim.report.flight_record import AUDIT, OBJECTS, PICTURES, FlightRecord
from fractus_sim.report.html_page import HTML_PAGE
from fractus_sim.report.mission_report import mission_results, write_mission_report
from fractus_sim.report.report_files import remove_report
from fractus_sim.testbeds.embedded_cluster import (
    CHARTS,
    READY_TIMEOUT_S,
    ROOT,
    TRAFFIC_EXAMPLE,
    FractusCluster,
    read_objects,
    traffic_example_objects,
)
from fractus_sim.testbeds.kube_commands import SYSTEM, Kube
from fractus_sim.testbeds.mission_watch import Mission, follow_mission, wait_for_drone

LANDING_TIMEOUT_S = 180.0
_STOP_TIMEOUT_S = 10.0
LOGS = "components.log"
_CHART_VALUES = {"fractus": ("camera.recordings.enabled=true",)}
"""Chart values for an embedded cluster. The report takes its pictures from recordings."""


class ConsoleProgress:
    """Prints progress: one line per event, and a status line for the current step."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._status = console.status("")
        self._start = time.monotonic()

    def report(self, line: str) -> None:
        """Print a line with the time since the start."""
        stamp = f"[dim]{time.monotonic() - self._start:7.1f} s[/dim]"
        # The clean-up must run even if the terminal is closed.
        with suppress(OSError):
            self._console.print(f"{stamp}  {_escaped(line)}", highlight=False, soft_wrap=True)

    def show(self, line: str) -> None:
        """Update the status line."""
        self._status.update(_escaped(line))

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Announce a step, and print its duration at the end."""
        started = time.monotonic()
        self.report(f"{name} ...")
        self.show(name)
        with suppress(OSError):
            self._status.start()
        try:
            yield
        finally:
            with suppress(OSError):
                self._status.stop()
        self.report(f"{name}: {time.monotonic() - started:.1f} s")


def _escaped(line: str) -> str:
    return line.replace("[", r"\[")


@dataclass
class Demo:
    """One run of the demo.

    Attributes:
        cluster: The user's cluster or an embedded cluster. The demo removes an embedded cluster that it started.
        out: Output folder of the report.
        keep: Do not remove cluster, Fractus and objects at the end.
        timeout_s: Maximum duration of the mission.
        progress: Output of progress lines.
    """

    cluster: FractusCluster | CurrentCluster
    out: Path
    keep: bool
    timeout_s: float
    progress: ConsoleProgress

    def run(self) -> bool:
        """Run all steps. After a failure, the report is still written and the cluster is still cleaned up.

        Returns:
            True if the mission completed, one request was corrected and one denied, and the drone landed.

        Raises:
            ExperimentError: A step failed.
        """
        self.out.mkdir(parents=True, exist_ok=True)
        remove_report(self.out, OBJECTS, HTML_PAGE, "events.json", LOGS)
        for folder in (AUDIT, PICTURES, RECORDINGS):
            shutil.rmtree(self.out / folder, ignore_errors=True)
        kube: Kube | None = None
        installed: list[str] = []
        try:
            if isinstance(self.cluster, FractusCluster):
                with self.progress.step("images"):
                    self.cluster.build_images([EXAMPLE_IMAGE])
            with self.progress.step("cluster"):
                kube = self.cluster.start() if isinstance(self.cluster, FractusCluster) else self.cluster.connect()
            with self.progress.step("removing objects of an earlier run"):
                self._remove_application(kube)
            with self.progress.step("Fractus"):
                self._install(kube, installed)
            return self._fly(kube)
        finally:
            if not self.keep:
                with self.progress.step("cleaning up"):
                    self._clean_up(kube, installed)

    def _install(self, kube: Kube, installed: list[str]) -> None:
        """Install Fractus and the environment of the example. Add the newly installed releases to `installed`."""
        for chart in CHARTS:
            # The chart values of the user's cluster are not changed.
            values = _CHART_VALUES.get(chart, ()) if isinstance(self.cluster, FractusCluster) else ()
            if kube.install(chart, ROOT / "charts" / chart, values):
                installed.append(chart)
        if isinstance(self.cluster, CurrentCluster):
            installed.extend(self.cluster.create_environment(kube))
        else:
            if "fractus" not in installed:
                # The images may have new content under the same names. Restart all pods, so that they use it.
                selector = ["-l", "app.kubernetes.io/name=fractus"]
                kube.run("delete", "pods", "-n", SYSTEM, *selector, "--timeout=60s", timeout_s=90)
            # Drones are not applied here: the agents register the vehicles of the embedded cluster.
            kube.apply(traffic_example_objects())
        wait_for_drone(kube, READY_TIMEOUT_S, self.progress.show)

    def _fly(self, kube: Kube) -> bool:
        application = read_objects(TRAFFIC_EXAMPLE / "application.yaml")
        mission = Mission(application[0]["metadata"]["name"])
        logs = self.out / LOGS
        progress = Progress(self.progress.report, self.progress.show)
        with self.progress.step("mission"):
            mission.times["applied"] = time.time()
            kube.apply(application)
            try:
                with live_view(kube.kubeconfig, self.progress.report):
                    follow_mission(kube, mission, logs, progress, timeout_s=self.timeout_s)
            finally:
                collect_mission_data(kube, mission, self.out, logs)
                self._fetch_recordings(kube, mission)
                record = FlightRecord.read(self.out)
                write_mission_report(record, self.out)
        return self._expectations_hold(record)

    def _fetch_recordings(self, kube: Kube, mission: Mission) -> None:
        try:
            recordings = fetch_recordings(kube, mission.drone, mission.times["applied"], self.out)
            extract_pictures(recordings, FlightRecord.read(self.out), self.out)
        except ExperimentError as error:
            self.progress.report(f"no recording of the flight: {error}")
            return
        if not recordings:
            self.progress.report("no recording of the flight: the services of the drone do not record")
        elif not any((self.out / PICTURES).glob("*")):
            self.progress.report(
                "no pictures of the flight: the camera service does not record (chart value camera.recordings.enabled)"
            )

    def _expectations_hold(self, record: FlightRecord) -> bool:
        results = mission_results(record)
        failures = {
            "the mission is not Completed": results["phase"] != "Completed",
            "no request was corrected": results["corrected"] == 0,
            "no request was denied": results["refused"] == 0,
            "the drone has not landed": not results["landed"],
            "the audit log is not valid": results["audit"].get("problem") != "",
        }
        failed = [text for text, fails in failures.items() if fails]
        for text in failed:
            self.progress.report(f"expectation not met: {text}")
        return not failed

    def _clean_up(self, kube: Kube | None, installed: list[str]) -> None:
        if isinstance(self.cluster, FractusCluster):
            self.cluster.remove_if_started()
        elif kube is not None:
            try:
                self._remove_application(kube)
                for release in reversed(installed):
                    kube.uninstall(release)
            except ExperimentError as error:
                self.progress.report(f"clean-up failed: {error}")

    def _remove_application(self, kube: Kube) -> None:
        """Delete the application and wait until all drones have landed.

        Raises:
            ExperimentError: A drone is still in the air after the timeout.
        """
        if "applications.fractus.dev" not in kube.run("get", "crd", "-o", "name"):
            return
        kube.delete(read_objects(TRAFFIC_EXAMPLE / "application.yaml"), LANDING_TIMEOUT_S)
        deadline = time.monotonic() + LANDING_TIMEOUT_S
        while time.monotonic() < deadline:
            states = {(body.get("status") or {}).get("flightState") for body in kube.objects("drones")}
            if states <= {*GROUNDED, None}:
                return
            self.progress.show("waiting for the drone to land")
            time.sleep(1.0)
        raise ExperimentError(
            f"a drone is still in the air {LANDING_TIMEOUT_S:.0f} s after its application was deleted"
        )


def rewrite_report(out: Path) -> None:
    """Write the report of an earlier run again from its recorded data.

    Raises:
        ExperimentError: The folder contains no recorded data.
    """
    try:
        write_mission_report(FlightRecord.read(out), out)
    except (OSError, json.JSONDecodeError) as error:
        raise ExperimentError(f"no recorded flight in {out}: {error}") from None


@contextmanager
def live_view(kubeconfig: Path, report: Callable[[str], None]) -> Iterator[None]:
    """Serve the page of `fractus view` and report its address. The demo continues if the page cannot be served."""
    command = [sys.executable, "-m", "fractus_cli", "view", "--kubeconfig", str(kubeconfig), "--listen", "127.0.0.1:0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:

        def report_address() -> None:
            line = process.stdout.readline().strip() if process.stdout is not None else ""
            _, separator, address = line.partition("view: open ")
            if separator:
                report(f"live view: {address}")
            elif line:
                report(f"live view not available: {line}")

        # The mission does not wait until the page is served.
        reader = threading.Thread(target=report_address, daemon=True)
        reader.start()
        try:
            yield
        finally:
            process.terminate()
            try:
                process.wait(_STOP_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                process.kill()
            reader.join(_STOP_TIMEOUT_S)


def replay_command(folder: Path) -> str | None:
    """Return the command that shows the recordings of a report, or None without recordings."""
    recordings = folder / RECORDINGS
    return f"fractus view {recordings}/*.mcap" if any(recordings.glob("*.mcap")) else None
