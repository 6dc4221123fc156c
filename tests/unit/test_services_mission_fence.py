"""Mission fence on the vehicle: shape, handling of the owner's fence, and failures."""

from __future__ import annotations

import asyncio
import contextlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import shapely
from depth import examples
from fractus_core.api.grants import GrantSpec
from fractus_core.geo import LocalFrame
from fractus_runtime.mavlink_codec import Message
from fractus_services.errors import AutopilotError
from fractus_services.mobility.mavlink import fence as module
from fractus_services.mobility.mavlink.fence import FENCE_MARGIN_M, MissionFence, MissionItem, fence_bounds
from fractus_services.mobility.mavlink.mission_protocol import ItemsUnsupported, NoSpace
from hypothesis import example, given, settings
from hypothesis import strategies as st
from parameter_vehicle import ParameterVehicle
from virtual_time import Loop

FRAME = LocalFrame(39.36, 22.95)


def area(x0: float, y0: float, x1: float, y1: float) -> dict[str, Any]:
    corners = ((x0, y0), (x1, y0), (x1, y1), (x0, y1))
    return {"polygon": {"exterior": [dict(zip(("lat", "lon"), FRAME.latlon(x, y), strict=True)) for x, y in corners]}}


def spec(*areas: dict[str, Any], **more: Any) -> GrantSpec:
    body: dict[str, Any] = {
        "node": "drone-1",
        "application": {"namespace": "default", "name": "app", "uid": "u1"},
        "component": "Navigator",
        "instance": "app-navigator",
        "operationArea": list(areas),
        **more,
    }
    return GrantSpec.model_validate(body)


def outline(items: tuple[MissionItem, ...]) -> Any:
    return shapely.Polygon([FRAME.xy(i.lat_e7 / 1e7, i.lon_e7 / 1e7) for i in items])


class Killed(Exception):
    """The service ends."""


class Vehicle(ParameterVehicle):
    """Fake autopilot with parameters and a list of fence items."""

    def __init__(self) -> None:
        values = {"FENCE_ENABLE": 0.0, "FENCE_TYPE": 7.0, "FENCE_ALT_MAX": 100.0, "FENCE_ACTION": 2.0}
        super().__init__(values | {"FS_GCS_ENABLE": 1.0, "FENCE_OPTIONS": 1.0, "FENCE_TOTAL": 0.0})
        self.items: tuple[MissionItem, ...] = ()
        self.written: list[str] = []

    def send(self, outgoing: Message) -> None:
        if outgoing.name == "PARAM_SET":
            self.written.append(outgoing.text("param_id"))
        super().send(outgoing)


@pytest.fixture
def vehicle(monkeypatch: pytest.MonkeyPatch) -> Vehicle:
    vehicle = Vehicle()

    async def upload(_autopilot: Any, items: Any) -> None:
        vehicle.items = tuple(items)
        vehicle.values["FENCE_TOTAL"] = float(len(vehicle.items))

    async def download(_autopilot: Any) -> tuple[MissionItem, ...]:
        return vehicle.items

    monkeypatch.setattr(module, "upload", upload)
    monkeypatch.setattr(module, "download", download)
    return vehicle


LIMITS = {"limits": {"maxAltitude": 60, "maxSpeed": 12}}


def test_fence_bounds_enclose_granted_area() -> None:
    bounds = fence_bounds(spec(area(-50, -50, 50, 50), corridor=[area(0, -120, 10, 0)], **LIMITS))
    assert bounds is not None
    assert bounds.altitude_m == 65.0
    whole = shapely.union(shapely.box(-50, -50, 50, 50), shapely.box(0, -120, 10, 0))
    assert outline(bounds.items).contains(whole.buffer(FENCE_MARGIN_M - 0.5, join_style="mitre"))
    assert outline(bounds.items).area < whole.buffer(3 * FENCE_MARGIN_M).area
    assert {i.param1 for i in bounds.items} == {float(len(bounds.items))}


def test_separate_areas_become_one_fence_polygon() -> None:
    bounds = fence_bounds(spec(area(0, 0, 50, 50), area(200, 0, 250, 50)))
    assert bounds is not None
    assert bounds.altitude_m is None
    assert outline(bounds.items).contains(shapely.box(0, 0, 250, 50))


