"""Bad manifests against a real API server: each is refused at apply with a reason."""

from __future__ import annotations

import copy
import json
import random
import re
import ssl
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from control_plane import ControlPlane
from corpus import CASES
from fractus_cli.manifests import BadManifest, read_manifests
from fractus_core.api import KINDS, InvalidObject
from fractus_core.api.crd import crd
from fractus_runtime.kubernetes import KubeError

Body = dict[str, Any]
API = "/apis/fractus.dev/v1alpha1"
MODELS = {kind.KIND: kind for kind in KINDS}

HERE = {"lat": 50.0, "lon": 4.0}
CONTAINER = {"image": "app", "ports": [{"port": 8080}]}
MOBILITY = {"service": "mobility", "methods": ["Arm", "Goto"]}
CAMERA = {"service": "camera", "methods": ["CaptureImage"]}
PATH = {"navigation": "pathBased", "path": [HERE]}
DRIVER = {
    "name": "Navigator",
    "placement": "drone",
    "class": "driver",
    "services": [MOBILITY],
    "controlPoints": [PATH],
    "container": CONTAINER,
}
PASSENGER = {"name": "Viewer", "placement": "drone", "class": "passenger", "container": CONTAINER}
GUIDED = PASSENGER | {"pointsOfInterest": {"points": [HERE]}}
EDGE = {"name": "Ground", "placement": "edge", "locations": [{"center": HERE, "radius": 5}], "container": CONTAINER}
HYBRID = {"name": "Checker", "placement": "hybrid", "hybridTo": ["Ground"], "container": CONTAINER}
CLOUD = {"name": "Store", "placement": "cloud", "container": CONTAINER}
MUTE = CLOUD | {"name": "Mute", "container": {"image": "app"}}
RING = {"exterior": [HERE, {"lat": 50.1, "lon": 4.0}, {"lat": 50.1, "lon": 4.1}]}
DISC = {"circle": {"center": HERE, "radius": 10}}
PINNED = "registry.example/app@sha256:" + "0" * 64
WINDOW = {"start": "2026-12-01T10:00:00Z", "duration": 15}


def body(kind: str, spec: Body) -> Body:
    return {"apiVersion": "fractus.dev/v1alpha1", "kind": kind, "metadata": {"name": "bad"}, "spec": spec}


def app(*components: Body) -> Body:
    return body("Application", {"components": list(components)})


def driver(**point: Any) -> Body:
    return app(DRIVER | {"controlPoints": [PATH | point]})


def volume(**source: Any) -> Body:
    return app(CLOUD | {"container": CONTAINER | {"volumes": [{"name": "v", "mountPath": "/v"} | source]}})


def resources(**given: Body) -> Body:
    return app(CLOUD | {"container": CONTAINER | {"resources": given}})


def policy(type_: str, kind: str, **more: Any) -> Body:
    return body("Policy", {"type": type_, "kind": kind, **more})


def selecting(*expressions: Body) -> Body:
    return policy("LimitControl", "speed", upperLimit=5, selector={"nodes": list(expressions)})


def zone(**spec: Any) -> Body:
    return body("Zone", {"area": DISC} | spec)


def template(application: Body | None = None, **more: Any) -> Body:
    """Return a template of an application, whose images get digests."""
    spec = (application or app(DRIVER))["spec"]
    components = [c | {"container": c["container"] | {"image": PINNED}} for c in spec["components"]]
    altitudes = {"lower": 20, "upper": 40}
    return body(
        "ApplicationTemplate",
        {"navigation": "path", "altitudes": altitudes, "template": spec | {"components": components}} | more,
    )


def flight(**more: Any) -> Body:
    """Return a flight plan. A value of None removes a field."""
    spec = {"template": "survey", "waypoints": [HERE], "window": WINDOW} | more
    return body("FlightPlan", {name: value for name, value in spec.items() if value is not None})


