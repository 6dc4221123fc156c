"""The steps of the demo: images, cluster, installation, mission, report and clean-up."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from fractus_core.api.nodes import GROUNDED
from rich.console import Console

from fractus_sim.demo.demo_clusters import EXAMPLE, RELEASES, ROOT, DemoCluster, documents
from fractus_sim.demo.live_view import RECORDINGS, fetch_recordings, shown
from fractus_sim.demo.mission_data import collect, keep_pictures
from fractus_sim.errors import ExperimentError
from fractus_sim.interruption import uninterrupted
from fractus_sim.report import Record, write_report
from fractus_sim.report.flight_record import AUDIT, OBJECTS, PICTURES
from fractus_sim.report.mission_report import figures
from fractus_sim.report.report_files import PAGE
from fractus_sim.testbeds.kube_commands import SYSTEM, Kube
from fractus_sim.testbeds.mission_watch import Mission, follow, wait_ready

READY_TIMEOUT_S = 180.0
HOME_TIMEOUT_S = 180.0
_OWN_VALUES = {"fractus": ("camera.recordings.enabled=true",)}
"""Chart values on a cluster of the demo. Recordings are needed because components delete their pictures."""
LOGS = "components.log"


class Teller:
    """Prints progress: one line per event, and a status line for the current step."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._status = console.status("")
        self._start = time.monotonic()

    def __call__(self, line: str) -> None:
        """Print a line."""
        stamp = f"[dim]{time.monotonic() - self._start:7.1f} s[/dim]"
        with suppress(OSError):  # # Terminal closed. The clean-up must still run.
            self._console.print(f"{stamp}  {_escaped(line)}", highlight=False, soft_wrap=True)

    def show(self, line: str) -> None:
        """Update the status line."""
        self._status.update(_escaped(line))

    @contextmanager
    def step(self, what: str) -> Iterator[None]:
        """Announce a step, and print its duration at the end."""
        started = time.monotonic()
        self(f"{what} ...")
        self.show(what)
        with suppress(OSError):
            self._status.start()
        try:
            yield
        finally:
            with suppress(OSError):
                self._status.stop()
        self(f"{what}: {time.monotonic() - started:.1f} s")


def _escaped(line: str) -> str:
    return line.replace("[", r"\[")


