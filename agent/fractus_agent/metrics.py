"""What the agent tells Prometheus of its node: what it knows of the API server, the drone and the grants, and how old that is."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from fractus_runtime.exposition import CERTIFICATE_EXPIRY
from fractus_runtime.figures import Figure, gauge, hash_number


@dataclass(frozen=True, slots=True)
class AgentFigures:
    """What holds of a node's agent now.

    Attributes:
        expires_s: Unix time at which the node's certificate expires; None while there is none.
        heard_s: by kind, seconds since the API server said anything about it.
        reported_s: seconds since the API server took the node's status; infinite before that.
        telemetry_s: seconds since the mobility service was heard; None on a node without one.
        grants: how many are stored, unverified, unusable or unstored.
        checkpoints: by name of an audit log, number and hash of the entry that was signed last.
    """

    expires_s: float | None
    heard_s: Mapping[str, float]
    reported_s: float
    telemetry_s: float | None
    grants: Mapping[str, int] = field(default_factory=dict)
    checkpoints: Mapping[str, tuple[int, str]] = field(default_factory=dict)

    def metrics(self) -> Iterator[Figure]:
        """All of it for Prometheus."""
        if self.expires_s is not None:
            yield gauge(CERTIFICATE_EXPIRY, "When the node's certificate expires, in Unix time.", self.expires_s)
        yield gauge(
            "fractus_agent_watch_age_seconds",
            "Since the API server said anything about nodegrants or directlinks; above 150 the watch is dead.",
            self.heard_s,
            "kind",
        )
        yield gauge(
            "fractus_agent_report_age_seconds",
            "Since the API server took the status of the Drone or EdgeNode.",
            self.reported_s,
        )
        if self.telemetry_s is not None:
            yield gauge(
                "fractus_telemetry_age_seconds", "Since the mobility service was heard; on drones.", self.telemetry_s
            )
        yield gauge(
            "fractus_agent_grants",
            "Grants: stored, unverified (of an authority that is not known), unusable, unstored (the disk does not take them).",
            self.grants,
            "state",
        )
        yield gauge(
            "fractus_audit_checkpoint_sequence",
            "Number of the entry of an audit log that was signed last.",
            {log: number for log, (number, _) in self.checkpoints.items()},
            "log",
        )
        yield gauge(
            "fractus_audit_checkpoint_head",
            "Hash of the entry of an audit log that was signed last, as in fractus_audit_head.",
            {log: hash_number(hash_) for log, (_, hash_) in self.checkpoints.items()},
            "log",
        )
