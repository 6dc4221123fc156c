"""Settings of the management API."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

DEFAULT_NAMESPACE = "default"
DEFAULT_REQUESTS_PER_S = 20.0


@dataclass(frozen=True, slots=True)
class AutomatedTesting:
    """Settings of the adapter for InterUSS' automated testing.

    Attributes:
        template: ApplicationTemplate of flights that name none.
        geoid_m: Height of the geoid above the ellipsoid where the tests fly, in metres.
    """

    template: str
    geoid_m: float = 0.0


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings of the management API.

    Attributes:
        namespace: Namespace of plans if a request names none.
        decision_timeout_s: Seconds for which a request waits for the decision of the operator.
        max_body_bytes: Maximum size of a request body in bytes.
        body_timeout_s: Seconds within which a request body must arrive.
        requests_per_s: Requests that a token may send per second in the long run. It may send five times as many at once.
        max_streams: Maximum number of open event streams and transfers of pictures of this process.
        max_streams_of_token: Maximum number of open event streams and transfers of pictures of a token.
        max_pages_of_drone: Maximum number of pages of records that are read from a drone at the same time.
        keepalive_s: Seconds without an event after which a stream sends a comment.
        automated_testing: Settings of the adapter for InterUSS' automated testing. None: the adapter is not served.
        node_ca: File of the CA that issues the certificates of drones. None: records of flights cannot be read.
    """

    namespace: str = DEFAULT_NAMESPACE
    decision_timeout_s: float = 10.0
    max_body_bytes: int = 2**20
    body_timeout_s: float = 30.0
    requests_per_s: float = DEFAULT_REQUESTS_PER_S
    max_streams: int = 256
    max_streams_of_token: int = 16
    max_pages_of_drone: int = 8
    keepalive_s: float = 15.0
    automated_testing: AutomatedTesting | None = None
    node_ca: Path | None = None

    @property
    def burst(self) -> float:
        """Requests that a token may send at once."""
        return 5 * self.requests_per_s
