"""`fractus policy check`: verdicts from manifests, and errors for invalid input."""

from __future__ import annotations

import json
import pathlib
import shutil
from typing import Any

import pytest
import yaml
from click.testing import CliRunner, Result
from fractus_cli.policy import policy

FIELD = pathlib.Path(__file__).parents[2] / "examples" / "field"
DRONE = str(FIELD / "place.yaml")
POSITION = "39.370270,22.930291,10"
INSIDE_ZONE = {"lat": 39.370540, "lon": 22.932629}
FREE = {"lat": 39.3704, "lon": 22.9302, "alt": 10}


def run(*options: str, policies: str = str(FIELD), drone: str = DRONE) -> Result:
    return CliRunner().invoke(policy, ["check", "--policies", policies, "--drone", drone, *options])


def check(
    method: str, args: dict[str, Any] | None = None, *options: str, at: str = POSITION, **paths: str
) -> dict[str, Any]:
    result = run("--method", method, "--args", json.dumps(args or {}), "--at", at, "-o", "json", *options, **paths)
    assert result.exit_code == 0, result.output
    verdict: dict[str, Any] = json.loads(result.output)
    return verdict


def test_permitted_call_is_allowed() -> None:
    verdict = check("Goto", FREE)
    assert {k: verdict[k] for k in ("action", "takeover", "reason", "policies")} == {
        "action": "allow", "takeover": None, "reason": "", "policies": [],
    }  # fmt: skip
    assert verdict["args"] == {**FREE, "reference": "home", "speed_mps": 4.5}, "the speed setpoint is at the limit"


def test_violations_are_corrected_denied_or_taken_over() -> None:
    high = check("Goto", {**FREE, "alt": 20})
    assert (high["action"], high["args"]["alt"], high["policies"]) == ("correct", 14.8, ["low-flight"])
    assert "limit 15.0 less 0.2 for overshoot" in high["reason"]
    forbidden = check("Goto", INSIDE_ZONE, at="39.370701,22.932303,10")
    assert (forbidden["action"], forbidden["takeover"], forbidden["args"]) == ("takeover", "revoke", None)
    assert forbidden["policies"] == ["keep-away"]
    assert check("Disarm")["action"] == "deny"
    assert check("Disarm", at="39.370270,22.930291,0")["action"] == "allow"


def test_capture_is_denied_in_privacy_zone() -> None:
    in_view = check("CaptureImage", at="39.370450,22.9318,10")
    assert (in_view["action"], in_view["code"]) == ("deny", "PrivacyZone")
    assert check("CaptureImage", at="39.3700,22.9300,10")["action"] == "allow"


def test_velocity_is_considered() -> None:
    still = check("Goto", {"lat": 39.3708, "lon": 22.9322, "alt": 10}, at="39.37015,22.9323,10")
    assert still["action"] == "allow"
    fast = check("Goto", {"lat": 39.3708, "lon": 22.9322, "alt": 10}, "--velocity", "0,7,0", at="39.37015,22.9323,10")
    assert fast["brakeFirst"] or fast["action"] != "allow"


def test_component_is_judged_by_grant_of_its_application() -> None:
    application = ("--application", str(FIELD / "application.yaml"), "--component")
    assert check("Goto", {"lat": 39.370674, "lon": 22.930233}, *application, "Navigator")["action"] == "allow"
    outside = check("Goto", {"lat": 39.3750, "lon": 22.930233}, *application, "Navigator")
    assert (outside["action"], outside["policies"]) == ("deny", ["operation-area"])
    assert check("Land", {}, *application, "Navigator")["code"] == "MethodNotGranted"
    assert check("Goto", FREE, *application, "AerialViewer")["code"] == "MethodNotGranted"


def test_time_home_and_return_route_are_considered(tmp_path: pathlib.Path) -> None:
    shutil.copytree(FIELD, tmp_path / "field")
    file = tmp_path / "field" / "policies.yaml"
    bodies = list(yaml.safe_load_all(file.read_text()))
    for body in bodies:
        if body["metadata"]["name"] == "keep-away":
            body["spec"]["validUntil"] = "2026-06-01T12:00:00Z"
        if body["metadata"]["name"] == "low-flight":
            body["spec"] |= {"altitudeReference": "amsl", "upperLimit": 115, "lowerLimit": 105}
    file.write_text(yaml.safe_dump_all(bodies))
    paths = {"policies": str(tmp_path / "field"), "drone": str(tmp_path / "field" / "place.yaml")}
    home = ("--home", "39.37,22.93,100")
    near = "39.370701,22.932303,10"
    before = check("Goto", INSIDE_ZONE, "--time", "2026-06-01T11:59:59Z", *home, at=near, **paths)
    after = check("Goto", INSIDE_ZONE, "--time", "2026-06-01T14:00:00+02:00", *home, at=near, **paths)
    assert (before["action"], after["action"]) == ("takeover", "allow")
    assert check("Goto", {**FREE, "alt": 20}, *home, **paths)["args"]["alt"] == 14.8
    behind = {"lat": 39.37055, "lon": 22.93315}
    spot = "39.37000,22.93315,10"
    early = ("--time", "2026-06-01T11:00:00Z", *home)
    assert check("Goto", behind, *early, at=spot, **paths)["code"] == "WayHomeBlocked"
    assert check("Goto", behind, *early, "--way-home", "retraced", at=spot, **paths)["action"] == "allow"


