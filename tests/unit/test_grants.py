"""Grants: policies of each instance, refreshes, and refusal of policies that cannot be resolved."""

import dataclasses
import gc

import pytest
import shapely
from fractus_core.api import InvalidObject, Policy, Zone
from fractus_core.api.policies import NodeExpression
from fractus_core.geo import area_polygon
from fractus_core.planning import flight_of, grant_compiler, plan
from fractus_core.planning.grant_compiler import (
    _VALIDATED,
    MAX_ROUNDING_M,
    compile_grants,
    refresh,
    validated,
    zone_crossings,
)
from fractus_core.planning.operation_area import operation_area
from fractus_core.policy.compiled_grant import compile_grant
from fractus_core.policy.decision_types import Call, CaptureArgs, GotoArgs, Home, Situation
from fractus_core.policy.engine import judge
from fractus_core.policy.selectors import is_attribute, matches, node_attributes
from fractus_core.validation import check_policy
from test_planning import FRAME, PATH, VIEWER, application, at, component, drone, edge, inventory, manifest, navigator


def zone(name, center, radius=50):
    return Zone.from_body(manifest("Zone", name, {"area": {"circle": {"center": at(*center), "radius": radius}}}))


def policy(name, zones=(), nodes=(), applications=None, **spec):
    selector = {"zones": list(zones), "nodes": list(nodes)} | ({"applications": applications} if applications else {})
    return Policy.from_body(manifest("Policy", name, {**spec, "selector": selector}))


ALTITUDE = {"type": "LimitControl", "kind": "altitude", "upperLimit": 50}
FENCE = {"type": "GeofenceControl", "kind": "exclusion", "action": "land"}


def compiled(*policies, zones=(), components=None):
    stock = inventory([drone("d")], zones={z.name: z for z in zones}, policies={p.name: p for p in policies})
    app = application(*(components or [navigator(PATH)]))
    return compile_grants(app, plan(app, stock), stock)


