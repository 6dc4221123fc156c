"""Where the agent finds things: its node, its files, the services beside it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

MAX_DRAIN_S = 600.0
"""A drone stays on a link for as long as something drains on it."""


class MissingSetting(Exception):
    """A setting that has no default is not set."""


class BadSetting(Exception):
    """A setting has a value that it cannot have."""


@dataclass(frozen=True, slots=True)
class Settings:
    """What differs between nodes; everything else is a constant of the module that uses it.

    Attributes:
        drain_s: how long connections may finish what they do on a path that their service leaves while it works.
    """

    node: str
    description: Path
    state: Path
    mobility_address: str
    log_level: str = "INFO"
    log_format: str = "text"
    direct_links: bool = True
    metrics: str = ""
    drain_s: float = 30.0

    @property
    def grants(self) -> Path:
        """Directory of the stored grants, which the node's services watch."""
        return self.state / "grants"

    @property
    def node_object(self) -> Path:
        """The node's Drone or EdgeNode, which the node's services watch."""
        return self.state / "node.json"

    @property
    def audit(self) -> Path:
        """Directory of the audit logs, the services' and this one's."""
        return self.state / "audit"

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
        """Read FRACTUS_NODE, which is needed, and others.

        These are FRACTUS_DESCRIPTION, _STATE_DIR, _MOBILITY, _LOG_LEVEL, _LOG_FORMAT, _DIRECT_LINKS, _DRAIN_S and _METRICS.

        Raises:
            MissingSetting: FRACTUS_NODE is not set.
            BadSetting: FRACTUS_DRAIN_S is no number of seconds, or too many.
        """
        node = environment.get("FRACTUS_NODE", "")
        if not node:
            raise MissingSetting("FRACTUS_NODE is not set: give it the node's name (fieldRef spec.nodeName)")
        drain_s = _seconds("FRACTUS_DRAIN_S", environment.get("FRACTUS_DRAIN_S", "30"), MAX_DRAIN_S)
        return cls(
            node=node,
            description=Path(environment.get("FRACTUS_DESCRIPTION", "/etc/fractus/node.yaml")),
            state=Path(environment.get("FRACTUS_STATE_DIR", "/var/lib/fractus")),
            mobility_address=environment.get("FRACTUS_MOBILITY", "127.0.0.1:50051"),
            drain_s=drain_s,
            direct_links=environment.get("FRACTUS_DIRECT_LINKS", "true").lower() == "true",
            metrics=environment.get("FRACTUS_METRICS", ""),
            log_format=environment.get("FRACTUS_LOG_FORMAT") or "text",
            log_level=environment.get("FRACTUS_LOG_LEVEL", "INFO").upper(),
        )


def _seconds(name: str, text: str, most: float) -> float:
    """A time.

    Raises:
        BadSetting: the text is no number, or one out of bounds.
    """
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not 0 <= seconds <= most:
        raise BadSetting(f"{name} is {text[:80]!r}: give it a number of seconds from 0 to {most:g}")
    return seconds
