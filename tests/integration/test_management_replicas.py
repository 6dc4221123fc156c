"""Several management APIs beside each other, while the operator is killed."""

from __future__ import annotations

from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from control_plane import ControlPlane, wait_for
from management_server import ManagementServer, Reply, User, plan
from operator_world import FRACTUS, OperatorProcess, World

CLIENTS = 20
PLANS = 200
DRONES = 5

pytestmark = pytest.mark.slow


# test_one_of_many_overlapping_plans_is_accepted_although_the_operator_is_killed (unit tests) is the fast form.
@pytest.mark.parametrize("killed_after", [1, 20, 100])
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
            return clients[number % 3]("POST", "/v1/plans", body, Idempotency_Key=f"key-{number // 2}")

        with ThreadPoolExecutor(CLIENTS) as pool:
            replies = list(pool.map(submit, range(PLANS)))
        assert {reply.status for reply in replies} <= {201, 202}
        path = f"{FRACTUS}/namespaces/{namespace}/flightplans"

        def states() -> Counter[str]:
            return Counter((item.get("status") or {}).get("state", "") for item in world.api.list(path))

        wait_for(lambda: "" not in states(), lambda: f"every plan to be decided: {states()}")
        # Two requests share each key.
        assert states() == {"Accepted": 1, "Rejected": PLANS // 2 - 1}
        named = {reply.body["metadata"]["name"] for reply in replies}
        assert len(named) == PLANS // 2
    finally:
        for server in servers:
            assert server.stop() == 0
