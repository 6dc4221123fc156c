"""Environment variables read by the SDK."""

from __future__ import annotations

import json
import math
from pathlib import Path

import fractus
import pytest
from fractus.environment import control_points, egress, endpoint
from fractus_core.api.names import address_variable, node_server_name

POD = {
    "FRACTUS_NODE": "drone-1",
    "FRACTUS_HOST_IP": "10.200.0.11",
    "FRACTUS_MOBILITY_ADDRESS": "10.200.0.11:50051",
    "FRACTUS_TLS_DIR": "/tls",
    "FRACTUS_SERVICE_IMAGE_CHECKER": "traffic-image-checker.default.svc:8080",
}


def test_mobility_endpoint_is_that_of_the_node() -> None:
    clients = endpoint("mobility", POD)
    assert clients.address == "10.200.0.11:50051"
    assert clients.server_name == "drone-1.node.fractus.dev"
    assert str(clients.tls_dir) == "/tls"


def test_camera_endpoint_uses_host_ip_unless_address_is_set() -> None:
    assert endpoint("camera", POD).address == "10.200.0.11:50052"
    assert endpoint("camera", POD | {"FRACTUS_CAMERA_ADDRESS": "10.0.0.1:1"}).address == "10.0.0.1:1"


@pytest.mark.parametrize("missing", ["FRACTUS_NODE", "FRACTUS_HOST_IP"])
def test_missing_environment_variable_is_named(missing: str) -> None:
    env = {k: v for k, v in POD.items() if k not in {missing, "FRACTUS_MOBILITY_ADDRESS"}}
    with pytest.raises(fractus.NotConfigured, match=missing):
        endpoint("mobility", env)


@pytest.mark.parametrize("component", ["ImageChecker", "image-checker"])
def test_egress_returns_component_address(component: str) -> None:
    assert egress(component, POD) == "traffic-image-checker.default.svc:8080"


def test_egress_to_unlisted_component_is_refused() -> None:
    with pytest.raises(fractus.NotConfigured, match="list DataStore in the egress"):
        egress("DataStore", POD)


def test_control_points_are_read_from_environment() -> None:
    text = json.dumps(
        [
            {
                "navigation": "pathBased",
                "path": [
                    {"lat": 40.0, "lon": 22.0, "alt": 20, "altitudeReference": "home"},
                    {"lat": 40.1, "lon": 22.1, "alt": 200, "altitudeReference": "amsl"},
                    {"lat": 40.2, "lon": 22.2},
                ],
            },
            {"navigation": "regionBased", "region": {"circle": {"center": {"lat": 1, "lon": 2}, "radius": 50}}},
        ]
    )
    path, region = control_points({"FRACTUS_CONTROL_POINTS": text})
    assert path.path[0] == fractus.Position(40.0, 22.0, 20.0)
    assert path.path[1].reference is fractus.AltitudeReference.AMSL
    assert math.isnan(path.path[2].alt)  # never the ground
    assert region.path == ()
    assert region.region == fractus.Circle(fractus.Position(1.0, 2.0), 50.0)


def test_control_points_are_read_from_grant_file(tmp_path: Path) -> None:
    corners = [{"lat": 0, "lon": 0}, {"lat": 0, "lon": 1}, {"lat": 1, "lon": 1}]
    points = [{"navigation": "regionBased", "region": {"polygon": {"exterior": corners, "holes": [corners]}}}]
    path = tmp_path / "grant.json"
    path.write_text(json.dumps({"kind": "Grant", "spec": {"controlPoints": points}}))
    (point,) = control_points({"FRACTUS_GRANT": str(path)})
    assert isinstance(point.region, fractus.Polygon)
    assert point.region.holes == (point.region.exterior,)
    assert point.region.exterior[1] == fractus.Position(0.0, 1.0)
    with pytest.raises(fractus.NotConfigured, match=r"FRACTUS_GRANT .* cannot be read"):
        control_points({"FRACTUS_GRANT": str(tmp_path / "none.json")})
    with pytest.raises(fractus.NotConfigured, match="set FRACTUS_GRANT to the file of a signed Grant"):
        control_points({})


@pytest.mark.parametrize("text", ["{", "3", '[{"path": []}]', '[{"navigation": "pathBased", "path": [{"lat": 1}]}]'])
def test_invalid_control_points_are_refused(text: str) -> None:
    with pytest.raises(fractus.NotConfigured, match="FRACTUS_CONTROL_POINTS"):
        control_points({"FRACTUS_CONTROL_POINTS": text})


@pytest.mark.parametrize("component", ["ImageChecker", "Viewer2D", "data-store", "A"])
def test_egress_variable_names_match_the_operator(component: str) -> None:
    assert egress(component, {address_variable(component): "a:1"}) == "a:1"
    clients = endpoint("mobility", {"FRACTUS_NODE": "drone-1", "FRACTUS_HOST_IP": "10.0.0.1"})
    assert clients.server_name == node_server_name("drone-1")
