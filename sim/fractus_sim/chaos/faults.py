"""The faults: each breaks something, says what, and makes it good again when it is left."""

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

from fractus_sim.chaos import apiserver, clocks, processes
from fractus_sim.chaos.holding import held
from fractus_sim.chaos.stage import Stage
from fractus_sim.demo.kube import NAMESPACE, SYSTEM, DemoError

Breaking = Generator[str, None, None]

MIN_STEP_S, MAX_STEP_S = 30.0, 26 * 3600.0
"""Of a clock: less is what NTP does all the time, and more is longer than any certificate here is valid."""

BALLAST = "ballast"
"""The file that takes a disk."""

_HEAL_TIMEOUT_S = 180.0
_FILL_S = 0.2
_RETRY_S = 1.0
_LANDING_S = 60.0
_RECONCILE_S = 4.0


@dataclass(frozen=True, slots=True)
class Fault:
    """A kind of fault.

    Attributes:
        breaks: breaks a stage, yields what it did, and heals it afterwards.
        shortest_s: of its duration; 0 for what is over at once.
        longest_s: the same.
    """

    breaks: Callable[[Stage, random.Random], Breaking]
    shortest_s: float = 0.0
    longest_s: float = 0.0


def broken(fault: Fault, stage: Stage, chance: random.Random) -> AbstractContextManager[str]:
    """The fault as a context.

    Raises:
        DemoError: there is nothing to break, or the API server refuses it.
    """
    return contextmanager(fault.breaks)(stage, chance)


def _tell(pids: Iterable[int], number: signal.Signals, whose: str) -> None:
    if not processes.tell(pids, number):
        raise DemoError(f"{whose} has no process")


def _kill_operator(stage: Stage, chance: random.Random) -> Breaking:
    """SIGKILL of who leads; every other time at a random step after the next Application is there."""
    when = "at a random moment"
    if chance.random() < 0.5 and stage.applied.wait(20.0):
        time.sleep(chance.uniform(0, _RECONCILE_S))
        when = "while it reconciles"
    pod = stage.leader()
    _tell(processes.of_pod(pod["metadata"]["uid"]), signal.SIGKILL, pod["metadata"]["name"])
    yield f"killed {pod['metadata']['name']} {when}"


def _kill_process(stage: Stage, chance: random.Random) -> Breaking:
    component = chance.choice(["agent", "mobility", "camera", "driver"])
    if component == "driver":
        pods = stage.objects("pods", "-n", NAMESPACE, "-l", "fractus.dev/component=Navigator")
        running = [pod for pod in pods if pod["status"].get("phase") == "Running"]
        if not running:
            raise DemoError("no driver runs")
        pod = running[0]
    else:
        pod = stage.system_pod(component, stage.drone)
    _tell(processes.of_pod(pod["metadata"]["uid"]), signal.SIGKILL, pod["metadata"]["name"])
    yield f"killed {pod['metadata']['name']}"


def _api_down(stage: Stage, _chance: random.Random) -> Breaking:
    with apiserver.refused(stage.control_plane):
        _tell(stage.program("kube-apiserver"), signal.SIGKILL, "the API server")
        yield "the API server is down"


def _silent_watches(stage: Stage, _chance: random.Random) -> Breaking:
    with apiserver.silenced(stage.control_plane) as count:
        yield f"{count} connections to the API server are silent"


def _slow_api(stage: Stage, _chance: random.Random) -> Breaking:
    with apiserver.slowed(lambda: stage.program("kube-apiserver")):
        yield f"the API server answers after {apiserver.SLOW_S:g} s"


def _too_many_requests(stage: Stage, _chance: random.Random) -> Breaking:
    try:
        stage.kube.run("apply", "-f", "-", stdin=apiserver.no_room(), timeout_s=20.0)
        with apiserver.occupied(stage.kube):
            yield "the API server answers 429 to Fractus"
    finally:
        _until_done(lambda: stage.kubectl("delete", "--ignore-not-found", *apiserver.RULES))


