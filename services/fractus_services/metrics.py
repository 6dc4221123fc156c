"""What both services tell Prometheus: decisions as the audit log records them, and the state of that log, of certificate and grants."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from fractus_observe.exposition import CERTIFICATE_EXPIRY, Observed, gauge, text_of
from fractus_storage.audit import AuditLog
from prometheus_client import CollectorRegistry, Counter
from prometheus_client.core import Metric

from fractus_services.grants import GrantFiles

MAX_POLICIES = 200
"""Policies that are counted by name; verdicts of others count as those of `other`."""


class DecisionMetrics:
    """Counts the decisions of a service from the entries of its audit log.

    Args:
        registry: where they are counted.
    """

    def __init__(self, registry: CollectorRegistry) -> None:
        self._verdicts = Counter(
            "fractus_verdicts", "Verdicts on calls, as the audit log has them.", ["action", "code"], registry=registry
        )
        self._by_policy = Counter(
            "fractus_policy_verdicts",
            "Verdicts on calls that a policy decided; one that several decided counts for each.",
            ["policy", "action"],
            registry=registry,
        )
        self._takeovers = Counter(
            "fractus_takeovers",
            "Changes of control authority that no driver asked for.",
            ["controller", "code"],
            registry=registry,
        )
        self._interventions = Counter(
            "fractus_monitor_interventions",
            "What the motion monitor did about a drone in flight.",
            ["action", "code"],
            registry=registry,
        )
        self._named: set[str] = set()

    def take_entry(self, entry: dict[str, Any]) -> None:
        """Count an entry, if it is of a decision."""
        match entry:
            case {"kind": "call", "action": str(action), "code": str(code), "policies": policies}:
                self._verdicts.labels(action, code).inc()
                for policy in policies:
                    self._by_policy.labels(self._name(policy), action).inc()
            case {"kind": "takeover", "controller": str(controller), "code": str(code)}:
                self._takeovers.labels(controller, code).inc()
            case {"kind": "monitor", "action": str(action), "code": str(code)}:
                self._interventions.labels(action, code).inc()

    def _name(self, policy: str) -> str:
        if len(self._named) < MAX_POLICIES:
            self._named.add(policy)
        return policy if policy in self._named else "other"


class ServiceMetrics:
    """All metrics of a service.

    Attributes:
        figures: what the service adds of its own; read when it is asked for.
        take_entry: takes the entries of the audit log.
    """

    def __init__(self) -> None:
        self._registry = CollectorRegistry()
        self.take_entry = DecisionMetrics(self._registry).take_entry

    def observe(self, figures: Callable[[], Iterator[Metric]]) -> None:
        """Add figures that are read when they are asked for."""
        self._registry.register(Observed(figures))

    def text(self) -> bytes:
        """All metrics in Prometheus' text format."""
        return text_of(self._registry)


def common_figures(
    expiry: Callable[[], float | None], grants: GrantFiles, audit: AuditLog, recording_problem: Callable[[], str]
) -> Iterator[Metric]:
    """What holds of any service now.

    Args:
        expiry: Unix time at which its certificate expires; None while that is not known.
        grants: of its node.
        audit: its audit log.
        recording_problem: why nothing is recorded that should be; empty while it is.
    """
    expires_s = expiry()
    if expires_s is not None:
        yield gauge(CERTIFICATE_EXPIRY, "When the node's certificate expires, in Unix time.", expires_s)
    yield gauge("fractus_grants", "Grants in force.", len(grants.active))
    yield gauge("fractus_audit_sequence", "Number of the last entry of the audit log on disk.", audit.sequence)
    yield gauge("fractus_audit_waiting", "Entries of the audit log that are not on disk yet.", audit.waiting)
    yield gauge("fractus_audit_failing", "1 while the audit log cannot be written.", bool(audit.failure))
    yield gauge("fractus_recording_failing", "1 while nothing is recorded that should be.", bool(recording_problem()))
