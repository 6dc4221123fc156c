"""What the operator tells Prometheus; docs/metrics.md describes each name."""

from __future__ import annotations

from collections import Counter as Tally
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Literal

from fractus_runtime.exposition import CERTIFICATE_EXPIRY
from fractus_runtime.figures import Counter, Figure, Histogram, gauge, text_of

_SECONDS = (0.001, 0.005, 0.02, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)

RECONCILES = Histogram(
    "fractus_operator_reconcile_seconds",
    "How long a step of reconciliation took, waiting for the API server included.",
    "kind",
    _SECONDS,
)
ERRORS = Counter(
    "fractus_operator_reconcile_errors_total",
    "Steps that failed and are tried again; Bug where it was not the API server that refused.",
    "kind",
    "reason",
)
PHASES = Histogram(
    "fractus_operator_plan_phase_seconds",
    "Phases of deploying an Application: observe, plan, grants, rollout; ways: what policies say of its way.",
    "phase",
    _SECONDS,
)

Phase = Literal["observe", "plan", "grants", "rollout", "ways"]


@contextmanager
def reconciling(kind: str) -> Iterator[None]:
    """Measure one step of reconciliation; one that raises counts as failed.

    Args:
        kind: Of what is reconciled.
    """
    with RECONCILES.timed(kind):
        try:
            yield
        except Exception as error:
            ERRORS.count(kind, str(getattr(error, "reason", None) or "Bug"))
            raise


@contextmanager
def phase(name: Phase) -> Iterator[None]:
    """Measure a phase of deploying an Application."""
    with PHASES.timed(name):
        yield


class Observed:
    """Figures that are read when they are asked for.

    Args:
        lease_s: For how many seconds this operator may still act; none where it does not lead.
        watches: By plural of the kind: whether its watch is open, and seconds since the API server said anything.
        phases: The phases of all Applications.
        states: The flight states of all Drones.
        expires_s: Unix time at which the certificate authority expires; None while it is not known.
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

    def collect(self) -> Iterator[Figure]:
        """The figures as they are now."""
        watches = self._watches()
        yield gauge(
            "fractus_operator_lease_left_seconds",
            "For how long this operator may still act; 0: it does not lead.",
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
            "Since the API server said anything about a kind; above 100 the watch is dead.",
            {kind: age_s for kind, (_, age_s) in watches.items()},
            "kind",
        )
        yield gauge("fractus_applications", "Applications by phase.", Tally(self._phases()), "phase")
        yield gauge(
            "fractus_drones",
            "Drones by flight state; offline: it was on the ground when last heard of, and no application may fly it; unknown: it may be in the air.",
            Tally(self._states()),
            "state",
        )
        if self._expires_s is not None:
            yield gauge(CERTIFICATE_EXPIRY, "When the certificate authority expires, in Unix time.", self._expires_s)


def text(observed: Observed) -> bytes:
    """All metrics in Prometheus' text format."""
    return text_of((RECONCILES.figure(), ERRORS.figure(), PHASES.figure(), *observed.collect()))
