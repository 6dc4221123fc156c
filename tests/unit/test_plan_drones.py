"""Choice of the drone: a flying drone that can be shared, or an idle drone near the start."""

import dataclasses
from dataclasses import replace

import pytest
from fractus_core.planning import Infeasible, Settings, flight_of, plan
from fractus_core.planning.inventory import Reservation
from test_planning import (
    FRAME,
    PATH,
    VIEWER,
    application,
    at,
    drone,
    host,
    inventory,
    navigator,
    reasons,
)

NOW_S = 1_800_000_000.0

# -- sharing a flying drone --

OTHER = ("default", "other")


def passenger(points, ordered=True):
    return application(VIEWER | {"egress": [], "pointsOfInterest": {"points": points, "ordered": ordered}})


def shared(fleet, flights, **more):
    return inventory(fleet, claimed={n: f.holder for n, f in flights.items()}, flights=flights, **more)


def flown_by_other():
    app = application(navigator(PATH)).model_copy(deep=True)
    return dataclasses.replace(flight_of(app, inventory().depots), holder=OTHER)


def test_passenger_shares_drone_that_visits_its_points():
    stock = shared([drone("busy", battery=0.5), drone("idle")], {"busy": flown_by_other()})
    result = plan(passenger([at(120, 0), at(250, 3)]), stock)
    assert (result.drone.node, result.drone.shared_with) == ("busy", "default/other")
    assert result.drone.mission is None
    assert [a.node for a in result.drone.alternatives] == ["idle"]
    assert result.drone.transit == ()


def test_passenger_does_not_share_drone_that_visits_points_in_another_order():
    stock = shared([drone("busy"), drone("idle")], {"busy": flown_by_other()})
    result = plan(passenger([at(250, 3), at(120, 0)]), stock)
    assert (result.drone.node, result.drone.shared_with) == ("idle", None)
    assert len(result.drone.transit) == 3
    busy = next(r for r in result.rejected if r.node == "busy")
    assert busy.reason == "Claimed"
    assert "does not visit pointsOfInterest.points[1] in this order" in busy.message
    elsewhere = shared([drone("busy", home=(9000, 0), depot=None), drone("idle")], {"busy": flown_by_other()})
    result = plan(passenger([at(250, 3), at(120, 0)]), elsewhere)
    assert reasons(result)["AerialViewer", "busy"] == "PathMissesPoint"
    assert plan(passenger([at(250, 3), at(120, 0)], ordered=False), stock).drone.node == "busy"


def test_driver_never_shares_drone():
    with pytest.raises(Infeasible) as caught:
        plan(application(navigator(PATH)), shared([drone("busy")], {"busy": flown_by_other()}))
    assert caught.value.reason == "DroneBusy"


def test_passenger_stays_on_shared_drone_when_replanned():
    app = passenger([at(120, 0), at(250, 3)])
    stock = shared([drone("b"), drone("c")], {"b": flown_by_other(), "c": flown_by_other()})
    first = plan(app, stock)
    assert first.drone.node == "b"
    tired = shared([drone("b", battery=0.3), drone("c")], {"b": flown_by_other(), "c": flown_by_other()})
    assert plan(app, tired, previous=first).drone.node == "b"
    assert plan(app, tired).drone.node == "c"


# -- drones near the start --


def test_partial_control_uses_drones_of_nearby_depots():
    start = {"position": at(900, 0)}
    fleet = [drone("near", home=(0, 0)), drone("far", home=(9000, 0))]
    partial = application(navigator([at(950, 0, 10)], point=start, control="partial"))
    result = plan(partial, inventory(fleet))
    assert result.drone.node == "near"
    assert [round(FRAME.xy(leg.end.lat, leg.end.lon)[0]) for leg in result.drone.transit] == [900, 0]
    assert reasons(result) == {("Navigator", "far"): "TooFar"}
    with pytest.raises(Infeasible):
        plan(application(navigator([at(950, 0, 10)], point=start)), inventory(fleet))


