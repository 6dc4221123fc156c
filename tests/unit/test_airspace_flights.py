"""Volumes of whole flights: depot, transit flights, operation area, return flight, landing places, and altitudes."""

import math

import pytest
import shapely
from fractus_core.airspace import Airspace, OperationalIntent, decide, flight_volumes
from fractus_core.api import Application, InvalidObject
from fractus_core.api.geometry import Position
from fractus_core.geo import LocalFrame, area_polygon
from fractus_core.planning import Settings, operation_area
from fractus_core.planning.grant_compiler import flight_grant
from test_plan_landing_places import FAR, aborting
from test_plan_legality import stock
from test_planning import FRAME, PATH, STORE, VIEWER, application, at, drone, inventory, navigator

BEGIN_S = 1_800_000_000.0
END_S = BEGIN_S + 900
GROUND_M = 30.0
MARGIN_M = 2.5
HEIGHT_MARGIN_M = 2.0
SAFETY_M = 7.0
DEPOT_M = 20.0


def located(name="d", home=(0, 0), **more):
    """Return a drone whose home has a ground elevation."""
    parked = drone(name, home, minutes=60, **more)
    place = parked.spec.home.model_copy(update={"alt": GROUND_M})
    return parked.model_copy(update={"spec": parked.spec.model_copy(update={"home": place})})


def volumes(app=None, flown=None, stocked=None, **more):
    flown = flown or located()
    bounds = {"begin_s": BEGIN_S, "end_s": END_S} | more
    settings = bounds.pop("settings", Settings(safety_radius_m=SAFETY_M))
    app = app or application(navigator(PATH))
    return flight_volumes(app, flown, stocked or inventory([flown]), settings, **bounds)


def ground(volume):
    return volume.in_frame(FRAME)


def test_flight_is_one_volume_from_the_ground_to_the_maximum_altitude():
    (volume,) = volumes()
    assert (volume.begin_s, volume.end_s) == (BEGIN_S, END_S)
    assert volume.lower_m == -math.inf
    assert volume.upper_m == pytest.approx(GROUND_M + 80 + HEIGHT_MARGIN_M)


def test_flight_contains_depot_path_and_every_straight_way_home():
    path = [at(100, 0, 10), at(300, 0, 10), at(300, 200, 10)]
    (volume,) = volumes(application(navigator(path)))
    shape = ground(volume)
    depot = shapely.Point(0, 0).buffer(DEPOT_M + SAFETY_M + MARGIN_M)
    flown = shapely.LineString([(0, 0), (100, 0), (300, 0), (300, 200), (0, 0)]).buffer(SAFETY_M + MARGIN_M)
    assert shape.buffer(0.05).covers(depot)
    assert shape.buffer(0.05).covers(flown)
    assert shape.area < depot.union(flown).convex_hull.area * 1.01


def test_flight_of_region_contains_the_region_and_the_way_to_it():
    corners = [at(200, 0), at(400, 0), at(400, 100), at(200, 100)]
    region = {"region": {"polygon": {"exterior": corners}}, "navigation": "regionBased", "duration": 1}
    component = navigator(PATH) | {"controlPoints": [region]}
    (volume,) = volumes(application(component))
    expected = shapely.box(200, 0, 400, 100).union(shapely.Point(0, 0).buffer(DEPOT_M)).convex_hull.buffer(MARGIN_M)
    assert ground(volume).buffer(0.05).covers(expected)
    assert ground(volume).area < expected.area * 1.01


def test_flight_of_points_of_interest_contains_the_points():
    tour = VIEWER | {"egress": [], "pointsOfInterest": {"points": [at(100, 0, 10), at(50, 200, 10)]}}
    (volume,) = volumes(application(tour))
    assert ground(volume).covers(shapely.LineString([(100, 0), (50, 200), (0, 0)]).buffer(SAFETY_M))


def test_ground_is_the_area_in_which_grants_permit_flight():
    app = application(navigator(PATH))
    stocked = inventory([located()])
    area = operation_area(app.spec, stocked.depots, SAFETY_M)
    granted = flight_grant(app, located(), stocked, area)
    (volume,) = volumes(app, stocked=stocked)
    for part in (*granted.operation_area, *granted.corridor):
        permitted = area_polygon(FRAME, part)
        assert ground(volume).covers(permitted)
        assert ground(volume).boundary.distance(permitted) >= MARGIN_M - 0.05


def test_floor_applies_except_above_depot_and_landing_places():
    place = (100, 0)
    stocked = stock(aborting(place), zones=[FAR], drones=[located()])
    path = [at(100, 0, 25), at(300, 0, 25)]
    flight, depot, landing = volumes(
        application(navigator(path)), located(depot="d"), stocked, floor_m=20, ceiling_m=30
    )
    assert (flight.lower_m, flight.upper_m) == pytest.approx((48.0, 62.0))
    assert (depot.lower_m, depot.upper_m) == (-math.inf, pytest.approx(62.0))
    assert (landing.lower_m, landing.upper_m) == (-math.inf, pytest.approx(62.0))
    assert ground(depot).covers(shapely.Point(0, 0).buffer(DEPOT_M))
    assert ground(landing).covers(shapely.Point(place).buffer(SAFETY_M))
    assert ground(landing).area < math.pi * (SAFETY_M + MARGIN_M + 0.1) ** 2


