"""Chaos faults. Each fault is a generator that injects it, yields a description, and repairs it at exit."""

from __future__ import annotations

import errno
import math
import os
import random
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Generator, Iterable, Mapping
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from typing import IO

from fractus_core.api.names import CLASS_LABEL

from fractus_sim.chaos import api_server_faults, clock_faults, process_lookup
from fractus_sim.chaos.api_server_faults import held
from fractus_sim.chaos.chaos_cluster import Stage
from fractus_sim.errors import ExperimentError
from fractus_sim.testbeds.kube_commands import NAMESPACE, SYSTEM

Breaking = Generator[str, None, None]

MIN_STEP_S = 30.0
MAX_STEP_S = 26 * 3600.0
"""Clock offset. NTP makes smaller steps all the time, and no certificate here is valid for longer than the maximum."""

BALLAST = "ballast"
"""File that fills a disk."""

_HEAL_TIMEOUT_S = 180.0
_FILL_S = 0.2
_RETRY_S = 1.0
_LANDING_S = 60.0
_RECONCILE_S = 4.0


@dataclass(frozen=True, slots=True)
class Fault:
    """A type of fault.

    Attributes:
        breaks: Injects the fault, yields its description, and repairs it.
        shortest_s: Minimum duration. 0 for instantaneous faults.
        longest_s: Maximum duration. 0 for instantaneous faults.
    """

    breaks: Callable[[Stage, random.Random], Breaking]
    shortest_s: float = 0.0
    longest_s: float = 0.0


def broken(fault: Fault, stage: Stage, chance: random.Random) -> AbstractContextManager[str]:
    """Return the fault as a context manager.

    Raises:
        ExperimentError: The target does not exist, or the API server rejected the fault.
    """
    return contextmanager(fault.breaks)(stage, chance)


def _tell(pids: Iterable[int], number: signal.Signals, owner: str) -> None:
    if not process_lookup.send_signal(pids, number):
        raise ExperimentError(f"{owner} has no process")


def _kill_operator(stage: Stage, chance: random.Random) -> Breaking:
    """Kill the leading operator, half of the time shortly after an Application was applied."""
    when = "at a random moment"
    if chance.random() < 0.5 and stage.applied.wait(20.0):
        time.sleep(chance.uniform(0, _RECONCILE_S))
        when = "during reconciliation"
    pod = stage.leader()
    _tell(process_lookup.of_pod(pod["metadata"]["uid"]), signal.SIGKILL, pod["metadata"]["name"])
    yield f"killed {pod['metadata']['name']} {when}"


def _kill_process(stage: Stage, chance: random.Random) -> Breaking:
    component = chance.choice(["agent", "mobility", "camera", "driver"])
    if component == "driver":
        pods = stage.objects("pods", "-n", NAMESPACE, "-l", "fractus.dev/component=Navigator")
        running = [pod for pod in pods if pod["status"].get("phase") == "Running"]
        if not running:
            raise ExperimentError("no driver is running")
        pod = running[0]
    else:
        pod = stage.system_pod(component, stage.drone)
    _tell(process_lookup.of_pod(pod["metadata"]["uid"]), signal.SIGKILL, pod["metadata"]["name"])
    yield f"killed {pod['metadata']['name']}"


def _api_down(stage: Stage, _chance: random.Random) -> Breaking:
    with api_server_faults.refused(stage.control_plane):
        _tell(stage.program("kube-apiserver"), signal.SIGKILL, "the API server")
        yield "the API server is down"


def _silent_watches(stage: Stage, _chance: random.Random) -> Breaking:
    with api_server_faults.silenced(stage.control_plane) as count:
        yield f"{count} connections to the API server are silent"


def _slow_api(stage: Stage, _chance: random.Random) -> Breaking:
    with api_server_faults.slowed(lambda: stage.program("kube-apiserver")):
        yield f"the API server responds after {api_server_faults.SLOW_S:g} s"


