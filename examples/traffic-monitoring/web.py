"""Small HTTP server and client for the components, based on the standard library."""

from __future__ import annotations

import json
import signal
import threading
import urllib.request
from collections.abc import Callable, Mapping
from email.message import Message
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

MAX_BODY_BYTES = 16 * 2**20
Handler = Callable[[bytes, Message], Any]


def serve(port: int, get: Mapping[str, Handler], post: Mapping[str, Handler]) -> None:
    """Serve requests with JSON responses until SIGTERM, including GET /healthz."""
    routes = {"GET": {"/healthz": lambda *_: {"status": "ok"}, **get}, "POST": post}

    class Requests(BaseHTTPRequestHandler):
        timeout = 10

        def respond(self) -> None:
            handler = routes[self.command].get(self.path)
            length = int(self.headers.get("Content-Length") or 0)
            if handler is None or not 0 <= length <= MAX_BODY_BYTES:
                return self.reply(404 if handler is None else 413, {"error": "unknown path, or body too large"})
            try:
                return self.reply(200, handler(self.rfile.read(length), self.headers))
            except ValueError as error:
                return self.reply(400, {"error": str(error)})
            except OSError as error:  # A dependency of this component is unreachable.
                return self.reply(503, {"error": str(error)})

        do_GET = do_POST = respond  # noqa: N815

        def reply(self, status: int, value: Any) -> None:
            body = json.dumps(value).encode()
            self.send_response(status)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: Any) -> None:
            """Suppress the access log."""

    server = ThreadingHTTPServer(("", port), Requests)
    signal.signal(signal.SIGTERM, lambda *_: threading.Thread(target=server.shutdown).start())
    with server:
        server.serve_forever()


def post(address: str, path: str, body: bytes, headers: Mapping[str, str], timeout_s: float = 5.0) -> Any:
    """Send a body to another component and return its JSON response.

    Raises:
        OSError: The component is unreachable, or returned an error.
    """
    request = urllib.request.Request(f"http://{address}{path}", data=body, headers=dict(headers), method="POST")
    with urllib.request.urlopen(request, timeout=timeout_s) as response:  # nosec B310  # plain HTTP within the cluster
        return json.load(response)
