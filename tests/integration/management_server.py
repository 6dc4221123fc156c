"""The management API as a process, users with tokens, and requests."""

from __future__ import annotations

import http.client
import json
import os
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from control_plane import ControlPlane, wait_for
from fractus_cluster.ports import free_port
from operator_world import World, at

Body = dict[str, Any]
RBAC = "/apis/rbac.authorization.k8s.io/v1"


@dataclass(frozen=True)
class Reply:
    """Response to a request."""

    status: int
    headers: Mapping[str, str]
    content: bytes

    @property
    def body(self) -> Any:
        return json.loads(self.content)

    @property
    def etag(self) -> str:
        return self.headers["ETag"]


class ManagementServer:
    """`fractus api serve` on a free port.

    By default, it gets the kubeconfig of the administrator, whose credentials it must not use.
    """

    def __init__(self, plane: ControlPlane, log: Path, *options: str) -> None:
        port = free_port()
        self.url = f"http://127.0.0.1:{port}"
        self.log = log
        argv = ["api", "serve", f"--listen=127.0.0.1:{port}", *options]
        if not any(option.startswith("--server") for option in options):
            argv.append(f"--kubeconfig={plane.kubeconfig}")
        with log.open("ab") as output:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "fractus_cli", *argv],
                stdout=output,
                stderr=output,
                env={**os.environ, "FRACTUS_LOG_FORMAT": "json"},
            )
        wait_for(self._ready, lambda: f"the management API: {log.read_text()}")

    def _ready(self) -> bool:
        assert self._process.poll() is None, self.log.read_text()
        try:
            return self.send("GET", "/readyz").status == 200
        except OSError:
            return False

    def stop(self) -> int:
        self._process.send_signal(signal.SIGTERM)
        return self._process.wait(30)

    def send(
        self,
        method: str,
        path: str,
        body: Any = None,
        *,
        token: str = "",
        headers: Mapping[str, str] | None = None,
    ) -> Reply:
        all_headers = {"Content-Type": "application/json", **(headers or {})}
        if token:
            all_headers["Authorization"] = f"Bearer {token}"
        if body is not None and not isinstance(body, bytes):
            body = json.dumps(body).encode()
        request = urllib.request.Request(self.url + path, body, all_headers, method=method)
        try:
            with urllib.request.urlopen(request, timeout=30) as response:
                return Reply(response.status, response.headers, response.read())
        except urllib.error.HTTPError as error:
            return Reply(error.code, error.headers, error.read())


def user_token(world: World, namespace: str, user: str, roles: tuple[str, ...], cluster_roles: tuple[str, ...]) -> str:
    """Create a ServiceAccount with ClusterRoles in its namespace and in all namespaces, and return a token, as kubectl does."""
    accounts = f"/api/v1/namespaces/{namespace}/serviceaccounts"
    world.api.apply(f"{accounts}/{user}", {"apiVersion": "v1", "kind": "ServiceAccount", "metadata": {"name": user}})
    subject = {"kind": "ServiceAccount", "name": user, "namespace": namespace}
    for scope, kind, bound in (
        (f"/namespaces/{namespace}/rolebindings", "RoleBinding", roles),
        ("/clusterrolebindings", "ClusterRoleBinding", cluster_roles),
    ):
        for role in bound:
            name = f"{namespace}-{user}-{role}"
            reference = {"apiGroup": "rbac.authorization.k8s.io", "kind": "ClusterRole", "name": role}
            header = {"apiVersion": "rbac.authorization.k8s.io/v1", "kind": kind, "metadata": {"name": name}}
            world.api.apply(f"{RBAC}{scope}/{name}", {**header, "roleRef": reference, "subjects": [subject]})
    request = {"apiVersion": "authentication.k8s.io/v1", "kind": "TokenRequest", "spec": {"expirationSeconds": 3600}}
    return str(world.api.call("POST", f"{accounts}/{user}/token", request)["status"]["token"])


class User:
    """A user of the API in one namespace."""

    def __init__(self, server: ManagementServer, token: str, namespace: str) -> None:
        self._server = server
        self.token = token
        self.namespace = namespace

    @property
    def url(self) -> str:
        return self._server.url

    def at(self, server: ManagementServer) -> User:
        """Return the same user at another server."""
        return User(server, self.token, self.namespace)

    def __call__(self, method: str, path: str, body: Any = None, **headers: str) -> Reply:
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        return self._server.send(method, self._in_namespace(path), body, token=self.token, headers=named)

    def open(
        self, path: str, headers: Mapping[str, str]
    ) -> tuple[http.client.HTTPConnection, http.client.HTTPResponse]:
        """Send a GET request, and return the response before its body."""
        connection = http.client.HTTPConnection(self._server.url.removeprefix("http://"), timeout=30)
        connection.request(
            "GET", self._in_namespace(path), headers={"Authorization": f"Bearer {self.token}", **headers}
        )
        return connection, connection.getresponse()

    def stream_status(self, path: str) -> int:
        """Return the status of the response with a stream, and close it."""
        connection, response = self.open(path, {})
        connection.close()
        return response.status

    def _in_namespace(self, path: str) -> str:
        return f"{path}{'&' if '?' in path else '?'}namespace={self.namespace}"


def plan(*, in_s: float = 3600, **more: Any) -> Body:
    start = (datetime.now(UTC) + timedelta(seconds=in_s)).strftime("%Y-%m-%dT%H:%M:%SZ")
    return {
        "template": "survey", "waypoints": [at(50, 50, alt=20)], "window": {"start": start, "duration": 15}, **more,
    }  # fmt: skip


def submitted(user: User, **more: Any) -> Reply:
    reply = user("POST", "/v1/plans", plan(**more))
    assert reply.status == 201, reply
    return reply


def restriction(name: str = "fair", north_m: float = 40, **policy: Any) -> Body:
    corners = [at(north_m + dx, 40 + dy) for dx, dy in ((0, 0), (0, 20), (20, 20), (20, 0))]
    zone = {"area": {"polygon": {"exterior": corners}}, "description": "Summer fair"}
    return {"name": name, "zone": zone, "policy": {"type": "GeofenceControl", "kind": "exclusion", **policy}}


def problem(reply: Reply, status: int) -> list[Body]:
    """Return the reasons of an error response."""
    assert reply.status == status, reply
    assert reply.headers["Content-Type"] == "application/problem+json"
    assert reply.body["status"] == status
    reasons: list[Body] = reply.body["reasons"]
    assert reasons
    return reasons


def path_of(reply: Reply) -> str:
    return f"/v1/plans/{reply.body['metadata']['name']}"