def _too_many_requests(stage: Stage, _chance: random.Random) -> Breaking:
    try:
        stage.kube.run("apply", "-f", "-", stdin=api_server_faults.no_room(), timeout_s=20.0)
        with api_server_faults.occupied(stage.kube):
            yield "the API server rejects requests of Fractus with 429"
    finally:
        _until_done(lambda: stage.kubectl("delete", "--ignore-not-found", *api_server_faults.RULES))


def _conflicts(stage: Stage, _chance: random.Random) -> Breaking:
    """Annotate all objects continuously, so that other writers get conflicts (409)."""
    kinds = ",".join(
        f"{kind}.fractus.dev" for kind in ("applications", "deploymentplans", "grants", "nodegrants", "drones")
    )

    def write(over: threading.Event) -> None:
        count = 0
        while not over.is_set():
            count += 1
            with suppress(ExperimentError):
                stage.kubectl("annotate", kinds, "--all", "-A", f"fractus-chaos={count}", "--overwrite")

    with held(write):
        yield "all objects of Fractus are updated continuously"


def _restart_etcd(stage: Stage, _chance: random.Random) -> Breaking:
    _tell(stage.program("etcd"), signal.SIGKILL, "etcd")
    yield "killed etcd, which restarts"


def _stop_kubelet(stage: Stage, chance: random.Random) -> Breaking:
    node = _some_node(stage, chance)
    _tell(stage.program("kubelet", node), signal.SIGSTOP, f"the kubelet of {node}")
    try:
        yield f"the kubelet of {node} hangs"
    finally:
        process_lookup.send_signal(stage.program("kubelet", node), signal.SIGCONT)


def _power_off(stage: Stage, chance: random.Random) -> Breaking:
    node = _some_node(stage, chance)
    stage.cluster.set_power(node, on=False)
    try:
        yield f"{node} is powered off"
    finally:
        stage.cluster.set_power(node, on=True)


def _cut_link(stage: Stage, chance: random.Random) -> Breaking:
    node = stage.cluster.node(_some_node(stage, chance))
    node.cut_link()
    try:
        yield f"the link of {node.name} is cut"
    finally:
        node.heal_link()


def _delete_pod(stage: Stage, chance: random.Random) -> Breaking:
    pods = [*stage.objects("pods", "-n", NAMESPACE), *stage.objects("pods", "-n", SYSTEM)]
    pod = chance.choice(sorted(pods, key=lambda body: str(body["metadata"]["name"])))["metadata"]
    stage.kubectl("delete", "pod", pod["name"], "-n", pod["namespace"], "--force", "--grace-period=0", "--wait=false")
    yield f"force-deleted pod {pod['name']}"


def _drain(stage: Stage, chance: random.Random) -> Breaking:
    node = _some_node(stage, chance)
    try:
        drained = "drained"
        try:
            stage.kube.run(
                "drain",
                node,
                "--ignore-daemonsets",
                "--delete-emptydir-data",
                "--force",
                "--timeout=10s",
                timeout_s=30.0,
            )
        except ExperimentError as error:
            drained = f"drain failed ({str(error)[-120:]}) on"
        yield f"{drained} {node}"
    finally:
        # kubectl uncordon exits with 0 even if the API server rejects the request.
        schedulable = '{"spec": {"unschedulable": null}}'
        _until_done(lambda: stage.kubectl("patch", "node", node, "--type=merge", "-p", schedulable))


def _take_label(stage: Stage, chance: random.Random) -> Breaking:
    """Remove the class label of the drone or of an edge node. For a drone, this is rejected until it has landed."""
    edges = [node.name for node in stage.cluster.spec.nodes if node.node_class == "edge"]
    node, node_class = (stage.drone, "drone") if chance.random() < 0.5 else (chance.choice(edges), "edge")
    try:
        _until_done(lambda: stage.kubectl("label", "node", node, f"{CLASS_LABEL}-"), _LANDING_S)
        yield f"removed label {CLASS_LABEL} from {node}"
    finally:
        _until_done(lambda: stage.kubectl("label", "node", node, f"{CLASS_LABEL}={node_class}", "--overwrite"))


