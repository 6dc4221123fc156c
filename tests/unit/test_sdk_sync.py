"""Synchronous clients have every method of the asynchronous clients, with the same arguments and documentation."""

from __future__ import annotations

import inspect

import fractus
import pytest
from fractus import sync

PAIRS = [
    (fractus.Mobility, sync.Mobility),
    (fractus.Camera, sync.Camera),
    (fractus.CanI, sync.CanI),
    (fractus.Watch, sync.Watch),
]


@pytest.mark.parametrize(("asynchronous", "synchronous"), PAIRS, ids=lambda kind: kind.__name__)
def test_sync_clients_have_every_asynchronous_method(asynchronous: type, synchronous: type) -> None:
    for name, method in inspect.getmembers(asynchronous, inspect.isfunction):
        if not name.startswith("_"):
            waiting = getattr(synchronous, name)
            assert not inspect.iscoroutinefunction(waiting)
            assert waiting.__doc__
            assert inspect.signature(waiting).parameters.keys() == inspect.signature(method).parameters.keys()
