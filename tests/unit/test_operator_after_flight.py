"""Instances that continue to run after a mission."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from fractus_core.api import Application
from fractus_core.api.plans import DeploymentPlanSpec
from fractus_operator.after_flight import after_flight, until_deleted

LANDED = datetime(2026, 6, 1, 12, 0, tzinfo=UTC)
WAYPOINTS = [{"navigation": "pathBased", "path": [{"lat": 50.8, "lon": 4.6, "alt": 20}]}]
MOBILITY = [{"service": "mobility", "methods": ["Arm"]}]


def application(after_s: int | None = 60, **ends: str) -> Application:
    """Return an Application with a component of each placement, of which some declare their end."""
    more: dict[str, dict[str, Any]] = {
        "drone": {"class": "driver", "controlPoints": WAYPOINTS, "services": MOBILITY},
        "edge": {"locations": [{"center": {"lat": 50.8, "lon": 4.6}, "radius": 100}]},
        "hybrid": {"hybridTo": ["drone"]},
        "cloud": {},
    }
    components = [
        {"name": name, "placement": name, "container": {"image": "a"}, **fields}
        | ({"endsWith": ends[name]} if name in ends else {})
        for name, fields in more.items()
    ]
    spec: dict[str, Any] = {"components": components}
    if after_s is not None:
        spec["afterFlight"] = after_s
    metadata = {"name": "app", "namespace": "ns", "uid": "u1", "generation": 1}
    body = {"apiVersion": "fractus.dev/v1alpha1", "kind": "Application", "metadata": metadata, "spec": spec}
    return Application.from_body(body)


def plan(**record: Any) -> DeploymentPlanSpec:
    """Return a plan of the Application, whose mission is over. Its hybrid component has an instance on the drone."""
    roles = {
        "drone": ("drone", "drone", "drone-1"),
        "edge": ("edge", "static", "edge-1"),
        "hybrid": ("hybrid", "cloud", None),
        "cloud": ("cloud", "cloud", None),
        "near": ("hybrid", "hybrid-drone", "drone-1"),
    }
    placements = [
        {"component": placement, "instance": name, "node": node, "placement": placement, "role": role}
        for name, (placement, role, node) in roles.items()
    ]
    body = {
        "application": "app",
        "drone": {"node": "drone-1"},
        "placements": placements,
        "flown": {"outcome": "Failed", **record},
    }
    return DeploymentPlanSpec.model_validate(body)


ALL = {"drone", "edge", "hybrid", "near", "cloud"}


@pytest.mark.parametrize(
    ("after_s", "running", "next_s"),
    [(-1, ALL, 61.0), (0, ALL, 60.0), (59, ALL, 1.0), (60, {"cloud"}, float("inf")), (9e5, {"cloud"}, float("inf"))],
)
def test_components_of_the_flight_run_for_the_declared_time_after_the_landing(
    after_s: float, running: set[str], next_s: float
) -> None:
    ends = after_flight(application(60), plan(landed=True, landedAt=LANDED), LANDED + timedelta(seconds=after_s))
    assert (set(ends.instances), ends.next_s, ends.flight_ended) == (running, next_s, running != ALL)


def test_all_components_run_until_the_landing() -> None:
    ends = after_flight(application(0), plan(landed=False), LANDED)
    assert (set(ends.instances), ends.flight_ended) == (ALL, False)


def test_components_stop_at_the_landing_without_time_after_the_flight() -> None:
    assert after_flight(application(0), plan(landed=True, landedAt=LANDED), LANDED).instances == {"cloud"}


@pytest.mark.parametrize("landed_at", [None, LANDED + timedelta(days=1)])
def test_unknown_time_of_landing_keeps_no_component_of_the_flight(landed_at: datetime | None) -> None:
    assert after_flight(application(60), plan(landed=True, landedAt=landed_at), LANDED).instances == {"cloud"}


def test_components_end_as_declared_but_never_stay_on_the_drone() -> None:
    ends = until_deleted(application(edge="application", hybrid="application", cloud="flight"), plan())
    assert ends.instances == {"edge", "hybrid"}


def test_components_of_an_invalid_manifest_have_default_ends() -> None:
    assert until_deleted(None, plan()).instances == {"cloud"}
    default_s = application(None).spec.after_flight
    ends = after_flight(None, plan(landed=True, landedAt=LANDED), LANDED)
    assert (set(ends.instances), ends.next_s) == (ALL, default_s)


def test_objects_are_kept_for_components_that_run() -> None:
    ends = until_deleted(application(hybrid="application"), plan())

    def labelled(**labels: str) -> dict[str, Any]:
        return {"metadata": {"labels": {f"fractus.dev/{name}": value for name, value in labels.items()}}}

    assert ends.keeps(labelled(component="cloud"))
    assert not ends.keeps(labelled(component="drone"))
    assert ends.keeps(labelled(component="hybrid", instance="hybrid"))
    assert not ends.keeps(labelled(component="hybrid", instance="near"))
    assert not ends.keeps(labelled())
    assert after_flight(application(), plan(landed=False), LANDED).keeps(labelled())
