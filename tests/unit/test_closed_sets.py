"""A member that is added to a closed set is noticed wherever it must be handled."""

from __future__ import annotations

from typing import Literal, get_args

import pytest
from fractus_core.api.geometry import Reference
from fractus_core.api.methods import METHODS_OF
from fractus_core.api.policies import FilterAction, GeofenceAction, LimitAction, PolicySpec
from fractus_core.exhaustive import exhaustive
from fractus_core.policy.altitude import altitude_above_home_m
from fractus_core.policy.compiled_grant import Rule
from fractus_core.policy.decision_types import Filter
from fractus_core.policy.picture_rules import combine_filters, rule_filter
from fractus_proto.v1 import mobility_pb2
from fractus_services.mobility.rpc.proto_conversion import call_of

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
    asked = rule_filter(rule(type="PrivacyControl", kind="camera", action=action))
    assert asked.action == action
    assert combine_filters([asked]) == (Filter(action),)


@pytest.mark.parametrize("action", get_args(GeofenceAction))
def test_every_action_of_a_geofence_is_its_own(action: GeofenceAction) -> None:
    fence = {"type": "GeofenceControl", "kind": "exclusion", "selector": {"zones": ["z"]}}
    assert rule(**fence, action=action).spec.geofence_action == action


@pytest.mark.parametrize("action", get_args(LimitAction))
def test_every_action_of_a_limit_is_its_own(action: LimitAction) -> None:
    assert rule(type="LimitControl", kind="speed", upperLimit=5, action=action).spec.limit_action == action


@pytest.mark.parametrize("reference", get_args(Reference))
def test_every_datum_has_a_height(reference: Reference) -> None:
    assert altitude_above_home_m(5.0, reference, None, True) == (None if reference == "amsl" else 5.0)


def test_every_method_of_the_mobility_service_can_be_checked() -> None:
    fields = {field.name for field in mobility_pb2.CheckCallRequest.DESCRIPTOR.oneofs_by_name["call"].fields}
    asked = {call_of(mobility_pb2.CheckCallRequest(**_filled(field))).method for field in fields}
    assert asked == METHODS_OF["mobility"]


def _filled(field: str) -> dict[str, object]:
    kind = type(getattr(mobility_pb2.CheckCallRequest(), field))
    needed = {"goto": {"target": {}}, "set_velocity": {"velocity": {}}}
    return {field: kind(**needed.get(field, {}))}
