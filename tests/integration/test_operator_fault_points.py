"""Kill the operator after each kind of write: the API server has stored the object, but not sent the response."""

from __future__ import annotations

import asyncio
import os
import random
import secrets
import ssl
import threading
from collections.abc import Container, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

import aiohttp
import pytest
import yaml
from aiohttp import web
from control_plane import ControlPlane, wait_for
from fractus_cluster.ports import free_port
from operator_world import OperatorProcess, World, traffic
from test_operator import deployed, end_mission, gone
from test_operator_flight_plans import approved_template, started, status, submit

EXPECTED = {
    "application is taken": {"PATCH applications", "PATCH applications/status", "POST deploymentplans"},
    "roll-out": {
        "POST deployments", "POST secrets", "POST services", "POST endpointslices", "POST networkpolicies", "POST grants",
        "POST poddisruptionbudgets", "POST nodegrants", "POST events",
    },
    "end of the mission": {"PATCH nodegrants", "DELETE secrets", "DELETE deployments", "DELETE replicasets", "PATCH pods"},
    "deletion": {"DELETE grants", "DELETE deploymentplans"},
}  # fmt: skip
"""Kinds of writes that must occur, by stage of the test. Other kinds may also occur."""


class FaultPoints:
    """Proxy between operator and API server. It kills the operator after the first write of some kinds.

    Args:
        plane: Control plane to which requests are forwarded.
        operator: Process that is killed.
        port: Port of the proxy.
        kinds: Kinds of writes that end with a kill. None: all kinds.

    Attributes:
        reached: Kinds of writes that occurred.
    """

    def __init__(self, plane: ControlPlane, operator: OperatorProcess, port: int, kinds: Container[str] | None) -> None:
        self._operator = operator
        self._kinds = kinds
        self._server = plane.server
        self._port = port
        credential = plane.authority.issue("points", common_name="points", organizations=("system:masters",))
        self._tls = ssl.create_default_context(cafile=str(plane.ca))
        self._tls.load_cert_chain(credential.certificate, credential.key)
        self.reached: list[str] = []

    @contextmanager
    def serving(self) -> Iterator[None]:
        """Forward requests for the length of a block."""
        ready = threading.Event()
        running: list[tuple[asyncio.AbstractEventLoop, asyncio.Event]] = []

        async def main() -> None:
            running.append((asyncio.get_running_loop(), end := asyncio.Event()))
            async with aiohttp.ClientSession(connector=aiohttp.TCPConnector(ssl=self._tls, limit=0)) as session:
                application = web.Application(client_max_size=1 << 26)
                application.router.add_route("*", "/{path:.*}", lambda request: self._forward(session, request))
                runner = web.AppRunner(application, shutdown_timeout=0.1)
                await runner.setup()
                await web.TCPSite(runner, "127.0.0.1", self._port).start()
                ready.set()
                await end.wait()
                await runner.cleanup()

        thread = threading.Thread(target=lambda: asyncio.run(main()))
        thread.start()
        assert ready.wait(30)
        try:
            yield
        finally:
            loop, end = running[0]
            loop.call_soon_threadsafe(end.set)
            thread.join(30)

    async def _forward(self, session: aiohttp.ClientSession, request: web.Request) -> web.StreamResponse:
        headers = {name: value for name, value in request.headers.items() if name.lower() in {"accept", "content-type"}}
        body = await request.read()
        timeout = aiohttp.ClientTimeout(total=None)
        url = f"{self._server}{request.raw_path}"
        async with session.request(
            request.method, url, data=body or None, headers=headers, timeout=timeout
        ) as upstream:
            step = _step(request)
            if step is not None and step not in self.reached and upstream.ok:
                self.reached.append(step)
                if self._kinds is None or step in self._kinds:
                    self._operator.kill()
                    return web.Response(status=503)
            response = web.StreamResponse(status=upstream.status)
            response.content_type = upstream.content_type
            await response.prepare(request)
            async for chunk in upstream.content.iter_any():
                await response.write(chunk)
        return response


def _step(request: web.Request) -> str | None:
    """Return method, kind and subresource of a write request, or None for requests that are not part of a reconciliation."""
    if request.method == "GET":
        return None
    parts = request.path.strip("/").split("/")
    rest = parts[2:] if parts[0] == "api" else parts[3:]
    if rest[0] == "namespaces" and len(rest) > 2:
        rest = rest[2:]
    if rest[0] == "leases":
        return None
    return f"{request.method} {'/'.join([rest[0], *rest[2:]])}"