@dataclass
class Demo:
    """One run of the demo.

    Attributes:
        cluster: Cluster to use.
        out: Output folder of the report.
        keep: Do not remove cluster, Fractus and objects at the end.
        timeout_s: Maximum duration of the mission.
    """

    cluster: DemoCluster
    out: Path
    keep: bool
    timeout_s: float
    tell: Teller

    def run(self) -> bool:
        """Run all steps. After a failure, the report is still written and the cluster is still cleaned up.

        Returns:
            True if the mission completed, one request was corrected and one denied, and the drone landed.

        Raises:
            ExperimentError: A step failed.
            ClusterError: The embedded cluster did not start.
        """
        self.out.mkdir(parents=True, exist_ok=True)
        for stale in (PAGE, OBJECTS, "events.json", LOGS):
            (self.out / stale).unlink(missing_ok=True)
        for folder in (AUDIT, PICTURES, RECORDINGS):
            shutil.rmtree(self.out / folder, ignore_errors=True)
        kube: Kube | None = None
        installed: list[str] = []
        try:
            with self.tell.step("images"):
                self.cluster.images()
            with self.tell.step("cluster"):
                kube = self.cluster.up()
            with self.tell.step("removing objects of an earlier run"):
                self._remove_application(kube)
            with self.tell.step("Fractus"):
                self._install(kube, installed)
            return self._fly(kube)
        finally:
            if not self.keep:
                with self.tell.step("cleaning up"):
                    self._clean_up(kube, installed)

    def _install(self, kube: Kube, installed: list[str]) -> None:
        for release in RELEASES:
            # The values of a foreign cluster are not changed.
            values = _OWN_VALUES.get(release, ()) if self.cluster.disposable else ()
            installed.extend([release] if kube.install(release, ROOT / "charts" / release, values) else [])
        if self.cluster.disposable and "fractus" not in installed:  # # Images with the same name may have new content.
            kube.run(
                "delete", "pods", "-n", SYSTEM, "-l", "app.kubernetes.io/name=fractus", "--timeout=60s", timeout_s=90
            )
        installed.extend(self.cluster.surroundings(kube))
        wait_ready(kube, READY_TIMEOUT_S, self.tell.show)

    def _fly(self, kube: Kube) -> bool:
        application = documents(EXAMPLE / "application.yaml")
        mission = Mission(application[0]["metadata"]["name"])
        logs = self.out / LOGS
        with self.tell.step("mission"):
            mission.times["applied"] = time.time()
            kube.apply(application)
            try:
                with shown(kube.kubeconfig, self.tell):
                    follow(kube, mission, logs, timeout_s=self.timeout_s, say=self.tell, show=self.tell.show)
            finally:
                collect(kube, mission, self.out, logs)
                self._fetch_recordings(kube, mission)
                record = Record.read(self.out)
                write_report(record, self.out)
        return _as_promised(record, self.tell)

    def _fetch_recordings(self, kube: Kube, mission: Mission) -> None:
        try:
            recordings = fetch_recordings(kube, mission.drone, mission.times["applied"], self.out)
            keep_pictures(recordings, Record.read(self.out), self.out)
        except ExperimentError as error:
            self.tell(f"no recording of the flight: {error}")
            return
        if not recordings:
            self.tell("no recording of the flight: the services of the drone do not record")
        elif not any((self.out / PICTURES).glob("*")):
            self.tell(
                "no pictures of the flight: the camera service does not record (chart value camera.recordings.enabled)"
            )

    def _clean_up(self, kube: Kube | None, installed: list[str]) -> None:
        if kube is not None and not self.cluster.disposable:
            try:
                self._remove(kube, installed)
            except ExperimentError as error:
                self.tell(f"clean-up failed: {error}")
        with uninterrupted():
            self.cluster.down()

    def _remove_application(self, kube: Kube) -> None:
        """Delete the application and wait until all drones have landed."""
        if "applications.fractus.dev" not in kube.run("get", "crd", "-o", "name"):
            return
        kube.delete(documents(EXAMPLE / "application.yaml"), HOME_TIMEOUT_S)
        deadline = time.monotonic() + HOME_TIMEOUT_S
        while time.monotonic() < deadline:
            states = {(body.get("status") or {}).get("flightState") for body in kube.objects("drones")}
            if states <= {*GROUNDED, None}:
                return
            self.tell.show("waiting for the drone to land")
            time.sleep(1.0)
        raise ExperimentError(f"a drone is still in the air {HOME_TIMEOUT_S:.0f} s after its application was deleted")

    def _remove(self, kube: Kube, installed: list[str]) -> None:
        self._remove_application(kube)
        for release in reversed(installed):
            kube.uninstall(release)


def _as_promised(record: Record, tell: Teller) -> bool:
    found = figures(record)
    missing = [
        what
        for what, holds in (
            ("the mission is not Completed", found["phase"] == "Completed"),
            ("no request was corrected", found["corrected"] > 0),
            ("no request was denied", found["refused"] > 0),
            ("the drone has not landed", found["landed"]),
            ("the audit log is not valid", found["audit"].get("problem") == ""),
        )
        if not holds
    ]
    for what in missing:
        tell(f"expectation not met: {what}")
    return not missing


def report_again(out: Path) -> None:
    """Write the report of an earlier run again from its recorded data.

    Raises:
        ExperimentError: The folder contains no recorded data.
    """
    try:
        write_report(Record.read(out), out)
    except (OSError, json.JSONDecodeError) as error:
        raise ExperimentError(f"no recorded flight in {out}: {error}") from None
