"""API models of all kinds: accepted manifests, and error messages for refused manifests."""

import math
import pathlib
from datetime import datetime
from typing import Any

import pytest
import yaml
from fractus_core.api import KINDS, Application, InvalidObject, Policy, Zone
from fractus_core.api.crd import crd
from fractus_core.api.model import quantity
from fractus_core.api.nodes import Interface
from fractus_core.api.policies import PolicySpec
from fractus_core.api.schedules import ActiveTime, active_at
from fractus_core.planning import operation_area
from fractus_core.validation import check_application, check_area, check_policy
from pydantic import ValidationError
from test_planning import CHECKER, PATH, STORE, VIEWER, application, at, component, manifest, navigator

ROOT = pathlib.Path(__file__).parents[2]


@pytest.mark.parametrize("kind", KINDS, ids=lambda k: k.KIND)
def test_crds_match_models(kind):
    assert yaml.safe_load((ROOT / "crds" / f"{kind.PLURAL}.yaml").read_text()) == crd(kind), "run `make generate`"


def test_crd_describes_every_number():
    def walk(schema, path):
        if schema.get("type") in {"number", "integer"} and "status" not in path and not path.endswith("*"):
            yield path, schema.get("description", "")
        for name, inner in schema.get("properties", {}).items():
            yield from walk(inner, f"{path}.{name}")
        for key in ("items", "additionalProperties"):
            if isinstance(schema.get(key), dict):
                yield from walk(schema[key], path)

    known = {"port", "replicas", "priority", "observedGeneration", "applicationGeneration"}
    for kind in KINDS:
        spec = crd(kind)["spec"]["versions"][0]["schema"]["openAPIV3Schema"]["properties"]["spec"]
        missing = [p for p, d in walk(spec, kind.KIND) if not d and p.rsplit(".", 1)[1] not in known]
        assert missing == []


@pytest.mark.parametrize("kind", KINDS, ids=lambda k: k.KIND)
def test_crd_describes_every_field(kind):
    def walk(schema, path):
        for name, inner in schema.get("properties", {}).items():
            yield from () if inner.get("description") else (f"{path}.{name}",)
            yield from walk(inner, f"{path}.{name}")
        yield from walk(schema.get("items", {}), path) if "items" in schema else ()

    (version,) = crd(kind)["spec"]["versions"]
    fields = version["schema"]["openAPIV3Schema"]["properties"]
    assert [path for part in ("spec", "status") if part in fields for path in walk(fields[part], part)] == []


def bad(*components):
    with pytest.raises(InvalidObject) as caught:
        application(*components)
    return str(caught.value)


def edge_component(**more):
    return component("GroundViewer", "edge", **({"locations": [{"center": {"lat": 1, "lon": 2}, "radius": 10}]} | more))


