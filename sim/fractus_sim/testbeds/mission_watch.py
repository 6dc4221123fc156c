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
from fractus_sim.testbeds.kube_commands import NAMESPACE, SYSTEM, Kube, Object

POLL_S = 0.5
LANDING_TIMEOUT_S = 180.0
_DEPLOYED = {"Running", "Waiting", "TakingOff", "Flying", "Landed"}
Say = Callable[[str], None]
_LOG_LINE = re.compile(rb"\[pod/(?P<pod>[^/]+)/(?P<container>[^\]]+)\] (?P<text>.*)")


@dataclass
class Mission:
    """Observed state of a mission.

    Attributes:
        application: Name of the Application.
        times: Unix seconds of events: applied, planned, running, ended, landed.
        pods: Last observed state of each pod, by name.
        links: Changes of the traffic path: Unix seconds, node, cloud or direct, and reason.
        phase: Phase of the Application.
    """

    application: str
    times: dict[str, float] = field(default_factory=dict)
    pods: dict[str, Object] = field(default_factory=dict)
    links: list[Object] = field(default_factory=list)
    phase: str = ""
    message: str = ""
    drone: str = ""
    flight_state: str = ""
    _running: int = 0

    def see(self, objects: list[Object], now_s: float, say: Say) -> None:
        """Read the objects of the cluster and report changes."""
        for body in objects:
            kind = body["kind"]
            name = body["metadata"]["name"]
            if kind == "Application" and name == self.application:
                self._see_application(body, now_s, say)
            elif kind == "DeploymentPlan" and name == self.application and "planned" not in self.times:
                self.times["planned"] = now_s
                placements = body["spec"].get("placements", [])
                say(
                    f"plan created after {now_s - self.times['applied']:.1f} s: {len(placements)} instances, {_drone(body)}"
                )
            elif kind == "Pod" and not _ends(body):
                self.pods[name] = body
            elif kind == "DirectLink" and body["spec"]["application"]["name"] == self.application:
                self._see_link(body, now_s, say)
            elif kind == "Drone" and name == self.drone:
                self._see_drone(body, now_s, say)
        self._see_pods(now_s, say)

    @property
    def ended(self) -> bool:
        """True if the mission of the Application has ended. The drone may still be returning."""
        return self.phase in {"Returning", "Completed", "Failed", "Invalid"}

    @property
    def grounded(self) -> bool:
        """True if the drone is on the ground according to its agent and the operator."""
        return self.phase != "Returning" and (self.flight_state in GROUNDED or not self.drone)

    def _see_application(self, body: Object, now_s: float, say: Say) -> None:
        status = body.get("status") or {}
        phase = status.get("phase", "")
        message = status.get("message", "")
        self.drone = status.get("drone") or self.drone
        if (phase, message) != (self.phase, self.message):
            say(f"application {phase or 'new'}{': ' + message if message else ''}")
        self.phase = phase
        self.message = message
        if self.ended and "ended" not in self.times:
            self.times["ended"] = now_s

    def _see_drone(self, body: Object, now_s: float, say: Say) -> None:
        state = (body.get("status") or {}).get("flightState", "")
        if state == self.flight_state:
            return
        if state in GROUNDED and self.flight_state and "running" in self.times:
            self.times["landed"] = now_s
        self.flight_state = state
        say(f"{self.drone} is {_words(state)}")

    def _see_link(self, body: Object, now_s: float, say: Say) -> None:
        node = body["spec"]["node"]
        status = body.get("status") or {}
        traffic = status.get("traffic") or "cloud"
        before = next((change["traffic"] for change in reversed(self.links) if change["node"] == node), "cloud")
        if traffic != before:
            why = status.get("message", "")
            self.links.append({"time": now_s, "node": node, "traffic": traffic, "why": why})
            path = f"to the direct link to {node}" if traffic == "direct" else f"from {node} to the cloud path"
            say(f"traffic moved {path}: {why}")

    def _see_pods(self, now_s: float, say: Say) -> None:
        running = sum(map(is_ready, self.pods.values()))
        if running > self._running:
            say(f"pods Running: {running} of {len(self.pods)}")
        self._running = running
        if self.phase in _DEPLOYED and running == len(self.pods) > 0 and "running" not in self.times:
            self.times["running"] = now_s
            say(f"all pods Running after {now_s - self.times['applied']:.1f} s")


