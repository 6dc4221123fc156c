"""Prometheus metrics of both services: decisions, audit log, certificate, Grants and recording."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from fractus_runtime.audit import AuditLog
from fractus_runtime.exposition import CERTIFICATE_EXPIRY
from fractus_runtime.figures import Counter, Figure, gauge, hash_number, text_of

from fractus_services.grant_files import GrantFiles

MAX_POLICIES = 200
"""Maximum number of policies with their own label. Verdicts of further policies have the label `other`."""


class DecisionMetrics:
    """Counters of decisions, fed with the entries of the audit log."""

    def __init__(self) -> None:
        self._verdicts = Counter(
            "fractus_verdicts_total",
            "Verdicts on calls: allow, correct or deny, and the code that callers see, empty where nothing was wrong.",
            "action",
            "code",
        )
        self._by_policy = Counter(
            "fractus_policy_verdicts_total",
            "Verdicts on calls by the policies that decided; one of several counts for each, the 201st policy and later ones as other.",
            "policy",
            "action",
        )
        self._takeovers = Counter(
            "fractus_takeovers_total", "Takeovers by the system or a pilot.", "controller", "code"
        )
        self._interventions = Counter(
            "fractus_monitor_interventions_total",
            "What the motion monitor did about a drone in flight.",
            "action",
            "code",
        )
        self._named: set[str] = set()

    def take_entry(self, entry: dict[str, Any]) -> None:
        """Count an entry if it contains a decision."""
        match entry:
            case {"kind": "call", "action": str(action), "code": str(code), "policies": policies}:
                self._verdicts.count(action, code)
                for policy in policies:
                    self._by_policy.count(self._name(policy), action)
            case {"kind": "takeover", "controller": str(controller), "code": str(code)}:
                self._takeovers.count(controller, code)
            case {"kind": "monitor", "action": str(action), "code": str(code)}:
                self._interventions.count(action, code)

    def figures(self) -> Iterator[Figure]:
        """Yield the current counts."""
        for counter in (self._verdicts, self._by_policy, self._takeovers, self._interventions):
            yield counter.figure()

    def _name(self, policy: str) -> str:
        if len(self._named) < MAX_POLICIES:
            self._named.add(policy)
        return policy if policy in self._named else "other"


class ServiceMetrics:
    """All metrics of a service.

    Metrics of the components are collected when Prometheus scrapes them.
    """

    def __init__(self) -> None:
        self._decisions = DecisionMetrics()
        self._figures: list[Callable[[], Iterator[Figure]]] = [self._decisions.figures]

    def take_entry(self, entry: dict[str, Any]) -> None:
        """Count an entry of the audit log if it contains a decision."""
        self._decisions.take_entry(entry)

    def observe(self, figures: Callable[[], Iterator[Figure]]) -> None:
        """Add a callback that returns metrics at each scrape."""
        self._figures.append(figures)

    def text(self) -> bytes:
        """Return all metrics in Prometheus' text format."""
        return text_of(figure for figures in self._figures for figure in figures())


def telemetry_age(age_s: float) -> Figure:
    """Return the age of the latest telemetry."""
    description = "Age of the drone's position, as this service knows it; not of a camera that stands."
    return gauge("fractus_telemetry_age_seconds", description, age_s)


def common_figures(
    expiry: Callable[[], float | None], grants: GrantFiles, audit: AuditLog, recording_problem: Callable[[], str]
) -> Iterator[Figure]:
    """Yield the metrics that all services have.

    Args:
        expiry: Returns the Unix time at which the certificate expires, or None if it is unknown.
        grants: Grants of the node.
        audit: Audit log of the service.
        recording_problem: Returns the reason why nothing is recorded, or an empty string.
    """
    expires_s = expiry()
    if expires_s is not None:
        yield gauge(CERTIFICATE_EXPIRY, "When the node's certificate expires, in Unix time.", expires_s)
    yield gauge("fractus_grants", "Grants in force.", len(grants.active))
    head = audit.head
    yield gauge(
        "fractus_audit_sequence",
        "Number of the last entry of the audit log on disk: the head of its chain.",
        head.sequence,
    )
    digits = hash_number(head.hash)
    yield gauge(
        "fractus_audit_head",
        "Hash of the last entry of the audit log on disk: its first 13 hexadecimal digits, as a number.",
        digits,
    )
    yield gauge("fractus_audit_waiting", "Entries of the audit log that are not on disk yet.", audit.waiting)
    yield gauge("fractus_audit_failing", "1 while the audit log cannot be written.", bool(audit.failure))
    yield gauge("fractus_recording_failing", "1 while nothing is recorded that should be.", bool(recording_problem()))
