"""Uninstallation of Fractus: removal of run-time objects and of data on nodes."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import Iterator
from typing import Any

import pytest
from fractus_operator import removal
from fractus_operator.kinds import POD, SIGNING_REQUEST
from fractus_operator.removal import await_wiped, main, remove, run, unwiped
from fractus_operator.store import Store
from fractus_runtime.kubernetes import KubeError, NotFound

NODES = [{"metadata": {"name": name}} for name in ("drone-2", "drone-1", "edge-1")]


def pod(node: str | None, ready: str | None = None) -> dict[str, Any]:
    conditions = {"conditions": [{"type": "Ready", "status": ready}]} if ready else {}
    return {"spec": {"nodeName": node} if node else {}, "status": conditions}


def test_node_is_wiped_when_its_pod_is_ready() -> None:
    assert unwiped(NODES, []) == ["drone-1", "drone-2", "edge-1"]
    assert unwiped(NODES, [pod("edge-1", "True"), pod("drone-1", "False"), pod("drone-2"), pod(None)]) == [
        "drone-1",
        "drone-2",
    ]
    assert unwiped(NODES, [pod(node["metadata"]["name"], "True") for node in NODES]) == []


class Cluster:
    """Fake API server. In each list of pods, one more pod is ready than in the previous list.

    Attributes:
        fails: Numbers of the listings that fail.
        refuses: Names of objects that cannot be deleted.
        operator: The Deployment of the operator, or the error of a request for it.
    """

    def __init__(self, fails: range = range(0), refuses: tuple[str, ...] = ()) -> None:
        self.operator: Any = NotFound(404, "NotFound", "there is none")
        self.ready = [pod("edge-1", "True"), pod("drone-1", "True")]
        self.looks = 0
        self.deleted: list[str] = []
        self.labels: list[str] = []
        self.fails = fails
        self.refuses = refuses

    async def get(self, kind: Any, name: str, namespace: str) -> Any:
        assert (kind.name, name, namespace) == ("Deployment", "fractus-operator", "fractus-system")
        if isinstance(self.operator, KubeError):
            raise self.operator
        return self.operator

    async def list(self, kind: Any, **_: object) -> list[Any]:
        if kind is SIGNING_REQUEST:
            return [{"metadata": {"name": "one"}}, {"metadata": {"name": "two"}}]
        return [{"metadata": {**node["metadata"], "labels": {"fractus.dev/depot": "base"}}} for node in NODES]

    async def list_whole(self, kind: object, **_: object) -> Any:
        assert kind is POD
        self.looks += 1
        if self.looks in self.fails:
            raise KubeError(503, "ServiceUnavailable", "the server is busy")

        class Page:
            items = self.ready[: self.looks]

        return Page

    async def delete(self, kind: Any, key: tuple[str, str]) -> None:
        if key[1] in self.refuses:
            raise KubeError(403, "Forbidden", f"{key[1]} may not be deleted")
        self.deleted.append(f"{kind.name} {key[1]}")

    async def set_labels(self, kind: Any, name: str, labels: object) -> None:
        if name in self.refuses:
            raise KubeError(403, "Forbidden", f"{name} may not be changed")
        self.labels.append(name)

    async def aclose(self) -> None:
        pass


@pytest.fixture(autouse=True)
def fast(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(removal, "_PERIOD_S", 0.0)


def connect(monkeypatch: pytest.MonkeyPatch, cluster: Cluster) -> Any:
    """Connect the removal to the fake cluster."""

    async def connect() -> Cluster:
        return cluster

    monkeypatch.setattr(Store, "connect", connect)
    return cluster


async def test_unreachable_nodes_are_named() -> None:
    cluster: Any = Cluster()
    assert await await_wiped(cluster, "fractus-system", timeout_s=0.05) == ["drone-2"]
    assert cluster.looks >= 2


@pytest.mark.parametrize("cluster", [Cluster(), Cluster(fails=range(1, 2)), Cluster(fails=range(2, 3))])
async def test_wait_for_wipe_continues_after_error(cluster: Any) -> None:
    cluster.ready.append(pod("drone-2", "True"))
    assert await await_wiped(cluster, "fractus-system", timeout_s=30.0) == []


async def test_unwiped_nodes_are_unknown_without_response(monkeypatch: pytest.MonkeyPatch) -> None:
    cluster = connect(monkeypatch, Cluster(fails=range(1, 1_000_000)))
    output = await run("fractus-system", "/data/fractus", timeout_s=0.05)
    assert "it is unknown on which nodes /data/fractus was wiped (the server is busy)" in output
    assert "rm -rf /data/fractus" in output
    assert "DaemonSet fractus-wipe" in cluster.deleted


async def test_refused_removal_does_not_stop_the_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    cluster = connect(monkeypatch, Cluster(refuses=("fractus-ca", "one", "drone-2")))
    output = await run("fractus-system", "/data/fractus", timeout_s=0.05)
    assert "some objects of Fractus were not removed" in output
    for text in (
        "Secret fractus-system/fractus-ca",
        "ConfigMap fractus-system/fractus-ca",
        "one may not",
        "drone-2 may not",
    ):
        assert text in output
    assert "/data/fractus was not wiped on drone-2: remove it on these nodes (rm -rf /data/fractus)" in output
    assert cluster.deleted == ["Lease fractus-operator", "CertificateSigningRequest two", "DaemonSet fractus-wipe"]
    assert cluster.labels == ["drone-1", "edge-1"]
    assert "wiped" not in await run("fractus-system", "")


async def test_remaining_wipe_daemon_set_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    connect(monkeypatch, Cluster(refuses=("fractus-wipe",)))
    assert "kubectl -n fractus-system delete daemonset fractus-wipe" in await run(
        "fractus-system", "/data/fractus", timeout_s=0.05
    )


async def test_existing_authority_is_kept() -> None:
    cluster: Any = Cluster()
    assert await remove(cluster, "fractus-system", keep_authority=True) == []
    assert "Secret fractus-ca" not in cluster.deleted
    assert "ConfigMap fractus-ca" in cluster.deleted


@pytest.mark.parametrize(
    ("operator", "message"),
    [
        ({"metadata": {"name": "fractus-operator"}}, "Fractus is installed in fractus-system"),
        (
            KubeError(0, "", "the server did not respond in time"),
            "unknown whether Fractus is still installed (the server did not",
        ),
    ],
)
async def test_removal_removes_nothing_while_operator_is_installed(
    monkeypatch: pytest.MonkeyPatch, operator: object, message: str
) -> None:
    """The output of `helm template` contains the removal Job together with the operator.

    If the Job removed the certificate authority, the operator could sign no Grant.
    """
    cluster = connect(monkeypatch, Cluster())
    cluster.operator = operator
    output = await run("fractus-system", "/data/fractus", timeout_s=0.05)
    assert output.startswith("nothing was removed")
    assert message in output
    assert cluster.deleted == ["DaemonSet fractus-wipe"], (
        "only the DaemonSet is removed, because it would wipe nodes in use"
    )
    assert not cluster.labels
    cluster.operator = {"metadata": {"name": "fractus-operator", "deletionTimestamp": "2026-01-01T00:00:00Z"}}
    await run("fractus-system", "/data/fractus", timeout_s=0.05)
    assert "Secret fractus-ca" in cluster.deleted


@pytest.mark.parametrize("status", [0, 429, 503])
async def test_check_for_operator_is_repeated_without_response(status: int, monkeypatch: pytest.MonkeyPatch) -> None:
    cluster = connect(monkeypatch, Cluster())
    answers = [KubeError(status, "", "not now"), KubeError(status, "", "not now"), NotFound(404, "NotFound", "none")]

    async def get(*_: object) -> Any:
        raise answers.pop(0)

    monkeypatch.setattr(cluster, "get", get)
    assert await run("fractus-system", "") == ""
    assert "Secret fractus-ca" in cluster.deleted


@pytest.fixture
def terminable() -> Iterator[None]:
    """Let the process survive a SIGTERM, and restore the handler afterwards."""
    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    yield
    signal.signal(signal.SIGTERM, before)


@pytest.mark.parametrize("at", ["delete", "list_whole"])
def test_signal_during_removal_deletes_wipe_daemon_set(
    terminable: None, monkeypatch: pytest.MonkeyPatch, at: str
) -> None:
    """The Job gets SIGTERM at its deadline, or when its node is drained.

    A remaining DaemonSet would wipe the data of the next installation.
    """
    cluster = connect(monkeypatch, Cluster())
    cluster.ready.append(pod("drone-2", "True"))  # ends the wait if the signal has no effect
    answer = getattr(cluster, at)

    async def interrupted(*args: Any, **selectors: Any) -> Any:
        monkeypatch.setattr(cluster, at, answer)
        os.kill(os.getpid(), signal.SIGTERM)
        await asyncio.sleep(0.01)
        return await answer(*args, **selectors)

    monkeypatch.setattr(cluster, at, interrupted)
    monkeypatch.setattr("sys.argv", ["removal", "--namespace=fractus-system", "--wiped=/data/fractus"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code not in {0, None}
    assert cluster.deleted[-1] == "DaemonSet fractus-wipe"
