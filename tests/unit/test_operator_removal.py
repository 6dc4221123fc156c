"""Which nodes have removed their data when Fractus was uninstalled."""

from __future__ import annotations

from typing import Any

import pytest
from fractus_kube import KubeError
from fractus_operator import removal
from fractus_operator.cluster.kinds import NODE, POD
from fractus_operator.cluster.store import Store
from fractus_operator.removal import await_wiped, run, unwiped

NODES = [{"metadata": {"name": name}} for name in ("drone-2", "drone-1", "edge-1")]


def pod(node: str | None, ready: str | None = None) -> dict[str, Any]:
    conditions = {"conditions": [{"type": "Ready", "status": ready}]} if ready else {}
    return {"spec": {"nodeName": node} if node else {}, "status": conditions}


def test_a_node_is_wiped_once_its_pod_is_ready() -> None:
    assert unwiped(NODES, []) == ["drone-1", "drone-2", "edge-1"]
    assert unwiped(NODES, [pod("edge-1", "True"), pod("drone-1", "False"), pod("drone-2"), pod(None)]) == [
        "drone-1",
        "drone-2",
    ]
    assert unwiped(NODES, [pod(node["metadata"]["name"], "True") for node in NODES]) == []


class Cluster:
    """Answers as the API server would; each look at the pods finds one more that is ready."""

    def __init__(self) -> None:
        self.ready = [pod("edge-1", "True"), pod("drone-1", "True")]
        self.looks = 0
        self.deleted: list[str] = []

    async def list(self, kind: object, **_: object) -> list[Any]:
        if kind is not NODE:
            raise KubeError(403, "Forbidden", "no")
        return NODES

    async def list_whole(self, kind: object, **_: object) -> Any:
        assert kind is POD
        self.looks += 1

        class Page:
            items = self.ready[: self.looks]

        return Page

    async def delete(self, kind: Any, key: tuple[str, str]) -> None:
        self.deleted.append(f"{kind.name} {key[1]}")

    async def aclose(self) -> None:
        pass


async def test_nodes_out_of_reach_are_named_and_the_daemon_set_goes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(removal, "_PERIOD_S", 0.0)
    cluster: Any = Cluster()
    assert await await_wiped(cluster, "fractus-system", timeout_s=0.05) == ["drone-2"]
    assert cluster.looks >= 2
    assert cluster.deleted == ["DaemonSet fractus-wipe"]


async def test_a_removal_that_is_refused_does_not_hide_which_nodes_are_left(monkeypatch: pytest.MonkeyPatch) -> None:
    cluster = Cluster()

    async def connect() -> Cluster:
        return cluster

    async def waited(*_: object) -> list[str]:
        return ["drone-2"]

    monkeypatch.setattr(Store, "connect", connect)
    monkeypatch.setattr(removal, "await_wiped", waited)
    said = await run("fractus-system", "/data/fractus")
    assert "not all that Fractus made in the cluster was removed" in said
    assert "/data/fractus was not wiped on drone-2: remove it there (rm -rf /data/fractus)" in said
    assert "wiped" not in await run("fractus-system", "")
