"""Faults of an application that its tests must find. `bench/application_faults.py` tries all of them.

The application inspects places in a region: it flies to each of them, takes a picture, and reports it. One place is private,
and another is closed during the flight. A fault replaces one text of the program. `CHECKS` is the test that a careful
developer writes for this application.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from fractus_core.api.geometry import Point
from fractus_core.geo import geodesic_m
from fractus_sim.report.track import Place
from fractus_testing import (
    MIN_RESOURCES,
    SUCCESS,
    ExperimentError,
    FlightPlan,
    Results,
    Scene,
    World,
    circle,
    max_altitude,
    max_speed,
    no_fly,
    no_photo,
    polygon,
    until,
)

HOME = (50.8637, 4.6785, 25.0)
ALTITUDE_M = 15.0
PLACES = (
    (50.8640, 4.6785, ALTITUDE_M, True), (50.8640, 4.6791, ALTITUDE_M, False), (50.8642, 4.6796, ALTITUDE_M, True),
    (50.8636, 4.6790, ALTITUDE_M, True),
)  # fmt: skip
"""Latitude, longitude, altitude above home, and True if a picture is required. The second place is private."""

CLOSED = 2
"""Index of the place that is closed during the flight."""

PICTURES = (0, 3)
"""Places of the pictures, in order."""

REGION = polygon((50.8630, 4.6780), (50.8630, 4.6802), (50.8646, 4.6802), (50.8646, 4.6780))
PLAN = FlightPlan(
    path=[place[:3] for place in PLACES],
    region=REGION,
    restrictions=[no_photo("school", circle(50.8640, 4.6791, 5)), max_altitude(20), max_speed(8)],
)
MAX_FLIGHT_S = 150.0
NEAR_M = 3.0

PROGRAM = """
import json
import os

import fractus

PLACES = json.loads(os.environ["PLACES"])


async def fly(drone, control):
    report = []
    await drone.arm()
    await drone.takeoff(PLACES[0][2])
    async with fractus.camera() as camera:
        for lat, lon, alt, required in PLACES:
            try:
                await drone.goto(lat, lon, alt, speed_mps=6)
            except fractus.PolicyDenied as refusal:
                print("place skipped:", refusal)
                continue
            if required:
                picture = await camera.take()
                report.append([lat, lon, len(picture.data)])
    with open(os.environ["REPORT"], "w") as file:
        json.dump(report, file)