def test_invalid_application_error_names_field_and_remedy():
    plain = {"lat": 1, "lon": 2}
    cases = [
        ([VIEWER | {"egress": []}], "spec.components[0].pointsOfInterest: an application with drone components needs"),
        ([navigator(PATH), navigator(PATH) | {"name": "Second"}], "spec.components[1].class: an application has at most one driver"),
        ([navigator([])], "spec.components[0].controlPoints[0].path: "),
        ([navigator([plain | {"lat": 95}])], "spec.components[0].controlPoints[0].path[0].lat: must be less than or equal to 90, not 95"),
        ([STORE | {"replicas": 0}], "spec.components[0].replicas: must be greater than or equal to 1, not 0"),
        ([edge_component(locations=[{"center": plain, "radius": -1}])], "spec.components[0].locations[0].radius: must be greater than 0, not -1"),
        ([edge_component(locations=[{"center": plain, "radius": 1, "instances": 0}])], "spec.components[0].locations[0].instances: instances must be a whole number from 1 to 10000, or"),
        ([edge_component(locations=[])], "spec.components[0].locations: locations are required for placement edge"),
        ([STORE | {"egress": ["Stranger"]}], "spec.components[0].egress[0]: egress names a component that is not in the application; correct the name or add the component (Stranger)"),
        ([STORE | {"egress": ["DataStore"]}], "spec.components[0].egress[0]: egress names the component itself; remove it (DataStore)"),
        ([edge_component(services=[{"service": "camera", "methods": ["Fly"]}])], "spec.components[0].services[0].methods[0]: must be 'Arm'"),
        ([edge_component(services=[{"service": "camera", "methods": ["Goto"]}])], "spec.components[0].services[0].methods[0]: the methods of the camera service are CaptureImage, DeleteImage"),
        ([edge_component(services=[{"service": "mobility", "methods": ["Goto"]}])], "spec.components[0].services: the mobility service is only available on drones"),
        ([STORE, STORE | {"name": "data-store"}], "spec.components[1].name: component names must differ in more than capitalisation and hyphens; rename one of them (data-store and DataStore)"),
        ([STORE | {"replica": 2}], "spec.components[0].replica: there is no such field; did you mean replicas?"),
        ([STORE | {"container": {"image": "x", "volumes": [{"name": "v", "mountPath": "/v"}]}}], "spec.components[0].container.volumes[0]: give exactly one of emptyDir"),
        ([STORE | {"container": {"image": "x", "volumes": [{"name": "v", "mountPath": "/v", "secret": "other-tls"}]}}], "spec.components[0].container.volumes[0].secret: Secrets with names ending in -tls are reserved for component certificates; choose another name"),
        ([STORE | {"container": {"image": "x", "volumes": [{"name": "tls", "mountPath": "/v", "claim": "c"}]}}], "spec.components[0].container.volumes[0].name: the volumes tls and tmp at"),
        ([STORE | {"container": {"image": "x", "env": [{"name": "A", "value": "1"}, {"name": "A"}]}}], "spec.components[0].container.env[1].name: A is duplicated; remove one of the entries"),
        ([STORE | {"container": {"image": "x", "ports": [{"port": 80}, {"port": 80}]}}], "spec.components[0].container.ports[1].port: 80 is duplicated; remove one of the entries"),
        ([STORE | {"container": {"image": "x", "ports": [{"port": 80, "name": "a"}, {"port": 81, "name": "a"}]}}], "spec.components[0].container.ports[1].name: port names must be unique; choose another name"),
        ([STORE | {"container": {"image": "x", "resources": {"limits": {"cpu": "much"}}}}], "spec.components[0].container.resources.limits.cpu: 'much' is not a quantity"),
    ]  # fmt: skip
    for components, sentence in cases:
        assert bad(*components).startswith(sentence), (bad(*components), sentence)


def test_application_with_nan_is_refused():
    assert "finite number" in bad(navigator([{"lat": float("nan"), "lon": 2}]))


def test_application_survives_dict_round_trip():
    app = application(navigator(PATH), VIEWER, CHECKER, STORE)
    assert Application.from_body(app.to_dict()) == app
    assert [c.slug for c in app.spec.components] == ["navigator", "aerial-viewer", "image-checker", "data-store"]


def test_unknown_depot_error_names_field():
    with pytest.raises(
        InvalidObject, match=r"spec\.components\[0\]\.controlPoints\[0\]\.point\.depot: there is no Depot base"
    ):
        check_application(application(navigator(PATH)), {})


def test_self_crossing_region_error_names_ring():
    cross = [{"lat": 0, "lon": 0}, {"lat": 1e-3, "lon": 1e-3}, {"lat": 0, "lon": 1e-3}, {"lat": 1e-3, "lon": 0}]
    point = {"navigation": "regionBased", "region": {"polygon": {"exterior": cross}}, "duration": 1}
    app = application(navigator(PATH) | {"controlPoints": [point]})
    with pytest.raises(InvalidObject, match=r"controlPoints\[0\]\.region\.polygon\.exterior: the ring crosses itself"):
        check_application(app, {})


def star(east, spikes, radius_m=100):
    turn = math.tau / (2 * spikes)
    radii = [radius_m, radius_m / 5] * spikes
    return [at(east + r * math.cos(turn * i), r * math.sin(turn * i)) for i, r in enumerate(radii)]


def test_regions_with_too_many_crossings_are_refused_before_union():
    """A region may have so many spikes that the union of a few regions takes minutes.

    Such a union would delay all other Applications.
    """

    def flown(*regions):
        points = [{"navigation": "regionBased", "region": {"polygon": {"exterior": r}}, "duration": 1} for r in regions]
        return application(navigator(PATH) | {"control": "partial", "controlPoints": points})

    check_application(flown(star(0, 600), star(1000, 600), star(5, 600)), {})
    check_application(flown(star(0, 3000), star(0, 3000)), {})
    app = flown(star(0, 1500), star(1000, 4), star(5, 1500))
    with pytest.raises(
        InvalidObject, match=r"components\[0\]\.controlPoints: paths and edges .* more than 50000 times"
    ):
        check_application(app, {})
    with pytest.raises(InvalidObject, match="more than 50000 times"):
        operation_area(app.spec, {}, 7.0)


