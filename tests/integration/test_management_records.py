"""Records of flights through the management API: roles of the chart, a real API server, and the agent's endpoint."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, cast

import pytest
from agent_pki import TestAuthority
from control_plane import ControlPlane, wait_for
from docs_pages import shell_lines
from docs_shell import Shell
from flight_log import START, call, grant, state, write_log, write_pictures
from fractus_agent.certificates import create_request
from fractus_agent.identity import NodeIdentity
from fractus_agent.records.record_server import RecordServer
from fractus_agent.store import Store
from fractus_cluster.ports import free_port
from fractus_core.api.flight_plans import application_name
from fractus_core.api.names import component_identity
from fractus_runtime.files import write_set
from fractus_runtime.kubernetes import Client, kubeconfig
from management_server import ManagementServer, User, path_of, problem, submitted, user_token
from operator_world import FRACTUS, World


class Identity:
    """The certificate of the node, which exists."""

    def __init__(self) -> None:
        self.ready = asyncio.Event()
        self.ready.set()
        self.serial = 1


class Node:
    """The recording endpoint of drone-1, with the files of a test."""

    def __init__(self, plane: ControlPlane, directory: Path) -> None:
        self.state = directory
        self.port = free_port()
        self.authority = TestAuthority()
        self._plane = plane
        self._loop = asyncio.new_event_loop()
        self._task: asyncio.Task[None] | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)

    def certify(self, name: str) -> None:
        key, request = create_request(name)
        files = {"tls.crt": self.authority.sign(request), "tls.key": key, "ca.crt": self.authority.pem}
        write_set(self.state / "tls", files)

    def start(self) -> None:
        self._thread.start()

    def _run(self) -> None:
        self._task = self._loop.create_task(self._serve())
        self._loop.run_until_complete(asyncio.wait([self._task]))

    async def _serve(self) -> None:
        store = Store(Client(await kubeconfig(self._plane.kubeconfig), "agent", trust_env=False), "drone-1")
        try:
            server = RecordServer(f"127.0.0.1:{self.port}", "drone-1", self.state, self.state / "tls", store)
            await server.run(cast("NodeIdentity", Identity()))
        finally:
            await store.close()

    def stop(self) -> None:
        if self._thread.is_alive() and self._task is not None:
            self._loop.call_soon_threadsafe(self._task.cancel)
            self._thread.join(10)


@pytest.fixture
def node(control_plane: ControlPlane, tmp_path: Path) -> Iterator[Node]:
    node = Node(control_plane, tmp_path / "node")
    node.certify("drone-1")
    yield node
    node.stop()


@pytest.fixture
def api(control_plane: ControlPlane, node: Node, tmp_path: Path) -> Iterator[ManagementServer]:
    ca = tmp_path / "ca.crt"
    ca.write_bytes(node.authority.pem)
    server = ManagementServer(control_plane, tmp_path / "api.log", f"--node-ca={ca}")
    yield server
    assert server.stop() == 0
    assert '"level": "ERROR"' not in server.log.read_text()


def publish_address(world: World, address: str) -> None:
    world.api.merge(f"{FRACTUS}/drones/drone-1/status", {"status": {"recordsAddress": address}})


def started(user: User, world: World) -> tuple[str, dict[str, Any]]:
    """Submit a plan, and report its Application as the operator does at the start. Return the path of the plan and the plan."""
    reply = submitted(user)
    metadata = reply.body["metadata"]
    status = {"status": {"application": application_name(metadata["uid"])}}
    world.api.merge(f"{FRACTUS}/namespaces/{metadata['namespace']}/flightplans/{metadata['name']}/status", status)
    return path_of(reply), reply.body


@dataclass(frozen=True)
class Flight:
    """The flight of a plan whose records exist.

    Attributes:
        user: User with the role of the chart for ordering flights.
        path: Path of the plan.
        name: Name of the plan.
        recorded: Path of the recording of pictures, which does not exist yet.
        pictures: Pictures to record: seconds after the start, owner, and JPEG.
    """

    user: User
    path: str
    name: str
    recorded: Path
    pictures: list[tuple[float, str, bytes]]


@pytest.fixture
def flight(pilot: User, api: ManagementServer, world: World, node: Node) -> Flight:
    """A flight with one verdict, two positions, and calls and a picture of another tenant. The endpoint is not started."""
    user = pilot.at(api)
    path, plan = started(user, world)
    uid = plan["metadata"]["uid"]
    driver = component_identity(user.namespace, application_name(uid), "Navigator", "navigator")
    foreign = component_identity("other", application_name(uid), "Navigator", "navigator")
    start = datetime.fromisoformat(plan["spec"]["window"]["start"])
    since_s = (start - START).total_seconds()
    entries = [grant(since_s, driver), call(since_s + 1, foreign), call(since_s + 2, driver, "deny", reason="too far")]
    write_log(node.state / "audit" / "mobility.jsonl", [*entries, state(since_s + 3), state(since_s + 4)])
    recorded = node.state / "recordings" / "camera" / start.strftime("000001-%Y%m%dT%H%M%SZ.mcap")
    pictures = [
        (since_s + 2, f"{uid}/{driver}", b"\xff\xd8 mine"),
        (since_s + 3, f"{uid}/{foreign}", b"\xff\xd8 other"),
    ]
    return Flight(user, path, plan["metadata"]["name"], recorded, pictures)


@pytest.fixture
def served(flight: Flight, world: World, node: Node) -> Flight:
    """The flight, whose records the endpoint serves."""
    publish_address(world, f"127.0.0.1:{node.port}")
    node.start()
    wait_for(lambda: flight.user("GET", f"{flight.path}/verdicts").status == 200, "the recording endpoint")
    return flight


def test_records_of_a_flight_are_returned(served: Flight) -> None:
    user, path = served.user, served.path
    (verdict,) = user("GET", f"{path}/verdicts").body["items"]
    assert (verdict["component"], verdict["action"], verdict["reason"]) == ("Navigator", "deny", "too far")
    first = user("GET", f"{path}/track?limit=1").body
    second = user("GET", f"{path}/track?limit=1&continue={first['continue']}").body
    assert [len(first["items"]), len(second["items"]), "continue" in second] == [1, 1, False]
    (reason,) = problem(user("GET", f"{path}/pictures"), 404)
    assert reason["reason"] == "NotRecorded"
    write_pictures(served.recorded, served.pictures)
    (picture,) = user("GET", f"{path}/pictures").body["items"]
    reply = user("GET", f"{path}/pictures/{picture['id']}")
    assert (reply.status, reply.content, reply.headers["Content-Type"]) == (200, b"\xff\xd8 mine", "image/jpeg")
    assert reply.headers["X-Content-Type-Options"] == "nosniff"


def test_documented_requests_read_the_records(served: Flight, control_plane: ControlPlane, tmp_path: Path) -> None:
    write_pictures(served.recorded, served.pictures)
    script = "\n".join(shell_lines("docs/management-api.md", "Fly in ten minutes"))
    function = next(line for line in script.splitlines() if line.startswith("api()"))
    variables = f"API={served.user.url}\nTOKEN={served.user.token}\nPLAN={served.name}"
    requests = "\n".join(shell_lines("docs/management-api.md", "Read the records of a flight"))
    requests = requests.replace("namespace=team", f"namespace={served.user.namespace}")
    shown = Shell(tmp_path, control_plane).type(f"set -eu\n{variables}\n{function}\n{requests}")
    assert "Navigator Goto deny too far" in shown
    assert (tmp_path / "first.jpg").read_bytes() == b"\xff\xd8 mine"


def test_hostile_parameters_are_refused(served: Flight) -> None:
    write_pictures(served.recorded, served.pictures)
    for hostile, statuses in {
        "verdicts?limit=501": (422,), "verdicts?continue=x": (422,), "verdicts?continue=1": (400,),
        "pictures?continue=9-9": (400,), "pictures/1-2-3": (404,), "pictures/..%2f..%2fverdicts": (404, 422),
        "pictures/1": (422,),
    }.items():  # fmt: skip
        assert served.user("GET", f"{served.path}/{hostile}").status in statuses, hostile


def test_records_need_the_permission_on_records(
    served: Flight, api: ManagementServer, observer: User, world: World
) -> None:
    path, namespace = served.path, served.user.namespace
    problem(observer.at(api)("GET", f"{path}/verdicts"), 403)
    token = user_token(world, namespace, "reader", ("fractus-flightplan-viewer",), ("fractus-drone-viewer",))
    reader = User(api, token, namespace)
    wait_for(lambda: reader("GET", "/v1/drones").status == 200, "the roles of the reader")
    (reason,) = problem(reader("GET", f"{path}/verdicts"), 403)
    assert "flightplans/records" in reason["message"]
    problem(User(api, "not-a-token", namespace)("GET", f"{path}/verdicts"), 401)


def test_missing_endpoint_is_explained(flight: Flight, world: World, node: Node, api: ManagementServer) -> None:
    user, path = flight.user, flight.path
    (reason,) = problem(user("GET", f"{path}/track"), 503)
    assert (reason["reason"], "management.records.enabled" in reason["message"]) == ("RecordsNotServed", True)
    publish_address(world, f"127.0.0.1:{node.port}")
    (reason,) = problem(user("GET", f"{path}/track"), 503)
    message = "drone-1 does not respond, so its records cannot be read now; try again when it has contact"
    assert (reason["reason"], reason["message"]) == ("NodeUnreachable", message)
    # A node that receives requests for another node has no certificate of that node.
    node.certify("drone-2")
    node.start()
    wait_for(lambda: user("GET", f"{path}/track").status == 503 and "mismatch" in api.log.read_text(), "the refusal")


def test_plan_without_flight_has_no_records(pilot: User) -> None:
    path = path_of(submitted(pilot))
    for records in ("verdicts", "track", "pictures", "pictures/1-2-3"):
        (reason,) = problem(pilot("GET", f"{path}/{records}"), 409)
        assert (reason["reason"], "has not started" in reason["message"]) == ("NotStarted", True)
    problem(pilot("GET", "/v1/plans/nothing/verdicts"), 404)


def test_api_without_authority_of_nodes_reads_no_records(pilot: User, world: World) -> None:
    path, _ = started(pilot, world)
    publish_address(world, "127.0.0.1:1")
    (reason,) = problem(pilot("GET", f"{path}/verdicts"), 503)
    assert (reason["reason"], "--node-ca" in reason["message"]) == ("NoAuthority", True)
