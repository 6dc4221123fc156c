"""Changes of an active plan: scale-up, running instances on their nodes, and passengers on the remaining flight."""

import pytest
from fractus_core.api.geometry import Position
from fractus_core.planning import Infeasible, Settings, flight_of, plan
from fractus_core.planning.mission import misses, remaining_flight
from fractus_core.planning.scale_up import full_nodes, next_free_node
from test_plan_drones import flown_by_other, passenger, shared
from test_plan_properties import component_and_node
from test_planning import PATH, application, at, component, drone, edge, host, inventory, navigator

CAMERA = [{"service": "camera", "methods": ["CaptureImage"]}]


def ground(locations, name="GroundViewer"):
    return component(name, "edge", services=CAMERA, locations=locations)


# -- active plans --


def everywhere(instances="*"):
    return application(navigator(PATH), ground([{"center": at(150, 0), "radius": 400, "instances": instances}]))


@pytest.mark.parametrize("instances", ["*", 3])
def test_plan_scales_up_to_new_node_when_location_has_too_few_instances(instances):
    app = everywhere(instances)
    stock = inventory([drone("d")], [edge("e1", (0, 0)), edge("e2", (50, 0))])
    before = plan(app, stock)
    assert next_free_node(app, stock, Settings(), before) is None
    more = inventory([drone("d")], [edge("e1", (0, 0)), edge("e2", (50, 0)), edge("e3", (10, 0)), edge("x", (900, 0))])
    assert next_free_node(app, more, Settings(), before) == "e3"
    after = plan(app, more, previous=before)
    assert set(map(component_and_node, before.placements)) < set(map(component_and_node, after.placements))
    assert next_free_node(app, more, Settings(), after) is None


def test_scale_up_ignores_full_and_excluded_nodes():
    app = everywhere()
    before = plan(app, inventory([drone("d")], [edge("e1", (0, 0))]))
    full = host("e2", "edge", cpu=0.01)
    stock = inventory([drone("d")], [edge("e1", (0, 0)), edge("e2", (50, 0))], [full])
    assert next_free_node(app, stock, Settings(), before) is None
    assert full_nodes(app, stock, Settings(), before) == {"e2"}
    stock = inventory([drone("d")], [edge("e1", (0, 0)), edge("e2", (50, 0))])
    assert not full_nodes(app, stock, Settings(excluded={"e2": "refused"}), before)
    assert next_free_node(app, stock, Settings(excluded={"e2": "refused"}), before) is None
    assert next_free_node(app, stock, Settings(), before) == "e2"


def test_plan_keeps_running_instance_when_earlier_component_needs_node():
    first = ground([{"center": at(0, 0), "radius": 100, "instances": "*"}], name="First")
    second = ground([{"center": at(0, 0), "radius": 100, "instances": 1}], name="Second")
    app = application(first, second)
    nodes = [edge("e1", (0, 0)), edge("e2", (90, 0))]
    taken = [host("e1", "edge", cpu=0.15), host("e2", "edge", cpu=0.01)]
    before = plan(application(second), inventory([], nodes, taken))
    assert set(map(component_and_node, before.placements)) == {("Second", "e1")}
    roomy = [host("e1", "edge", cpu=0.15), host("e2", "edge", cpu=0.15)]
    after = plan(app, inventory([], nodes, roomy), previous=before)
    assert set(map(component_and_node, after.placements)) == {("Second", "e1"), ("First", "e2")}


def test_plan_moves_running_instance_when_no_other_plan_exists():
    first = ground([{"center": at(0, 0), "radius": 100, "instances": 1}], name="First")
    second = ground([{"center": at(0, 0), "radius": 100, "instances": "*"}], name="Second")
    stock = inventory([], [edge("e1", (0, 0))], [host("e1", "edge", cpu=0.15)])
    before = plan(application(second), stock)
    after = plan(application(first, second), stock, previous=before)
    assert set(map(component_and_node, after.placements)) == {("First", "e1")}


def test_plan_checks_shared_drone_again_when_passenger_flies_alone():
    app = passenger([at(120, 0), at(250, 3)])
    along = plan(app, shared([drone("b", battery=0.21)], {"b": flown_by_other()}))
    with pytest.raises(Infeasible) as caught:
        plan(app, inventory([drone("b", battery=0.21)]), previous=along)
    assert caught.value.rejected[0].reason == "FlightTooLong"


# -- remaining flight --


def test_remaining_flight_contains_only_path_ahead():
    whole = flown_by_other()
    rest = remaining_flight(whole, Position(**at(150, 3)), 7.0)
    assert misses(passenger([at(200, 0), at(290, 0)]), rest, 7.0) is None
    assert misses(passenger([at(120, 0), at(290, 0)]), rest, 7.0) == 0
    assert misses(passenger([at(120, 0), at(290, 0)]), whole, 7.0) is None
    assert remaining_flight(whole, Position(**at(150, 60)), 7.0) is None


def test_remaining_flight_starts_at_last_passage_of_position():
    out_and_back = application(navigator([at(0, 0), at(200, 0), at(0, 0)]))
    whole = flight_of(out_and_back, inventory().depots)
    rest = remaining_flight(whole, Position(**at(100, 0)), 7.0)
    assert misses(passenger([at(50, 0)]), rest, 7.0) is None
    assert misses(passenger([at(150, 0)]), rest, 7.0) == 0
