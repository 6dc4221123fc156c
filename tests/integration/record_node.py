"""The recording endpoint of a drone's agent with the files of a test, and flights with records."""

from __future__ import annotations

import asyncio
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from agent_pki import TestAuthority
from control_plane import ControlPlane
from fractus_agent.certificates import create_request
from fractus_agent.identity import NodeIdentity
from fractus_agent.records.record_server import RecordServer
from fractus_agent.store import Store
from fractus_cluster.ports import free_port
from fractus_core.api.flight_plans import application_name
from fractus_runtime.files import write_set
from fractus_runtime.kubernetes import Client, kubeconfig
from management_server import User, path_of, submitted
from operator_world import FRACTUS, World


class Identity:
    """The certificate of the node, which exists."""

    def __init__(self) -> None:
        self.ready = asyncio.Event()
        self.ready.set()
        self.serial = 1


class RecordNode:
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


def publish_address(world: World, address: str) -> None:
    world.api.merge(f"{FRACTUS}/drones/drone-1/status", {"status": {"recordsAddress": address}})


def report_start(world: World, plan: dict[str, Any]) -> None:
    """Report the Application of a plan as the operator does at the start."""
    metadata = plan["metadata"]
    status = {"status": {"application": application_name(metadata["uid"])}}
    world.api.merge(f"{FRACTUS}/namespaces/{metadata['namespace']}/flightplans/{metadata['name']}/status", status)


def started(user: User, world: World) -> tuple[str, dict[str, Any]]:
    """Submit a plan, and report its start. Return the path of the plan and the plan."""
    reply = submitted(user)
    report_start(world, reply.body)
    return path_of(reply), reply.body


@dataclass(frozen=True)
class Flight:
    """The flight of a plan whose records exist.

    Attributes:
        user: User with the role of the chart for ordering flights.
        path: Path of the plan.
        name: Name of the plan.
        driver: Identity of its component.
        log: Audit log of the mobility service. Its last entry has the number 5.
        since_s: Begin of the flight, in seconds after the `START` of logs.
        recorded: Path of the recording of pictures, which does not exist yet.
        pictures: Pictures to record: seconds after the start, owner, and JPEG.
    """

    user: User
    path: str
    name: str
    driver: str
    log: Path
    since_s: float
    recorded: Path
    pictures: list[tuple[float, str, bytes]]
