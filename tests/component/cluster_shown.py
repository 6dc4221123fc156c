"""A cluster for commands that read one, from a dict of objects by path."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import pytest

Body = dict[str, Any]


class Shown:
    """Stands for `fractus_cli.reading.Cluster`."""

    def __init__(self, objects: Mapping[str, Any]) -> None:
        self.objects = objects

    def get(self, path: str) -> Body | None:
        found = self.objects.get(path)
        assert not isinstance(found, list)
        return found

    def list(self, path: str, **selectors: str) -> Sequence[Body]:
        found = self.objects.get(path, [])
        assert isinstance(found, list)
        return found

    def list_permitted(self, path: str) -> Sequence[Body]:
        return self.list(path)


def show(monkeypatch: pytest.MonkeyPatch, module: Any, objects: Mapping[str, Any]) -> None:
    """Let a command's module find these objects."""

    @contextmanager
    def cluster(_: str | None) -> Iterator[Shown]:
        yield Shown(objects)

    monkeypatch.setattr(module, "cluster", cluster)


def condition(type_: str, status: str, reason: str = "Because", message: str = "") -> Body:
    return {"type": type_, "status": status, "reason": reason, "message": message}
