"""Chaos faults. Each fault is a generator that injects the fault, yields its description, and repairs it at the end."""

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
from fractus_sim.chaos.api_server_faults import in_background
from fractus_sim.chaos.chaos_cluster import BALLAST, ChaosTarget
from fractus_sim.errors import ExperimentError
from fractus_sim.testbeds.kube_commands import NAMESPACE, SYSTEM, Object

Injection = Generator[str, None, None]

MIN_STEP_S = 30.0
MAX_STEP_S = 26 * 3600.0
"""Range of clock offsets. NTP often makes steps below the minimum. All certificates expire within the maximum."""

_REPAIR_TIMEOUT_S = 180.0
_FILL_INTERVAL_S = 0.2
_RETRY_S = 1.0
_LANDING_TIMEOUT_S = 60.0
_APPLY_TIMEOUT_S = 20.0
_RECONCILE_S = 4.0


@dataclass(frozen=True, slots=True)
class Fault:
    """A type of fault.

    Attributes:
        inject: Injects the fault, yields its description, and repairs it.
        shortest_s: Minimum duration. 0 for instantaneous faults.
        longest_s: Maximum duration. 0 for instantaneous faults.
    """

    inject: Callable[[ChaosTarget, random.Random], Injection]
    shortest_s: float = 0.0
    longest_s: float = 0.0


def inject(fault: Fault, target: ChaosTarget, generator: random.Random) -> AbstractContextManager[str]:
    """Return the fault as a context manager.

    Raises:
        ExperimentError: The target does not exist, or the API server rejected the fault.
    """
    return contextmanager(fault.inject)(target, generator)


def _send_signal(pids: Iterable[int], number: signal.Signals, owner: str) -> None:
    """Send a signal to processes.

    Raises:
        ExperimentError: No process received the signal.
    """
    if not process_lookup.send_signal(pids, number):
        raise ExperimentError(f"{owner} has no process")


def _kill_pod(pod: Object) -> str:
    """Kill the processes of a pod. Return its name."""
    name: str = pod["metadata"]["name"]
    _send_signal(process_lookup.of_pod(pod["metadata"]["uid"]), signal.SIGKILL, name)
    return name


def _kill_operator(target: ChaosTarget, generator: random.Random) -> Injection:
    """Kill the leading operator, half of the time shortly after an Application was applied."""
    when = "at a random moment"
    if generator.random() < 0.5 and target.applied.wait(_APPLY_TIMEOUT_S):
        time.sleep(generator.uniform(0, _RECONCILE_S))
        when = "during reconciliation"
    yield f"killed {_kill_pod(target.leader())} {when}"


def _kill_process(target: ChaosTarget, generator: random.Random) -> Injection:
    """Kill the agent, a service or the driver of the drone."""
    component = generator.choice(["agent", "mobility", "camera", "driver"])
    if component == "driver":
        pods = target.objects("pods", "-n", NAMESPACE, "-l", "fractus.dev/component=Navigator")
        running = [pod for pod in pods if pod["status"].get("phase") == "Running"]
        if not running:
            raise ExperimentError("no driver is running")
        pod = running[0]
    else:
        pod = target.system_pod(component, target.drone)
    yield f"killed {_kill_pod(pod)}"


def _api_down(target: ChaosTarget, _generator: random.Random) -> Injection:
    with api_server_faults.connections_reset(target.control_plane):
        _send_signal(target.program("kube-apiserver"), signal.SIGKILL, "the API server")
        yield "the API server is down"


def _silent_watches(target: ChaosTarget, _generator: random.Random) -> Injection:
    with api_server_faults.responses_dropped(target.control_plane) as count:
        yield f"{count} connections to the API server receive no responses"


def _slow_api(target: ChaosTarget, _generator: random.Random) -> Injection:
    with api_server_faults.suspended_repeatedly(lambda: target.program("kube-apiserver")):
        yield f"the API server responds after {api_server_faults.SLOW_S:g} s"


def _too_many_requests(target: ChaosTarget, _generator: random.Random) -> Injection:
    try:
        target.kube.run("apply", "-f", "-", stdin=api_server_faults.rate_limit_manifests(), timeout_s=20.0)
        with api_server_faults.occupied_request_slot(target.kube):
            yield "the API server rejects requests of Fractus with 429"
    finally:
        _retry(lambda: target.kubectl("delete", "--ignore-not-found", *api_server_faults.RATE_LIMIT_OBJECTS))


def _conflicts(target: ChaosTarget, _generator: random.Random) -> Injection:
    """Annotate all objects continuously, so that other writers get conflicts (409)."""
    kinds = ",".join(
        f"{kind}.fractus.dev" for kind in ("applications", "deploymentplans", "grants", "nodegrants", "drones")
    )

    def write(stop: threading.Event) -> None:
        count = 0
        while not stop.is_set():
            count += 1
            with suppress(ExperimentError):
                target.kubectl("annotate", kinds, "--all", "-A", f"fractus-chaos={count}", "--overwrite")

    with in_background(write):
        yield "all objects of Fractus are updated continuously"


def _restart_etcd(target: ChaosTarget, _generator: random.Random) -> Injection:
    _send_signal(target.program("etcd"), signal.SIGKILL, "etcd")
    yield "killed etcd, which restarts"


