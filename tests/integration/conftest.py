"""Fixtures of integration tests: a control plane without nodes, the operator as a process, and a drone's services."""

from __future__ import annotations

import hashlib
import os
import signal
from collections.abc import AsyncIterator, Iterator
from datetime import datetime
from pathlib import Path

import chart as fractus_chart
import pytest
from control_plane import ControlPlane, programs, wait_for
from flight_log import START, call, grant, state, write_log
from fractus_core.api.flight_plans import application_name
from fractus_core.api.names import component_identity
from management_server import ManagementServer, User, restriction, user_token
from mobility_rig import Rig
from operator_world import FRACTUS, OperatorProcess, World, approved_template, fresh_namespace
from record_node import Flight, RecordNode, publish_address, started

AUTHORITY_ROLES = (
    "fractus-policy-editor",
    "fractus-zone-editor",
    "fractus-flightplan-viewer",
    "fractus-drone-viewer",
    "fractus-grant-viewer",
)

# Background jobs of a shell ignore SIGINT, and nohup ignores SIGHUP. Programs that tests start would also ignore them.
for number in (signal.SIGINT, signal.SIGHUP):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, signal.default_int_handler)

LONG = (
    "test_scenario_field",
    "test_agent",
    "test_agent_watch",
    "test_sdk_flight",
    "test_sdk_plans",
    "test_gimbal",
    "test_flight_recording",
    "test_mobility_sdk",
    "test_mobility_lost",
)
"""Modules with the longest flights, or with tests of one group. They run first, so that no worker runs them alone at the end."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Sort the longest tests to the front."""
    items.sort(key=lambda item: item.path.stem not in LONG)


@pytest.fixture
async def rig(tmp_path: Path) -> AsyncIterator[Rig]:
    """Services and vehicle of a drone. The test starts them as processes."""
    rig = Rig(tmp_path)
    try:
        yield rig
    finally:
        await rig.close()


@pytest.fixture(scope="session")
def control_plane(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ControlPlane]:
    """A real API server with the CRDs. It starts once per session, in about 6 s."""
    directory: Path = tmp_path_factory.mktemp("control-plane")
    plane = ControlPlane(programs(), directory)
    try:
        plane.start()
        yield plane
    finally:
        plane.stop()


@pytest.fixture(scope="session")
def kept_operator(control_plane: ControlPlane, tmp_path_factory: pytest.TempPathFactory) -> Iterator[OperatorProcess]:
    """The operator of consecutive tests that use the fixture `operator`. A start takes about 3 s of CPU time."""
    process = OperatorProcess(control_plane.kubeconfig, tmp_path_factory.mktemp("operator") / "operator.log")
    yield process
    _stop(process)


def _stop(process: OperatorProcess) -> None:
    code = process.stop() if process.running else None
    # SIGTERM kills a process that has not set its signal handlers yet.
    assert code in (0, -signal.SIGTERM, None), f"the operator exited with code {code}"


@pytest.fixture
def world(
    control_plane: ControlPlane, kept_operator: OperatorProcess, request: pytest.FixtureRequest
) -> Iterator[World]:
    """Objects of one drone, three edge nodes and a cloud node at the API server."""
    if "operator" not in request.fixturenames:
        _stop(kept_operator)
    world = World(control_plane)
    world.furnish()
    yield world
    world.clear()


@pytest.fixture(scope="module")
def chart(control_plane: ControlPlane) -> Iterator[None]:
    """Objects of the chart fractus without its workloads: accounts, roles and admission policies."""
    world = World(control_plane)
    fractus_chart.install(world)
    yield
    fractus_chart.uninstall(world)


@pytest.fixture
def operator(kept_operator: OperatorProcess, world: World) -> Iterator[OperatorProcess]:
    """A running operator that has received the drones and edge nodes of the test. A failed test prints its log."""
    kept_operator.begin_log()
    if not kept_operator.running:
        kept_operator.start()
    wait_for(world.is_labelled, kept_operator.log)
    yield kept_operator
    print(kept_operator.log())


@pytest.fixture
def namespace(world: World, request: pytest.FixtureRequest) -> Iterator[str]:
    """A separate namespace for the test."""
    name = "t-" + hashlib.sha256(f"{request.node.nodeid}{os.getpid()}".encode()).hexdigest()[:10]
    with fresh_namespace(world, name) as fresh:
        yield fresh


@pytest.fixture(scope="session")
def management(control_plane: ControlPlane, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ManagementServer]:
    """The management API as a process."""
    server = ManagementServer(control_plane, tmp_path_factory.mktemp("management") / "log")
    yield server
    assert server.stop() == 0


