"""Closed sets: if a member is added, a test fails for each place that does not handle it."""

from __future__ import annotations

from typing import Literal, get_args

import pytest
from fractus_core.api.geometry import Reference
from fractus_core.api.methods import METHODS_OF
from fractus_core.api.policies import FilterAction, GeofenceAction, LimitAction, PolicySpec
from fractus_core.exhaustive import exhaustive
from fractus_core.policy.compiled_grant import Rule, altitude_above_home_m
from fractus_core.policy.decision_types import Filter
from fractus_core.policy.picture_rules import combine_filters, rule_filter
from fractus_proto.v1 import mobility_pb2
from fractus_services.mobility.rpc.proto_conversion import call_of

Shape = Literal["round", "square"]


def test_exhaustive_table_has_exactly_the_members() -> None:
    assert exhaustive(Shape, {"round": 1, "square": 2})["square"] == 2
    assert exhaustive(Shape, ("square", "round")) == ("square", "round")
    for wrong in ({"round": 1}, {"round": 1, "square": 2, "flat": 3}, ("round", "square", "round")):
        with pytest.raises(TypeError, match="closed set"):
            exhaustive(Shape, wrong)


def rule(**spec: object) -> Rule:
    return Rule("p", PolicySpec.model_validate(spec), float("-inf"), float("inf"))


@pytest.mark.parametrize("action", get_args(FilterAction))
def test_rule_filter_has_name_of_action(action: FilterAction) -> None:
    required = rule_filter(rule(type="PrivacyControl", kind="camera", action=action))
    assert required.action == action
    assert combine_filters([required]) == (Filter(action),)


@pytest.mark.parametrize("action", get_args(GeofenceAction))
def test_geofence_policy_keeps_every_action(action: GeofenceAction) -> None:
    fence = {"type": "GeofenceControl", "kind": "exclusion", "selector": {"zones": ["z"]}}
    assert rule(**fence, action=action).spec.geofence_action == action


@pytest.mark.parametrize("action", get_args(LimitAction))
def test_limit_policy_keeps_every_action(action: LimitAction) -> None:
    assert rule(type="LimitControl", kind="speed", upperLimit=5, action=action).spec.limit_action == action


@pytest.mark.parametrize("reference", get_args(Reference))
def test_altitude_is_converted_from_every_reference(reference: Reference) -> None:
    assert altitude_above_home_m(5.0, reference, None, True) == (None if reference == "amsl" else 5.0)


def test_check_call_accepts_every_mobility_method() -> None:
    fields = {field.name for field in mobility_pb2.CheckCallRequest.DESCRIPTOR.oneofs_by_name["call"].fields}
    methods = {call_of(mobility_pb2.CheckCallRequest(**_filled(field))).method for field in fields}
    assert methods == METHODS_OF["mobility"]


def _filled(field: str) -> dict[str, object]:
    kind = type(getattr(mobility_pb2.CheckCallRequest(), field))
    needed = {"goto": {"target": {}}, "set_velocity": {"velocity": {}}}
    return {field: kind(**needed.get(field, {}))}