def test_landing_place_for_lost_contact_gets_a_column():
    body = application(navigator(PATH)).to_dict()
    lost = {"action": "abort", "landAt": {name: at(200, 0)[name] for name in ("lat", "lon")}}
    app = Application.from_body(body | {"spec": body["spec"] | {"contactLost": lost}})
    *_, landing = volumes(app, floor_m=5)
    assert landing.lower_m == -math.inf
    assert ground(landing).covers(shapely.Point(200, 0).buffer(SAFETY_M))


def test_two_flights_above_each_other_are_accepted_and_two_at_the_same_altitude_are_not():
    low = volumes(application(navigator([at(100, 0, 10)])), ceiling_m=15)
    crossing = [at(100, -200, 40), at(100, 200, 40)]
    other = located("e", (100, -200))
    high = volumes(application(navigator(crossing, {"position": crossing[0]})), other, floor_m=30, ceiling_m=50)
    level = volumes(application(navigator(crossing, {"position": crossing[0]})), other, ceiling_m=50)
    airspace = Airspace([OperationalIntent("low", "Accepted", volumes=low)])
    assert decide(OperationalIntent("high", "Accepted", volumes=high), None, airspace, BEGIN_S).accepted
    assert not decide(OperationalIntent("level", "Accepted", volumes=level), None, airspace, BEGIN_S).accepted


@pytest.mark.parametrize("lon", [179.9995, -180.0, 0.0])
@pytest.mark.parametrize("lat", [0.0, -77.0, 89.9])
def test_flight_at_antimeridian_and_near_pole_contains_its_path(lat, lon):
    frame = LocalFrame(lat, lon)

    def there(x, y, alt):
        degrees = frame.latlon(x, y)
        return {"lat": degrees[0], "lon": degrees[1], "alt": alt}

    path = [there(50, 0, 10), there(-150, 40, 10)]
    home = Position(lat=lat, lon=lon, alt=GROUND_M)
    flown = located()
    flown = flown.model_copy(update={"spec": flown.spec.model_copy(update={"home": home, "depot": None})})
    (volume,) = volumes(application(navigator(path, {"position": path[0]})), flown)
    shape = volume.in_frame(frame)
    assert shape.covers(shapely.LineString([(0, 0), (50, 0), (-150, 40), (0, 0)]).buffer(SAFETY_M))
    assert shape.area < 20_000


def test_altitude_above_mean_sea_level_is_compared_with_the_limits_above_home():
    path = [at(100, 0, 60) | {"altitudeReference": "amsl"}]  # 30 m above home
    assert volumes(application(navigator(path)), ceiling_m=30)
    with pytest.raises(
        InvalidObject, match=r"route\[1\].alt: 30.0 m above home is outside the altitudes .*, 0 to 29 m"
    ):
        volumes(application(navigator(path)), ceiling_m=29)


def test_altitude_above_terrain_is_refused_unless_terrain_is_flat():
    app = application(navigator([at(100, 0, 20) | {"altitudeReference": "terrain"}]))
    with pytest.raises(InvalidObject, match=r"route\[1\].altitudeReference: terrain is unknown"):
        volumes(app)
    assert volumes(app, settings=Settings(flat_terrain=True))


@pytest.mark.parametrize(
    "limits",
    [
        {"ceiling_m": 81},
        {"floor_m": -1},
        {"floor_m": 30, "ceiling_m": 30},
        {"floor_m": math.nan},
        {"ceiling_m": math.nan},
        {"ceiling_m": math.inf},
    ],
)
def test_impossible_altitude_limits_are_refused(limits):
    with pytest.raises(
        InvalidObject, match=r"altitudes: .* is not possible for Drone d; give a range within 0 to 80 m"
    ):
        volumes(**limits)


def test_window_shorter_than_the_flight_is_refused():
    with pytest.raises(InvalidObject, match=r"window: the flight takes 2\.\d min including the way home"):
        volumes(end_s=BEGIN_S + 60)


@pytest.mark.parametrize("end_s", [BEGIN_S, BEGIN_S - 900, math.nan])
def test_window_without_duration_is_refused(end_s):
    with pytest.raises(InvalidObject, match="window: the flight takes"):
        volumes(end_s=end_s)


def test_drone_without_ground_elevation_is_refused():
    with pytest.raises(InvalidObject, match="the ground elevation of the home of Drone d is unknown"):
        volumes(flown=drone("d", minutes=60))


def test_application_without_drone_component_is_refused():
    with pytest.raises(InvalidObject, match="no component runs on a drone"):
        volumes(application(STORE))


def test_flight_over_the_maximum_distance_is_refused():
    with pytest.raises(InvalidObject, match="divide the flight into shorter flights"):
        volumes(application(navigator([at(100, 0, 10), at(65_000, 0, 10)])), end_s=BEGIN_S + 86_400)


@pytest.mark.parametrize(("limit_m", "expected_m"), [(40, 40), (500, 80)])
def test_maximum_altitude_of_application_limits_its_volumes(limit_m, expected_m):
    app = application(navigator(PATH))
    limited = app.model_copy(update={"spec": app.spec.model_copy(update={"max_altitude": limit_m})})
    (volume,) = volumes(limited)
    assert volume.upper_m == pytest.approx(GROUND_M + expected_m + HEIGHT_MARGIN_M)
    granted = flight_grant(
        limited, located(), inventory([located()]), operation_area(app.spec, inventory().depots, SAFETY_M)
    )
    assert granted.limits.max_altitude == expected_m
