"""Prometheus metrics of both services: decisions, audit log, certificate, Grants and recording."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from fractus_runtime.audit import AuditLog
from fractus_runtime.metrics import CERTIFICATE_EXPIRY, gauge, hash_number
from prometheus_client import Counter, Metric

from fractus_services.grant_files import GrantFiles

MAX_POLICIES = 200
"""Maximum number of policies with their own label. Verdicts of further policies have the label `other`."""


class ServiceMetrics:
    """All metrics of a service.

    Decisions are counted from the entries of the audit log. Metrics of the components are collected when Prometheus scrapes
    them.
    """

    def __init__(self) -> None:
        self._verdicts = Counter(
            "fractus_verdicts_total",
            "Verdicts on calls: allow, correct or deny, and the code that the caller received. The code is empty if no policy was violated.",
            ["action", "code"],
            registry=None,
        )
        self._by_policy = Counter(
            "fractus_policy_verdicts_total",
            "Verdicts by deciding policy. A verdict of several policies counts for each of them. Policies after the 200th are counted as other.",
            ["policy", "action"],
            registry=None,
        )
        self._takeovers = Counter(
            "fractus_takeovers_total", "Takeovers by the system or a pilot.", ["controller", "code"], registry=None
        )
        self._interventions = Counter(
            "fractus_monitor_interventions_total",
            "Interventions of the motion monitor in flight.",
            ["action", "code"],
            registry=None,
        )
        self._named: set[str] = set()
        self._callbacks: list[Callable[[], Iterator[Metric]]] = []

    def take_entry(self, entry: dict[str, Any]) -> None:
        """Count an entry of the audit log if it contains a decision."""
        match entry:
            case {"kind": "call", "action": str(action), "code": str(code), "policies": policies}:
                self._verdicts.labels(action, code).inc()
                for policy in policies:
                    self._by_policy.labels(self._name(policy), action).inc()
            case {"kind": "takeover", "controller": str(controller), "code": str(code)}:
                self._takeovers.labels(controller, code).inc()
            case {"kind": "monitor", "action": str(action), "code": str(code)}:
                self._interventions.labels(action, code).inc()

    def add_callback(self, callback: Callable[[], Iterator[Metric]]) -> None:
        """Add a callback that returns metrics at each scrape."""
        self._callbacks.append(callback)

    def collect(self) -> Iterator[Metric]:
        """Yield all metrics."""
        for counter in (self._verdicts, self._by_policy, self._takeovers, self._interventions):
            yield from counter.collect()
        for callback in self._callbacks:
            yield from callback()

    def _name(self, policy: str) -> str:
        if len(self._named) < MAX_POLICIES:
            self._named.add(policy)
        return policy if policy in self._named else "other"


def telemetry_age(age_s: float) -> Metric:
    """Return the age of the latest telemetry."""
    description = "Age of the latest position of the drone. No value for a stationary camera."
    return gauge("fractus_telemetry_age_seconds", description, age_s)


def common_metrics(
    expiry: Callable[[], float | None], grants: GrantFiles, audit: AuditLog, recording_problem: Callable[[], str]
) -> Iterator[Metric]:
    """Yield the metrics that all services have.

    Args:
        expiry: Returns the Unix time at which the certificate expires, or None if it is unknown.
        grants: Grants of the node.
        audit: Audit log of the service.
        recording_problem: Returns the reason why nothing is recorded, or an empty string.
    """
    expires_s = expiry()
    if expires_s is not None:
        yield gauge(CERTIFICATE_EXPIRY, "Expiry of the node's certificate in Unix time.", expires_s)
    yield gauge("fractus_grants", "Grants in force.", len(grants.active))
    yield from audit_metrics(audit)
    yield gauge("fractus_recording_failing", "1 while recording is enabled but fails.", bool(recording_problem()))


def audit_metrics(audit: AuditLog) -> Iterator[Metric]:
    """Yield the metrics of an audit log."""
    head = audit.head
    yield gauge(
        "fractus_audit_sequence",
        "Sequence number of the last entry of the audit log on disk, the head of its hash chain.",
        head.sequence,
    )
    digits = hash_number(head.hash)
    yield gauge(
        "fractus_audit_head",
        "First 13 hexadecimal digits of the hash of the last entry of the audit log on disk, as a number.",
        digits,
    )
    yield gauge("fractus_audit_waiting", "Entries of the audit log not yet written to disk.", audit.waiting)
    yield gauge("fractus_audit_failing", "1 while the audit log cannot be written.", bool(audit.failure))