@pytest.fixture
def pilot(
    chart: None, world: World, operator: OperatorProcess, management: ManagementServer, namespace: str
) -> Iterator[User]:
    """A user who may order flights of an approved template."""
    approved_template(world)
    token = user_token(
        world,
        namespace,
        "pilot",
        ("fractus-flightplan-editor",),
        ("fractus-drone-viewer", "fractus-applicationtemplate-viewer"),
    )
    user = User(management, token, namespace)
    wait_for(lambda: user("GET", "/v1/plans").status == 200, "the role of the pilot")
    yield user
    # A plan that is left would reserve the drone.
    for item in world.api.list(f"{FRACTUS}/flightplans"):
        world.api.delete(f"{FRACTUS}/namespaces/{item['metadata']['namespace']}/flightplans/{item['metadata']['name']}")
    wait_for(lambda: not world.api.list(f"{FRACTUS}/flightplans"), "the plans to be deleted")


@pytest.fixture
def authority(pilot: User, world: World, management: ManagementServer, namespace: str) -> Iterator[User]:
    """A user who may publish restrictions, and read what they affect."""
    user = User(management, user_token(world, namespace, "publisher", (), AUTHORITY_ROLES), namespace)
    wait_for(lambda: user("POST", "/v1/restrictions:impact", restriction()).status == 200, "the roles of the authority")
    wait_for(lambda: user("DELETE", "/v1/restrictions/none", If_Match="*").status == 404, "the roles of the authority")
    yield user
    for kind in ("policies", "zones"):
        for item in world.api.list(f"{FRACTUS}/{kind}"):
            world.api.delete(f"{FRACTUS}/{kind}/{item['metadata']['name']}")


@pytest.fixture
def observer(pilot: User, world: World, management: ManagementServer, namespace: str) -> User:
    """A user who may only read."""
    user = User(management, user_token(world, namespace, "observer", ("fractus-flightplan-viewer",), ()), namespace)
    wait_for(lambda: user("GET", "/v1/plans").status == 200, "the role of the observer")
    return user


@pytest.fixture
def record_node(control_plane: ControlPlane, tmp_path: Path) -> Iterator[RecordNode]:
    node = RecordNode(control_plane, tmp_path / "node")
    node.certify("drone-1")
    yield node
    node.stop()


@pytest.fixture
def record_api(control_plane: ControlPlane, record_node: RecordNode, tmp_path: Path) -> Iterator[ManagementServer]:
    ca = tmp_path / "ca.crt"
    ca.write_bytes(record_node.authority.pem)
    server = ManagementServer(control_plane, tmp_path / "api.log", f"--node-ca={ca}")
    yield server
    assert server.stop() == 0
    assert '"level": "ERROR"' not in server.log.read_text()


@pytest.fixture
def recorded_flight(pilot: User, record_api: ManagementServer, world: World, record_node: RecordNode) -> Flight:
    """A flight with one verdict, two positions, and calls and a picture of another tenant. The endpoint is not started."""
    user = pilot.at(record_api)
    path, plan = started(user, world)
    uid = plan["metadata"]["uid"]
    driver = component_identity(user.namespace, application_name(uid), "Navigator", "navigator")
    foreign = component_identity("other", application_name(uid), "Navigator", "navigator")
    start = datetime.fromisoformat(plan["spec"]["window"]["start"])
    since_s = (start - START).total_seconds()
    entries = [grant(since_s, driver), call(since_s + 1, foreign), call(since_s + 2, driver, "deny", reason="too far")]
    log = record_node.state / "audit" / "mobility.jsonl"
    write_log(log, [*entries, state(since_s + 3), state(since_s + 4, lat=39.3604)])
    recorded = record_node.state / "recordings" / "camera" / start.strftime("000001-%Y%m%dT%H%M%SZ.mcap")
    pictures = [
        (since_s + 2, f"{uid}/{driver}", b"\xff\xd8 mine"),
        (since_s + 3, f"{uid}/{foreign}", b"\xff\xd8 other"),
    ]
    return Flight(user, path, plan["metadata"]["name"], driver, log, since_s, recorded, pictures)


@pytest.fixture
def served_flight(recorded_flight: Flight, world: World, record_node: RecordNode) -> Flight:
    """The flight, whose records the endpoint serves."""
    publish_address(world, f"127.0.0.1:{record_node.port}")
    record_node.start()
    wait_for(
        lambda: recorded_flight.user("GET", f"{recorded_flight.path}/verdicts").status == 200, "the recording endpoint"
    )
    return recorded_flight