BAD: list[tuple[str, Body, str]] = [
    ("template with a tag", template(template={"components": [DRIVER]}), "every image needs a digest, because the approval is for its content"),
    ("template without a flight", template(app(CLOUD)), "the template needs one component that leads the flight"),
    ("template with two control points", template(app(DRIVER | {"control": "partial", "controlPoints": [PATH, PATH]})), "the template needs one component that leads the flight"),
    ("template of a region with a path", template(navigation="region"), "navigation region needs a driver with a control point that has a region"),
    ("template upside down", template(altitudes={"lower": 40, "upper": 40}), "lower must be below upper"),
    ("template without altitudes", template(altitudes={}), "spec.altitudes.upper"),
    ("template with a long name", template() | {"metadata": {"name": "n" * 64}}, "the name of an ApplicationTemplate must have at most 63"),
    ("template with a dot in its name", template() | {"metadata": {"name": "a.b"}}, "the name of an ApplicationTemplate must have at most 63"),
    ("flight to nowhere", flight(waypoints=None), "give either waypoints or region, and only one of them"),
    ("flight to waypoints and a region", flight(region=DISC, stay=5), "give either waypoints or region, and only one of them"),
    ("flight to a region without stay", flight(waypoints=None, region=DISC), "a region needs stay"),
    ("flight that stays at waypoints", flight(stay=5), "a region needs stay"),
    ("check of a change that is no dry run", flight(changeOf="morning"), "only a dry run may have changeOf"),
    ("flight without a window", flight(window=None), "spec.window"),
    ("flight of no duration", flight(window=WINDOW | {"duration": 0}), "spec.window.duration"),
    ("flight of two days", flight(window=WINDOW | {"duration": 2881}), "spec.window.duration"),
    ("flight before 1970", flight(window=WINDOW | {"start": "1970-01-01T00:00:00+01:00"}), "start must be an RFC 3339 time after 1970"),
    ("flight at a local time", flight(window=WINDOW | {"start": "2026-12-01T10:00:00"}), "spec.window.start"),
    ("flight of an unknown class", flight(priorityClass="urgent"), "spec.priorityClass"),
    ("flight with two actions for one policy", flight(policyActions=[{"policy": "p", "action": "hover"}, {"policy": "p", "action": "land"}]), "policyActions has at most one entry for each policy"),
    ("two drivers", app(DRIVER, DRIVER | {"name": "Other"}), "an application has at most one driver"),
    ("no driver and no points of interest", app(PASSENGER), "an application with drone components needs a driver, or one passenger with pointsOfInterest"),
    ("driver and points of interest", app(DRIVER, GUIDED), "an application with a driver cannot have pointsOfInterest; remove them"),
    ("two guides", app(GUIDED, GUIDED | {"name": "Second"}), "only one passenger may have pointsOfInterest"),
    ("driver without control points", app({k: v for k, v in DRIVER.items() if k != "controlPoints"}), "a driver requires controlPoints"),
    ("full control at two control points", app(DRIVER | {"controlPoints": [PATH, PATH]}), "a driver with full control has one control point"),
    ("driver without mobility", app(DRIVER | {"services": [CAMERA]}), "a driver requires the mobility service with the methods that it calls"),
    ("drone component without class", app({k: v for k, v in GUIDED.items() if k != "class"}), "class (driver or passenger) is required for placement drone, and not allowed otherwise"),
    ("drone component that stays", app(DRIVER | {"endsWith": "application"}), "a component on a drone ends with the flight"),
    ("start of the cloud when ready", body("Application", {"components": [CLOUD], "start": "whenReady"}), "start: whenReady delays the flight of a drone"),
    ("two selections for one policy", body("Application", {"components": [CLOUD], "policyActions": [{"policy": "p", "action": "hover"}, {"policy": "p", "action": "land"}]}), "policyActions has at most one entry for each policy"),
    ("selection that hovers at a landing place", body("Application", {"components": [CLOUD], "policyActions": [{"policy": "p", "action": "hover", "landAt": HERE}]}), "landAt is only allowed with action abort"),
    ("camera over MAVLink", app(DRIVER | {"services": [MOBILITY, CAMERA | {"interfaces": ["mavlink"]}]}), "only the mobility service can be called over mavlink"),
    ("two hours after the flight", body("Application", {"components": [CLOUD], "afterFlight": 7200}), "spec.afterFlight"),
    ("path without waypoints", driver(path=[]), "spec.components[0].controlPoints[0].path"),
    ("path and region", driver(region=DISC), "give either path or region, and only one of them"),
    ("region without region", app(DRIVER | {"controlPoints": [{"navigation": "regionBased"}]}), "regionBased navigation needs region"),
    ("region without duration", app(DRIVER | {"controlPoints": [{"navigation": "regionBased", "region": DISC}]}), "a region needs duration"),
    ("path with a duration", driver(duration=5), "duration is for regionBased navigation"),
    ("point with depot and position", driver(point={"depot": "base", "position": HERE}), "give either depot or position, and only one of them"),
    ("altitude reference without altitude", driver(path=[{"lat": 1, "lon": 2, "altitudeReference": "amsl"}]), "altitudeReference requires alt; set alt or remove altitudeReference"),
    ("latitude of 95", driver(path=[HERE | {"lat": 95}]), "should be less than or equal to 90"),
    ("edge component without locations", app({k: v for k, v in EDGE.items() if k != "locations"}), "locations are required for placement edge, and not allowed otherwise"),
    ("radius of 0", app(EDGE | {"locations": [{"center": HERE, "radius": 0}]}), "radius: Invalid value: 0: spec.components[0].locations[0].radius in body should be greater than 0"),
    ("no instances", app(EDGE | {"locations": [{"center": HERE, "radius": 5, "instances": 0}]}), 'instances must be a whole number from 1 to 10000, or "*" for as many as possible'),
    ("hybrid to nothing", app({k: v for k, v in HYBRID.items() if k != "hybridTo"}), "hybridTo is required for placement hybrid, and not allowed otherwise"),
    ("hybrid to the cloud", app(CLOUD, HYBRID | {"hybridTo": ["Store"]}), "hybridTo takes components placed on a drone or at the edge"),
    ("heuristic in the cloud", app(CLOUD | {"heuristic": {"kind": "preferDirect"}}), "heuristic is for placement hybrid"),
    ("heuristic without metric", app(EDGE, HYBRID | {"heuristic": {"kind": "max"}}), "kinds max and min require a metric; other kinds must not have a metric"),
    ("replicas at the edge", app(EDGE | {"replicas": 2}), "replicas are for placement cloud"),
    ("services in the cloud", app(CLOUD | {"services": [CAMERA]}), "services are only allowed for placements drone and edge"),
    ("mobility at the edge", app(EDGE | {"services": [MOBILITY]}), "the mobility service is only available on drones; use placement drone"),
    ("service named twice", app(EDGE | {"services": [CAMERA, CAMERA]}), "services must be unique; list all methods of a service in one entry"),
    ("method of another service", app(EDGE | {"services": [CAMERA | {"methods": ["Goto"]}]}), "the methods of the camera service are CaptureImage, DeleteImage, ListImages, RetrieveImage"),
    ("egress to a stranger", app(CLOUD | {"egress": ["Stranger"]}), "egress names a component that is not in the application"),
    ("egress to itself", app(CLOUD | {"egress": ["Store"]}), "egress names the component itself; remove it"),
    ("egress to a component without ports", app(CLOUD | {"egress": ["Mute"]}, MUTE), "egress names a component without container.ports; give it the port it listens on"),
    ("ingress from a stranger", app(CLOUD | {"ingress": ["Stranger"]}), "ingress names a component that is not in the application"),
    ("ingress from itself", app(CLOUD | {"ingress": ["Store"]}), "ingress names the component itself; remove it"),
    ("hybrid to a stranger", app(HYBRID | {"hybridTo": ["Stranger"]}), "hybridTo names a component that is not in the application"),
    ("hybrid to itself", app(EDGE, HYBRID | {"hybridTo": ["Checker"]}), "hybridTo names the component itself; remove it"),
    ("control points of a passenger", app(GUIDED | {"controlPoints": [PATH]}), "controlPoints are only allowed for class driver"),
    ("points of interest at the edge", app(EDGE | {"pointsOfInterest": {"points": [HERE]}}), "pointsOfInterest are only allowed for class passenger"),
    ("path without path", app(DRIVER | {"controlPoints": [{"navigation": "pathBased"}]}), "pathBased navigation needs path"),
    ("method of the camera", app(DRIVER | {"services": [MOBILITY | {"methods": ["CaptureImage"]}]}), "the methods of the mobility service are Arm, Disarm"),
    ("two components of one name", app(CLOUD, CLOUD), "duplicate entries for key"),
    ("volume without a source", volume(), "give exactly one of emptyDir, configMap, secret and claim"),
    ("volume of -1 bytes", volume(emptyDir={"sizeLimit": -1}), "should be greater than or equal to 0"),
    ("volume with two sources", volume(claim="c", secret="s"), "give exactly one of emptyDir, configMap, secret and claim"),
    ("volume of a certificate Secret", volume(secret="viewer-tls"), "Secrets with names ending in -tls are reserved for component certificates"),
    ("zone with two shapes", zone(area=DISC | {"polygon": RING}), "give either polygon or circle, and only one of them"),
    ("zone upside down", zone(altitude={"lower": 50, "upper": 10}), "lower must be below upper"),
    ("start without end", zone(schedule=[{"start": "08:00"}]), "give start and end together, or neither"),
    ("no such time", zone(schedule=[{"start": "08:00", "end": "24:30"}]), "spec.schedule[0].end"),
    ("schedule with validUntil before validFrom", zone(schedule=[{"validFrom": "2026-02-01T00:00:00Z", "validUntil": "2026-01-01T00:00:00Z"}]), "validUntil must be after validFrom"),
    ("ring of two points", zone(area={"polygon": {"exterior": RING["exterior"][:2]}}), "should have at least 3 items"),
    ("denial of nothing", policy("AccessControl", "denial"), "AccessControl requires kind grant or denial, and methods"),
    ("limit without limits", policy("LimitControl", "speed"), "LimitControl requires kind speed or altitude, and upperLimit or lowerLimit"),
    ("limits crossed", policy("LimitControl", "speed", upperLimit=1, lowerLimit=2), "lowerLimit must not be above upperLimit"),
    ("speed limit of -5", policy("LimitControl", "speed", upperLimit=-5), "speed limits require an upperLimit above 0 and a lowerLimit of at least 0 m/s; limits above terrain require an upperLimit above 0 m"),
    ("speed limit of 0", policy("LimitControl", "speed", upperLimit=0), "speed limits require an upperLimit above 0 and a lowerLimit of at least 0 m/s; limits above terrain require an upperLimit above 0 m"),
    ("minimum speed of -1", policy("LimitControl", "speed", lowerLimit=-1), "speed limits require an upperLimit above 0 and a lowerLimit of at least 0 m/s; limits above terrain require an upperLimit above 0 m"),
    ("flight below terrain", policy("LimitControl", "altitude", upperLimit=0, altitudeReference="terrain"), "speed limits require an upperLimit above 0 and a lowerLimit of at least 0 m/s; limits above terrain require an upperLimit above 0 m"),
    ("altitude limit in space", policy("LimitControl", "altitude", upperLimit=20_001), "should be less than or equal to 20000"),
    ("limit that lands", policy("LimitControl", "speed", upperLimit=1, action="land"), "LimitControl requires action enforce or refuse"),
    ("geofence nowhere", policy("GeofenceControl", "exclusion"), "GeofenceControl requires kind inclusion or exclusion, and selector.zones"),
    ("geofence that lands somewhere and hovers", policy("GeofenceControl", "exclusion", selector={"zones": ["z"]}, action="hover", landAt=HERE), "landAt is only allowed for GeofenceControl with action abort"),
    ("choice of another type", policy("GeofenceControl", "exclusion", selector={"zones": ["z"]}, choices=["enforce"]), "choices must be actions of the type of the policy"),
    ("geofence that filters", policy("GeofenceControl", "exclusion", selector={"zones": ["z"]}, action="black"), "GeofenceControl requires action ignore, adjust, hover"),
    ("privacy without filter", policy("PrivacyControl", "camera"), "PrivacyControl requires kind camera, and action refuse"),
    (
        "fallback without faces",
        policy("PrivacyControl", "camera", action="blurAverage", fallback="black"),
        "faces and fallback are only allowed for PrivacyControl with action blurFaces",
    ),
    ("policy with validUntil before validFrom", policy("LimitControl", "speed", upperLimit=1, validFrom="2026-02-01T00:00:00Z", validUntil="2026-01-01T00:00:00Z"), "validUntil must be after validFrom"),
    ("operator In without values", selecting({"key": "class", "operator": "In"}), "values are required for In, NotIn, Gt and Lt, and not allowed for Exists"),
    ("operator Gt with two values", selecting({"key": "mtom", "operator": "Gt", "values": ["1", "2"]}), "Gt and Lt require exactly one value"),
    ("operator Gt with a word", selecting({"key": "mtom", "operator": "Gt", "values": ["much"]}), "Gt and Lt require a number"),
    ("drone of class C9", body("Drone", {"class": "C9"}), 'Unsupported value: "C9"'),
    ("edge node without location", body("EdgeNode", {}), "spec.location: Required value"),
    ("time before 1970", policy("LimitControl", "speed", upperLimit=1, validUntil="1970-01-01T00:00:00+05:00"), "validFrom and validUntil must be RFC 3339 times after 1970"),
    ("access control with a limit", policy("AccessControl", "denial", methods=["Arm"], upperLimit=5), "lowerLimit and upperLimit are only allowed for type LimitControl"),
    ("access control with an altitude reference", policy("AccessControl", "denial", methods=["Arm"], altitudeReference="amsl"), "altitudeReference is only allowed for type LimitControl with kind altitude"),
    ("limit control with methods", policy("LimitControl", "speed", upperLimit=5, methods=["Arm"]), "methods are only allowed for type AccessControl"),
    ("access control with an action", policy("AccessControl", "denial", methods=["Arm"], action="refuse"), "AccessControl has no action"),
    ("names that differ only in case and hyphens", app(CLOUD | {"name": "DataStore"}, CLOUD | {"name": "data-store"}), "component names must differ in more than capitalisation and hyphens"),
    ("control of a passenger", app(GUIDED | {"control": "full"}), "control is only allowed for class driver"),
    ("reserved port name", app(CLOUD | {"container": {"image": "app", "ports": [{"port": 1, "name": "port-2"}]}}), "names that begin with port- are reserved for ports without a name"),
    ("two ports with one name", app(CLOUD | {"container": {"image": "app", "ports": [{"port": 1, "name": "a"}, {"port": 2, "name": "a"}]}}), "port names must be unique"),
    ("reserved environment variable", app(CLOUD | {"container": {"image": "app", "env": [{"name": "FRACTUS_NODE"}]}}), "names that begin with FRACTUS_ are reserved"),
    ("unknown resource", resources(requests={"disk": 1}), "a resource must be cpu, memory"),
    ("component named like a controller", app(DRIVER | {"name": "Pilot"}), "a drone is also controlled by a pilot or by the system"),
    ("memory without unit", resources(limits={"memory": 128}), "memory must be at least 4Mi"),
    ("memory in thousandths of a byte", resources(requests={"memory": "128m"}), "memory must be at least 4Mi"),
    ("request above the limit", resources(requests={"cpu": 2}, limits={"cpu": "1500m"}), "a request must not be above the limit"),
    ("extended resource without limit", resources(requests={"a.b/c": 2}), "an extended resource needs a limit that is equal to its request"),
    ("half of an extended resource", resources(limits={"a.b/c": "500m"}), "limits of extended resources must be whole numbers"),
    ("reserved volume name", volume(claim="c", name="tls"), "the volumes tls and tmp at"),
    ("two volumes with one mount path", app(CLOUD | {"container": CONTAINER | {"volumes": [{"name": n, "mountPath": "/v", "claim": "c"} for n in "vw"]}}), "mountPath must be unique"),
    ("edge node that flies", body("EdgeNode", {"location": HERE, "services": {"mobility": {"maxAltitude": 1, "maxFlightTime": 1, "maxSpeed": 1, "methods": ["Arm"]}}}), "an edge node cannot fly"),
    ("edge node with a gimbal", body("EdgeNode", {"location": HERE, "services": {"camera": {"methods": ["CaptureImage"], "mount": {"gimbal": True}}}}), "an edge node has no gimbal"),
    ("drone with a mount height", body("Drone", {"services": {"camera": {"methods": ["CaptureImage"], "mount": {"height": 5}}}}), "mount.height applies to cameras of edge nodes only"),
    ("fisheye with polynomials", body("Drone", {"services": {"camera": {"methods": ["CaptureImage"], "lens": {"model": "equidistant", "k1": 0.1}}}}), "distortion coefficients belong to model brownConrady"),
    ("depot name with a dot", body("Depot", {"location": HERE}) | {"metadata": {"name": "a.b"}}, "the name of a Depot must have at most 63"),
    ("zone name with a dot", zone() | {"metadata": {"name": "a.b"}}, "the name of a Zone must have at most 63"),
    ("depot without radius", body("Depot", {"location": HERE, "radius": 0}), "should be greater than 0"),
]  # fmt: skip


