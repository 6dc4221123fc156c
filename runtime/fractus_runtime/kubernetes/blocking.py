"""Client for programs without an event loop: tools that start clusters, tests and benchmarks."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Coroutine, Mapping
from typing import Any, Self, TypeVar

from fractus_runtime.kubernetes.access import Access
from fractus_runtime.kubernetes.client import LIST_TIMEOUT_S, Client
from fractus_runtime.kubernetes.connection import REQUEST_TIMEOUT_S, ContentType
from fractus_runtime.kubernetes.errors import NotFound, unreachable
from fractus_runtime.kubernetes.objects import Body

T = TypeVar("T")

_POLL_S = 0.05


class BlockingClient:
    """Sends requests to paths of the API server. Thread-safe."""

    def __init__(self, access: Access, field_manager: str, *, trust_env: bool = False) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="kube", daemon=True)
        self._thread.start()
        self._client = Client(access, field_manager, trust_env=trust_env)

    def close(self) -> None:
        """Close every connection."""
        if self._loop.is_closed():
            return
        self._run(self._client.aclose())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def call(
        self,
        method: str,
        path: str,
        body: Body | list[Body] | None = None,
        *,
        content_type: ContentType = ContentType.JSON,
        params: Mapping[str, str] | None = None,
        timeout_s: float = REQUEST_TIMEOUT_S,
    ) -> Body:
        """Send one request and return the object in the response.

        Raises:
            KubeError: The request was refused, or there was no response in time.
        """
        return self._run(
            self._client.request(method, path, body, content_type=content_type, params=params, timeout_s=timeout_s)
        )

    def get(self, path: str) -> Body | None:
        """Return an object, or None if it does not exist."""
        try:
            return self.call("GET", path)
        except NotFound:
            return None

    def list(self, path: str, **params: str) -> list[Body]:
        """Return the items of a collection."""
        return list(self.call("GET", path, params=params, timeout_s=LIST_TIMEOUT_S)["items"])

    def apply(self, path: str, body: Mapping[str, Any], manager: str = "") -> Body:
        """Apply an object by server-side apply. `path` is the path of the object."""
        params = {"fieldManager": manager or self._client.field_manager, "force": "true"}
        return self.call("PATCH", path, dict(body), content_type=ContentType.APPLY, params=params)

    def merge(self, path: str, body: Mapping[str, Any]) -> Body:
        """Apply a merge patch to an object."""
        return self.call("PATCH", path, dict(body), content_type=ContentType.MERGE)

    def delete(self, path: str, grace_s: int | None = None) -> None:
        """Delete an object and, in the background, the objects that it owns. A missing object is not an error."""
        options: Body = {"propagationPolicy": "Background"}
        if grace_s is not None:
            options["gracePeriodSeconds"] = grace_s
        try:
            self.call("DELETE", path, options)
        except NotFound:
            return

    def ready(self) -> bool:
        """Return True if the API server reports that it is ready."""
        return self._run(self._client.ready())

    def wait_ready(self, timeout_s: float) -> None:
        """Wait until the API server is ready.

        Raises:
            KubeError: The API server was not ready in time.
        """
        deadline = time.monotonic() + timeout_s
        while not self.ready():
            if time.monotonic() > deadline:
                raise unreachable(f"not ready within {timeout_s:.0f} s")
            time.sleep(_POLL_S)

    def _run(self, request: Coroutine[Any, Any, T]) -> T:
        return asyncio.run_coroutine_threadsafe(request, self._loop).result()
