"""Prometheus metrics of the gateway: messages by verdict, time to a verdict, connections."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Literal

from fractus_runtime.audit import AuditLog
from fractus_runtime.metrics import CERTIFICATE_EXPIRY, gauge
from prometheus_client import Counter, Histogram, Metric

from fractus_services.service_metrics import audit_metrics

Verdict = Literal["allow", "correct", "deny", "respond", "consume", "refuse"]
"""Result of a message: verdict of the mobility service on the call (allow, correct, deny), or decision of the gateway."""


def ignore_verdict(_verdict: Verdict) -> None:
    """Count nothing."""


class GatewayMetrics:
    """All metrics of the gateway.

    Args:
        audit: Audit log of the gateway.
        expiry: Returns the Unix time at which the certificate expires, or None if it is unknown.
        connections: Returns the number of connections of programs.
        instances: Returns for each instance with a connection whether it is connected to the mobility service.
    """

    def __init__(
        self,
        audit: AuditLog,
        expiry: Callable[[], float | None],
        connections: Callable[[], int],
        instances: Callable[[], list[bool]],
    ) -> None:
        self._audit = audit
        self._expiry = expiry
        self._connections = connections
        self._instances = instances
        self._messages = Counter(
            "fractus_gateway_messages_total",
            "Messages of programs: verdict on the call (allow, correct, deny), or decision of the gateway (respond, consume, refuse). A target that is replaced by a later target before its verdict is not counted.",
            ["verdict"],
            registry=None,
        )
        self._verdict_s = Histogram(
            "fractus_gateway_verdict_seconds",
            "Time from the receipt of a message to the verdict of the mobility service. Messages that wait for control are not counted.",
            buckets=(0.0005, 0.001, 0.002, 0.005, 0.01, 0.05, 0.25, 1.0, 5.0),
            registry=None,
        )

    def count(self, verdict: Verdict) -> None:
        """Count a message."""
        self._messages.labels(verdict).inc()

    def observe(self, duration_s: float) -> None:
        """Record the time from the receipt of a message to its verdict, in seconds."""
        self._verdict_s.observe(duration_s)

    def collect(self) -> Iterator[Metric]:
        """Yield all metrics."""
        yield from self._messages.collect()
        yield from self._verdict_s.collect()
        yield gauge("fractus_gateway_connections", "Connections of programs and sidecars.", self._connections())
        instances = self._instances()
        counts = {"connected": float(sum(instances)), "waiting": float(len(instances) - sum(instances))}
        yield gauge(
            "fractus_gateway_instances",
            "Instances with a connection, by the state of their connection to the mobility service: connected or waiting.",
            counts,
            "state",
        )
        expires_s = self._expiry()
        if expires_s is not None:
            yield gauge(CERTIFICATE_EXPIRY, "Expiry of the node's certificate in Unix time.", expires_s)
        yield from audit_metrics(self._audit)
