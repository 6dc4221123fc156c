"""Clusters that do not answer, or refuse the user: each answer names the cause and the remedy."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from fractus_cli.main import run

COMMANDS = ["status", "status -n city", "explain survey", "explain survey -n city", "doctor"]
KUBECONFIG = """\
apiVersion: v1
kind: Config
current-context: a
contexts: [{{name: a, context: {{cluster: c, user: u}}}}]
clusters: [{{name: c, cluster: {{server: "http://127.0.0.1:{port}"}}}}]
users: [{{name: u, user: {{token: old}}}}]
"""


class Refusing(BaseHTTPRequestHandler):
    """API server that refuses every request with a status."""

    status = 0

    def do_GET(self) -> None:
        """Refuse the request."""
        message = {401: "Unauthorized", 403: "applications.fractus.dev is forbidden"}[self.status]
        body = json.dumps({"kind": "Status", "code": self.status, "message": message}).encode()
        self.send_response(self.status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_arguments: object) -> None:
        """Print nothing."""


@pytest.fixture
def refusing(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Path]:
    """Return the kubeconfig of an API server that refuses every request with the status of the parameter."""
    handler = type("Handler", (Refusing,), {"status": request.param})
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        file = tmp_path / "config"
        file.write_text(KUBECONFIG.format(port=server.server_port))
        yield file
        server.shutdown()


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(
    ("refusing", "remedies"),
    [
        (401, ["the credentials are invalid or expired: log in again"]),
        (
            403,
            [
                "forbidden; check your permissions",
                "check your permissions there",
                "specify a namespace with --namespace",
            ],
        ),
    ],
    indirect=["refusing"],
)
def test_refusal_of_a_cluster_is_explained(
    refusing: Path, remedies: list[str], command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run([*command.split(), "--kubeconfig", str(refusing)]) in {1, 2}
    printed = capsys.readouterr()
    assert any(remedy in printed.out + printed.err for remedy in remedies)


@pytest.mark.parametrize("command", COMMANDS)
def test_unreachable_cluster_is_explained(tmp_path: Path, command: str, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "config"
    file.write_text(KUBECONFIG.format(port=1))
    assert run([*command.split(), "--kubeconfig", str(file)]) == 1
    error = capsys.readouterr().err
    assert "127.0.0.1:1" in error
    assert "check the cluster and --kubeconfig" in error
