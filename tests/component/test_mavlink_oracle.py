"""Random MAVLink messages that move a drone, flown by the oracle. Short version of `bench/oracle.py --mavlink`."""

from __future__ import annotations

import numpy as np
import pytest
from fractus_services.gateway import translate
from mavlink_requests import MavlinkRequests
from policy_flights import Fleet, flights, scene


def translated(seed: int, count: int) -> MavlinkRequests:
    """Send random messages of several drones, without flying the resulting requests."""
    rng = np.random.default_rng(seed)
    fleet = Fleet(rng, [scene(rng) for _ in range(10)])
    source = MavlinkRequests()
    for number in range(count):
        drone = number % len(fleet.scenes)
        source.request(rng, fleet.scenes[drone], fleet.situation(drone, measured=False))
    return source


def test_messages_in_all_frames_and_masks_keep_their_meaning() -> None:
    source = translated(seed=5, count=4000)
    assert source.wrong == []
    assert 800 < source.refused < 3200


def test_oracle_finds_no_permitted_message_that_violates_a_policy() -> None:
    source = MavlinkRequests()
    tally = flights(seed=7, count=300, source=source)
    assert source.wrong == []
    assert tally.wrong == []
    assert tally.permitted > source.messages / 8
    assert tally.corrected > 20


@pytest.mark.parametrize(
    ("name", "defect"),
    [
        ("_rotated", lambda forward, right, _heading_deg: (forward, right)),
        ("_offset", lambda lat, lon, north_m, _east_m: (lat + north_m / 111_000, lon)),
        ("RELATIVE_FRAMES", translate.RELATIVE_FRAMES | translate.ABSOLUTE_FRAMES),
        ("ABSOLUTE_FRAMES", frozenset()),
        ("_VELOCITY", 0),
    ],
)
def test_oracle_detects_wrong_translation(monkeypatch: pytest.MonkeyPatch, name: str, defect: object) -> None:
    monkeypatch.setattr(translate, name, defect)
    if name == "RELATIVE_FRAMES":
        monkeypatch.setattr(translate, "ABSOLUTE_FRAMES", frozenset())
    assert translated(seed=5, count=400).wrong