def _conflicts(stage: Stage, _chance: random.Random) -> Breaking:
    """Writes all the time what others write, so that their writes meet a newer version: 409."""
    kinds = ",".join(
        f"{kind}.fractus.dev" for kind in ("applications", "deploymentplans", "grants", "nodegrants", "drones")
    )

    def write(over: threading.Event) -> None:
        count = 0
        while not over.is_set():
            count += 1
            with suppress(DemoError):
                stage.kubectl("annotate", kinds, "--all", "-A", f"fractus-chaos={count}", "--overwrite")

    with held(write):
        yield "every object of Fractus is written all the time"


def _restart_etcd(stage: Stage, _chance: random.Random) -> Breaking:
    _tell(stage.program("etcd"), signal.SIGKILL, "etcd")
    yield "killed etcd, which starts again"


def _stop_kubelet(stage: Stage, chance: random.Random) -> Breaking:
    node = _some_node(stage, chance)
    _tell(stage.program("kubelet", node), signal.SIGSTOP, f"the kubelet of {node}")
    try:
        yield f"the kubelet of {node} hangs"
    finally:
        processes.tell(stage.program("kubelet", node), signal.SIGCONT)


def _power_off(stage: Stage, chance: random.Random) -> Breaking:
    node = _some_node(stage, chance)
    stage.cluster.set_power(node, on=False)
    try:
        yield f"{node} has no power"
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
    yield f"deleted pod {pod['name']} by force"


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
        except DemoError as error:
            drained = f"tried to drain ({str(error)[-120:]})"
        yield f"{drained} {node}"
    finally:
        # kubectl uncordon ends with 0 when the API server refuses it.
        schedulable = '{"spec": {"unschedulable": null}}'
        _until_done(lambda: stage.kubectl("patch", "node", node, "--type=merge", "-p", schedulable))


def _take_label(stage: Stage, chance: random.Random) -> Breaking:
    """Take the class of a drone, which is refused until it has landed and has no mission, or of an edge node."""
    edges = [node.name for node in stage.cluster.spec.nodes if node.node_class == "edge"]
    node, node_class = (stage.drone, "drone") if chance.random() < 0.5 else (chance.choice(edges), "edge")
    try:
        _until_done(lambda: stage.kubectl("label", "node", node, f"{CLASS_LABEL}-"), _LANDING_S)
        yield f"{node} lost its label {CLASS_LABEL}"
    finally:
        _until_done(lambda: stage.kubectl("label", "node", node, f"{CLASS_LABEL}={node_class}", "--overwrite"))


def _fill_disk(stage: Stage, _chance: random.Random) -> Breaking:
    """Take all of the disk of the drone's node, also what is freed on it meanwhile."""
    if not stage.state.is_mount():
        raise DemoError(f"{stage.drone} has no disk of its own")
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
    """Let a file take every block that its disk has left."""
    end, piece = os.fstat(file.fileno()).st_size, 1 << 30
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
    """Step the clock of one service of the drone's node, or of all of them, as a node whose time server is wrong."""
    if not clocks.can_step(stage.state):
        raise DemoError(f"clocks of {stage.drone} cannot be stepped")
    services = chance.choice([*((service,) for service in clocks.SERVICES), clocks.SERVICES])
    # As often by minutes as by hours.
    offset_s = chance.choice((-1, 1)) * math.exp(chance.uniform(math.log(MIN_STEP_S), math.log(MAX_STEP_S)))
    try:
        clocks.step(stage.state, services, offset_s)
        yield f"clocks of {', '.join(services)} of {stage.drone} were stepped by {offset_s:+.0f} s"
    finally:
        clocks.step(stage.state, services, 0.0)


def _some_node(stage: Stage, chance: random.Random) -> str:
    """The drone's node as often as any other."""
    others = [node.name for node in stage.cluster.spec.nodes if node.name != stage.drone]
    return stage.drone if chance.random() < 0.5 else chance.choice(others)


def _until_done(act: Callable[[], object], timeout_s: float = _HEAL_TIMEOUT_S) -> None:
    """Try again while the API server refuses it or cannot be had, for another fault may have taken it.

    Raises:
        DemoError: it could not be done in time.
    """
    deadline = time.monotonic() + timeout_s
    while True:
        try:
            act()
        except (DemoError, subprocess.SubprocessError):
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
