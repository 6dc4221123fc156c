"""Fake cluster for commands that read a cluster, built from a dict of objects by path."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import pytest

Body = dict[str, Any]


class FakeClusterReader:
    """Fake of `fractus_cli.cluster_reader.ClusterReader`."""

    def __init__(self, objects: Mapping[str, Any]) -> None:
        self.objects = objects

    def get(self, path: str) -> Body | None:
        body = self.objects.get(path)
        assert not isinstance(body, list)
        return body

    def list(self, path: str, **selectors: str) -> Sequence[Body]:
        bodies = self.objects.get(path, [])
        assert isinstance(bodies, list)
        return bodies

    def list_permitted(self, path: str) -> Sequence[Body]:
        return self.list(path)


def show(monkeypatch: pytest.MonkeyPatch, module: Any, objects: Mapping[str, Any]) -> None:
    """Make the module of a command read these objects."""

    @contextmanager
    def open_cluster(_: str | None) -> Iterator[FakeClusterReader]:
        yield FakeClusterReader(objects)

    monkeypatch.setattr(module, "open_cluster", open_cluster)


def condition(type_: str, status: str, reason: str = "Because", message: str = "") -> Body:
    return {"type": type_, "status": status, "reason": reason, "message": message}
