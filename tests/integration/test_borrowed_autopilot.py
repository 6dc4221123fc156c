"""All settings of the owner are restored in a running autopilot. Otherwise the difference is reported, and they stay on disk."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from fractus_cluster.ports import free_port
from fractus_sim.errors import ExperimentError
from fractus_sim.testbeds.borrowed_autopilot import BorrowedAutopilot, default_state
from fractus_sim.testbeds.standalone_drones import DroneSetup
from fractus_sim.testbeds.vehicle_settings import AutopilotConnection, VehicleSettings
from owner_settings import FENCE, OWNED, RALLY, assert_owned, parameter_arguments, read_settings, upload_lists
from vehicle_process import HOME, running_vehicle


@pytest.fixture(scope="module")
def link() -> Iterator[str]:
    """Return the link of a vehicle with the settings of its owner. Each test restores them."""
    address = f"tcp:127.0.0.1:{free_port()}"
    with running_vehicle("--ready-after", "2", *parameter_arguments(), links=(address,)):
        upload_lists(address, HOME[:2])
        yield address


def set_parameter(link: str, name: str, value: float) -> None:
    with AutopilotConnection.open(link) as connection:
        connection.write_parameter(name, value)


def setup_of(borrowed: BorrowedAutopilot) -> DroneSetup:
    return DroneSetup("drone-1", HOME, autopilot=borrowed.link, state=borrowed.service_state)


def test_all_settings_of_a_vehicle_are_read(link: str) -> None:
    settings = read_settings(link)
    assert len(settings.parameters) > 1300
    assert {name: settings.parameters[name] for name in OWNED} == pytest.approx(OWNED)
    assert (len(settings.fence), len(settings.rally)) == (len(FENCE), len(RALLY))
    assert not settings.differences(read_settings(link))
    assert "system 1" in settings.identity


def test_given_back_autopilot_has_the_failsafes_of_its_owner(link: str, tmp_path: Path) -> None:
    borrowed = BorrowedAutopilot(link, tmp_path, print)
    borrowed.take()
    owner = read_settings(link)
    for name, value in {"FS_GCS_ENABLE": 3.0, "SYSID_MYGCS": 244.0, "BATT_FS_LOW_ACT": 3.0}.items():
        set_parameter(link, name, value)
    assert BorrowedAutopilot(link, tmp_path, print).interrupted, "the settings survive the process"
    assert borrowed.give_back() == []
    assert_owned(link, owner)
    assert not BorrowedAutopilot(link, tmp_path, print).interrupted


def test_difference_is_named_and_keeps_the_stored_settings(link: str, tmp_path: Path) -> None:
    borrowed = BorrowedAutopilot(link, tmp_path, print)
    borrowed.take()
    set_parameter(link, "WPNAV_SPEED", 200.0)
    assert borrowed.give_back() == ["WPNAV_SPEED was 450 and is 200"]
    again = BorrowedAutopilot(link, tmp_path, print)
    again.take()
    assert again.give_back() == ["WPNAV_SPEED was 450 and is 200"], "later settings do not replace those of the owner"
    set_parameter(link, "WPNAV_SPEED", 450.0)
    assert again.give_back() == []


def test_values_that_a_service_must_still_restore_are_a_difference(link: str, tmp_path: Path) -> None:
    borrowed = BorrowedAutopilot(link, tmp_path, print)
    borrowed.take()
    borrowed.service_state.mkdir()
    (borrowed.service_state / "return.json").write_text("{}")
    (difference,) = borrowed.give_back()
    assert str(borrowed.service_state) in difference


def test_interrupted_flight_of_another_vehicle_is_not_restored(link: str, tmp_path: Path) -> None:
    BorrowedAutopilot(link, tmp_path, print).take()
    set_parameter(link, "LAND_SPEED", 80.0)
    borrowed = BorrowedAutopilot(link, tmp_path, print)
    with pytest.raises(ExperimentError, match=r"may be another vehicle now \(LAND_SPEED changed\); use --restore"):
        borrowed.restore(tmp_path, setup_of(borrowed), forced=False)
    set_parameter(link, "LAND_SPEED", 50.0)
    borrowed.restore(tmp_path, setup_of(borrowed), forced=False)
    assert not borrowed.interrupted


def test_unreadable_settings_of_the_owner_are_refused_in_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "owner.json").write_text('{"identity": "system 1"}')
    with pytest.raises(ExperimentError, match="cannot read the settings of the owner"):
        BorrowedAutopilot("tcp:127.0.0.1:1", tmp_path, print)


def test_settings_are_stored_exactly_and_compared_without_measured_values() -> None:
    owner = VehicleSettings("system 1", {"A": 0.1, "B": float("nan"), "STAT_RUNTIME": 1.0}, ((5001.0, 0.0),), ())
    assert replace(owner, parameters={**owner.parameters, "STAT_RUNTIME": 9.0}).differences(owner) == []
    assert owner.differences(replace(owner, parameters={"A": 0.1})) == ["B was nan and is missing"]
    assert owner.differences(replace(owner, fence=())) == ["the fence had 1 items and has 0"]
    assert owner.differences(replace(owner, fence=((5002.0, 0.0),))) == ["items of the fence changed"]


def test_settings_directory_is_named_after_the_link(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert default_state("tcp:10.0.0.2:5760") == tmp_path / "fractus/autopilots/tcp-10.0.0.2-5760"
