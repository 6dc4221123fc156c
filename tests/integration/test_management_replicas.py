"""Several management APIs beside each other, while the operator is killed."""

from __future__ import annotations

from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from control_plane import ControlPlane, wait_for
from depth import cells
from management_server import ManagementServer, Reply, User, plan
from operator_world import FRACTUS, OperatorProcess, World

CLIENTS = 20
PLANS = 200
REQUESTS = 220
"""Requests of all clients. The last 20 repeat earlier ones."""

DRONES = 5
KILLED_AFTER = cells(range(1, PLANS, 4), quick=[1, 21, 101])
"""Number of requests before the operator is killed, for each run."""

pytestmark = pytest.mark.slow


# test_one_of_many_overlapping_plans_is_accepted_although_the_operator_is_killed (unit tests) is the fast form.
@pytest.mark.parametrize("killed_after", KILLED_AFTER)
def test_one_of_many_overlapping_plans_is_accepted_through_several_servers(
    pilot: User,
    control_plane: ControlPlane,
    world: World,
    operator: OperatorProcess,
    namespace: str,
    tmp_path: Path,
    killed_after: int,
) -> None:
    for number in range(2, DRONES + 1):
        world.add_drone(f"drone-{number}")
    wait_for(world.is_labelled, "the operator to know the drones")
    servers = [ManagementServer(control_plane, tmp_path / f"log-{number}") for number in range(3)]
    try:
        clients = [pilot.at(server) for server in servers]
        body = plan()

        def submit(number: int) -> Reply:
            if number == killed_after:
                operator.kill()
                operator.stop()
                operator.start()
            return clients[number % 3]("POST", "/v1/plans", body, Idempotency_Key=f"key-{number % PLANS}")

        with ThreadPoolExecutor(CLIENTS) as pool:
            replies = list(pool.map(submit, range(REQUESTS)))
        assert {reply.status for reply in replies} <= {201, 202}
        path = f"{FRACTUS}/namespaces/{namespace}/flightplans"

        def states() -> Counter[str]:
            return Counter((item.get("status") or {}).get("state", "") for item in world.api.list(path))

        wait_for(lambda: "" not in states(), lambda: f"every plan to be decided: {states()}")
        assert states() == {"Accepted": 1, "Rejected": PLANS - 1}
        named = {reply.body["metadata"]["name"] for reply in replies}
        assert len(named) == PLANS
    finally:
        for server in servers:
            assert server.stop() == 0