fractus.run(fly)
"""


@dataclass(frozen=True)
class ApplicationFault:
    """A fault of the application.

    Attributes:
        name: Short description.
        old: Text of the program, which it contains once.
        new: Replacement.
        check: Check of `CHECKS` that must find the fault.
    """

    name: str
    old: str
    new: str
    check: str

    def program(self) -> str:
        """Return the program with this fault.

        Raises:
            ValueError: The program does not contain the text once.
        """
        if PROGRAM.count(self.old) != 1:
            raise ValueError(f"{self.name}: the program contains the text {PROGRAM.count(self.old)} times, not once")
        return PROGRAM.replace(self.old, self.new)


_GOTO = "await drone.goto(lat, lon, alt, speed_mps=6)"
_REFUSAL = """                print("place skipped:", refusal)\n                continue\n"""
_END = """    with open(os.environ["REPORT"], "w") as file:\n"""

FAULTS: tuple[ApplicationFault, ...] = (
    ApplicationFault("altitude above mean sea level", _GOTO, "await drone.goto(lat, lon, alt + 25, speed_mps=6)", "keeps_to_policies"),
    ApplicationFault("latitude and longitude exchanged", _GOTO, "await drone.goto(lon, lat, alt, speed_mps=6)", "visits_its_places"),
    ApplicationFault("first place missed", "in PLACES:\n", "in PLACES[1:]:\n", "visits_its_places"),
    ApplicationFault("places in reverse order", "in PLACES:\n", "in PLACES[::-1]:\n", "visits_its_places"),
    ApplicationFault("coordinates rounded", _GOTO, "await drone.goto(round(lat, 3), round(lon, 3), alt, speed_mps=6)", "visits_its_places"),
    ApplicationFault("end of the leg not awaited", _GOTO, "await drone.goto(lat, lon, alt, speed_mps=6, acceptance_radius_m=20)", "takes_its_pictures_at_its_places"),
    ApplicationFault("picture before the leg", f"                {_GOTO}\n", f"                picture = await camera.take()\n                {_GOTO}\n", "takes_its_pictures_at_its_places"),
    ApplicationFault("no picture", "picture = await camera.take()\n                report.append([lat, lon, len(picture.data)])", "pass", "takes_its_pictures_at_its_places"),
    ApplicationFault("private place photographed", "            if required:\n", "            if True:\n", "keeps_to_policies"),
    ApplicationFault("takeoff too high", "takeoff(PLACES[0][2])", "takeoff(40)", "keeps_to_policies"),
    ApplicationFault("speed too high", "speed_mps=6", "speed_mps=12", "keeps_to_policies"),
    ApplicationFault("refusal ends the program", "except fractus.PolicyDenied as refusal", "except ZeroDivisionError as refusal", "ends_with_success"),
    ApplicationFault("refused place requested again and again", _REFUSAL, f"                for _ in range(3):\n                    try:\n                        {_GOTO}\n                    except fractus.PolicyDenied:\n                        pass\n                continue\n", "requests_a_refused_place_once"),
    ApplicationFault("refusal ignored", "                continue\n", "                pass\n", "takes_its_pictures_at_its_places"),
    ApplicationFault("lands at the last place", _END, f"    await drone.land()\n{_END}", "lands_at_home"),
    ApplicationFault("never returns", _END, f"    import asyncio\n    await asyncio.sleep(10_000)\n{_END}", "lands_at_home"),
    ApplicationFault("incomplete report", "json.dump(report, file)", "json.dump(report[:1], file)", "reports_each_picture"),
    ApplicationFault("report to the wrong file", 'os.environ["REPORT"]', 'os.environ["REPORT"] + ".txt"', "reports_each_picture"),
    ApplicationFault("pictures kept in memory", "    report = []\n", "    report = []\n    pictures = bytearray(200_000_000)\n", "keeps_to_its_resources"),
    ApplicationFault("error after the flight", "fractus.run(fly)\n", "fractus.run(fly)\nraise SystemExit(1)\n", "ends_with_success"),
)  # fmt: skip


@dataclass(frozen=True)
class Inspection:
    """The end of a flight of the application."""

    results: Results
    landed: bool
    report: str


def ends_with_success(inspection: Inspection) -> None:
    inspection.results.check_app_status("vDrone-1", SUCCESS)


def visits_its_places(inspection: Inspection) -> None:
    """All places except the closed one are visited, in order."""
    samples = iter(inspection.results.track("vDrone-1").samples)
    for place in PLACES[:CLOSED] + PLACES[CLOSED + 1 :]:
        assert any(_near(sample.place, place) for sample in samples), f"{place[:2]} was not visited in order"


def keeps_to_policies(inspection: Inspection) -> None:
    violations = inspection.results.get_violations("vDrone-1")
    others = [violation for violation in violations if violation.type != "no_fly"]
    assert not others, f"violations: {[violation.reason for violation in others]}"


def requests_a_refused_place_once(inspection: Inspection) -> None:
    inspection.results.check_violations("vDrone-1", type="no_fly", count=1)


def takes_its_pictures_at_its_places(inspection: Inspection) -> None:
    pictures = inspection.results.requests("vDrone-1", method="CaptureImage")
    assert len(pictures) == len(PICTURES), f"{len(pictures)} pictures"
    for picture, number in zip(pictures, PICTURES, strict=True):
        assert picture.position is not None
        assert _near(picture.position, PLACES[number]), f"picture {number} was taken at {picture.position}"


def lands_at_home(inspection: Inspection) -> None:
    assert inspection.landed, "the drone has not landed"
    inspection.results.check_landed("vDrone-1", near_home=NEAR_M)


def reports_each_picture(inspection: Inspection) -> None:
    report = json.loads(inspection.report or "[]")
    assert [entry[:2] for entry in report] == [list(PLACES[number][:2]) for number in PICTURES]


def keeps_to_its_resources(inspection: Inspection) -> None:
    inspection.results.check_app_resources("vDrone-1")


CHECKS: Mapping[str, Callable[[Inspection], None]] = {
    check.__name__: check
    for check in (
        ends_with_success, visits_its_places, keeps_to_policies, requests_a_refused_place_once,
        takes_its_pictures_at_its_places, lands_at_home, reports_each_picture, keeps_to_its_resources,
    )
}  # fmt: skip


def findings(scene: Scene, program: str) -> dict[str, str]:
    """Fly a program, and return the problem of each check that does not hold."""
    controller = scene.vController()
    drone = scene.vDrone("vDrone-1", setup=MIN_RESOURCES)
    drone.set_pos(HOME)
    drone.set_plan(PLAN)
    drone.set_camera(World(seed=3))
    source = scene.folder / "inspection.py"
    source.write_text(program)
    report = scene.folder / "inspection.json"
    drone.set_app(str(source), params={"PLACES": PLACES, "REPORT": str(report)})
    drone.start_app()
    landed = True
    try:
        # The place is closed before the drone can request it, also by a program that visits the places in another order.
        lat, lon, _, _ = PLACES[CLOSED]
        controller.update_restrictions(no_fly("accident", circle(lat, lon, 8)), at=until(drone, altitude=3))
        drone.wait_landed(MAX_FLIGHT_S)
    except AssertionError:
        landed = False
    inspection = Inspection(scene.results(), landed, report.read_text() if report.exists() else "")
    problems: dict[str, str] = {}
    for name, check in CHECKS.items():
        try:
            check(inspection)
        except (AssertionError, ExperimentError) as error:
            problems[name] = str(error)
    return problems


def _near(place: Place, target: tuple[float, float, float, bool]) -> bool:
    lat, lon, alt, _ = target
    return geodesic_m(place.ground, Point(lat=lat, lon=lon)) <= NEAR_M and abs(place.alt_m - alt) <= NEAR_M
