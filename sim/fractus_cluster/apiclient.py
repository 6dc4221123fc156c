"""A few calls to the API server, for bringing a cluster up: JSON over HTTPS with the administrator's certificate."""

from __future__ import annotations

import http.client
import json
import ssl
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from fractus_cluster.errors import ClusterError
from fractus_cluster.pki import Credential

_REQUEST_TIMEOUT_S = 10.0
_POLL_S = 0.05

Json = dict[str, Any]


class ApiError(ClusterError):
    """The API server refused a request."""

    def __init__(self, status: int, message: str) -> None:
        super().__init__(f"the API server answered {status}: {message}")
        self.status = status


class ApiClient:
    """A connection to the API server that is opened again when it breaks."""

    def __init__(self, host: str, port: int, *, ca: Path, credential: Credential) -> None:
        context = ssl.create_default_context(cafile=str(ca))
        context.load_cert_chain(credential.certificate, credential.key)
        self._connection = http.client.HTTPSConnection(host, port, timeout=_REQUEST_TIMEOUT_S, context=context)

    def __enter__(self) -> ApiClient:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._connection.close()

    def _send(self, method: str, path: str, body: Json | None, content_type: str) -> tuple[int, bytes]:
        payload = None if body is None else json.dumps(body).encode()
        try:
            self._connection.request(method, path, body=payload, headers={"Content-Type": content_type})
            answer = self._connection.getresponse()
            return answer.status, answer.read()
        except (OSError, http.client.HTTPException) as error:
            self._connection.close()
            raise ClusterError(f"the API server cannot be reached: {error}") from error

    def request(
        self, method: str, path: str, body: Json | None = None, *, content_type: str = "application/json"
    ) -> Json:
        """Send one request and return the object in the answer.

        Raises:
            ApiError: The server refused it.
            ClusterError: The server cannot be reached.
        """
        status, content = self._send(method, path, body, content_type)
        if status >= 400:
            try:
                message = str(json.loads(content)["message"])
            except (json.JSONDecodeError, KeyError, TypeError):
                message = content.decode(errors="replace")[:500]
            raise ApiError(status, message)
        answer = json.loads(content)
        return answer if isinstance(answer, dict) else {}

    def apply(self, path: str, body: Mapping[str, Any]) -> Json:
        """Make an object be as given, by server-side apply; `path` is the object's own."""
        url = f"{path}?fieldManager=fractus-sim&force=true"
        return self.request("PATCH", url, dict(body), content_type="application/apply-patch+yaml")

    def patch(self, path: str, body: Mapping[str, Any]) -> Json:
        """Merge a patch into an object."""
        return self.request("PATCH", path, dict(body), content_type="application/merge-patch+json")

    def ready(self) -> bool:
        """Whether the server says that it is ready."""
        try:
            status, _ = self._send("GET", "/readyz", None, "application/json")
        except ClusterError:
            return False
        return status == 200

    def wait_ready(self, *, timeout_s: float) -> None:
        """Wait until the server is ready.

        Raises:
            ClusterError: It was not in time.
        """
        deadline = time.monotonic() + timeout_s
        while not self.ready():
            if time.monotonic() > deadline:
                raise ClusterError(f"the API server was not ready within {timeout_s:.0f} s")
            time.sleep(_POLL_S)


def answers_ready(host: str, port: int) -> bool:
    """Whether a server answers `GET /ready` (over plain HTTP) with success."""
    connection = http.client.HTTPConnection(host, port, timeout=_REQUEST_TIMEOUT_S)
    try:
        connection.request("GET", "/ready")
        return connection.getresponse().status == 200
    except (OSError, http.client.HTTPException):
        return False
    finally:
        connection.close()