@contextmanager
def killed_after_writes(
    plane: ControlPlane, folder: Path, kinds: Container[str] | None
) -> Iterator[tuple[OperatorProcess, FaultPoints]]:
    """An operator that is killed after writes of some kinds, and then started again."""
    port = free_port()
    kubeconfig = folder / "points.kubeconfig"
    cluster = {"name": "points", "cluster": {"server": f"http://127.0.0.1:{port}"}}
    context = {"name": "points", "context": {"cluster": "points", "user": "points"}}
    users = [{"name": "points", "user": {}}]
    kubeconfig.write_text(
        yaml.safe_dump({"clusters": [cluster], "contexts": [context], "users": users, "current-context": "points"})
    )
    operator = OperatorProcess(kubeconfig, folder / "operator.log")
    points = FaultPoints(plane, operator, port, kinds)
    over = threading.Event()

    def again() -> None:
        while not over.wait(0.05):
            if not operator.running:
                operator.start()

    keeper = threading.Thread(target=again)
    with points.serving():
        keeper.start()
        try:
            yield operator, points
        finally:
            over.set()
            keeper.join()
            if operator.running:
                operator.stop()
            print(kinds, points.reached, operator.log()[-6000:])


GRANT_WRITES = {"POST nodegrants", "POST grants", "PATCH nodegrants", "DELETE grants"}
"""Kinds of writes that permit flights, or end the permission. The operator is always killed after them."""


def sampled_kinds() -> set[str]:
    """Return `GRANT_WRITES` and one kind of write per stage, at random unless SEED contains the printed seed."""
    seed = int(os.environ.get("SEED") or secrets.randbelow(1 << 31))
    print("seed", seed)
    source = random.Random(seed)
    return GRANT_WRITES | {source.choice(sorted(kinds)) for kinds in EXPECTED.values()}


@pytest.mark.timeout(1500)
@pytest.mark.parametrize("every", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["sample", "every kind"])
def test_operator_killed_after_any_write_reaches_same_state(
    control_plane: ControlPlane, world: World, namespace: str, tmp_path: Path, *, every: bool
) -> None:
    """Kill the operator after each kind of write. `make test` kills it after a sample only."""
    kinds = None if every else sampled_kinds()
    with killed_after_writes(control_plane, tmp_path, kinds) as (operator, points):
        world.put(traffic(namespace))
        # The operator starts up to two dozen times. Each start takes up to ten seconds on a busy machine.
        wait_for(lambda: len(world.pods(namespace)) == 7, operator.log, 600)
        # No pod starts without its certificate.
        wait_for(lambda: sum(name.startswith("secrets/") for name in world.children(namespace)) == 7, operator.log, 600)
        world.run_pods(namespace)
        wait_for(lambda: world.condition(namespace, "Ready").get("status") == "True", operator.log, 600)
        ready = deployed(world, namespace)
        assert (ready["drone"], ready["pods"]) == ("drone-1", "7/7")
        grants = [grant["spec"]["instance"] for grant in world.grants(namespace)]
        assert len(grants) == len(set(grants)) == 4
        assert len(world.pods(namespace)) == 7
        end_mission(world, namespace, "Complete", "done")
        wait_for(lambda: world.status(namespace).get("phase") == "Completed", operator.log, 600)
        wait_for(lambda: not world.grants(namespace), operator.log, 600)
        wait_for(
            lambda: all(pod["spec"].get("activeDeadlineSeconds") for pod in world.pods(namespace)), operator.log, 600
        )
        wait_for(lambda: list(world.children(namespace)) == ["deploymentplans/traffic"], operator.log, 600)
        world.api.delete(f"/apis/fractus.dev/v1alpha1/namespaces/{namespace}/applications/traffic")
        wait_for(lambda: gone(world, namespace) and not world.pods(namespace), operator.log, 600)
        for when, steps in EXPECTED.items():
            assert steps <= set(points.reached), f"{when}: {steps - set(points.reached)}"


@pytest.mark.timeout(600)
def ended_after_reports(world: World, namespace: str) -> bool:
    """Report from the drone on the ground. Return True if the plan has ended."""
    report = {"status": {"lastSeen": datetime.now(UTC).isoformat()}}
    world.api.merge("/apis/fractus.dev/v1alpha1/drones/drone-1/status", report)
    return bool(status(world, namespace).get("state") == "Ended")


@pytest.mark.parametrize(
    "write",
    [
        "POST applications",
        pytest.param("PATCH flightplans/status", marks=pytest.mark.slow),
        pytest.param("PATCH flightplans", marks=pytest.mark.slow),
    ],
)
def test_operator_killed_after_write_for_flight_plan_starts_the_flight_once(
    control_plane: ControlPlane, world: World, namespace: str, tmp_path: Path, write: str
) -> None:
    approved_template(world)
    with killed_after_writes(control_plane, tmp_path, {write}) as (operator, points):
        submit(world, namespace, in_s=5, autoActivate=True)
        wait_for(lambda: started(world, namespace), operator.log, 120)
        assert write in points.reached
        applications = f"/apis/fractus.dev/v1alpha1/namespaces/{namespace}/applications"
        (application,) = world.api.list(applications)
        plan = world.api.get(f"/apis/fractus.dev/v1alpha1/namespaces/{namespace}/flightplans/flight")
        assert plan is not None
        assert application["metadata"]["name"] == f"flight-{plan['metadata']['uid']}"
        world.api.delete(f"{applications}/{application['metadata']['name']}")
        wait_for(lambda: not world.api.list(applications), operator.log, 120)
        wait_for(lambda: ended_after_reports(world, namespace), operator.log, 120)
        assert not world.api.list(applications)