@pytest.mark.parametrize(("manifest", "sentence"), [case[1:] for case in BAD], ids=[case[0] for case in BAD])
def test_bad_manifest_is_refused_at_apply_with_reason(
    control_plane: ControlPlane, manifest: Body, sentence: str
) -> None:
    model = MODELS[manifest["kind"]]
    place = f"namespaces/default/{model.PLURAL}" if model.NAMESPACED else model.PLURAL
    with pytest.raises(KubeError) as refused:
        control_plane.admin.apply(f"{API}/{place}/{manifest['metadata']['name']}", copy.deepcopy(manifest))
    assert sentence.lower() in str(refused.value).lower()


def rules(schema: Body) -> Iterator[str]:
    """Yield the messages of all CEL rules of a schema, at any depth."""
    yield from (rule["message"] for rule in schema.get("x-kubernetes-validations", ()))
    for inner in (*schema.get("properties", {}).values(), schema.get("items")):
        if isinstance(inner, dict):
            yield from rules(inner)


RULES = {
    sentence
    for kind in KINDS
    if not kind.WRITTEN_BY_OPERATOR
    for sentence in rules(crd(kind)["spec"]["versions"][0]["schema"]["openAPIV3Schema"])
}


@pytest.mark.parametrize(("manifest", "sentence"), [case[1:] for case in BAD], ids=[case[0] for case in BAD])
def test_bad_manifest_is_refused_by_models_with_same_reason(manifest: Body, sentence: str) -> None:
    with pytest.raises(InvalidObject) as refused:
        MODELS[manifest["kind"]].from_body(manifest)
    if any(rule.startswith(sentence) for rule in RULES):
        assert sentence in refused.value.problem


