"""Observation of a mission on a cluster from apply to landing, with a progress line for each change."""

from __future__ import annotations

import re
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from fractus_cluster.manifests import is_ready
from fractus_core.api.nodes import GROUNDED

from fractus_sim.errors import ExperimentError
from fractus_sim.progress import Progress, ignore
from fractus_sim.testbeds.kube_commands import NAMESPACE, SYSTEM, Kube, Object

POLL_S = 0.5
LANDING_TIMEOUT_S = 180.0
_DEPLOYED_PHASES = frozenset({"Running", "Waiting", "TakingOff", "Flying", "Landed"})
_START_FAILURES = frozenset({"CrashLoopBackOff", "ErrImageNeverPull", "ImagePullBackOff", "ErrImagePull"})
_STATE_WORDS = {"takingOff": "taking off", "inactive": "on the ground"}
_LOG_LINE = re.compile(rb"\[pod/(?P<pod>[^/]+)/(?P<container>[^\]]+)\] (?P<text>.*)")
Report = Callable[[str], None]


@dataclass
class Mission:
    """Observed state of a mission.

    Attributes:
        application: Name of the Application.
        times: Unix seconds of events: applied, planned, running, ended, landed.
        pods: Last observed state of each pod, by name.
        links: Changes of the traffic path, each with time (Unix seconds), node, new path and reason.
        phase: Phase of the Application.
        message: Message of the Application.
        drone: Name of the drone. Empty until one is selected.
        flight_state: Flight state of the drone that its agent reported.
        namespace: Namespace of the Application.
    """

    application: str
    times: dict[str, float] = field(default_factory=dict)
    pods: dict[str, Object] = field(default_factory=dict)
    links: list[Object] = field(default_factory=list)
    phase: str = ""
    message: str = ""
    drone: str = ""
    flight_state: str = ""
    namespace: str = NAMESPACE
    _running_pods: int = 0

    def update(self, objects: list[Object], now_s: float, report: Report) -> None:
        """Read the objects of the cluster and report changes."""
        for body in objects:
            kind = body["kind"]
            name = body["metadata"]["name"]
            if kind == "Application" and name == self.application:
                self._update_application(body, now_s, report)
            elif kind == "DeploymentPlan" and name == self.application and "planned" not in self.times:
                self.times["planned"] = now_s
                placements = body["spec"].get("placements", [])
                drone = f"{body['spec']['drone']['node']} flies" if body["spec"].get("drone") else "no drone"
                report(
                    f"plan created after {now_s - self.times['applied']:.1f} s: {len(placements)} instances, {drone}"
                )
            elif kind == "Pod" and not _is_stopping(body):
                self.pods[name] = body
            elif kind == "DirectLink" and body["spec"]["application"]["name"] == self.application:
                self._update_traffic(body, now_s, report)
            elif kind == "Drone" and name == self.drone:
                self._update_drone(body, now_s, report)
        self._update_running_pods(now_s, report)

    @property
    def ended(self) -> bool:
        """True if the mission of the Application has ended. The drone may still be returning."""
        return self.phase in {"Returning", "Completed", "Failed", "Invalid"}

    @property
    def grounded(self) -> bool:
        """True if the drone is on the ground according to its agent and the operator."""
        return self.phase != "Returning" and (self.flight_state in GROUNDED or not self.drone)

    @property
    def flight_state_words(self) -> str:
        """Flight state of the drone as words."""
        return _STATE_WORDS.get(self.flight_state, self.flight_state)

    def _update_application(self, body: Object, now_s: float, report: Report) -> None:
        status = body.get("status") or {}
        phase = status.get("phase", "")
        message = status.get("message", "")
        self.drone = status.get("drone") or self.drone
        if (phase, message) != (self.phase, self.message):
            detail = f": {message}" if message else ""
            report(f"application {phase or 'new'}{detail}")
        self.phase = phase
        self.message = message
        if self.ended and "ended" not in self.times:
            self.times["ended"] = now_s

    def _update_drone(self, body: Object, now_s: float, report: Report) -> None:
        state = (body.get("status") or {}).get("flightState", "")
        if state == self.flight_state:
            return
        if state in GROUNDED and self.flight_state and "running" in self.times:
            self.times["landed"] = now_s
        self.flight_state = state
        report(f"{self.drone} is {self.flight_state_words}")

    def _update_traffic(self, body: Object, now_s: float, report: Report) -> None:
        node = body["spec"]["node"]
        status = body.get("status") or {}
        traffic = status.get("traffic") or "cloud"
        before = next((change["traffic"] for change in reversed(self.links) if change["node"] == node), "cloud")
        if traffic != before:
            reason = status.get("message", "")
            self.links.append({"time": now_s, "node": node, "traffic": traffic, "why": reason})
            path = f"to the direct link to {node}" if traffic == "direct" else f"from {node} to the cloud path"
            report(f"traffic moved {path}: {reason}")

    def _update_running_pods(self, now_s: float, report: Report) -> None:
        running = sum(map(is_ready, self.pods.values()))
        if running > self._running_pods:
            report(f"pods Running: {running} of {len(self.pods)}")
        self._running_pods = running
        if self.phase in _DEPLOYED_PHASES and running == len(self.pods) > 0 and "running" not in self.times:
            self.times["running"] = now_s
            report(f"all pods Running after {now_s - self.times['applied']:.1f} s")