def test_round_area_has_few_fence_vertices() -> None:
    circle = {"circle": {"center": {"lat": 39.36, "lon": 22.95}, "radius": 5000}}
    bounds = fence_bounds(spec(circle))
    assert bounds is not None
    assert 4 <= len(bounds.items) <= 60
    assert outline(bounds.items).contains(shapely.Point(0, 0).buffer(5000))


@settings(max_examples=examples(200, 60))
@example([(0.0, 0.0, 6.0), (0.0, 6.0, 6.0)], 8)
@given(
    st.lists(st.tuples(st.floats(-300, 300), st.floats(-300, 300), st.floats(5, 200)), min_size=1, max_size=5),
    st.sampled_from([60, 30, 15, 8, 4]),
)
def test_fence_with_fewer_vertices_lies_further_out(circles: list[tuple[float, float, float]], vertices: int) -> None:
    areas = []
    for x, y, radius in circles:
        lat, lon = FRAME.latlon(x, y)
        areas.append({"circle": {"center": {"lat": lat, "lon": lon}, "radius": radius}})
    bounds = fence_bounds(spec(*areas), vertices)
    assert bounds is not None
    assert 3 <= len(bounds.items) <= vertices
    whole = shapely.union_all([shapely.Point(x, y).buffer(radius, 64) for x, y, radius in circles])
    assert outline(bounds.items).is_valid
    assert outline(bounds.items).contains(whole.buffer(FENCE_MARGIN_M - 0.5))