def test_every_validation_rule_has_a_bad_manifest() -> None:
    assert [rule for rule in RULES if not any(rule.startswith(sentence) for _, _, sentence in BAD)] == []


@pytest.fixture(scope="module")
def https(control_plane: ControlPlane) -> urllib.request.OpenerDirector:
    """HTTPS client of the API server. It sends YAML text unchanged, so that the API server parses the YAML."""
    credential = control_plane.authority.issue("corpus", common_name="corpus", organizations=("system:masters",))
    context = ssl.create_default_context(cafile=control_plane.ca)
    context.load_cert_chain(credential.certificate, credential.key)
    return urllib.request.build_opener(urllib.request.HTTPSHandler(context=context))


def test_corpus_verdicts_of_api_server_equal_those_of_plan_command(
    control_plane: ControlPlane, https: urllib.request.OpenerDirector
) -> None:
    """Unit tests check that `fractus plan` gives the same verdicts for the same corpus."""
    taken = {case: all(not _refusal(control_plane, https, text) for text in case.documents) for case in CASES}
    assert [case for case, was in taken.items() if was == bool(case.refused)] == []


TOKENS = [
    *["0178", "9", "x", "o", "b", "_", ".", "e", "E", "+", "-", ":", "n", "y", "Y", "~", "T", "Z", "a", "#", "&", "*", ",", "%", "@", "=", "0x", "0b", "0o"], "on", "true", "null", "inf", "nan",
    "2026-01-01", "00:00:00", "<<", " ", "'", '"', "|", "<",
]  # fmt: skip
"""Parts of random plain scalars. Other scalars are omitted, because `fractus plan` refuses their tags and the API server does not."""


