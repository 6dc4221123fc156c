"""Settings of the agent, from environment variables."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

DEFAULT_DRAIN_S = 1.5
MAX_DRAIN_S = 600.0
"""Maximum of `drain_s`, in seconds. A drone cannot leave a link while connections drain on it."""


class MissingSetting(Exception):
    """A required setting is missing."""


class BadSetting(Exception):
    """A setting has an invalid value."""


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings of the agent.

    Attributes:
        node: Name of the Kubernetes node (FRACTUS_NODE, required).
        description: Manifest of the node's Drone or EdgeNode (FRACTUS_DESCRIPTION).
        state: State directory (FRACTUS_STATE_DIR).
        mobility_address: Host and port of the mobility service (FRACTUS_MOBILITY).
        log_level: Log level (FRACTUS_LOG_LEVEL).
        log_format: Log format, text or json (FRACTUS_LOG_FORMAT).
        direct_links: True to use direct links (FRACTUS_DIRECT_LINKS).
        metrics: Host and port of the Prometheus endpoint, empty for none (FRACTUS_METRICS).
        records: Host and port of the recording endpoint, empty for none (FRACTUS_RECORDS). The status of the Drone contains it,
            so the host must be an address that other nodes can reach.
        drain_s: Time for which connections may stay on a working path that their service has left, in seconds
            (FRACTUS_DRAIN_S).
    """

    node: str
    description: Path
    state: Path
    mobility_address: str
    log_level: str = "INFO"
    log_format: str = "text"
    direct_links: bool = True
    metrics: str = ""
    records: str = ""
    drain_s: float = DEFAULT_DRAIN_S

    @property
    def grants(self) -> Path:
        """Directory of the stored Grants, which the node's services watch."""
        return self.state / "grants"

    @property
    def node_object(self) -> Path:
        """File of the node's Drone or EdgeNode, which the node's services watch."""
        return self.state / "node.json"

    @property
    def audit(self) -> Path:
        """Directory of the audit logs of the services and the agent."""
        return self.state / "audit"

    @property
    def gateway_audit(self) -> Path:
        """Directory of the audit log of the gateway, which runs as another user."""
        return self.state / "gateway" / "audit"

    @property
    def links(self) -> Path:
        """Directory of the stored DirectLinks."""
        return self.state / "links"

    @property
    def tls(self) -> Path:
        """Directory of the node's certificate, key and authority."""
        return self.state / "tls"

    @classmethod
    def from_environment(cls, environment: Mapping[str, str]) -> Settings:
        """Read the settings from the environment variables of the attributes.

        Raises:
            MissingSetting: FRACTUS_NODE is not set.
            BadSetting: FRACTUS_DRAIN_S is not a number of seconds in the allowed range.
        """
        node = environment.get("FRACTUS_NODE", "")
        if not node:
            raise MissingSetting("FRACTUS_NODE is not set: set it to the node's name (fieldRef spec.nodeName)")
        drain_s = _seconds("FRACTUS_DRAIN_S", environment.get("FRACTUS_DRAIN_S", str(DEFAULT_DRAIN_S)), MAX_DRAIN_S)
        return cls(
            node=node,
            description=Path(environment.get("FRACTUS_DESCRIPTION", "/etc/fractus/node.yaml")),
            state=Path(environment.get("FRACTUS_STATE_DIR", "/var/lib/fractus")),
            mobility_address=environment.get("FRACTUS_MOBILITY", "127.0.0.1:50051"),
            drain_s=drain_s,
            direct_links=environment.get("FRACTUS_DIRECT_LINKS", "true").lower() == "true",
            metrics=environment.get("FRACTUS_METRICS", ""),
            records=environment.get("FRACTUS_RECORDS", ""),
            log_format=environment.get("FRACTUS_LOG_FORMAT") or "text",
            log_level=environment.get("FRACTUS_LOG_LEVEL", "INFO").upper(),
        )


def _seconds(name: str, text: str, maximum: float) -> float:
    """Parse a number of seconds.

    Raises:
        BadSetting: The text is not a number, or out of range.
    """
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not 0 <= seconds <= maximum:
        raise BadSetting(f"{name} is {text[:80]!r}: set it to a number of seconds from 0 to {maximum:g}")
    return seconds