def follow(kube: Kube, mission: Mission, logs: Path, *, timeout_s: float, say: Say, show: Say) -> None:
    """Observe the mission until it has ended and the drone has landed.

    Args:
        kube: Cluster.
        mission: Mission to update. `times["applied"]` must be set.
        logs: File for the logs of the components.
        timeout_s: Maximum duration of the mission without the landing.
        say: Called with one line per change.
        show: Called with the current state for a status line.

    Raises:
        ExperimentError: The timeout expired.
    """
    deadline = mission.times["applied"] + timeout_s
    tail: subprocess.Popen[bytes] | None = None
    told = 0
    with logs.open("wb") as out:
        try:
            while not (mission.ended and mission.grounded):
                now = time.time()
                mission.see(kube.objects("applications,deploymentplans,pods,drones,directlinks"), now, say)
                if mission.ended and deadline < now + LANDING_TIMEOUT_S:
                    deadline = max(deadline, mission.times["ended"] + LANDING_TIMEOUT_S)
                if now > deadline:
                    raise ExperimentError(
                        f"the mission did not end within {timeout_s:.0f} s: {mission.message or mission.phase}"
                    )
                if tail is None and "running" in mission.times:
                    selector = f"fractus.dev/application={mission.application}"
                    tail = kube.follow(
                        ["logs", "-n", NAMESPACE, "-l", selector, "-f", "--prefix", "--tail=-1", "--max-log-requests=50"], out
                    )  # fmt: skip
                told = _tell(logs, told, say)
                show(
                    f"{now - mission.times['applied']:.0f} s  {mission.phase}  {mission.drone} {_words(mission.flight_state)}"
                )
                time.sleep(POLL_S)
            _tell(logs, told, say)
        finally:
            if tail is not None:
                tail.terminate()
                tail.wait(timeout=10)


def wait_ready(kube: Kube, timeout_s: float, show: Say) -> None:
    """Wait until a drone reports that it is ready to fly.

    Raises:
        ExperimentError: No drone was ready before the timeout. The message contains its condition.
    """
    deadline = time.monotonic() + timeout_s
    reason = "no Drone has registered"
    while time.monotonic() < deadline:
        for body in kube.objects("drones"):
            ready = [c for c in (body.get("status") or {}).get("conditions", ()) if c["type"] == "Ready"]
            if ready and ready[0]["status"] == "True":
                return
            reason = f"{body['metadata']['name']}: " + (ready[0].get("message") if ready else "has not reported yet")
        show(reason)
        time.sleep(POLL_S)
    sick = "; ".join(_sick(kube)) or "see: kubectl -n fractus-system get pods"
    raise ExperimentError(f"no drone was ready within {timeout_s:.0f} s ({reason}); {sick}")


def _sick(kube: Kube) -> list[str]:
    """Return the system pods that fail to start, with the reason."""
    found = []
    for pod in kube.objects("pods", SYSTEM):
        for container in pod.get("status", {}).get("containerStatuses", ()):
            waiting = container.get("state", {}).get("waiting", {})
            if waiting.get("reason") in {"CrashLoopBackOff", "ErrImageNeverPull", "ImagePullBackOff", "ErrImagePull"}:
                found.append(f"pod {pod['metadata']['name']} is in {waiting['reason']}")
    return found


def _tell(logs: Path, start: int, say: Say) -> int:
    """Report new log lines of the driver. Return the offset where the next call continues."""
    with logs.open("rb") as file:
        file.seek(start)
        fresh = file.read()
    end = fresh.rfind(b"\n") + 1
    for line in fresh[:end].splitlines():
        match = _LOG_LINE.match(line)
        if match and match["container"] == b"navigator":
            say("navigator: " + match["text"].decode("utf-8", "replace"))
    return start + end


def _ends(pod: Object) -> bool:
    """Return True if a pod's mission has ended, so its last running state is kept."""
    metadata = pod["metadata"]
    return "deletionTimestamp" in metadata or "fractus.dev/finished" in metadata.get("labels", {})


def _drone(plan: Object) -> str:
    return f"{plan['spec']['drone']['node']} flies" if plan["spec"].get("drone") else "no drone"


def _words(state: str) -> str:
    return {"takingOff": "taking off", "inactive": "on the ground"}.get(state, state)
