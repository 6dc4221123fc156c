"""A member that is added to a closed set is noticed wherever it must be handled."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Literal, get_args

import pytest
from fractus_core.api.geometry import Reference
from fractus_core.api.methods import METHODS_OF
from fractus_core.api.policies import FilterAction, GeofenceAction, LimitAction, PolicySpec
from fractus_core.exhaustive import exhaustive
from fractus_core.policy.compiled import Rule, height_m
from fractus_core.policy.privacy import compose, filter_of
from fractus_core.policy.values import Filter
from fractus_proto.v1 import mobility_pb2
from fractus_services.mobility.rpc.arguments import call_of

ROOT = Path(__file__).parents[2]

Shape = Literal["round", "square"]


def test_a_table_has_every_member_and_no_other() -> None:
    assert exhaustive(Shape, {"round": 1, "square": 2})["square"] == 2
    assert exhaustive(Shape, ("square", "round")) == ("square", "round")
    for wrong in ({"round": 1}, {"round": 1, "square": 2, "flat": 3}, ("round", "square", "round")):
        with pytest.raises(TypeError, match="closed set"):
            exhaustive(Shape, wrong)


def rule(**spec: object) -> Rule:
    return Rule("p", PolicySpec.model_validate(spec), float("-inf"), float("inf"))


@pytest.mark.parametrize("action", get_args(FilterAction))
def test_every_filter_is_asked_for_by_its_name(action: FilterAction) -> None:
    asked = filter_of(rule(type="PrivacyControl", kind="camera", action=action))
    assert asked.action == action
    assert compose([asked]) == (Filter(action),)


@pytest.mark.parametrize("action", get_args(GeofenceAction))
def test_every_action_of_a_geofence_is_its_own(action: GeofenceAction) -> None:
    fence = {"type": "GeofenceControl", "kind": "exclusion", "selector": {"zones": ["z"]}}
    assert rule(**fence, action=action).spec.geofence_action == action


@pytest.mark.parametrize("action", get_args(LimitAction))
def test_every_action_of_a_limit_is_its_own(action: LimitAction) -> None:
    assert rule(type="LimitControl", kind="speed", upperLimit=5, action=action).spec.limit_action == action


@pytest.mark.parametrize("reference", get_args(Reference))
def test_every_datum_has_a_height(reference: Reference) -> None:
    assert height_m(5.0, reference, None, True) == (None if reference == "amsl" else 5.0)


def test_mypy_notices_a_filter_that_is_not_applied(tmp_path: Path) -> None:
    """The pipeline is checked against the models with a filter more: mypy names the line that lacks it."""
    api = tmp_path / "fractus_core"
    subprocess.run(["cp", "-r", ROOT / "core/fractus_core", api], check=True)
    policies = api / "api/policies.py"
    text = policies.read_text()
    policies.write_text(text.replace('FilterAction = Literal["black",', 'FilterAction = Literal["mosaic", "black",'))
    assert policies.read_text() != text
    pipeline = ROOT / "services/fractus_services/camera/imaging/pipeline.py"
    command = [sys.executable, "-m", "mypy", "--config-file", ROOT / "pyproject.toml", "--follow-imports=silent"]
    command += ["--cache-dir", tmp_path / "cache", pipeline]
    paths = ":".join(map(str, (tmp_path, ROOT / "services")))
    found = subprocess.run(command, env={"MYPYPATH": paths}, capture_output=True, text=True, cwd=tmp_path, check=False)
    assert 'Argument 1 to "assert_never" has incompatible type "Literal[\'mosaic\']"' in found.stdout, found.stdout


def test_every_method_of_the_mobility_service_can_be_checked() -> None:
    fields = {field.name for field in mobility_pb2.CheckCallRequest.DESCRIPTOR.oneofs_by_name["call"].fields}
    asked = {call_of(mobility_pb2.CheckCallRequest(**_filled(field))).method for field in fields}
    assert asked == METHODS_OF["mobility"]


def _filled(field: str) -> dict[str, object]:
    kind = type(getattr(mobility_pb2.CheckCallRequest(), field))
    needed = {"goto": {"target": {}}, "set_velocity": {"velocity": {}}}
    return {field: kind(**needed.get(field, {}))}
