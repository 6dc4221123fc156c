"""Prometheus metrics of the agent: certificate expiry, ages of watches, reports and telemetry, and Grants."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from fractus_runtime.metrics import CERTIFICATE_EXPIRY, gauge, hash_number
from prometheus_client import Metric


@dataclass(frozen=True, slots=True)
class AgentMetrics:
    """Current values of the agent's metrics.

    Attributes:
        expires_s: Expiry of the node's certificate in Unix time, None without a certificate.
        watch_ages_s: Seconds since the last event or list of each watched kind.
        report_age_s: Seconds since the last successful status write, infinite before the first.
        telemetry_age_s: Seconds since the last telemetry, None on a node without a mobility service.
        grants: Number of Grants by state: stored, unverified, unusable, unstored.
        checkpoints: Number and hash of the last signed entry of each audit log, by the name of the log.
    """

    expires_s: float | None
    watch_ages_s: Mapping[str, float]
    report_age_s: float
    telemetry_age_s: float | None
    grants: Mapping[str, int] = field(default_factory=dict)
    checkpoints: Mapping[str, tuple[int, str]] = field(default_factory=dict)

    def collect(self) -> Iterator[Metric]:
        """Yield all metrics."""
        if self.expires_s is not None:
            yield gauge(CERTIFICATE_EXPIRY, "Expiry of the node's certificate in Unix time.", self.expires_s)
        yield gauge(
            "fractus_agent_watch_age_seconds",
            "Seconds since the last event of nodegrants or directlinks. Above 150 the watch is dead.",
            self.watch_ages_s,
            "kind",
        )
        yield gauge(
            "fractus_agent_report_age_seconds",
            "Seconds since the last successful write of the status of the Drone or EdgeNode.",
            self.report_age_s,
        )
        if self.telemetry_age_s is not None:
            yield gauge(
                "fractus_telemetry_age_seconds",
                "Seconds since the last telemetry of the mobility service (drones only).",
                self.telemetry_age_s,
            )
        yield gauge(
            "fractus_agent_grants",
            "Grants by state: stored, unverified (unknown authority), unusable, unstored (cannot be written to disk).",
            self.grants,
            "state",
        )
        yield gauge(
            "fractus_audit_checkpoint_sequence",
            "Sequence number of the last signed entry of an audit log.",
            {log: number for log, (number, _) in self.checkpoints.items()},
            "log",
        )
        yield gauge(
            "fractus_audit_checkpoint_head",
            "Hash of the last signed entry of an audit log, as in fractus_audit_head.",
            {log: hash_number(hash_) for log, (_, hash_) in self.checkpoints.items()},
            "log",
        )
