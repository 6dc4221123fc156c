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
_QUICK_S = 0.4
_POLL_S = 0.2
_TIMEOUT_S = 20.0
_NAME = "fractus-chaos"
RULES = (
    f"flowschemas.flowcontrol.apiserver.k8s.io/{_NAME}",
    f"prioritylevelconfigurations.flowcontrol.apiserver.k8s.io/{_NAME}",
)
"""Objects of `no_room` in kubectl notation."""
_ACCOUNTS = (SYSTEM, "fractus-nodes")
_UNFINISHED = (
    "create", "--raw=/apis/authorization.k8s.io/v1/selfsubjectaccessreviews", "-f", "-",
    f"--as=system:serviceaccount:{SYSTEM}:chaos",
)  # fmt: skip


def no_room() -> str:
    """Return manifests that limit all accounts of Fractus to one concurrent API request."""
    api = "flowcontrol.apiserver.k8s.io/v1"
    level = {
        "apiVersion": api, "kind": "PriorityLevelConfiguration", "metadata": {"name": _NAME},
        "spec": {"type": "Limited", "limited": {
            "nominalConcurrencyShares": 0, "lendablePercent": 0, "borrowingLimitPercent": 0,
            "limitResponse": {"type": "Reject"},
        }},
    }  # fmt: skip
    who = [{"kind": "Group", "group": {"name": f"system:serviceaccounts:{name}"}} for name in _ACCOUNTS]
    every = {
        "verbs": ["*"], "apiGroups": ["*"], "resources": ["*"], "clusterScope": True, "namespaces": ["*"]
    }  # fmt: skip
    flow = {
        "apiVersion": api, "kind": "FlowSchema", "metadata": {"name": _NAME},
        "spec": {
            "priorityLevelConfiguration": {"name": _NAME}, "matchingPrecedence": 2,
            "rules": [{"subjects": who, "resourceRules": [every]}],
        },
    }  # fmt: skip
    return dump_documents([level, flow])


@contextmanager
def occupied(kube: Kube) -> Iterator[None]:
    """Occupy the request slot of `no_room`. All other requests of Fractus receive status 429."""

    def hold(over: threading.Event) -> None:
        # The API server ends the request after one minute, and rejects it while another request is running.
        while not over.is_set():
            with kube.follow(_UNFINISHED, subprocess.DEVNULL, subprocess.PIPE) as request:
                while request.poll() is None and not over.wait(_POLL_S):
                    continue
                request.kill()

    with held(hold):
        yield


@contextmanager
def refused(namespace: Path) -> Iterator[None]:
    """Reset every connection to the API server."""
    rule = f"tcp dport {API_PORT} reject with tcp reset"
    with _table(namespace, "fractus_chaos_down", f"chain c {{ type filter hook input priority -300; {rule}; }}"):
        yield


@contextmanager
def silenced(namespace: Path) -> Iterator[int]:
    """Drop all responses on existing connections to the API server, but not on new ones. Yield their number."""
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
def slowed(pids: Callable[[], list[int]]) -> Iterator[None]:
    """Suspend the API server for two seconds repeatedly."""

    def hold(over: threading.Event) -> None:
        while not over.is_set():
            process_lookup.send_signal(pids(), signal.SIGSTOP)
            over.wait(SLOW_S)
            process_lookup.send_signal(pids(), signal.SIGCONT)
            over.wait(_QUICK_S)

    try:
        with held(hold):
            yield
    finally:
        process_lookup.send_signal(pids(), signal.SIGCONT)


@contextmanager
def _table(namespace: Path, name: str, content: str) -> Iterator[None]:
    _run(namespace, ["nft", "-f", "-"], f"table inet {name} {{\n{content}\n}}\n")
    try:
        yield
    finally:
        _run(namespace, ["nft", "delete", "table", "inet", name])


def _peers(namespace: Path) -> set[str]:
    """Return the peers of established API server connections as nftables set elements (address . port)."""
    listed = _run(namespace, ["ss", "-Htn", "state", "established", f"( sport = :{API_PORT} )"])
    found = set()
    for line in listed.splitlines():
        address, _, port = line.split()[-1].rpartition(":")
        address = address.strip("[]").removeprefix("::ffff:")
        if ":" not in address:
            found.add(f"{address} . {port}")
    return found


def _run(namespace: Path, command: list[str], text: str = "") -> str:
    done = subprocess.run(
        ["nsenter", f"--net={namespace}", *command], input=text, capture_output=True, text=True, timeout=_TIMEOUT_S, check=True
    )  # fmt: skip
    return done.stdout


_JOIN_S = 30.0


@contextmanager
def held(hold: Callable[[threading.Event], None]) -> Iterator[None]:
    """Run a function in a thread until the end of the block, which sets the event."""
    over = threading.Event()
    # Daemon thread: an interrupted run does not wait for faults because its cluster is removed.
    holder = threading.Thread(target=hold, args=(over,), daemon=True)
    holder.start()
    try:
        yield
    finally:
        over.set()
        holder.join(_JOIN_S)