def test_yaml_scalars_have_same_types_as_in_api_server(
    control_plane: ControlPlane, https: urllib.request.OpenerDirector, tmp_path: Path
) -> None:
    """Use each scalar as a radius, which must be a number, and as an annotation, which must be a string."""
    rng = random.Random(1)
    head = "apiVersion: fractus.dev/v1alpha1\nkind: Depot\nmetadata:\n  name: x\n  annotations:\n    a: "
    taken = 0
    for _ in range(300):
        scalar = "".join(rng.choices(TOKENS, k=rng.randint(1, 4)))
        for note, radius in ((scalar, "5"), ('"t"', scalar)):
            text = f"{head}{note}\nspec:\n  location: {{lat: 1, lon: 2}}\n  radius: {radius}\n"
            command_verdict = judged(text, tmp_path / "m.yaml")
            server_verdict = _refusal(control_plane, https, text)
            assert bool(command_verdict) == bool(server_verdict), (scalar, command_verdict, server_verdict)
            taken += not command_verdict
    assert 100 < taken < 500


def judged(text: str, file: Path) -> str:
    """Return the reason for which `fractus plan` refuses a manifest, or an empty string."""
    file.write_text(text)
    try:
        read_manifests([file])
    except BadManifest as error:
        return str(error)
    return ""


