"""Validation of numeric arguments before they are converted to protobuf."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
from fractus import InvalidRequest, Position, Velocity
from fractus.drone import goto_request, speed_request, takeoff_request, velocity_request
from fractus.pictures import capture_request

NUMBERS: dict[str, Callable[[Any], object]] = {
    "lat": lambda bad: goto_request(Position(bad, 1.0, 1.0), None, None),
    "lon": lambda bad: goto_request(Position(1.0, bad, 1.0), None, None),
    "alt": lambda bad: goto_request(Position(1.0, 1.0, bad), None, None),
    "acceptance_radius_m": lambda bad: goto_request(Position(1.0, 1.0, 1.0), None, None, bad),
    "altitude_m": takeoff_request,
    "speed_mps": speed_request,
    "north_mps": lambda bad: velocity_request(Velocity(bad, 0.0, 0.0), None, 0.0),
    "east_mps": lambda bad: velocity_request(Velocity(0.0, bad, 0.0), None, 0.0),
    "down_mps": lambda bad: velocity_request(Velocity(0.0, 0.0, bad), None, 0.0),
    "hold_s": lambda bad: velocity_request(Velocity(), None, bad),
}


@pytest.mark.parametrize("field", NUMBERS)
@pytest.mark.parametrize("bad", [None, "39.36", True, [], 10**400, object()])
def test_non_numeric_argument_is_refused_by_name(field: str, bad: object) -> None:
    with pytest.raises(InvalidRequest, match=f"^{field} must be a number"):
        NUMBERS[field](bad)


@pytest.mark.parametrize("bad", ["90", True, []])
def test_yaw_and_speed_are_numbers_or_none(bad: Any) -> None:
    with pytest.raises(InvalidRequest, match="yaw_deg"):
        goto_request(Position(1.0, 1.0), bad, None)
    with pytest.raises(InvalidRequest, match="speed_mps"):
        goto_request(Position(1.0, 1.0), None, bad)
    assert not goto_request(Position(1.0, 1.0), None, None).HasField("yaw_deg")


@pytest.mark.parametrize("bad", [-1, 2**31, 10**30, 1.5, math.nan, "640", None])
def test_picture_size_must_be_whole_numbers(bad: Any) -> None:
    with pytest.raises(InvalidRequest, match="width must be a whole number"):
        capture_request(bad, 480)
    with pytest.raises(InvalidRequest, match="height must be a whole number"):
        capture_request(640, bad)


def test_numeric_arguments_are_sent_unchanged() -> None:
    assert goto_request(Position(1, 2, 3), 90, 4).speed_mps == 4.0
    assert math.isnan(takeoff_request(math.nan).altitude_m)
    assert capture_request(640, 480).height == 480
