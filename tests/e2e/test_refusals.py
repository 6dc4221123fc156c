"""Bad manifests: refused at apply, or Ready=False with a reason that names the field. No objects are created."""

from __future__ import annotations

import copy

import pytest
from conftest import example
from kubectl import Kube, Object, condition
from test_mission import children


def application() -> Object:
    app = copy.deepcopy(example("application.yaml")[0])
    app["metadata"] = {"name": "bad"}
    return app


def part(app: Object, name: str) -> Object:
    return next(c for c in app["spec"]["components"] if c["name"] == name)


def unknown_egress() -> Object:
    app = application()
    part(app, "AerialViewer")["egress"] = ["Stranger"]
    return app


def no_driver() -> Object:
    app = application()
    app["spec"]["components"] = [c for c in app["spec"]["components"] if c["name"] != "Navigator"]
    return app


def latitude() -> Object:
    app = application()
    part(app, "Navigator")["controlPoints"][0]["path"][0]["lat"] = 95
    return app


def crossing() -> Object:
    corners = [(50.1, 4.1), (50.2, 4.2), (50.1, 4.2), (50.2, 4.1)]
    ring = [{"lat": lat, "lon": lon} for lat, lon in corners]
    return {
        "apiVersion": "fractus.dev/v1alpha1",
        "kind": "Zone",
        "metadata": {"name": "bad"},
        "spec": {"area": {"polygon": {"exterior": ring}}},
    }


def zero_replicas() -> Object:
    app = application()
    part(app, "DataStore")["replicas"] = 0
    return app


def unknown_zone() -> Object:
    return {
        "apiVersion": "fractus.dev/v1alpha1",
        "kind": "Policy",
        "metadata": {"name": "bad"},
        # The policy selects another application only, because an unresolved policy would prevent flights of other tests.
        "spec": {
            "type": "GeofenceControl",
            "kind": "exclusion",
            "selector": {"zones": ["atlantis"], "applications": {"names": ["stranger"]}},
        },
    }


def unknown_method() -> Object:
    app = application()
    part(app, "Navigator")["services"][0]["methods"].append("Teleport")
    return app


def two_drivers() -> Object:
    app = application()
    second = copy.deepcopy(part(app, "Navigator"))
    second["name"] = "Second"
    app["spec"]["components"].append(second)
    return app


def empty_path() -> Object:
    app = application()
    part(app, "Navigator")["controlPoints"][0]["path"] = []
    return app


def negative_radius() -> Object:
    app = application()
    part(app, "GroundViewer")["locations"][0]["radius"] = -5
    return app


BAD = {
    unknown_egress: "egress",
    no_driver: "pointsOfInterest",
    latitude: "path[0].lat",
    crossing: "polygon.exterior",
    zero_replicas: "replicas",
    unknown_zone: "selector.zones[0]",
    unknown_method: "services[0].methods[6]",
    two_drivers: "driver",
    empty_path: "path",
    negative_radius: "locations[0].radius",
}


@pytest.mark.parametrize("make", BAD, ids=lambda make: make.__name__)
def test_bad_manifest_refusal_names_field(kube: Kube, make) -> None:
    bad = make()
    kind = {"Application": "application.fractus.dev", "Zone": "zone.fractus.dev", "Policy": "policy.fractus.dev"}[
        bad["kind"]
    ]
    before = set(children(kube))  # stopped pods of other tests may still be terminating
    sentence = kube.refused(bad)
    try:
        if not sentence:
            ready = kube.wait("Ready=False", lambda: not_ready(kube.get(kind, "bad")), timeout_s=30)
            sentence = ready["message"]
        assert BAD[make] in sentence
        assert set(children(kube)) <= before
        assert not kube.all("deploymentplans.fractus.dev")
    finally:
        kube.run("delete", kind, "bad", "--ignore-not-found", "--wait=true", "--timeout=30s")


def not_ready(obj: Object | None) -> Object | None:
    ready = condition(obj, "Ready")
    return dict(ready) if ready.get("status") == "False" else None
