"""HTTP server of the simulated camera. It limits clients, so that slow clients cannot block it."""

from __future__ import annotations

import logging
import socket
import threading
import time
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from fractus_world.camera_api import CameraApi, RequestError, Response

log = logging.getLogger(__name__)

MAX_CLIENTS = 32
CLIENT_TIMEOUT_S = 10.0
CLIENT_LIFE_S = 30.0


class _Handler(BaseHTTPRequestHandler):
    """Handles one request per connection, so that idle clients use no resources."""

    server: CameraServer
    server_version = "fractus-camera-world"
    sys_version = ""
    timeout = CLIENT_TIMEOUT_S

    def do_GET(self) -> None:
        if self._is_client_gone():
            # The client closed the connection after its request. Do not render a picture for it.
            self.close_connection = True
            return
        parts = urlsplit(self.path)
        try:
            response = self.server.api.handle(parts.path, dict(parse_qsl(parts.query, max_num_fields=16)))
        except RequestError as error:
            self._send(error.status, Response("text/plain; charset=utf-8", f"{error}\n".encode()))
        except ValueError as error:
            self._send(HTTPStatus.BAD_REQUEST, Response("text/plain; charset=utf-8", f"query: {error}\n".encode()))
        else:
            self._send(HTTPStatus.OK, response)

    def _is_client_gone(self) -> bool:
        """Return True if the client has disconnected."""
        self.connection.settimeout(0.0)
        try:
            return not self.connection.recv(1, socket.MSG_PEEK)
        except BlockingIOError:
            return False
        except OSError:
            return True
        finally:
            self.connection.settimeout(self.timeout)

    def _send(self, status: HTTPStatus, response: Response) -> None:
        try:
            self.send_response(status)
            self.send_header("Content-Type", response.content_type)
            self.send_header("Content-Length", str(len(response.body)))
            self.send_header("Cache-Control", "no-store")
            for name, value in response.headers:
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(response.body)
        except OSError as error:
            log.debug("camera world: client disconnected (error=%s)", error)
            self.close_connection = True

    def log_message(self, format: str, *args: object) -> None:
        log.debug("%s %s", self.client_address[0], format % args)


class CameraServer(ThreadingHTTPServer):
    """Serves the API to a limited number of clients, each for a limited time.

    Args:
        address: Host and port. Port 0 selects a free port.
        api: Handles requests.
    """

    daemon_threads = True
    request_queue_size = 64
    allow_reuse_address = True

    def __init__(self, address: tuple[str, int], api: CameraApi) -> None:
        if ":" in address[0]:
            self.address_family = socket.AF_INET6
        self.api = api
        self._clients: dict[socket.socket, float] = {}
        self._lock = threading.Lock()
        super().__init__(address, _Handler)

    @property
    def port(self) -> int:
        """Port of the server."""
        return int(self.server_address[1])

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve a client in a thread, or close the connection if there are too many clients."""
        with self._lock:
            full = len(self._clients) >= MAX_CLIENTS
            if not full:
                self._clients[request] = time.monotonic()
        if full:
            self.shutdown_request(request)
            return
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """Close a connection."""
        with self._lock:
            self._clients.pop(request, None)
        super().shutdown_request(request)

    def service_actions(self) -> None:
        """Disconnect clients that have been connected for too long."""
        now_s = time.monotonic()
        with self._lock:
            expired = [client for client, since_s in self._clients.items() if now_s - since_s > CLIENT_LIFE_S]
        for client in expired:
            try:
                client.shutdown(socket.SHUT_RDWR)
            except OSError as error:
                log.debug("camera world: client disconnected (error=%s)", error)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Log an error of one client. Other clients are not affected."""
        log.warning("camera world: request failed (client=%s)", client_address, exc_info=True)
