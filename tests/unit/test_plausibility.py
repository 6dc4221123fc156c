"""Notes about valid manifests that are probably mistakes."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest
import yaml
from click.testing import CliRunner
from fractus_cli.plan import plan
from fractus_core.api import Application, Depot, InvalidObject, Policy, Zone
from fractus_core.api.geometry import Point
from fractus_core.plausibility import exchanged_coordinates, far_zones, notes, policy_notes, zone_notes
from fractus_core.validation import check_application

EXAMPLE = Path(__file__).parents[2] / "examples" / "traffic-monitoring"


def bodies(name: str) -> list[dict[str, Any]]:
    return list(yaml.safe_load_all((EXAMPLE / name).read_text()))


DEPOTS = {body["metadata"]["name"]: Depot.from_body(body) for body in bodies("depot.yaml")}
APPLICATIONS = [Application.from_body(body) for body in bodies("application.yaml")]


def exchange(value: Any) -> Any:
    """Return a copy of a manifest with latitude and longitude exchanged."""
    if isinstance(value, list):
        return [exchange(each) for each in value]
    if not isinstance(value, dict):
        return value
    new = {key: exchange(each) for key, each in value.items()}
    if "lat" in value:
        new |= {"lat": value["lon"], "lon": value["lat"]}
    return new


def test_point_near_depot_or_far_from_all_has_no_note() -> None:
    depots = DEPOTS.values()
    assert exchanged_coordinates(Point(lat=50.9, lon=4.7), depots) == ""
    assert exchanged_coordinates(Point(lat=-33.8, lon=151.2), depots) == ""
    assert exchanged_coordinates(Point(lat=4.7, lon=50.9), []) == ""
    assert "latitude and longitude are probably exchanged" in exchanged_coordinates(Point(lat=4.7, lon=50.9), depots)


def test_zone_with_exchanged_coordinates_has_note() -> None:
    body = bodies("zones.yaml")[0]
    assert list(zone_notes(Zone.from_body(body), DEPOTS.values())) == []
    (note,) = zone_notes(Zone.from_body(exchange(body)), DEPOTS.values())
    assert note.startswith(f"Zone {body['metadata']['name']}: spec.area: 4.6")


def far(lat: float, lon: float, radius: float = 100, name: str = "far") -> Zone:
    area = {"circle": {"center": {"lat": lat, "lon": lon}, "radius": radius}}
    return Zone.from_body({"metadata": {"name": name}, "spec": {"area": area}})


def test_zones_far_from_every_depot_have_note() -> None:
    depot = DEPOTS["depot-1"].spec.location
    near = far(depot.lat + 0.5, depot.lon)
    large = far(depot.lat + 2, depot.lon, radius=200_000)
    assert far_zones([near, large], DEPOTS.values()) == ""
    assert far_zones([far(0, 0)], []) == ""
    others = [far(depot.lat + 1.5, depot.lon, name=f"z{i}") for i in range(5)]
    note = far_zones([near, *others], DEPOTS.values())
    assert note.startswith("more than 100 km from every Depot: z0, z1, z2 and 2 more; check latitude and longitude")


def test_policy_of_far_zone_has_one_note() -> None:
    body = bodies("policies.yaml")[0]
    policy = Policy.from_body(body)
    depot = DEPOTS["depot-1"].spec.location
    distant, exchanged = (
        far(lat, lon, name=policy.spec.selector.zones[0]) for lat, lon in ((-33.8, 151.2), (depot.lon, depot.lat))
    )

    def found(zone: Zone) -> list[str]:
        return list(notes(DEPOTS.values(), [zone], [], [policy], APPLICATIONS))

    assert found(distant) == [
        f"Policy {policy.name}: spec.selector.zones: more than 100 km from every Depot: {distant.name};"
        " check latitude and longitude, which may be exchanged"
    ]
    assert [note.partition(":")[0] for note in found(exchanged)] == [f"Zone {exchanged.name}"]


def test_application_with_exchanged_coordinates_is_refused() -> None:
    body = exchange(bodies("application.yaml")[0])
    with pytest.raises(InvalidObject, match=r"controlPoints\[0\]\.path\[0\]: .* probably exchanged"):
        check_application(Application.from_body(body), DEPOTS)


@pytest.mark.parametrize(
    ("selected", "note"),
    [
        ({"names": ["traffic-monitoring"]}, ""),
        ({"names": ["trafic-monitoring"]}, "no Application is selected"),
        ({"namespaces": ["other"]}, "no Application is selected"),
        ({"components": ["Navigator"]}, ""),
        (
            {"components": ["Pilot"]},
            "no component of a selected Application has one of these names (existing: AerialViewer",
        ),
    ],
)
def test_policy_that_selects_nothing_has_note(selected: dict[str, Any], note: str) -> None:
    body = copy.deepcopy(bodies("policies.yaml")[1])
    body["spec"]["selector"]["applications"] = selected
    notes = list(policy_notes(Policy.from_body(body), APPLICATIONS))
    assert len(notes) == bool(note)
    assert not note or note in notes[0]


def test_plan_prints_notes(tmp_path: Path) -> None:
    (tmp_path / "zone.yaml").write_text(
        yaml.safe_dump(exchange(bodies("zones.yaml")[0]) | {"metadata": {"name": "far"}})
    )
    files = ["application", "depot", "drone", "edge-nodes", "policies", "zones"]
    arguments = [part for name in files for part in ("-f", str(EXAMPLE / f"{name}.yaml"))]
    result = CliRunner().invoke(plan, [*arguments, "-f", str(tmp_path / "zone.yaml")], catch_exceptions=False)
    assert result.exit_code == 0
    assert "note: Zone far: spec.area:" in result.stderr