def _refusal(control_plane: ControlPlane, https: urllib.request.OpenerDirector, text: str) -> str:
    kind = (re.search(r"^kind: (\w+)$", text, re.MULTILINE) or [""] * 2)[1]
    if kind not in MODELS:
        return "no such kind"
    place = f"namespaces/default/{MODELS[kind].PLURAL}" if MODELS[kind].NAMESPACED else MODELS[kind].PLURAL
    url = f"{control_plane.server}{API}/{place}?dryRun=All&fieldValidation=Strict"
    request = urllib.request.Request(url, text.encode(), {"Content-Type": "application/yaml"}, method="POST")
    try:
        with https.open(request, timeout=10):
            return ""
    except urllib.error.HTTPError as error:
        assert error.code in {400, 422}
        return str(json.loads(error.read())["message"])


def test_manifest_with_unknown_field_is_refused(control_plane: ControlPlane) -> None:
    """kubectl validates strictly by default (--validate=strict)."""
    with pytest.raises(KubeError, match="unknown field"):
        control_plane.admin.call("POST", f"{API}/zones", zone(colour="red"), params={"fieldValidation": "Strict"})


GOOD = [
    app(DRIVER | {"egress": ["Checker"]}, PASSENGER, EDGE, HYBRID | {"ingress": ["Navigator"]}, CLOUD | {"replicas": 2}),
    app(GUIDED, HYBRID | {"hybridTo": ["Viewer"], "heuristic": {"kind": "max", "metric": "ingress-bandwidth"}}),
    driver(path=[HERE], point={"depot": "base"}),
    app(DRIVER | {"control": "partial", "controlPoints": [PATH, PATH]}),
    app(DRIVER | {"controlPoints": [{"navigation": "regionBased", "region": DISC, "duration": 5}]}),
    template(),
    template(app(GUIDED)),
    template(app(DRIVER | {"controlPoints": [{"navigation": "regionBased", "region": DISC, "duration": 5}]}), navigation="region", parameters={"type": "object", "properties": {"speed": {"type": "number"}}}),
    flight(),
    flight(waypoints=None, region=DISC, stay=5, drone="d", priorityClass="emergency", parameters={"speed": 2}, use="InUse"),
    flight(policyActions=[{"policy": "p", "action": "abort", "landAt": HERE}], contactLost={"action": "abort", "landAt": HERE}, autoActivate=True),
    volume(secret="key"),
    policy("AccessControl", "denial", methods=["Arm"], validFrom="2026-01-01T00:00:00Z", validUntil="2026-02-01T00:00:00Z"),
    policy("LimitControl", "altitude", lowerLimit=1, upperLimit=2, action="refuse"),
    policy("GeofenceControl", "exclusion", selector={"zones": ["z"]}, action="land"),
    policy("PrivacyControl", "camera", action="blurFaces", faces="gaussian", fallback="black"),
    selecting({"key": "mtom", "operator": "Gt", "values": ["1.5"]}, {"key": "class", "operator": "Exists"}),
    app(CLOUD | {"container": CONTAINER | {"env": [{"name": "A", "value": "b"}], "resources": {"requests": {"cpu": 1, "a.b/c": 2}, "limits": {"cpu": "1", "a.b/c": 2}}, "volumes": [{"name": "v", "mountPath": "/v", "emptyDir": {"sizeLimit": "1Gi"}}, {"name": "w", "mountPath": "/w", "claim": "c"}]}}, MUTE),
    body("Drone", {"class": "C2", "physicalFeatures": {"mtom": 900}, "interfaces": [{"technology": "WiFi", "range": 100, "pairing": {"networkId": "n"}}], "services": {"mobility": {"maxAltitude": 120, "maxFlightTime": 20, "maxSpeed": 10, "methods": ["Arm"]}, "camera": {"methods": ["CaptureImage"], "resolution": "640x480", "mount": {"pitch": -45, "gimbal": True}}}, "depot": "base", "home": HERE}),
    body("EdgeNode", {"location": HERE, "services": {"camera": {"methods": ["CaptureImage"], "mount": {"height": 5}}}}),
    body("Depot", {"location": HERE, "radius": 20}),
    zone(altitude={"lower": 1, "upper": 2}, schedule=[{"start": "08:00", "end": "17:00", "days": ["Mon"]}]),
]  # fmt: skip