def test_partial_control_from_depot_uses_its_drones_and_nearby_drones():
    fleet = [
        drone("away", home=(2500, 0), minutes=60),
        drone("far", home=(2500, 10), depot="other", minutes=60),
        drone("near", home=(1900, 0), depot="other", minutes=60),
    ]
    app = application(navigator(PATH, control="partial"))
    result = plan(app, inventory(fleet))
    assert {result.drone.node, *(a.node for a in result.drone.alternatives)} == {"away", "near"}
    assert reasons(result) == {("Navigator", "far"): "TooFar"}
    with pytest.raises(Infeasible, match="near: it is 1900 m from the start, more than 1000 m"):
        plan(app, inventory(fleet[1:]), Settings(depot_radius_m=1000))
    assert reasons(plan(application(navigator(PATH)), inventory(fleet)))["Navigator", "near"] == "OtherDepot"


def test_full_control_at_position_uses_drones_of_depot_at_that_position():
    start = {"position": at(15, 0)}
    fleet = [drone("kept", home=(400, 0)), drone("stray", home=(60, 0), depot=None)]
    result = plan(application(navigator(PATH, point=start)), inventory(fleet))
    assert result.drone.node == "kept"
    assert reasons(result) == {("Navigator", "stray"): "TooFar"}


def test_drone_with_too_low_maximum_altitude_is_rejected_with_figures():
    with pytest.raises(Infeasible) as caught:
        plan(application(navigator([at(100, 0, 95)])), inventory([drone("d")]))
    assert [r.reason for r in caught.value.rejected] == ["TooHigh"]
    assert "climbs to 80 m; the path goes up to 95 m" in caught.value.message


def test_plan_does_not_wait_for_claimed_drone_with_too_short_flight_time():
    with pytest.raises(Infeasible) as caught:
        plan(application(navigator(PATH)), inventory([drone("d", minutes=2)], claimed={"d": OTHER}))
    assert caught.value.reason == "NoDrone"
    assert "even with a full battery" in caught.value.message


def test_flight_time_message_contains_figures():
    with pytest.raises(
        Infeasible,
        match=r"can fly 0\.8 min with its reserve kept, with its battery at 25%; the mission takes 2\.\d min for \d+ m",
    ):
        plan(application(navigator(PATH)), inventory([drone("d", battery=0.25)]))


@pytest.mark.parametrize(("begins_s", "suits"), [(-60, False), (60, False), (3600, True)])
def test_drone_reserved_by_a_flight_plan_during_the_mission_is_rejected(begins_s, suits):
    reserved = Reservation("team/morning", NOW_S + begins_s, NOW_S + begins_s + 600)
    fleet = inventory([drone("d")], reservations={"d": [reserved]})
    settings = Settings(time_s=NOW_S)
    if suits:
        assert plan(application(navigator(PATH)), fleet, settings).drone.node == "d"
        return
    with pytest.raises(Infeasible) as refused:
        plan(application(navigator(PATH)), fleet, settings)
    assert refused.value.reason == "DroneBusy"
    (rejection,) = refused.value.rejected
    assert rejection.reason == "Reserved"
    assert rejection.message.startswith("flight plan team/morning has reserved it from 2027-01-15T")


def test_drone_of_running_application_is_kept_when_a_flight_plan_reserves_it():
    app = application(navigator(PATH))
    before = plan(app, inventory([drone("d")]), Settings(time_s=NOW_S))
    reserved = inventory([drone("d"), drone("e")], reservations={"d": [Reservation("a/b", NOW_S, NOW_S + 60)]})
    assert plan(app, reserved, Settings(time_s=NOW_S), before).drone.node == "d"


def test_later_flight_ignores_present_state_but_not_missing_services():
    weak = drone("d", battery=0.0, ready="False")
    unready = replace(host("d", "drone"), ready=False)
    stocked = inventory([weak], hosts=[unready])
    later = Settings(time_s=NOW_S, begins_later=True)
    assert plan(application(navigator(PATH)), stocked, later).drone.node == "d"
    with pytest.raises(Infeasible, match="Takeoff"):
        plan(application(navigator(PATH)), inventory([drone("d", methods=["Arm"])]), later)


def test_path_above_the_maximum_altitude_of_the_application_is_rejected():
    app = application(navigator([at(100, 0, 30)]))
    low = app.model_copy(update={"spec": app.spec.model_copy(update={"max_altitude": 29})})
    assert plan(app, inventory([drone("d")])).drone.node == "d"
    with pytest.raises(Infeasible, match="it climbs to 29 m; the path goes up to 30 m"):
        plan(low, inventory([drone("d")]))