async def test_vehicle_with_little_storage_gets_fewer_fence_vertices(
    vehicle: Vehicle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    round_area = {"circle": {"center": {"lat": 39.36, "lon": 22.95}, "radius": 300}}
    sent = list[int]()
    room = 12

    async def little(_autopilot: Any, items: Any) -> None:
        sent.append(len(items))
        if len(items) > room:
            vehicle.items = ()
            raise NoSpace("the autopilot refused the fence: no space: Only 12 items are supported")
        vehicle.items = tuple(items)

    monkeypatch.setattr(module, "upload", little)
    fence = MissionFence(vehicle, tmp_path)
    await fence.raise_around(spec(round_area), retraces=False)
    assert sent[-1] <= room < sent[0]
    assert outline(vehicle.items).contains(shapely.Point(0, 0).buffer(300 + FENCE_MARGIN_M - 0.5))
    await fence.lower(lambda: True)
    room = 3
    with pytest.raises(AutopilotError, match="Only 12 items"):
        await fence.raise_around(spec(round_area), retraces=False)


def test_no_fence_is_loaded_without_bounds() -> None:
    assert fence_bounds(spec()) is None


async def test_mission_fence_is_enabled_and_owner_fence_restored(vehicle: Vehicle, tmp_path: Path) -> None:
    vehicle.values["FENCE_TOTAL"] = 1.0
    before = dict(vehicle.values)
    vehicle.items = (MissionItem(5003, 30.0, 1, 2),)
    fence = MissionFence(vehicle, tmp_path)
    await fence.raise_around(spec(area(-50, -50, 50, 50), **LIMITS), retraces=True)
    assert vehicle.written[-1] == "FENCE_ENABLE", "the fence is enabled after all other settings"
    assert vehicle.values["FENCE_TYPE"] == 5.0
    assert vehicle.values["FENCE_ACTION"] == 3.0
    assert vehicle.values["FENCE_ALT_MAX"] == 65.0
    assert {i.command for i in vehicle.items} == {5001}, "items of the owner's disabled fence are not used"
    restarted = MissionFence(vehicle, tmp_path)
    assert restarted.raised, "a restarted service knows the mission fence"
    await restarted.raise_around(spec(area(-10, -10, 10, 10)), retraces=False)
    await restarted.lower(lambda: True)
    assert vehicle.values == before
    assert vehicle.items == (MissionItem(5003, 30.0, 1, 2),)
    assert not restarted.raised


async def test_owner_fence_stays_in_force(vehicle: Vehicle, tmp_path: Path) -> None:
    vehicle.values |= {"FENCE_ENABLE": 1.0, "FENCE_TYPE": 3.0, "FENCE_ALT_MAX": 40.0, "FENCE_OPTIONS": 3.0}
    vehicle.items = (MissionItem(5003, 30.0, 1, 2),)
    fence = MissionFence(vehicle, tmp_path)
    await fence.raise_around(spec(area(-50, -50, 50, 50), **LIMITS), retraces=True)
    assert [n for n in vehicle.written if n == "FENCE_ENABLE"] == ["FENCE_ENABLE"] * 2, (
        "the fence is disabled first, and enabled again after all changes"
    )
    assert (vehicle.written[0], vehicle.written[-1]) == ("FENCE_ENABLE", "FENCE_ENABLE")
    assert vehicle.values["FENCE_ENABLE"] == 1.0
    assert vehicle.items[0] == MissionItem(5003, 30.0, 1, 2)
    assert len(vehicle.items) == 5
    assert vehicle.values["FENCE_ALT_MAX"] == 40.0
    assert vehicle.values["FENCE_TYPE"] == 7.0
    assert vehicle.values["FENCE_ACTION"] == 2.0
    assert vehicle.values["FENCE_OPTIONS"] == 1.0, (
        "the option for a union of inclusion areas is cleared, because it would weaken both fences"
    )


@pytest.mark.parametrize("action", [0.0, 4.0])
async def test_owner_fence_without_action_gets_action_for_the_mission(
    vehicle: Vehicle, tmp_path: Path, action: float
) -> None:
    vehicle.values |= {"FENCE_ENABLE": 1.0, "FENCE_ACTION": action}
    fence = MissionFence(vehicle, tmp_path)
    await fence.raise_around(spec(area(-50, -50, 50, 50), **LIMITS), retraces=True)
    assert vehicle.values["FENCE_ACTION"] == 3.0
    await fence.lower(lambda: True)
    assert vehicle.values["FENCE_ACTION"] == action


def test_vehicle_without_fence_support_is_not_changed_but_silent_vehicle_raises(
    vehicle: Vehicle, tmp_path: Path
) -> None:
    async def raised() -> None:
        fence = MissionFence(vehicle, tmp_path)
        with pytest.raises(AutopilotError, match="FENCE_ENABLE cannot be read"):
            vehicle.loss = 1.0
            await fence.raise_around(spec(area(-50, -50, 50, 50)), retraces=False)
        vehicle.loss = 0.0
        del vehicle.values["FENCE_ENABLE"]
        await fence.raise_around(spec(area(-50, -50, 50, 50)), retraces=False)
        assert fence.missing == "the autopilot has no FENCE_ENABLE"
        assert not vehicle.written

    with asyncio.Runner(loop_factory=Loop) as runner:
        runner.run(raised())


async def test_vehicle_without_item_lists_is_not_changed(
    vehicle: Vehicle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def unsupported(*_: Any) -> tuple[MissionItem, ...]:
        raise ItemsUnsupported("the autopilot keeps no fence items")

    monkeypatch.setattr(module, "download", unsupported)
    fence = MissionFence(vehicle, tmp_path)
    await fence.raise_around(spec(area(-50, -50, 50, 50)), retraces=False)
    assert fence.missing
    assert not fence.raised


async def test_fence_read_back_must_match_sent_fence(
    vehicle: Vehicle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def forgetful(_autopilot: Any, items: Any) -> None:
        vehicle.items = tuple(items)[:-1]

    monkeypatch.setattr(module, "upload", forgetful)
    fence = MissionFence(vehicle, tmp_path)
    with pytest.raises(AutopilotError, match="stored 3 fence items"):
        await fence.raise_around(spec(area(-50, -50, 50, 50)), retraces=False)


async def test_fence_parameter_that_cannot_be_set_is_reported(vehicle: Vehicle, tmp_path: Path) -> None:
    vehicle.fixed = ("FENCE_TYPE",)
    with pytest.raises(AutopilotError, match="FENCE_TYPE cannot be set to 4"):
        await MissionFence(vehicle, tmp_path).raise_around(spec(area(-50, -50, 50, 50)), retraces=False)


async def test_owner_fence_is_stored_before_any_change(vehicle: Vehicle, tmp_path: Path) -> None:
    fence = MissionFence(vehicle, tmp_path / "gone")
    with pytest.raises(OSError, match="gone"):
        await fence.raise_around(spec(area(-50, -50, 50, 50)), retraces=False)
    assert not vehicle.written
    assert not vehicle.items


async def test_damaged_owner_fence_file_is_ignored(vehicle: Vehicle, tmp_path: Path) -> None:
    await asyncio.to_thread((tmp_path / "fence.json").write_text, json.dumps({"items": 3}))
    await MissionFence(vehicle, tmp_path).lower(lambda: True)
    assert not vehicle.written


OWNED = {"FENCE_ENABLE": 1.0, "FENCE_TYPE": 3.0, "FENCE_ALT_MAX": 40.0}


async def test_fence_is_not_changed_while_armed(vehicle: Vehicle, tmp_path: Path) -> None:
    vehicle.values |= OWNED
    vehicle.vehicle.armed = True
    fence = MissionFence(vehicle, tmp_path)
    with pytest.raises(AutopilotError, match="the motors are running"):
        await fence.raise_around(spec(area(-50, -50, 50, 50)), retraces=False)
    assert not vehicle.written
    vehicle.vehicle.armed = False
    await fence.raise_around(spec(area(-50, -50, 50, 50)), retraces=False)
    vehicle.vehicle.armed = True
    vehicle.written.clear()
    with pytest.raises(AutopilotError, match="the motors are running"):
        await fence.lower(lambda: True)
    assert not vehicle.written
    assert fence.raised


async def test_owner_fence_stays_enabled_if_vehicle_arms_before_it_is_disabled(
    vehicle: Vehicle, tmp_path: Path
) -> None:
    vehicle.values |= OWNED
    send = vehicle.send
    reads = 0

    def arm_during_read(outgoing: Message) -> None:
        nonlocal reads
        reads += outgoing.name == "PARAM_REQUEST_READ" and outgoing.text("param_id") == "FENCE_ENABLE"
        vehicle.vehicle.armed = reads >= 3
        send(outgoing)

    vehicle.send = arm_during_read  # type: ignore[method-assign]
    fence = MissionFence(vehicle, tmp_path)
    with pytest.raises(AutopilotError, match="cannot be disabled"):
        await fence.raise_around(spec(area(-50, -50, 50, 50)), retraces=False)
    assert not vehicle.written


@pytest.mark.parametrize("how", ["refused", "given up"])
async def test_owner_fence_is_kept_if_mission_fence_cannot_be_enabled(
    vehicle: Vehicle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    vehicle.values |= OWNED
    vehicle.items = (MissionItem(5003, 30.0, 1, 2),)
    before = dict(vehicle.values)

    async def full(_autopilot: Any, items: Any) -> None:
        vehicle.items = tuple(items)
        if len(items) > 1:
            assert vehicle.values["FENCE_ENABLE"] == 0.0
            raise AutopilotError("no space") if how == "refused" else asyncio.CancelledError

    monkeypatch.setattr(module, "upload", full)
    fence = MissionFence(vehicle, tmp_path)
    with pytest.raises((AutopilotError, asyncio.CancelledError)):
        await fence.raise_around(spec(area(-50, -50, 50, 50)), retraces=False)
    assert vehicle.values == before
    assert vehicle.items == (MissionItem(5003, 30.0, 1, 2),)
    assert not fence.raised


async def test_owner_fence_that_cannot_be_restored_is_kept_for_later(
    vehicle: Vehicle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    vehicle.values |= OWNED

    async def silent(*_: Any) -> None:
        raise AutopilotError("the autopilot stopped responding", link=True)

    monkeypatch.setattr(module, "upload", silent)
    fence = MissionFence(vehicle, tmp_path)
    with pytest.raises(AutopilotError, match="stopped responding"):
        await fence.raise_around(spec(area(-50, -50, 50, 50)), retraces=False)
    assert fence.raised, "the fence stays marked as raised, so that the supervisor restores the owner's fence later"


@pytest.mark.parametrize(("types", "disabled"), [(7.0, 0), (3.0, 1)])
async def test_restore_that_is_cut_off_leaves_a_fence_enabled_and_is_continued(
    vehicle: Vehicle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, types: float, disabled: int
) -> None:
    owner = {"FENCE_ENABLE": 1.0, "FENCE_TYPE": types, "FENCE_ALT_MAX": 40.0}
    items = (MissionItem(5003, 30.0, 1, 2),)
    send = vehicle.send
    upload = module.upload
    left = 0

    def cut() -> None:
        nonlocal left
        left -= 1
        if left < 0:
            raise Killed

    def dying(outgoing: Message) -> None:
        if outgoing.name == "PARAM_SET":
            cut()
        send(outgoing)

    async def dying_upload(*call: Any) -> None:
        cut()
        await upload(*call)

    found_disabled = 0
    for step in range(8):
        vehicle.values |= owner
        vehicle.items = items
        await MissionFence(vehicle, tmp_path).raise_around(spec(area(-50, -50, 50, 50), **LIMITS), retraces=False)
        with monkeypatch.context() as patch:
            patch.setattr(vehicle, "send", dying)
            patch.setattr(module, "upload", dying_upload)
            left = step
            with contextlib.suppress(Killed):
                await MissionFence(vehicle, tmp_path).lower(lambda: True)
        found_disabled += vehicle.values["FENCE_ENABLE"] == 0.0
        await MissionFence(vehicle, tmp_path).lower(lambda: True)
        assert {name: vehicle.values[name] for name in owner} == owner
        assert vehicle.items == items
    assert left > 0, "the last restore was complete"
    assert found_disabled == disabled, "only the moment in which the fence reads its types"


async def test_fence_parameter_changed_by_another_station_in_flight_is_reset(vehicle: Vehicle, tmp_path: Path) -> None:
    fence = MissionFence(vehicle, tmp_path)
    await fence.raise_around(spec(area(-50, -50, 50, 50), **LIMITS), retraces=False)
    raised = dict(vehicle.values)
    vehicle.vehicle.armed = True
    assert await MissionFence(vehicle, tmp_path).hold() == ()
    vehicle.values |= {"FENCE_ENABLE": 0.0, "FENCE_ALT_MAX": 900.0, "FENCE_ACTION": 0.0}
    changed = await MissionFence(vehicle, tmp_path).hold()
    assert changed == (
        "FENCE_ALT_MAX was 900 and is 65", "FENCE_ACTION was 0 and is 1", "FENCE_ENABLE was 0 and is 1",
    )  # fmt: skip
    assert vehicle.values == raised
    vehicle.values["FENCE_ACTION"] = 0.0
    vehicle.fixed = ("FENCE_ACTION",)
    with pytest.raises(AutopilotError, match="FENCE_ACTION cannot be set to 1; it remains 0"):
        await fence.hold()


async def test_fence_replaced_by_another_station_is_reported(vehicle: Vehicle, tmp_path: Path) -> None:
    fence = MissionFence(vehicle, tmp_path)
    await fence.raise_around(spec(area(-50, -50, 50, 50)), retraces=False)
    vehicle.values["FENCE_TOTAL"] = 1.0
    with pytest.raises(AutopilotError, match="another station changed its fence from 4 to 1 items"):
        await fence.hold()


async def test_replaced_fence_items_of_same_count_are_reported(
    vehicle: Vehicle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fence = MissionFence(vehicle, tmp_path)
    await fence.raise_around(spec(area(-50, -50, 50, 50)), retraces=False)
    vehicle.items = tuple(replace(item, lat_e7=item.lat_e7 + 5000) for item in vehicle.items)
    assert await fence.hold() == (), "the change is not detected yet, because the items were read recently"
    with pytest.raises(AutopilotError, match="replaced the items of its fence"):
        await MissionFence(vehicle, tmp_path).hold()
    monkeypatch.setattr(module, "ITEMS_AGAIN_S", 0.0)
    with pytest.raises(AutopilotError, match="replaced the items of its fence"):
        await fence.hold()


async def test_loaded_fence_is_not_loaded_again(vehicle: Vehicle, tmp_path: Path) -> None:
    fence = MissionFence(vehicle, tmp_path)
    loads = list[int]()

    async def counted(_autopilot: Any, items: Any) -> None:
        loads.append(len(items))

    await fence.raise_around(spec(area(-50, -50, 50, 50)), retraces=False)
    upload = module.upload
    module.upload = counted  # type: ignore[assignment]
    try:
        vehicle.values["FENCE_ACTION"] = 0.0
        await fence.raise_around(spec(area(-50, -50, 50, 50)), retraces=False)
        assert not loads
        assert vehicle.values["FENCE_ACTION"] == 1.0, "a parameter changed by another station is reset"
    finally:
        module.upload = upload
    vehicle.values["FENCE_TOTAL"] = 9.0
    vehicle.items = ()
    await fence.raise_around(spec(area(-50, -50, 50, 50)), retraces=False)
    assert len(vehicle.items) == 4, "items replaced by another station are loaded again"
    await fence.raise_around(spec(area(-60, -50, 50, 50)), retraces=False)
    assert len(vehicle.items) == 4