CHOICES: dict[str, list[Any]] = {
    "placement": ["drone", "edge", "hybrid", "cloud"],
    "class": ["driver", "passenger"],
    "navigation": ["pathBased", "regionBased"],
    "service": ["mobility", "camera"],
    "methods": [["Goto"], ["CaptureImage"], ["Arm", "ListImages"], []],
    "type": ["AccessControl", "LimitControl", "GeofenceControl", "PrivacyControl"],
    "kind": ["grant", "speed", "inclusion", "camera", "max", "min", "preferDirect", "acme.least-cost", "-x"],
    "action": ["refuse", "land", "blurFaces", "black", "enforce"],
    "operator": ["In", "Exists", "Gt"],
    "values": [["1"], ["1", "2"], ["much"], ["+.5"], ["1e3"], []],
    "hybridTo": [["Ground"], ["Store"], ["Navigator"], ["Checker"], []],
    "egress": [["Store"], ["Mute"], ["Stranger"], []],
    "ingress": [["Store"], ["Navigator"], ["Stranger"]],
    "instances": [0, 1, 10000, 10001, "*", "many"],
    "lower": [1, 5], "upper": [1, 5], "lowerLimit": [1, 5], "upperLimit": [1, 5],
    "validFrom": ["2026-01-01T00:00:00Z", "2026-03-01T00:00:00Z"],
    "validUntil": ["2026-02-01T00:00:00Z", "2026-02-01T00:00:00", ["2026-02-01T00:00:00Z"]],
    "start": ["08:00", "25:00"], "end": ["09:00"],
    "path": [[HERE], []], "region": [DISC], "duration": [5], "depot": ["base"], "position": [HERE],
    "replicas": [1], "heuristic": [{"kind": "max"}, {"kind": "preferDirect"}, {"kind": "acme.cost"}],
    "controlPoints": [[PATH], [PATH, PATH], []], "control": ["full", "partial"], "pointsOfInterest": [{"points": [HERE]}],
    "locations": [[{"center": HERE, "radius": 5}], []],
    "services": [[MOBILITY], [CAMERA], [MOBILITY, CAMERA], [CAMERA, CAMERA], []],
    "faces": ["pixelate"], "fallback": ["black"], "zones": [["z"], []],
    "secret": ["key", "viewer-tls"], "claim": ["c"], "circle": [DISC["circle"]], "polygon": [RING],
    "altitudeReference": ["home", "amsl"], "priority": [5, -1001],
    "name": ["a", "port-1", "FRACTUS_A", "DataStore", "data-store", "tls", "", "a" * 41],
    "port": [80, 81, 65536], "protocol": ["TCP", "UDP"], "mountPath": ["/v", "/w", "/tmp", "v"],
    "env": [[{"name": "A"}, {"name": "A"}], [{"name": "A"}, {"name": "B"}]],
    "ports": [[{"port": 80}, {"port": 80, "protocol": "UDP"}], [{"port": 1, "name": "a"}, {"port": 2, "name": "a"}]],
    "requests": [{"cpu": 2}, {"cpu": "1500m", "memory": "1Gi"}, {"memory": 128}, {"disk": "1"}, {"a.b/c": 1}, {"cpu": "x"}, {"cpu": 0.5}],
    "limits": [{"cpu": "1.5"}, {"cpu": 1}, {"a.b/c": "1"}, {"a.b/c": "0.5"}, {"memory": "1G"}],
    "mount": [{"height": 5}, {"pitch": -90}, {"gimbal": True}], "mobility": [{"maxSpeed": 5}], "resolution": ["640x480", "640"],
}  # fmt: skip
"""Replacement values by field. Some are valid, some are invalid, some are invalid only with certain other fields."""