def test_arguments_are_accepted_with_and_without_units() -> None:
    for args in ({"north": 1, "east": 0, "hold": 1}, {"north_mps": 1, "east_mps": 0, "hold_s": 1}):
        assert check("SetVelocity", args)["args"]["north_mps"] == 1.0
    assert check("Takeoff", {"altitude": 12}, at="39.37,22.93,0")["args"] == {"altitude_m": 12.0}
    assert check("SetSpeed", {"speed": 99})["args"] == {"speed_mps": 4.5}


def test_text_output_has_action_arguments_and_policies() -> None:
    text = run("--method", "Goto", "--args", json.dumps({**FREE, "alt": 20}), "--at", POSITION).output
    assert text.splitlines()[0] == "action:   correct"
    assert "alt=14.8" in text
    assert "policies: low-flight" in text


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("--method", "Fly", "--at", POSITION), "unknown method Fly"),
        (("--method", "Goto", "--at", POSITION), "Goto requires lat and lon"),
        (("--method", "Goto", "--args", "{", "--at", POSITION), "invalid JSON"),
        (("--method", "Goto", "--args", "[1]", "--at", POSITION), "JSON object"),
        (("--method", "Goto", "--args", '{"lat": "x", "lon": 1}', "--at", POSITION), "lat must be a number"),
        (("--method", "Goto", "--args", '{"lat": 1, "lon": 1, "up": 1}', "--at", POSITION), "Goto has no up"),
        (("--method", "Land", "--args", '{"lat": 1}', "--at", POSITION), "takes no arguments"),
        (("--method", "Land", "--at", "1,2"), "3 comma-separated numbers"),
        (("--method", "Land", "--at", "nan,2,3"), "3 comma-separated numbers"),
        (("--method", "Land", "--at", "91,2,3"), "lat must be"),
        (("--method", "Land", "--at", "1,2,1e300"), "alt must be"),
        (("--method", "Land", "--at", POSITION, "--velocity", "1e300,0,0"), "n must be"),
        (("--method", "Goto", "--args", '{"lat": null, "lon": 1}', "--at", POSITION), "Goto requires lat"),
        (("--method", "Goto", "--args", '{"lat": true, "lon": 1}', "--at", POSITION), "lat must be a number"),
        (("--method", "Goto", "--args", '{"lat": 1, "lon": 1, "alt": 1, "altitude": 2}', "--at", POSITION), "twice"),
        (
            ("--method", "Goto", "--args", '{"lat": 1, "lon": 1, "reference": []}', "--at", POSITION),
            "reference must be",
        ),
        (("--method", "Goto", "--args", "[" * 100_000, "--at", POSITION), "nested too deeply"),
        (("--method", "CaptureImage", "--args", '{"width": NaN}', "--at", POSITION), "whole number"),
        (("--method", "Land", "--at", POSITION, "--time", "2026-01-01T00:00:00"), "not a time with a time zone"),
        (("--method", "Land", "--at", POSITION, "--component", "Navigator"), "together"),
        (("--method", "Land", "--at", POSITION, "--application", DRONE, "--component", "X"), "one Application"),
        (
            (
                "--method",
                "Land",
                "--at",
                POSITION,
                "--application",
                str(FIELD / "application.yaml"),
                "--component",
                "X",
            ),
            "no component X",
        ),
    ],
)
def test_invalid_option_is_refused_with_message(options: tuple[str, ...], sentence: str) -> None:
    result = run(*options)
    assert result.exit_code in {1, 2}
    assert sentence in result.output
    assert "Traceback" not in result.output


def test_manifest_without_drone_is_refused() -> None:
    result = run("--method", "Land", "--at", POSITION, drone=str(FIELD / "application.yaml"))
    assert (result.exit_code, "one Drone" in result.output) == (1, True)


def test_argument_out_of_range_is_denied_by_the_engine() -> None:
    assert check("Goto", {"lat": 95, "lon": 0})["code"] == "InvalidArgument"
    assert check("Goto", {"lat": 10**400, "lon": 0})["code"] == "InvalidArgument"


def test_zones_are_found_in_another_file_than_their_policies(tmp_path: pathlib.Path) -> None:
    bodies = list(yaml.safe_load_all((FIELD / "place.yaml").read_text()))
    policies = list(yaml.safe_load_all((FIELD / "policies.yaml").read_text()))
    zones = tmp_path / "zones.yaml"
    rest = tmp_path / "others.yaml"
    zones.write_text(yaml.safe_dump_all(b for b in bodies if b["kind"] == "Zone"))
    rest.write_text(yaml.safe_dump_all([*(b for b in bodies if b["kind"] != "Zone"), *policies]))
    verdict = check("Goto", INSIDE_ZONE, at="39.370701,22.932303,10", policies=str(zones), drone=str(rest))
    assert verdict["policies"] == ["keep-away"]


def test_missing_policies_are_reported() -> None:
    result = run("--method", "Goto", "--args", json.dumps(FREE), "--at", POSITION, policies=DRONE)
    assert (result.exit_code, "contains no Policy" in result.stderr) == (0, True)