def test_path_with_too_many_self_crossings_is_refused():
    def grid(lines):
        ends = [at(20 * (i // 2), 20 * lines * (((i + 1) // 2) % 2), 10) for i in range(2 * lines)]
        across = [at(20 * lines * (((i + 1) // 2) % 2), 20 * (i // 2), 10) for i in range(2 * lines)]
        return ends + across

    driver = navigator(grid(200), point={"position": at(0, 0, 10)})
    check_application(application(driver), {})
    with pytest.raises(InvalidObject, match=r"components\[0\]\.controlPoints: paths and edges"):
        check_application(application(navigator(grid(240), point={"position": at(0, 0, 10)})), {})
    guide = VIEWER | {"egress": [], "pointsOfInterest": {"points": grid(240)}}
    with pytest.raises(InvalidObject, match=r"spec\.components: paths and edges"):
        check_application(application(guide), {})


def test_zone_area_over_1000_km_is_refused():
    corners = [{"lat": 0, "lon": 0}, {"lat": 50, "lon": 0}, {"lat": 50, "lon": 50}]
    zone = Zone.from_body(manifest("Zone", "z", {"area": {"polygon": {"exterior": corners}}}))
    with pytest.raises(InvalidObject, match=r"spec\.area\.polygon\.exterior\[0\]: is more than 1000 km"):
        check_area(zone.spec.area, "spec.area")


@pytest.mark.parametrize(
    ("spec", "sentence"),
    [
        (
            {"type": "AccessControl", "kind": "speed"},
            "spec.kind: AccessControl requires kind grant or denial, and methods",
        ),
        (
            {"type": "AccessControl", "kind": "denial"},
            "spec.methods: AccessControl requires kind grant or denial, and methods",
        ),
        (
            {"type": "LimitControl", "kind": "speed"},
            "spec.upperLimit: LimitControl requires kind speed or altitude, and upperLimit or lowerLimit",
        ),
        (
            {"type": "LimitControl", "kind": "altitude", "lowerLimit": 9, "upperLimit": 5},
            "spec.lowerLimit: lowerLimit must not be above upperLimit",
        ),
        (
            {"type": "LimitControl", "kind": "speed", "upperLimit": -5},
            "spec.upperLimit: speed limits require an upperLimit above 0 and a lowerLimit of at least 0 m/s; limits above terrain require an upperLimit above 0 m",
        ),
        (
            {"type": "LimitControl", "kind": "speed", "upperLimit": 0},
            "spec.upperLimit: speed limits require an upperLimit above 0 and a lowerLimit of at least 0 m/s; limits above terrain require an upperLimit above 0 m",
        ),
        (
            {"type": "LimitControl", "kind": "speed", "lowerLimit": -0.5, "upperLimit": 5},
            "spec.lowerLimit: speed limits require an upperLimit above 0 and a lowerLimit of at least 0 m/s; limits above terrain require an upperLimit above 0 m",
        ),
        (
            {"type": "LimitControl", "kind": "altitude", "upperLimit": 0, "altitudeReference": "terrain"},
            "spec.upperLimit: speed limits require an upperLimit above 0 and a lowerLimit of at least 0 m/s; limits above terrain require an upperLimit above 0 m",
        ),
        (
            {"type": "GeofenceControl", "kind": "exclusion"},
            "spec.selector.zones: GeofenceControl requires kind inclusion or exclusion, and selector.zones",
        ),
        (
            {"type": "PrivacyControl", "kind": "camera"},
            "spec.action: PrivacyControl requires kind camera, and action refuse, black",
        ),
        (
            {"type": "PrivacyControl", "kind": "camera", "action": "black", "fallback": "refuse"},
            "spec.fallback: faces and fallback are only allowed for PrivacyControl with action blurFaces",
        ),
        (
            {"type": "LimitControl", "kind": "speed", "upperLimit": 3, "faces": "gaussian"},
            "spec.faces: faces and fallback are only allowed for PrivacyControl with action blurFaces",
        ),
    ],
)
def test_invalid_policy_error_names_field_and_remedy(spec, sentence):
    with pytest.raises(InvalidObject) as caught:
        Policy.from_body(manifest("Policy", "p", spec))
    assert str(caught.value).startswith(sentence)


@pytest.mark.parametrize(
    "limit",
    [
        {"kind": "speed", "upperLimit": 0.1},
        {"kind": "speed", "lowerLimit": 0},
        {"kind": "altitude", "upperLimit": -50, "lowerLimit": -80},
        {"kind": "altitude", "upperLimit": -400, "altitudeReference": "amsl"},
        {"kind": "altitude", "upperLimit": 20_000},
        {"kind": "altitude", "upperLimit": 1, "lowerLimit": -10, "altitudeReference": "terrain"},
    ],
)
def test_limit_policy_accepts_extreme_but_possible_limits(limit):
    assert Policy.from_body(manifest("Policy", "p", {"type": "LimitControl", **limit})).spec.kind == limit["kind"]


@pytest.mark.parametrize("limit", [-1001, 20_001, float("nan"), float("inf")])
def test_limit_policy_refuses_impossible_altitude(limit):
    spec = {"type": "LimitControl", "kind": "altitude", "upperLimit": limit}
    with pytest.raises(InvalidObject, match=r"spec\.upperLimit"):
        Policy.from_body(manifest("Policy", "p", spec))


def test_policy_with_unknown_zone_error_names_zone():
    spec = {"type": "GeofenceControl", "kind": "exclusion", "selector": {"zones": ["a", "b"]}}
    with pytest.raises(InvalidObject, match=r"spec\.selector\.zones\[1\]: Zone b does not exist \(existing: a\)"):
        check_policy(Policy.from_body(manifest("Policy", "p", spec)), {"a"})


@pytest.mark.parametrize(("text", "value"), [("250m", 0.25), ("2", 2), ("512Mi", 2**29), ("1.5G", 1.5e9), (3, 3)])
def test_quantity_is_parsed_to_number(text, value):
    assert quantity(text) == pytest.approx(value)


def test_volumes_are_converted_to_pod_volumes():
    volumes = [
        {"name": "scratch", "mountPath": "/scratch", "emptyDir": {"sizeLimit": "64Mi", "medium": "memory"}},
        {"name": "models", "mountPath": "/models", "claim": "models", "readOnly": True},
        {"name": "config", "mountPath": "/config", "configMap": "settings"},
        {"name": "key", "mountPath": "/key", "secret": "key"},
    ]
    app = application(STORE | {"container": {"image": "x", "volumes": volumes}})
    volumes = app.spec.components[0].container.volumes
    assert [v.pod_volume() for v in volumes] == [
        {"name": "scratch", "emptyDir": {"sizeLimit": "64Mi", "medium": "Memory"}},
        {"name": "models", "persistentVolumeClaim": {"claimName": "models"}},
        {"name": "config", "configMap": {"name": "settings"}},
        {"name": "key", "secret": {"secretName": "key", "defaultMode": 0o440}},
    ]
    assert [v.mount()["readOnly"] for v in volumes] == [False, True, True, True]


def unix(text):
    return datetime.fromisoformat(text).timestamp()


@pytest.mark.parametrize(
    ("time", "moment", "active"),
    [
        ({}, "2026-06-01T00:00:00+00:00", True),
        ({"days": ["Mon"]}, "2026-06-01T23:59:59+00:00", True),
        ({"days": ["Mon"]}, "2026-06-02T00:00:00+00:00", False),
        ({"start": "08:00", "end": "17:30"}, "2026-06-01T08:00:00+00:00", True),
        ({"start": "08:00", "end": "17:30"}, "2026-06-01T17:30:00+00:00", False),
        ({"start": "22:00", "end": "06:00", "days": ["Fri"]}, "2026-06-06T05:59:00+00:00", True),
        ({"start": "22:00", "end": "06:00", "days": ["Fri"]}, "2026-06-05T05:59:00+00:00", False),
        ({"start": "22:00", "end": "06:00", "days": ["Fri"]}, "2026-06-06T22:00:00+00:00", False),
        ({"start": "08:00", "end": "09:00"}, "2026-06-01T10:30:00+02:00", True),
        ({"validFrom": "2026-06-01T12:00:00Z"}, "2026-06-01T11:59:59+00:00", False),
        ({"validUntil": "2026-06-01T12:00:00Z"}, "2026-06-01T12:00:00+00:00", False),
    ],
)
def test_schedule_is_active_within_its_window(time, moment, active):
    window = ActiveTime.model_validate(time)
    assert window.active(unix(moment)) is active
    assert active_at((), unix(moment))
    assert active_at((window,), unix(moment)) is active


@pytest.mark.parametrize(
    ("time", "sentence"),
    [
        ({"start": "08:00"}, "spec.schedule[0].start: give start and end together"),
        ({"start": "24:00", "end": "25:00"}, "spec.schedule[0].start: "),
        (
            {"validFrom": "2026-06-02T00:00:00Z", "validUntil": "2026-06-01T00:00:00Z"},
            "spec.schedule[0].validUntil: validUntil must be after",
        ),
    ],
)
def test_invalid_schedule_error_names_field(time, sentence):
    area = {"circle": {"center": {"lat": 1, "lon": 2}, "radius": 5}}
    with pytest.raises(InvalidObject) as caught:
        Zone.from_body(manifest("Zone", "z", {"area": area, "schedule": [time]}))
    assert str(caught.value).startswith(sentence)


@pytest.mark.parametrize(
    ("spec", "sentence"),
    [
        ({"components": "x"}, "spec.components: must be a list, not 'x'"),
        ({"components": []}, "spec.components: must have at least 1 entries, not 0"),
        ({"components": [STORE] * 51}, "spec.components: must have at most 50 entries, not 51"),
        ([], "spec: must be an object with named fields"),
        ({"components": [STORE | {"container": "x" * 500}]}, "spec.components[0].container: must be an object with"),
    ],
)
def test_wrong_type_error_uses_manifest_terms(spec, sentence):
    with pytest.raises(InvalidObject) as caught:
        Application.from_body(manifest("Application", "a", spec))
    assert str(caught.value).startswith(sentence)
    assert len(str(caught.value)) < 200


def test_application_with_too_many_waypoints_is_refused():
    path = [{"lat": 50 + i * 1e-6, "lon": 4} for i in range(1000)]
    point = {"navigation": "pathBased", "path": path}
    app = application(navigator(PATH) | {"control": "partial", "controlPoints": [point] * 3})
    with pytest.raises(InvalidObject, match=r"controlPoints: 3000 waypoints in all, more than 2000"):
        check_application(app, {})


@pytest.mark.parametrize("control", [{}, {"control": "full"}])
def test_full_control_permits_one_control_point(control):
    point = {"navigation": "pathBased", "path": PATH}
    with pytest.raises(InvalidObject, match=r"controlPoints: a driver with full control has one control point"):
        application(navigator(PATH) | control | {"controlPoints": [point, point]})
    application(navigator(PATH) | {"control": "partial", "controlPoints": [point, point]})


@pytest.mark.parametrize(
    ("field", "good", "bad"),
    [
        ("device", ["wlan0", "wlx00c0caa5_1", "eth0.7"], ['w"; drop', "wlan0 ", "-w", "../x", "a" * 16]),
        ("networkId", ["fleet", "Fleet 7!", "n" * 32], ["", "n" * 33, "réseau", "a\nb"]),
    ],
)
def test_interface_accepts_valid_device_and_network_names_only(field: str, good: list[str], bad: list[str]) -> None:
    def interface(name: str) -> dict[str, Any]:
        pairing = {"networkId": name if field == "networkId" else "net"}
        return {"technology": "WiFi", "device": name if field == "device" else "wlan0", "range": 80, "pairing": pairing}

    for name in good:
        Interface.model_validate(interface(name))
    for name in bad:
        with pytest.raises(ValidationError):
            Interface.model_validate(interface(name))


@pytest.mark.parametrize(
    ("spec", "uses"),
    [
        ({"type": "GeofenceControl", "kind": "exclusion", "selector": {"zones": ["a"]}}, {"exclusion"}),
        ({"type": "GeofenceControl", "kind": "inclusion", "selector": {"zones": ["a"]}}, {"inclusion"}),
        ({"type": "LimitControl", "kind": "speed", "upperLimit": 3}, {"speedLimit"}),
        ({"type": "LimitControl", "kind": "altitude", "upperLimit": 30}, {"altitudeLimit"}),
        ({"type": "PrivacyControl", "kind": "camera", "action": "refuse"}, {"noPictures"}),
        ({"type": "PrivacyControl", "kind": "camera", "action": "blurFaces"}, {"pictureFilter"}),
        ({"type": "AccessControl", "kind": "grant", "methods": ["CaptureImage"]}, {"grant"}),
        ({"type": "AccessControl", "kind": "denial", "methods": ["CaptureImage"]}, {"noPictures"}),
        ({"type": "AccessControl", "kind": "denial", "methods": ["ListImages"]}, {"denial"}),
        ({"type": "AccessControl", "kind": "denial", "methods": ["CaptureImage", "Land"]}, {"noPictures", "denial"}),
    ],
)
def test_policy_has_effects_on_its_zones(spec: dict[str, object], uses: set[str]) -> None:
    assert PolicySpec.model_validate(spec).zone_uses == uses