def _stop_kubelet(target: ChaosTarget, generator: random.Random) -> Injection:
    node = _select_node(target, generator)
    _send_signal(target.program("kubelet", node), signal.SIGSTOP, f"the kubelet of {node}")
    try:
        yield f"the kubelet of {node} hangs"
    finally:
        process_lookup.send_signal(target.program("kubelet", node), signal.SIGCONT)


def _power_off(target: ChaosTarget, generator: random.Random) -> Injection:
    node = _select_node(target, generator)
    target.cluster.set_power(node, on=False)
    try:
        yield f"{node} is powered off"
    finally:
        target.cluster.set_power(node, on=True)


def _cut_link(target: ChaosTarget, generator: random.Random) -> Injection:
    node = target.cluster.node(_select_node(target, generator))
    node.cut_link()
    try:
        yield f"the link of {node.name} is cut"
    finally:
        node.heal_link()


def _delete_pod(target: ChaosTarget, generator: random.Random) -> Injection:
    pods = [*target.objects("pods", "-n", NAMESPACE), *target.objects("pods", "-n", SYSTEM)]
    pod = generator.choice(sorted(pods, key=lambda body: str(body["metadata"]["name"])))["metadata"]
    target.kubectl("delete", "pod", pod["name"], "-n", pod["namespace"], "--force", "--grace-period=0", "--wait=false")
    yield f"force-deleted pod {pod['name']}"


def _drain(target: ChaosTarget, generator: random.Random) -> Injection:
    node = _select_node(target, generator)
    try:
        result = "drained"
        try:
            options = ["--ignore-daemonsets", "--delete-emptydir-data", "--force", "--timeout=10s"]
            target.kube.run("drain", node, *options, timeout_s=30.0)
        except ExperimentError as error:
            result = f"drain failed ({str(error)[-120:]}) on"
        yield f"{result} {node}"
    finally:
        # kubectl uncordon exits with 0 even if the API server rejects the request.
        schedulable = '{"spec": {"unschedulable": null}}'
        _retry(lambda: target.kubectl("patch", "node", node, "--type=merge", "-p", schedulable))


def _remove_label(target: ChaosTarget, generator: random.Random) -> Injection:
    """Remove the class label of the drone or of an edge node. For a drone, this is rejected until it has landed."""
    edges = [node.name for node in target.cluster.spec.nodes if node.node_class == "edge"]
    if generator.random() < 0.5:
        node = target.drone
        node_class = "drone"
    else:
        node = generator.choice(edges)
        node_class = "edge"
    try:
        _retry(lambda: target.kubectl("label", "node", node, f"{CLASS_LABEL}-"), _LANDING_TIMEOUT_S)
        yield f"removed label {CLASS_LABEL} from {node}"
    finally:
        _retry(lambda: target.kubectl("label", "node", node, f"{CLASS_LABEL}={node_class}", "--overwrite"))


def _fill_disk(target: ChaosTarget, _generator: random.Random) -> Injection:
    """Keep the disk of the drone's node full. Space that is freed during the fault is filled again."""
    if not target.state.is_mount():
        raise ExperimentError(f"{target.drone} has no separate disk")
    ballast = target.state / BALLAST
    try:
        with ballast.open("wb") as file:
            _allocate_free_space(file)

            def fill(stop: threading.Event) -> None:
                while not stop.wait(_FILL_INTERVAL_S):
                    _allocate_free_space(file)

            with in_background(fill):
                yield f"the disk of {target.drone} is full"
    finally:
        ballast.unlink(missing_ok=True)


def _allocate_free_space(file: IO[bytes]) -> None:
    """Allocate all free blocks of the disk to a file."""
    end = os.fstat(file.fileno()).st_size
    block = 1 << 30
    while block:
        try:
            os.posix_fallocate(file.fileno(), end, block)
        except OSError as error:
            if error.errno != errno.ENOSPC:
                raise
            block //= 2
        else:
            end += block


def _step_clock(target: ChaosTarget, generator: random.Random) -> Injection:
    """Step the clock of one or all services of the drone's node, as a wrong time server does."""
    if not clock_faults.can_step(target.state):
        raise ExperimentError(f"clocks of {target.drone} cannot be stepped")
    services = generator.choice([*((service,) for service in clock_faults.SERVICES), clock_faults.SERVICES])
    # The distribution is logarithmic, so that offsets of minutes are as likely as offsets of hours.
    offset_s = generator.choice((-1, 1)) * math.exp(generator.uniform(math.log(MIN_STEP_S), math.log(MAX_STEP_S)))
    try:
        clock_faults.set_offset(target.state, services, offset_s)
        yield f"stepped clocks of {', '.join(services)} on {target.drone} by {offset_s:+.0f} s"
    finally:
        clock_faults.set_offset(target.state, services, 0.0)


def _select_node(target: ChaosTarget, generator: random.Random) -> str:
    """Select a node. The drone's node is selected half of the time."""
    others = [node.name for node in target.cluster.spec.nodes if node.name != target.drone]
    return target.drone if generator.random() < 0.5 else generator.choice(others)


def _retry(action: Callable[[], object], timeout_s: float = _REPAIR_TIMEOUT_S) -> None:
    """Repeat an action until it succeeds, because another fault may affect the API server at the same time.

    Raises:
        ExperimentError: The action did not succeed before the timeout.
    """
    deadline = time.monotonic() + timeout_s
    while True:
        try:
            action()
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
    "label-removal": Fault(_remove_label, 5, 30),
    "disk-full": Fault(_fill_disk, 10, 60),
    "clock-jump": Fault(_step_clock, 10, 120),
}
