"""Recording endpoint of the agent process with a real API server, which decides who may read records."""

from __future__ import annotations

import http.client
import json
import ssl
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from agent_pki import TestAuthority
from agent_server import FRACTUS, RBAC, ApiServer
from control_plane import wait_for
from flight_log import DRIVER, UID, call, flight_plan, grant, write_log
from fractus_core.api.flight_plans import application_name
from test_agent import Node, authority, drone, server

__all__ = ["authority", "drone", "server"]

pytestmark = [pytest.mark.timeout(300), pytest.mark.xdist_group("agent")]

RECORDS_RULE = {"apiGroups": ["fractus.dev"], "resources": ["flightplans", "flightplans/records"], "verbs": ["get"]}
PLANS_RULE = {"apiGroups": ["fractus.dev"], "resources": ["flightplans"], "verbs": ["get"]}


def user(server: ApiServer, namespace: str, name: str, rule: dict[str, Any], audience: str | None = None) -> str:
    """Create a ServiceAccount with a Role in its namespace, and return a token."""
    accounts = f"/api/v1/namespaces/{namespace}/serviceaccounts"
    server.admin.apply(f"{accounts}/{name}", {"apiVersion": "v1", "kind": "ServiceAccount", "metadata": {"name": name}})
    roles = f"{RBAC}/namespaces/{namespace}"
    header = {"apiVersion": "rbac.authorization.k8s.io/v1", "metadata": {"name": name}}
    server.admin.apply(f"{roles}/roles/{name}", header | {"kind": "Role", "rules": [rule]})
    reference = {"apiGroup": "rbac.authorization.k8s.io", "kind": "Role", "name": name}
    subjects = [{"kind": "ServiceAccount", "name": name, "namespace": namespace}]
    binding = header | {"kind": "RoleBinding", "roleRef": reference, "subjects": subjects}
    server.admin.apply(f"{roles}/rolebindings/{name}", binding)
    spec = {"expirationSeconds": 3600} | ({"audiences": [audience]} if audience else {})
    request = {"apiVersion": "authentication.k8s.io/v1", "kind": "TokenRequest", "spec": spec}
    return str(server.post(f"{accounts}/{name}/token", request)["status"]["token"])


@pytest.fixture
def namespaces(server: ApiServer) -> Iterator[None]:
    for name in ("team", "other"):
        server.post("/api/v1/namespaces", {"metadata": {"name": name}})
    yield
    for name in ("team", "other"):
        server.delete(f"/api/v1/namespaces/{name}")


def read(node: Node, authority: TestAuthority, path: str, token: str) -> tuple[int, Any]:
    """Send a request like the management API: verify the certificate of the node, and send the token of a user."""
    context = ssl.create_default_context(cadata=authority.pem.decode())
    context.check_hostname = False
    connection = http.client.HTTPSConnection("127.0.0.1", node.records, context=context, timeout=30)
    connection.request("GET", path, headers={"Authorization": f"Bearer {token}"})
    response = connection.getresponse()
    return response.status, json.loads(response.read())


def created_plan(server: ApiServer, namespace: str) -> dict[str, Any]:
    body = flight_plan(datetime.now(UTC).replace(microsecond=0))
    body["metadata"] = {"name": "survey-1", "namespace": namespace}
    plans = f"{FRACTUS}/namespaces/{namespace}/flightplans"
    created = server.post(plans, body)
    created["status"] = body["status"] | {"application": application_name(created["metadata"]["uid"])}
    return server.admin.call("PUT", f"{plans}/survey-1/status", created)


def test_api_server_decides_who_reads_the_records_of_a_plan(
    server: ApiServer, authority: TestAuthority, drone: Node, namespaces: None
) -> None:
    plan = created_plan(server, "team")
    start = datetime.fromisoformat(plan["spec"]["window"]["start"])
    driver = DRIVER.replace(UID, plan["metadata"]["uid"])
    begin_s = start.timestamp() - datetime.fromisoformat(call(0, driver)["time"]).timestamp()
    write_log(Path(drone.state) / "audit" / "mobility.jsonl", [grant(begin_s, driver), call(begin_s + 1, driver)])
    drone.describe()
    drone.start()
    drone.certify()
    address = wait_for(
        lambda: (drone.object() or {}).get("status", {}).get("recordsAddress"),
        "the address in the status",
        timeout_s=30,
    )
    assert address == f"127.0.0.1:{drone.records}"

    verdicts = "/v1/namespaces/team/plans/survey-1/verdicts"
    alice = user(server, "team", "alice", RECORDS_RULE)
    # RBAC knows a new role after a moment.
    wait_for(lambda: read(drone, authority, verdicts, alice)[0] == 200, "the role of alice", timeout_s=30)
    _, page = read(drone, authority, verdicts, alice)
    assert [verdict["component"] for verdict in page["items"]] == ["Navigator"]

    strangers = {
        "a reader of plans": (user(server, "team", "observer", PLANS_RULE), 403),
        "a user of another namespace": (user(server, "other", "bob", RECORDS_RULE), 403),
        "a token for another audience": (user(server, "team", "audience", RECORDS_RULE, "https://else.test"), 401),
        "a token that is none": ("eyJhbGciOiJub25lIn0.e30.", 401),
    }
    for stranger, (token, status) in strangers.items():
        assert read(drone, authority, verdicts, token)[0] == status, stranger

    # The same name in another namespace is another plan, whose flight has not started.
    assert (
        read(
            drone,
            authority,
            "/v1/namespaces/other/plans/survey-1/verdicts",
            strangers["a user of another namespace"][0],
        )[0]
        == 404
    )

    revoked = user(server, "team", "carol", RECORDS_RULE)
    wait_for(lambda: read(drone, authority, verdicts, revoked)[0] == 200, "the role of carol", timeout_s=30)
    server.delete("/api/v1/namespaces/team/serviceaccounts/carol")
    wait_for(lambda: read(drone, authority, verdicts, revoked)[0] == 401, "the revoked token", timeout_s=30)

    with server.frozen():
        status, body = read(drone, authority, verdicts, alice)
    assert (status, body["reason"]) == (503, "Unreachable")
    assert alice not in drone.log()
    assert "Traceback" not in drone.log()