def _fill_disk(stage: Stage, _chance: random.Random) -> Breaking:
    """Fill the disk of the drone's node, including space that is freed during the fault."""
    if not stage.state.is_mount():
        raise ExperimentError(f"{stage.drone} has no separate disk")
    ballast = stage.state / BALLAST
    try:
        with ballast.open("wb") as file:
            _take_all(file)

            def fill(over: threading.Event) -> None:
                while not over.wait(_FILL_S):
                    _take_all(file)

            with held(fill):
                yield f"the disk of {stage.drone} is full"
    finally:
        ballast.unlink(missing_ok=True)


def _take_all(file: IO[bytes]) -> None:
    """Allocate all free blocks of the disk to a file."""
    end = os.fstat(file.fileno()).st_size
    piece = 1 << 30
    while piece:
        try:
            os.posix_fallocate(file.fileno(), end, piece)
        except OSError as error:
            if error.errno != errno.ENOSPC:
                raise
            piece //= 2
        else:
            end += piece


def _step_clock(stage: Stage, chance: random.Random) -> Breaking:
    """Step the clock of one or all services of the drone's node, as a node with a wrong time server."""
    if not clock_faults.can_step(stage.state):
        raise ExperimentError(f"clocks of {stage.drone} cannot be stepped")
    services = chance.choice([*((service,) for service in clock_faults.SERVICES), clock_faults.SERVICES])
    # Logarithmic distribution: minutes are as likely as hours.
    offset_s = chance.choice((-1, 1)) * math.exp(chance.uniform(math.log(MIN_STEP_S), math.log(MAX_STEP_S)))
    try:
        clock_faults.step(stage.state, services, offset_s)
        yield f"stepped clocks of {', '.join(services)} on {stage.drone} by {offset_s:+.0f} s"
    finally:
        clock_faults.step(stage.state, services, 0.0)


def _some_node(stage: Stage, chance: random.Random) -> str:
    """Select a node. The drone's node is selected half of the time."""
    others = [node.name for node in stage.cluster.spec.nodes if node.name != stage.drone]
    return stage.drone if chance.random() < 0.5 else chance.choice(others)


def _until_done(act: Callable[[], object], timeout_s: float = _HEAL_TIMEOUT_S) -> None:
    """Retry an action while the API server rejects it or is unavailable, because another fault may be active.

    Raises:
        ExperimentError: The action failed until the timeout.
    """
    deadline = time.monotonic() + timeout_s
    while True:
        try:
            act()
        except (ExperimentError, subprocess.SubprocessError):
            if time.monotonic() > deadline:
                raise
            time.sleep(_RETRY_S)
        else:
            return


FAULTS: Mapping[str, Fault] = {
    "operator-kill": Fault(_kill_operator),
    "process-kill": Fault(_kill_process),
    "api-down": Fault(_api_down, 10, 600),
    "api-slow": Fault(_slow_api, 10, 120),
    "api-429": Fault(_too_many_requests, 10, 120),
    "api-409": Fault(_conflicts, 10, 60),
    "watch-silent": Fault(_silent_watches, 20, 300),
    "etcd-restart": Fault(_restart_etcd),
    "kubelet-hang": Fault(_stop_kubelet, 10, 120),
    "power-off": Fault(_power_off, 5, 60),
    "link-cut": Fault(_cut_link, 10, 300),
    "pod-delete": Fault(_delete_pod),
    "drain": Fault(_drain, 5, 30),
    "label-removal": Fault(_take_label, 5, 30),
    "disk-full": Fault(_fill_disk, 10, 60),
    "clock-jump": Fault(_step_clock, 10, 120),
}
