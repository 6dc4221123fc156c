"""Plans that stand: what makes them grow, what may not be displaced, and who may come along with a flight under way."""

import pytest
from fractus_core.api.geometry import Position
from fractus_core.planning import Infeasible, Settings, flight_of, plan
from fractus_core.planning.mission import misses, remaining_flight
from fractus_core.planning.scale_up import full_nodes, next_free_node
from test_plan_drones import flown_by_other, passenger, shared
from test_plan_properties import where
from test_planning import PATH, application, at, component, drone, edge, host, inventory, navigator

CAMERA = [{"service": "camera", "methods": ["CaptureImage"]}]


def ground(locations, name="GroundViewer"):
    return component(name, "edge", services=CAMERA, locations=locations)


# -- plans that stand --


def everywhere(instances="*"):
    return application(navigator(PATH), ground([{"center": at(150, 0), "radius": 400, "instances": instances}]))


@pytest.mark.parametrize("instances", ["*", 3])
def test_a_location_with_too_few_instances_grows_onto_a_new_node(instances):
    app = everywhere(instances)
    stock = inventory([drone("d")], [edge("e1", (0, 0)), edge("e2", (50, 0))])
    before = plan(app, stock)
    assert next_free_node(app, stock, Settings(), before) is None
    more = inventory([drone("d")], [edge("e1", (0, 0)), edge("e2", (50, 0)), edge("e3", (10, 0)), edge("x", (900, 0))])
    assert next_free_node(app, more, Settings(), before) == "e3"
    after = plan(app, more, previous=before)
    assert set(map(where, before.placements)) < set(map(where, after.placements))
    assert next_free_node(app, more, Settings(), after) is None


def test_a_node_that_does_not_suit_is_no_room():
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


def test_what_comes_first_in_the_manifest_does_not_drive_out_what_runs():
    first = ground([{"center": at(0, 0), "radius": 100, "instances": "*"}], name="First")
    second = ground([{"center": at(0, 0), "radius": 100, "instances": 1}], name="Second")
    app = application(first, second)
    nodes = [edge("e1", (0, 0)), edge("e2", (90, 0))]
    taken = [host("e1", "edge", cpu=0.15), host("e2", "edge", cpu=0.01)]
    before = plan(application(second), inventory([], nodes, taken))
    assert set(map(where, before.placements)) == {("Second", "e1")}
    roomy = [host("e1", "edge", cpu=0.15), host("e2", "edge", cpu=0.15)]
    after = plan(app, inventory([], nodes, roomy), previous=before)
    assert set(map(where, after.placements)) == {("Second", "e1"), ("First", "e2")}


def test_what_runs_gives_way_where_there_is_no_other_plan():
    first = ground([{"center": at(0, 0), "radius": 100, "instances": 1}], name="First")
    second = ground([{"center": at(0, 0), "radius": 100, "instances": "*"}], name="Second")
    stock = inventory([], [edge("e1", (0, 0))], [host("e1", "edge", cpu=0.15)])
    before = plan(application(second), stock)
    after = plan(application(first, second), stock, previous=before)
    assert set(map(where, after.placements)) == {("First", "e1")}


def test_a_drone_that_took_someone_along_is_judged_again_when_it_is_to_fly_for_him():
    app = passenger([at(120, 0), at(250, 3)])
    along = plan(app, shared([drone("b", battery=0.21)], {"b": flown_by_other()}))
    with pytest.raises(Infeasible) as caught:
        plan(app, inventory([drone("b", battery=0.21)]), previous=along)
    assert caught.value.rejected[0].reason == "FlightTooLong"


# -- what is left of a flight --


def test_of_a_flight_only_what_lies_ahead_is_offered():
    whole = flown_by_other()
    rest = remaining_flight(whole, Position(**at(150, 3)), 7.0)
    assert misses(passenger([at(200, 0), at(290, 0)]), rest, 7.0) is None
    assert misses(passenger([at(120, 0), at(290, 0)]), rest, 7.0) == 0
    assert misses(passenger([at(120, 0), at(290, 0)]), whole, 7.0) is None
    assert remaining_flight(whole, Position(**at(150, 60)), 7.0) is None


def test_of_two_passages_the_last_counts():
    there_and_back = application(navigator([at(0, 0), at(200, 0), at(0, 0)]))
    whole = flight_of(there_and_back, inventory().depots)
    rest = remaining_flight(whole, Position(**at(100, 0)), 7.0)
    assert misses(passenger([at(50, 0)]), rest, 7.0) is None
    assert misses(passenger([at(150, 0)]), rest, 7.0) == 0
