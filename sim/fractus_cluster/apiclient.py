"""API server client with administrator rights, used to start a cluster."""

from __future__ import annotations

import http.client
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fractus_runtime.kubernetes import BlockingClient, KubeError, Unconfigured, with_certificate

from fractus_cluster.errors import ClusterError
from fractus_cluster.pki import Credential

_REQUEST_TIMEOUT_S = 10.0


@contextmanager
def administrating(server: str, ca: Path, credential: Credential) -> Iterator[BlockingClient]:
    """Connect to the API server.

    Raises:
        ClusterError: The API server rejected a request or was unreachable.
    """
    try:
        access = with_certificate(server, ca, (credential.certificate, credential.key))
        with BlockingClient(access, "fractus-sim") as api:
            yield api
    except (KubeError, Unconfigured) as error:
        raise ClusterError(f"the API server: {error}") from error


def is_ready(host: str, port: int) -> bool:
    """Return True if a server responds to `GET /ready` (plain HTTP) with success."""
    connection = http.client.HTTPConnection(host, port, timeout=_REQUEST_TIMEOUT_S)
    try:
        connection.request("GET", "/ready")
        return connection.getresponse().status == 200
    except (OSError, http.client.HTTPException):
        return False
    finally:
        connection.close()
