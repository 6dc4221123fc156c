"""Prometheus metrics of the operator, documented in docs/metrics.md."""

from __future__ import annotations

from collections import Counter as Tally
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Literal

from fractus_runtime.metrics import CERTIFICATE_EXPIRY, gauge
from prometheus_client import Counter, Histogram, Metric

_SECONDS = (0.001, 0.005, 0.02, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)

RECONCILES = Histogram(
    "fractus_operator_reconcile_seconds",
    "Duration of a reconciliation step, including requests to the API server.",
    ["kind"],
    registry=None,
    buckets=_SECONDS,
)
ERRORS = Counter(
    "fractus_operator_reconcile_errors_total",
    "Failed reconciliation steps, which are retried. Reason Bug if the API server did not cause the failure.",
    ["kind", "reason"],
    registry=None,
)
PHASES = Histogram(
    "fractus_operator_plan_phase_seconds",
    "Duration of the phases of deploying an Application: observe, plan, grants, rollout, routes (route check).",
    ["phase"],
    registry=None,
    buckets=_SECONDS,
)

DeployPhase = Literal["observe", "plan", "grants", "rollout", "routes"]


@contextmanager
def reconciling(kind: str) -> Iterator[None]:
    """Measure one reconciliation step. A step that raises counts as failed.

    Args:
        kind: Kind of the reconciled objects.
    """
    with RECONCILES.labels(kind).time():
        try:
            yield
        except Exception as error:
            ERRORS.labels(kind, str(getattr(error, "reason", None) or "Bug")).inc()
            raise


@contextmanager
def phase(name: DeployPhase) -> Iterator[None]:
    """Measure a phase of deploying an Application."""
    with PHASES.labels(name).time():
        yield


class MetricsSource:
    """Metrics whose values are read at each scrape.

    Args:
        lease_s: Returns for how many seconds this operator may still act. 0 if it is not the leader.
        watches: Returns by plural of the kind True if the watch is open, and the seconds since the last message.
        phases: Returns the phases of all Applications.
        states: Returns the flight states of all Drones.
        expires_s: Expiry of the certificate authority in Unix time, if known.
    """

    def __init__(
        self,
        lease_s: Callable[[], float],
        watches: Callable[[], Mapping[str, tuple[bool, float]]] = dict,
        phases: Callable[[], Iterable[str]] = tuple,
        states: Callable[[], Iterable[str]] = tuple,
        expires_s: float | None = None,
    ) -> None:
        self._lease_s = lease_s
        self._watches = watches
        self._phases = phases
        self._states = states
        self._expires_s = expires_s

    def collect(self) -> Iterator[Metric]:
        """Yield all metrics."""
        yield from (*RECONCILES.collect(), *ERRORS.collect(), *PHASES.collect())
        watches = self._watches()
        yield gauge(
            "fractus_operator_lease_left_seconds",
            "Seconds for which this operator may still act. 0 if it is not the leader.",
            self._lease_s(),
        )
        yield gauge(
            "fractus_operator_watch_open",
            "1 while the watch of a kind is open.",
            {kind: float(watching) for kind, (watching, _) in watches.items()},
            "kind",
        )
        yield gauge(
            "fractus_operator_watch_age_seconds",
            "Seconds since the last message of the API server about a kind. Above 100 the watch is dead.",
            {kind: age_s for kind, (_, age_s) in watches.items()},
            "kind",
        )
        yield gauge("fractus_applications", "Applications by phase.", Tally(self._phases()), "phase")
        yield gauge(
            "fractus_drones",
            "Drones by flight state. offline: on the ground at the last report, and no Application may fly it. unknown: may be in the air.",
            Tally(self._states()),
            "state",
        )
        if self._expires_s is not None:
            yield gauge(CERTIFICATE_EXPIRY, "Expiry of the certificate authority in Unix time.", self._expires_s)