def follow_mission(kube: Kube, mission: Mission, logs: Path, progress: Progress, *, timeout_s: float) -> None:
    """Observe a mission until it has ended and the drone has landed.

    Args:
        kube: Cluster.
        mission: Mission to update. `times["applied"]` must be set.
        logs: File for the logs of the components.
        progress: Callbacks for progress.
        timeout_s: Maximum duration of the mission without the landing.

    Raises:
        ExperimentError: The timeout expired.
    """
    deadline = mission.times["applied"] + timeout_s
    log_follower: subprocess.Popen[bytes] | None = None
    reported = 0
    with logs.open("wb") as out:
        try:
            while not (mission.ended and mission.grounded):
                now = time.time()
                objects = kube.objects("applications,deploymentplans,pods,drones,directlinks")
                mission.update(objects, now, progress.report)
                if mission.ended and deadline < now + LANDING_TIMEOUT_S:
                    deadline = max(deadline, mission.times["ended"] + LANDING_TIMEOUT_S)
                if now > deadline:
                    state = mission.message or mission.phase
                    raise ExperimentError(f"the mission did not end within {timeout_s:.0f} s: {state}")
                if log_follower is None and "running" in mission.times:
                    selector = f"fractus.dev/application={mission.application}"
                    arguments = ["-l", selector, "-f", "--prefix", "--tail=-1", "--max-log-requests=50"]
                    log_follower = kube.follow(["logs", "-n", NAMESPACE, *arguments], out)
                reported = report_driver_lines(logs, reported, progress.report)
                elapsed_s = now - mission.times["applied"]
                progress.show(f"{elapsed_s:.0f} s  {mission.phase}  {mission.drone} {mission.flight_state_words}")
                time.sleep(POLL_S)
            report_driver_lines(logs, reported, progress.report)
        finally:
            if log_follower is not None:
                log_follower.terminate()
                log_follower.wait(timeout=10)


def report_driver_lines(logs: Path, start: int, report: Report) -> int:
    """Report the complete lines that the Navigator has logged since the last call.

    Returns:
        Offset in the file at which the next call continues.
    """
    with logs.open("rb") as file:
        file.seek(start)
        data = file.read()
    end = data.rfind(b"\n") + 1
    for line in data[:end].splitlines():
        match = _LOG_LINE.match(line)
        if match and match["container"] == b"navigator":
            report("navigator: " + match["text"].decode("utf-8", "replace"))
    return start + end


def wait_for_drone(kube: Kube, timeout_s: float, show: Report = ignore) -> None:
    """Wait until a drone reports that it is ready to fly.

    Args:
        kube: Cluster.
        timeout_s: Maximum time to wait, seconds.
        show: Called repeatedly with the reason why no drone is ready.

    Raises:
        ExperimentError: No drone was ready before the timeout. The message contains its condition.
    """
    deadline = time.monotonic() + timeout_s
    reason = "no Drone has registered"
    while time.monotonic() < deadline:
        for body in kube.objects("drones"):
            conditions = (body.get("status") or {}).get("conditions", ())
            ready = next((condition for condition in conditions if condition["type"] == "Ready"), None)
            if ready is not None and ready["status"] == "True":
                return
            detail = "has not reported yet" if ready is None else ready.get("message")
            reason = f"{body['metadata']['name']}: {detail}"
        show(reason)
        time.sleep(POLL_S)
    failures = "; ".join(_start_failures(kube)) or "see: kubectl -n fractus-system get pods"
    raise ExperimentError(f"no drone was ready within {timeout_s:.0f} s ({reason}); {failures}")


def _start_failures(kube: Kube) -> list[str]:
    """Describe the system pods that fail to start."""
    failures = []
    for pod in kube.objects("pods", SYSTEM):
        for container in pod.get("status", {}).get("containerStatuses", ()):
            reason = container.get("state", {}).get("waiting", {}).get("reason")
            if reason in _START_FAILURES:
                failures.append(f"pod {pod['metadata']['name']} is in {reason}")
    return failures


def _is_stopping(pod: Object) -> bool:
    """Return True if a pod is being deleted or has stopped after its mission. Its earlier state is then kept."""
    metadata = pod["metadata"]
    return "deletionTimestamp" in metadata or "fractus.dev/finished" in metadata.get("labels", {})