def comb(name, teeth, across=False, lon=None):
    """Return a comb-shaped zone with long thin teeth. They point north, or east if `across` is set."""
    sides = [(500.0 * (((i + 1) // 2) % 2), float(i - teeth)) for i in range(2 * teeth)]
    corners = [*sides, (-1.0, float(teeth)), (-1.0, float(-teeth - 1))]
    ring = [at(*(c if across else reversed(c))) for c in corners]
    if lon is not None:
        ring = [c | {"lon": (c["lon"] - ring[0]["lon"] + lon + 180) % 360 - 180} for c in ring]
    return Zone.from_body(manifest("Zone", name, {"area": {"polygon": {"exterior": ring}}}))


def test_grant_refuses_zones_with_too_many_crossings():
    """A union of these zones would take minutes. During that time, the services could not read other Grants."""
    spiky = [comb("north", 480), comb("east", 480, across=True)]
    inside = {"type": "GeofenceControl", "kind": "inclusion", "action": "land"}
    with pytest.raises(
        InvalidObject, match=r"Policy in spec\.selector\.zones: edges of its zones cross more than 50000 times"
    ):
        compiled(policy("in", ("north", "east"), **inside), zones=spiky)
    # A refreshed Grant keeps the previous version of the policy, like that of every broken policy.
    (granted,) = compiled(policy("in", ("north",), **inside), zones=spiky)
    stock = inventory([drone("d")], zones={z.name: z for z in spiky})
    broken = dataclasses.replace(stock, policies={"in": policy("in", ("north", "east"), **inside)})
    assert refresh(granted, broken).policies == granted.policies
    # Exclusion zones are accepted, because they are not united.
    assert compiled(policy("out", ("north", "east"), **FENCE), zones=spiky)


def test_zone_validity_cache_is_cleared_with_the_zone():
    """Each change of a zone, even of its status, creates a new object, so the cache would grow."""
    gc.collect()
    before = len(_VALIDATED)
    near = zone("near", (50, 0))
    compiled(policy("out", ("near",), **FENCE), zones=[near])
    compiled(policy("out", ("near",), **FENCE), zones=[near])
    assert len(_VALIDATED) == before + 1
    assert validated(near) is validated(near)
    del near
    gc.collect()
    assert len(_VALIDATED) == before


def test_zone_crossings_are_equal_across_the_antimeridian():
    zones = [
        tuple(validated(z) for z in (comb("north", 20, lon=lon), comb("east", 20, across=True, lon=lon)))
        for lon in (20.0, 179.9999, -180.0)
    ]
    first, *others = (zone_crossings(each, 10**6) for each in zones)
    assert first > 150
    assert others == [pytest.approx(first, rel=0.05)] * 2


def test_driver_and_passenger_get_separate_grants():
    driver, passenger = compiled(components=(navigator(PATH), VIEWER | {"egress": []}))
    assert driver.class_ == "driver"
    assert driver.control == "full"
    assert driver.methods("mobility") == {"Arm", "Takeoff", "Goto", "GetControl", "ReturnControl"}
    assert driver.methods("camera") == frozenset()
    assert driver.control_points[0].point.position.lat == pytest.approx(at(0, 0)["lat"])
    assert driver.control_points[0].point.depot is None
    assert passenger.class_ == "passenger"
    assert passenger.control is None
    assert passenger.methods("camera") == {"CaptureImage"}
    assert driver.operation_area == passenger.operation_area != ()
    assert (
        driver.identity == "spiffe://fractus.dev/ns/default/app/traffic/component/Navigator/instance/traffic-navigator"
    )


def winding_path(turns, apart_m=20.0, length_m=60.0):
    return [at((i + 1) // 2 % 2 * length_m, i // 2 * apart_m, 10) for i in range(turns)]


def test_grant_area_of_winding_path_is_exact_to_a_centimetre():
    (grant,) = compiled(components=[navigator(winding_path(60))])
    (area,) = grant.operation_area
    assert len(area.polygon.exterior) > 1000
    assert _deviation_m(grant, winding_path(60)) < 0.011


def test_grant_area_is_simplified_when_ring_has_too_many_points(monkeypatch):
    monkeypatch.setattr(grant_compiler, "MAX_RING_POINTS", 150)
    (grant,) = compiled(components=[navigator(winding_path(12))])
    (area,) = grant.operation_area
    assert len(area.polygon.exterior) <= 150
    assert 0.011 < _deviation_m(grant, winding_path(12)) < MAX_ROUNDING_M


def test_grant_refuses_path_with_too_many_holes(monkeypatch):
    monkeypatch.setattr(grant_compiler, "MAX_HOLES", 0)
    meshes = [at(0, 0, 10), at(60, 0, 10), at(60, 60, 10), at(0, 60, 10), at(0, 0, 10)]
    with pytest.raises(
        InvalidObject, match=r"^spec\.components: .* 1 holes, more than .*; use fewer waypoints, or a region"
    ):
        compiled(components=[navigator(meshes)])


def _deviation_m(grant, path):
    spec = application(navigator(path)).spec
    planned = operation_area(spec, inventory([drone("d")]).depots, 7.0)
    granted = shapely.union_all([area_polygon(planned.frame, area) for area in grant.operation_area])
    return max(
        float(shapely.distance(shapely.points(shapely.get_coordinates(a)), b.boundary).max())
        for a, b in ((granted, planned.shape), (planned.shape, granted))
    )


def guide(points, **more):
    return VIEWER | {"egress": [], "pointsOfInterest": {"points": points, **more}}


@pytest.mark.parametrize("services", [VIEWER["services"], []])
def test_grant_has_tour_without_driver(services):
    points = [at(100, 0, 10), at(300, 0, 10), at(200, 0, 10)]
    (grant,) = compiled(components=[guide(points, ordered=False) | {"services": services}])
    assert [round(FRAME.xy(p.lat, p.lon)[0]) for p in grant.tour] == [100, 200, 300]
    assert [s.service for s in grant.services] == [s["service"] for s in services]


def test_grant_of_passenger_on_shared_drone_has_no_tour():
    app = application(guide([at(100, 0)]))
    flown = flight_of(application(navigator(PATH)), inventory().depots)
    flight = dataclasses.replace(flown, holder=("default", "other"))
    stock = inventory([drone("d")], claimed={"d": flight.holder}, flights={"d": flight})
    (grant,) = compile_grants(app, plan(app, stock), stock)
    assert grant.tour == ()
    assert grant.methods("camera") == {"CaptureImage"}


def test_grant_contains_policies_and_zones_sorted_by_name():
    (grant,) = compiled(policy("b", **ALTITUDE), policy("a", zones=["z"], **FENCE), zones=[zone("z", (100, 100))])
    assert [p.name for p in grant.policies] == ["a", "b"]
    assert [z.name for z in grant.policies[0].zones] == ["z"]
    assert grant.policies[1].zones == ()


def test_grant_is_refused_when_zone_is_unknown():
    with pytest.raises(InvalidObject, match=r"Policy a spec\.selector\.zones\[0\]: there is no Zone nowhere"):
        compiled(policy("a", zones=["nowhere"], **FENCE))


def stocked(*policies, zones=(), **more):
    named = {z.name: z for z in zones}
    return inventory([drone("d")], zones=named, policies={p.name: p for p in policies}, **more)


def test_refreshed_grant_equals_new_grant():
    policies = policy("a", zones=["z"], **FENCE), policy("b", **ALTITUDE), policy("c", zones=["far"], **FENCE)
    zones = zone("z", (100, 100)), zone("far", (80_000, 0))
    (old,) = compiled()
    (new,) = compiled(*policies, zones=zones)
    assert refresh(old, stocked(*policies, zones=zones)) == new
    assert refresh(new, stocked()) == old


@pytest.mark.parametrize("more", [{}, {"unreadable_zones": {"z": "no area"}}])
def test_refreshed_grant_keeps_previous_version_of_broken_policy(more):
    fence = policy("fence", zones=["z"], **FENCE)
    (old,) = compiled(fence, policy("read", **ALTITUDE), zones=[zone("z", (100, 100))])
    never = policy("never", zones=["nowhere"], **FENCE)
    stock = stocked(fence, never, policy("low", **ALTITUDE), unreadable_policies={"read": "no kind"}, **more)
    fresh = refresh(old, stock)
    assert [p.name for p in fresh.policies] == ["fence", "low", "read"]
    assert fresh.policies[0] == old.policies[0]
    assert fresh.policies[2] == old.policies[1]
    app = application(navigator(PATH))
    assert compile_grants(app, plan(app, stock), stock, None, [old]) == (fresh,)


def test_grant_is_refused_while_policy_is_unreadable():
    stock = stocked(unreadable_policies={"odd": "spec.validFrom: no date"})
    app = application(navigator(PATH))
    with pytest.raises(InvalidObject, match=r"Policy odd: spec\.validFrom: no date"):
        compile_grants(app, plan(app, stock), stock)


def test_refreshed_grant_keeps_policies_when_node_description_is_missing():
    heavy = policy("heavy", nodes=[{"key": "interfaces", "operator": "NotIn", "values": ["x"]}], **ALTITUDE)
    (old,) = compiled(heavy)
    fresh = refresh(old, inventory([], policies={"heavy": heavy, "low": policy("low", **ALTITUDE)}))
    assert [p.name for p in fresh.policies] == ["heavy", "low"]
    stock = inventory([drone("d")])
    app = application(navigator(PATH))
    decided = plan(app, stock)
    without_zone = inventory([], policies={"heavy": heavy, "low": policy("low", **ALTITUDE)})
    assert compile_grants(app, decided, without_zone, None, [old]) == (fresh,)
    with pytest.raises(InvalidObject, match="node d"):
        compile_grants(app, decided, without_zone)


def test_grant_omits_zones_beyond_reach():
    far = zone("far", (80_000, 0))
    (grant,) = compiled(policy("a", zones=["far"], **FENCE), zones=[far])
    assert grant.policies == ()


@pytest.mark.parametrize(
    "options", [FENCE | {"kind": "inclusion"}, {"type": "AccessControl", "kind": "grant", "methods": ["Goto"]}]
)
def test_grant_keeps_permission_of_zone_beyond_reach(options):
    (grant,) = compiled(policy("a", zones=["far"], **options), zones=[zone("far", (80_000, 0))])
    assert [p.name for p in grant.policies] == ["a"]
    situation = Situation(
        time_s=0.0, lat=FRAME.lat, lon=FRAME.lon, altitude_m=20.0, home=Home(FRAME.lat, FRAME.lon, 0.0)
    )
    goto = Call("Goto", GotoArgs(FRAME.lat, FRAME.lon, 20.0))
    assert not judge(goto, situation, compile_grant(grant)).permits


@pytest.mark.parametrize(
    "spec",
    [
        {"type": "PrivacyControl", "kind": "camera", "action": "refuse"},
        {"type": "AccessControl", "kind": "denial", "methods": ["CaptureImage"]},
    ],
)
def test_grant_keeps_camera_policies_of_distant_zones_in_view(spec):
    near = zone("near", (4000, 0))
    far = zone("far", (80_000, 0))
    private = policy("a", zones=["near", "far"], **spec)
    policies = {"a": private, "b": policy("b", zones=["near"], **FENCE)}
    stock = inventory(edges=[edge("e", (0, 0))], zones={z.name: z for z in (near, far)}, policies=policies)
    locations = [{"center": at(0, 0), "radius": 100, "instances": 1}]
    services = [{"service": "camera", "methods": ["CaptureImage"]}]
    app = application(component("Watch", "edge", locations=locations, services=services))
    (grant,) = compile_grants(app, plan(app, stock), stock)
    assert [[z.name for z in p.zones] for p in grant.policies] == [["near"]]
    # A camera without description may see everything around it.
    view = Situation(time_s=0.0, lat=FRAME.lat, lon=FRAME.lon, altitude_m=5.0, home=Home(FRAME.lat, FRAME.lon, 0.0))
    assert not judge(Call("CaptureImage", CaptureArgs()), view, compile_grant(grant)).permits


@pytest.mark.parametrize(
    ("applications", "expected"),
    [
        ({"names": ["traffic"]}, True),
        ({"names": ["other"]}, False),
        ({"namespaces": ["default"]}, True),
        ({"namespaces": ["prod"]}, False),
        ({"components": ["Navigator"]}, True),
        ({"components": ["AerialViewer"]}, False),
    ],
)
def test_grant_contains_policies_selected_for_application(applications, expected):
    (grant,) = compiled(policy("a", applications=applications, **ALTITUDE))
    assert bool(grant.policies) is expected


@pytest.mark.parametrize(
    ("key", "operator", "values", "attributes", "restriction", "permission"),
    [
        ("class", "In", ["C2", "C3"], {"class": "C2"}, True, True),
        ("class", "In", ["C2"], {"class": "C0"}, False, False),
        ("class", "In", ["C2"], {}, True, False),
        ("class", "NotIn", ["C2"], {"class": "C0"}, True, True),
        ("class", "NotIn", ["C2"], {"class": "C2"}, False, False),
        ("mtom", "Gt", ["2000"], {"mtom": 2500.0}, True, True),
        ("mtom", "Gt", ["2000"], {"mtom": 2000.0}, False, False),
        ("mtom", "Gt", ["2000"], {}, True, False),
        ("mtom", "Lt", ["2000"], {"mtom": 1999.0}, True, True),
        ("mtom", "Lt", ["2000"], {"mtom": "heavy"}, True, False),
        ("camera", "Exists", [], {"camera": 1}, True, True),
        ("camera", "Exists", [], {}, False, False),
        ("labels.owner", "Exists", [], {}, False, False),
        ("camra", "Exists", [], {}, True, False),
        ("services.camera.mount.pich", "Exists", [], {}, True, False),
        ("interfaces.technology", "Exists", [], {}, True, False),
        ("interfaces", "In", ["WiFi"], {"interfaces": [{"technology": "WiFi"}]}, True, False),
    ],
)
def test_node_selector_matches_unknown_attribute_only_for_restrictions(
    key, operator, values, attributes, restriction, permission
):
    expression = NodeExpression(key=key, operator=operator, values=tuple(values))
    assert matches(expression, attributes, unknown=True) is restriction
    assert matches(expression, attributes, unknown=False) is permission


def test_node_attributes_contain_description_fields():
    attributes = node_attributes(drone("d"))
    assert attributes["name"] == "d"
    assert attributes["kind"] == "Drone"
    assert attributes["maxSpeed"] == 15
    assert attributes["services.mobility.maxSpeed"] == 15
    assert node_attributes(edge("e", (0, 0)))["location.lat"] == pytest.approx(at(0, 0)["lat"])
    assert {"services.camera", "camera", "interfaces"} <= attributes.keys()
    assert not {"services.camera", "camera"} & node_attributes(edge("e", (0, 0), camera=False)).keys()


def test_node_selector_knows_every_node_attribute():
    for node in (drone("d"), edge("e", (0, 0))):
        assert [key for key in node_attributes(node) if not is_attribute(key)] == []
    keys = "class mtom name kind depot services.camera.mount.pitch physicalFeatures.dimensions.height autonomy"
    assert all(map(is_attribute, keys.split()))


@pytest.mark.parametrize("operator", [{"operator": "Exists"}, {"operator": "In", "values": ["x"]}])
def test_node_selector_with_unknown_attribute_restricts_and_is_reported(operator):
    near = zone("z", (100, 100))
    mistyped = policy("fence", zones=["z"], nodes=[{"key": "camra", **operator}], **FENCE)
    (grant,) = compiled(mistyped, zones=[near])
    assert [p.name for p in grant.policies] == ["fence"]
    with pytest.raises(
        InvalidObject, match=r"nodes\[0\]\.key: Drones and EdgeNodes have no attribute camra.* every node"
    ):
        check_policy(mistyped, ["z"])
    allowing = policy("may", nodes=[{"key": "camra", **operator}], type="AccessControl", kind="grant", methods=["Goto"])
    assert compiled(allowing)[0].policies == ()
    with pytest.raises(InvalidObject, match="applies to no node"):
        check_policy(allowing, [])
