"""What integration tests share: a bare control plane, the operator as a process on it, and a drone's services."""

from __future__ import annotations

import hashlib
import os
import signal
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import chart as fractus_chart
import pytest
from control_plane import ControlPlane, programs
from mobility_rig import Rig
from operator_world import OperatorProcess, World, fresh_namespace

# A shell's background jobs ignore the one, what nohup starts the other; and so would every program that they start.
for number in (signal.SIGINT, signal.SIGHUP):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, signal.default_int_handler)

LONG = ("test_scenario_field", "test_sdk_flight", "test_mobility_sdk", "test_mobility_lost")
"""Modules whose flights take longest: what begins first lets no one wait for it at the end."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest."""
    items.sort(key=lambda item: item.path.stem not in LONG)


@pytest.fixture
async def rig(tmp_path: Path) -> AsyncIterator[Rig]:
    """A drone's services and its vehicle, as processes that a test starts."""
    rig = Rig(tmp_path)
    try:
        yield rig
    finally:
        await rig.close()


@pytest.fixture(scope="session")
def control_plane(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ControlPlane]:
    """A real API server with the CRDs installed; about 6 s, once a session."""
    directory: Path = tmp_path_factory.mktemp("control-plane")
    plane = ControlPlane(programs(), directory)
    try:
        plane.start()
        yield plane
    finally:
        plane.stop()


@pytest.fixture
def world(control_plane: ControlPlane) -> Iterator[World]:
    """One drone, three edge nodes and a cloud node."""
    world = World(control_plane)
    world.furnish()
    yield world
    world.clear()


@pytest.fixture(scope="module")
def chart(control_plane: ControlPlane) -> Iterator[None]:
    """What the chart fractus makes, but its workloads: accounts, roles, the admission policies."""
    world = World(control_plane)
    fractus_chart.install(world)
    yield
    fractus_chart.uninstall(world)


@pytest.fixture
def operator(control_plane: ControlPlane, world: World, tmp_path: Path) -> Iterator[OperatorProcess]:
    """A running operator; its log is shown when the test fails."""
    process = OperatorProcess(control_plane.kubeconfig, tmp_path / "operator.log")
    process.start()
    yield process
    code = process.stop() if process.running else None
    print(process.log())
    # A signal that comes before the handlers are set ends it as well.
    assert code in (0, -signal.SIGTERM, None), "the operator ended badly"


@pytest.fixture
def namespace(world: World, request: pytest.FixtureRequest) -> Iterator[str]:
    """A namespace of the test's own."""
    name = "t-" + hashlib.sha256(f"{request.node.nodeid}{os.getpid()}".encode()).hexdigest()[:10]
    with fresh_namespace(world, name) as fresh:
        yield fresh
