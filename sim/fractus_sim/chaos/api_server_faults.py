"""API server faults: connections reset, no responses, slow responses, too many requests."""

from __future__ import annotations

import signal
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from fractus_cluster.controlplane import API_PORT
from fractus_core.documents import dump_documents

from fractus_sim.chaos import process_lookup
from fractus_sim.testbeds.kube_commands import SYSTEM, Kube

SLOW_S = 2.0
"""Duration of each suspension of the API server."""

_RUNNING_S = 0.4
_POLL_S = 0.2
_TIMEOUT_S = 20.0
_NAME = "fractus-chaos"
RATE_LIMIT_OBJECTS = (
    f"flowschemas.flowcontrol.apiserver.k8s.io/{_NAME}",
    f"prioritylevelconfigurations.flowcontrol.apiserver.k8s.io/{_NAME}",
)
"""Objects of `rate_limit_manifests` in kubectl notation."""
_ACCOUNTS = (SYSTEM, "fractus-nodes")
_INCOMPLETE_REQUEST = (
    "create", "--raw=/apis/authorization.k8s.io/v1/selfsubjectaccessreviews", "-f", "-",
    f"--as=system:serviceaccount:{SYSTEM}:chaos",
)  # fmt: skip


def rate_limit_manifests() -> str:
    """Return manifests that limit all accounts of Fractus to one concurrent API request."""
    api = "flowcontrol.apiserver.k8s.io/v1"
    level = {
        "apiVersion": api, "kind": "PriorityLevelConfiguration", "metadata": {"name": _NAME},
        "spec": {"type": "Limited", "limited": {
            "nominalConcurrencyShares": 0, "lendablePercent": 0, "borrowingLimitPercent": 0,
            "limitResponse": {"type": "Reject"},
        }},
    }  # fmt: skip
    accounts = [{"kind": "Group", "group": {"name": f"system:serviceaccounts:{name}"}} for name in _ACCOUNTS]
    all_requests = {
        "verbs": ["*"], "apiGroups": ["*"], "resources": ["*"], "clusterScope": True, "namespaces": ["*"]
    }  # fmt: skip
    flow = {
        "apiVersion": api, "kind": "FlowSchema", "metadata": {"name": _NAME},
        "spec": {
            "priorityLevelConfiguration": {"name": _NAME}, "matchingPrecedence": 2,
            "rules": [{"subjects": accounts, "resourceRules": [all_requests]}],
        },
    }  # fmt: skip
    return dump_documents([level, flow])


@contextmanager
def occupied_request_slot(kube: Kube) -> Iterator[None]:
    """Occupy the only request slot that `rate_limit_manifests` leaves.

    All requests of Fractus then receive status 429.
    """

    def repeat(stop: threading.Event) -> None:
        # The API server ends the request after one minute, so it is repeated. It also receives status 429 at first if a
        # request of Fractus occupies the slot.
        while not stop.is_set():
            with kube.follow(_INCOMPLETE_REQUEST, subprocess.DEVNULL, subprocess.PIPE) as request:
                while request.poll() is None and not stop.wait(_POLL_S):
                    continue
                request.kill()

    with in_background(repeat):
        yield


@contextmanager
def connections_reset(namespace: Path) -> Iterator[None]:
    """Reset every connection to the API server."""
    rule = f"tcp dport {API_PORT} reject with tcp reset"
    with _table(namespace, "fractus_chaos_down", f"chain c {{ type filter hook input priority -300; {rule}; }}"):
        yield


@contextmanager
def responses_dropped(namespace: Path) -> Iterator[int]:
    """Drop all responses on the existing connections to the API server. Yield the number of these connections.

    New connections are not affected.
    """
    peers = sorted(_peers(namespace))
    if not peers:
        yield 0
        return
    rule = f"tcp sport {API_PORT} ip daddr . tcp dport @peers drop"
    content = (
        f"set peers {{ type ipv4_addr . inet_service; elements = {{ {', '.join(peers)} }}; }}\n"
        f"chain c {{ type filter hook output priority -300; {rule}; }}"
    )
    with _table(namespace, "fractus_chaos_silent", content):
        yield len(peers)


@contextmanager
def suspended_repeatedly(pids: Callable[[], list[int]]) -> Iterator[None]:
    """Suspend the API server repeatedly, each time for `SLOW_S`."""

    def repeat(stop: threading.Event) -> None:
        while not stop.is_set():
            process_lookup.send_signal(pids(), signal.SIGSTOP)
            stop.wait(SLOW_S)
            process_lookup.send_signal(pids(), signal.SIGCONT)
            stop.wait(_RUNNING_S)

    try:
        with in_background(repeat):
            yield
    finally:
        process_lookup.send_signal(pids(), signal.SIGCONT)


@contextmanager
def _table(namespace: Path, name: str, content: str) -> Iterator[None]:
    """Install an nftables table until the end of the block."""
    _run(namespace, ["nft", "-f", "-"], f"table inet {name} {{\n{content}\n}}\n")
    try:
        yield
    finally:
        _run(namespace, ["nft", "delete", "table", "inet", name])


def _peers(namespace: Path) -> set[str]:
    """Return the peers of established API server connections as nftables set elements (address . port)."""
    output = _run(namespace, ["ss", "-Htn", "state", "established", f"( sport = :{API_PORT} )"])
    peers = set()
    for line in output.splitlines():
        address, _, port = line.split()[-1].rpartition(":")
        address = address.strip("[]").removeprefix("::ffff:")
        if ":" not in address:
            peers.add(f"{address} . {port}")
    return peers


def _run(namespace: Path, command: list[str], text: str = "") -> str:
    """Run a command in a network namespace, and return its output."""
    completed = subprocess.run(
        ["nsenter", f"--net={namespace}", *command], input=text, capture_output=True, text=True, timeout=_TIMEOUT_S, check=True
    )  # fmt: skip
    return completed.stdout


_JOIN_S = 30.0


@contextmanager
def in_background(action: Callable[[threading.Event], None]) -> Iterator[None]:
    """Run an action in a thread until the end of the block. Its event is set when the action must return."""
    stop = threading.Event()
    # The thread is a daemon, so that an interrupted run does not wait for the repair of a fault. The run removes its
    # cluster anyway.
    thread = threading.Thread(target=action, args=(stop,), daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(_JOIN_S)