ODD: list[Any] = [
    "5",
    "",
    "A b",
    True,
    None,
    -1,
    0,
    1.5,
    1e300,
    2**63,
    [],
    {},
    [None],
    ["a"],
    {"a": 1},
    "2026-01-01T00:00:00Z",
]
"""Replacement values for every field: values of another type, empty values, and values that are too large."""


def objects(value: Any) -> Iterator[Body]:
    """Yield every object inside a value, at any depth."""
    for inner in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        yield from ([inner] if isinstance(inner, dict) else [])
        yield from objects(inner)


def mutated(rng: random.Random, manifest: Body) -> Body:
    """Return the manifest with one to three fields removed, changed or added."""
    changed = copy.deepcopy(manifest)
    for _ in range(rng.randint(1, 3)):
        place = rng.choice([changed["spec"], *objects(changed["spec"])])
        schema = schema_of(place)
        chance = rng.random()
        if place and chance < 0.3:
            place.pop(rng.choice(sorted(place)))
        elif place and chance < 0.6:
            place[rng.choice([*sorted(place), "unknown"])] = copy.deepcopy(rng.choice(ODD))
        elif known := sorted(schema & CHOICES.keys()):
            field = rng.choice(known)
            place[field] = copy.deepcopy(rng.choice(CHOICES[field]))
    return changed


def schema_of(place: Body) -> set[str]:
    """Return the fields that the object may have: the fields of all schemas that contain each field of the object."""
    keys: set[str] = set()
    for fields in SHAPES:
        if place.keys() <= fields:
            keys |= fields
    return keys


def shapes(schema: Body) -> Iterator[set[str]]:
    """Yield the set of fields of each object type in a schema."""
    if "properties" in schema:
        yield set(schema["properties"])
    for inner in (*schema.get("properties", {}).values(), schema.get("items")):
        if isinstance(inner, dict):
            yield from shapes(inner)


SHAPES = [
    fields
    for kind in ("Application", "Policy", "Zone", "Drone", "EdgeNode", "Depot")
    for fields in shapes(crd(MODELS[kind])["spec"]["versions"][0]["schema"]["openAPIV3Schema"]["properties"]["spec"])
]


@pytest.mark.parametrize("seed", range(len(GOOD)))
def test_api_server_and_models_refuse_same_random_manifests(control_plane: ControlPlane, seed: int) -> None:
    """Each rule exists in the CRD and in the models. Compare both on the same randomly changed manifests."""
    rng = random.Random(seed)
    refused = 0
    model = MODELS[GOOD[seed]["kind"]]
    place = f"{API}/namespaces/default/{model.PLURAL}" if model.NAMESPACED else f"{API}/{model.PLURAL}"
    for manifest in [GOOD[seed], *(mutated(rng, GOOD[seed]) for _ in range(150))]:
        model_verdict = server_verdict = ""
        try:
            model.from_body(manifest)
        except InvalidObject as error:
            model_verdict = str(error)
        try:
            control_plane.admin.call("POST", place, manifest, params={"dryRun": "All", "fieldValidation": "Strict"})
        except KubeError as error:
            server_verdict = str(error)
        assert bool(model_verdict) == bool(server_verdict), (manifest, model_verdict, server_verdict)
        refused += bool(model_verdict)
    assert 10 < refused < 151
