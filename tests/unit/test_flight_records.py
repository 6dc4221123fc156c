"""Records of a plan's flight: which entries and pictures belong to it, pages, and hostile parameters."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import pytest
from flight_log import (
    DRIVER,
    FOREIGN,
    NAMESPACE,
    VIEWER,
    at,
    call,
    flight_plan,
    grant,
    state,
    write_log,
    write_pictures,
)
from fractus_agent.records import audit_records, picture_records
from fractus_agent.records.audit_records import InvalidContinue, read_track, read_verdicts
from fractus_agent.records.picture_records import NotRecorded, read_picture, read_pictures
from fractus_agent.records.planned_flight import NoFlight, PlannedFlight, planned_flight
from fractus_core.api import FlightPlan
from fractus_core.api.flight_records import PicturePage, TrackPage, VerdictPage
from fractus_core.api.model import OpenModel
from fractus_core.api.names import component_identity
from pydantic import ValidationError

SEGMENT = "000001-20260601T120000Z.mcap"


@pytest.fixture
def flight() -> PlannedFlight:
    return planned_flight(FlightPlan.from_body(flight_plan()), "drone-1")


def track(directory: Path, flight: PlannedFlight) -> list[float]:
    return [(point.time.timestamp() - flight.begin_s) - 600 for point in read_track(directory, flight, 500, "").items]


def test_flight_of_plan_is_known_on_its_drone_only() -> None:
    with pytest.raises(NoFlight, match="has not started"):
        planned_flight(FlightPlan.from_body(flight_plan(application=None)), "drone-1")
    with pytest.raises(NoFlight, match="drone-2 does not fly survey-1"):
        planned_flight(FlightPlan.from_body(flight_plan()), "drone-2")
    with pytest.raises(NoFlight, match="does not fly"):
        planned_flight(FlightPlan.from_body(flight_plan(application="flight-of-another-plan")), "drone-1")


def test_track_begins_with_the_grant_and_ends_on_the_ground(tmp_path: Path, flight: PlannedFlight) -> None:
    entries = [
        grant(-60, FOREIGN), state(-50), state(-40, in_air=False), grant(-30, FOREIGN, "removed"),
        grant(1, DRIVER), state(2, in_air=False), state(3),
        at(4, "started"), grant(4, DRIVER), state(5),
        grant(6, DRIVER, "removed"), state(7), state(8, in_air=False), state(9), grant(10, FOREIGN), state(11),
    ]  # fmt: skip
    write_log(tmp_path / "mobility.jsonl", entries)
    assert track(tmp_path, flight) == [2, 3, 5, 7]


def test_track_ends_in_the_air_when_the_drone_flies_for_another_application(
    tmp_path: Path, flight: PlannedFlight
) -> None:
    write_log(
        tmp_path / "mobility.jsonl",
        [grant(1, DRIVER), state(2), grant(3, DRIVER, "removed"), grant(4, FOREIGN), state(5)],
    )
    assert track(tmp_path, flight) == [2]


def test_track_ends_when_a_driver_that_shared_the_flight_takes_control(tmp_path: Path, flight: PlannedFlight) -> None:
    entries = [
        grant(0, FOREIGN), grant(1, DRIVER), state(2), state(3, controller=FOREIGN), grant(4, DRIVER, "removed"),
        state(5, controller=FOREIGN), state(6),
    ]  # fmt: skip
    write_log(tmp_path / "mobility.jsonl", entries)
    assert track(tmp_path, flight) == [2, 3]


def test_entries_after_the_landing_do_not_belong_to_the_flight(tmp_path: Path, flight: PlannedFlight) -> None:
    def control(second: float, action: str) -> dict[str, Any]:
        return at(second, "control", action=action, controller="pilot", reason="r", code="", policies=[])

    entries = [
        grant(0, DRIVER), state(1), grant(2, DRIVER, "removed"), control(3, "returned"), control(4, "landed"),
        control(5, "granted"),
    ]  # fmt: skip
    write_log(tmp_path / "mobility.jsonl", entries)
    assert [verdict.time.second for verdict in read_verdicts(tmp_path, flight, 500, "").items] == [3, 4]


def test_records_outside_the_window_are_not_returned(tmp_path: Path, flight: PlannedFlight) -> None:
    entries = [grant(-601, DRIVER), state(-601), call(-601, DRIVER), state(0), call(4500, DRIVER), call(4501, DRIVER)]
    write_log(tmp_path / "mobility.jsonl", entries)
    assert track(tmp_path, flight) == [0]
    assert len(read_verdicts(tmp_path, flight, 500, "").items) == 1


@pytest.mark.parametrize(
    "caller",
    [
        FOREIGN,
        component_identity("other", "flight-0b5c9a3e-1111-4222-8333-444455556666", "Navigator", "navigator"),
        component_identity(NAMESPACE, "flight-0b5c9a3e-1111-4222-8333-44445555666", "Navigator", "navigator"),
        f"{DRIVER}/more",
        "",
    ],
)
def test_calls_of_other_applications_are_not_returned(tmp_path: Path, flight: PlannedFlight, caller: str) -> None:
    write_log(tmp_path / "mobility.jsonl", [grant(0, DRIVER), call(1, caller, reason=DRIVER), call(2, DRIVER)])
    (verdict,) = read_verdicts(tmp_path, flight, 500, "").items
    assert (verdict.component, verdict.method, verdict.action) == ("Navigator", "Goto", "allow")


def test_driver_of_another_application_is_not_described(tmp_path: Path, flight: PlannedFlight) -> None:
    def control(second: float, kind: str, controller: str) -> dict[str, Any]:
        return at(second, kind, action="granted", controller=controller, reason="r", code="c", policies=["p"])

    alarm = {"action": "correct", "code": "AltitudeAboveLimit", "reason": "too high", "policies": ["p"]}
    entries = [
        grant(0, DRIVER), control(1, "control", DRIVER), at(2, "monitor", **alarm),
        control(3, "control", FOREIGN), at(4, "monitor", **alarm), state(5, controller=FOREIGN),
        control(6, "takeover", "system"), at(7, "monitor", **alarm), state(8), control(9, "control", "pilot"),
    ]  # fmt: skip
    write_log(tmp_path / "mobility.jsonl", entries)
    kinds = [(verdict.kind, verdict.time.second) for verdict in read_verdicts(tmp_path, flight, 500, "").items]
    assert kinds == [("control", 1), ("monitor", 2), ("monitor", 7), ("control", 9)]
    assert [point.controller for point in read_track(tmp_path, flight, 500, "").items] == ["other", "system"]


def test_verdicts_of_both_services_are_merged_in_pages(tmp_path: Path, flight: PlannedFlight) -> None:
    write_log(tmp_path / "mobility.000000000001.jsonl", [grant(0, DRIVER), *(call(n, DRIVER) for n in range(0, 20, 2))])
    write_log(tmp_path / "mobility.jsonl", [call(n, DRIVER) for n in range(20, 30, 2)], first=12)
    write_log(tmp_path / "camera.jsonl", [call(n, VIEWER, filters=["Blur"]) for n in range(1, 30, 2)])
    seen = []
    continue_: str | None = ""
    pages = 0
    while continue_ is not None:
        page = read_verdicts(tmp_path, flight, 7, continue_)
        seen += [verdict.time.second for verdict in page.items]
        continue_ = page.continue_
        pages += 1
    assert (seen, pages) == (list(range(30)), 5)
    assert read_verdicts(tmp_path, flight, 2, "").items[1].filters == ("Blur",)


def test_segments_of_other_times_are_not_read(
    tmp_path: Path, flight: PlannedFlight, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_log(tmp_path / "mobility.000000000001.jsonl", [state(-9000), state(-8000)])
    write_log(tmp_path / "mobility.000000000003.jsonl", [state(-7000), grant(0, DRIVER), state(1)], first=3)
    write_log(tmp_path / "mobility.000000000006.jsonl", [state(20000)], first=6)
    write_log(tmp_path / "mobility.jsonl", [state(30000)], first=7)
    read: list[str] = []
    original = audit_records.open_file

    def open_file(path: Path) -> Any:
        read.append(path.name)
        return original(path)

    monkeypatch.setattr(audit_records, "open_file", open_file)
    assert track(tmp_path, flight) == [1]
    # Each segment is opened once for its first entry.
    assert [name for name, names in itertools.groupby(sorted(read)) if len(list(names)) > 1] == [
        "mobility.000000000003.jsonl"
    ]


def test_log_is_complete_after_the_clock_was_set_back(tmp_path: Path, flight: PlannedFlight) -> None:
    write_log(tmp_path / "mobility.000000000001.jsonl", [grant(0, DRIVER), state(1)])
    write_log(tmp_path / "mobility.000000000003.jsonl", [state(-40_000)], first=3)
    write_log(tmp_path / "mobility.jsonl", [state(-39_000)], first=4)
    assert track(tmp_path, flight) == [1]


def test_log_is_read_while_its_full_file_becomes_a_segment(tmp_path: Path, flight: PlannedFlight) -> None:
    write_log(tmp_path / "mobility.000000000001.jsonl", [grant(0, DRIVER), state(1)])
    assert track(tmp_path, flight) == [1]


@pytest.mark.parametrize(
    "line", [b"", b"\x00", b"[]", b'{"kind":"state"}', b'{"seq":true,"kind":"grant"}', b"[" * 5000]
)
def test_damaged_lines_are_skipped(tmp_path: Path, flight: PlannedFlight, line: bytes) -> None:
    log = tmp_path / "mobility.jsonl"
    write_log(log, [grant(0, DRIVER)])
    with log.open("ab") as file:
        file.write(line + b"\n")
    write_log(
        log,
        [
            state(1, lat=float("nan")), at(2, "state", lat="x", in_air=1), at(3, "call", caller=["x"]), at(4, "grant", change=[]),
            {**state(6), "kind": ["state"]}, state(7, lat=10**400),
        ],
        first=2,
    )  # fmt: skip
    assert [point.lat for point in read_track(tmp_path, flight, 500, "").items] == [None, None, None]
    assert read_verdicts(tmp_path, flight, 500, "").items == []


def test_text_that_is_not_unicode_does_not_hide_the_page(tmp_path: Path, flight: PlannedFlight) -> None:
    write_log(tmp_path / "mobility.jsonl", [call(1, DRIVER, reason="terrain-\udcff.tif", policies=["\udc80"])])
    page = VerdictPage(items=tuple(read_verdicts(tmp_path, flight, 10, "").items))
    received = VerdictPage.model_validate_json(json.dumps(page.to_dict()))
    assert (received.items[0].reason, received.items[0].policies) == ("terrain-\\udcff.tif", ("\\udc80",))


@pytest.mark.parametrize(
    "content",
    [
        b'{"items": [' + b"0," * 20_000 + b"0]}",
        b'{"items": [{"time": 0, "kind": "call", "action": "", "policies": [' + b"0," * 20_000 + b"0]}]}",
    ],
    ids=["items", "policies"],
)
def test_page_with_many_invalid_items_is_refused_at_the_first(content: bytes) -> None:
    with pytest.raises(ValidationError) as invalid:
        VerdictPage.model_validate_json(content)
    assert invalid.value.error_count() == 1


@pytest.mark.parametrize("model", [VerdictPage, TrackPage, PicturePage])
def test_page_with_too_many_records_is_refused(model: type[OpenModel]) -> None:
    record = {"time": 0, "kind": "call", "action": "", "controller": "", "inAir": True, "id": "1", "component": ""}
    content = {"items": [record | {"sizeBytes": 1}] * 501}
    with pytest.raises(ValidationError, match="at most 500 items"):
        model.model_validate(content)


@pytest.mark.parametrize("token", ["x", "1", "1-2-3", "-1-2", "1-" + "9" * 16, "٣-١", "1-2\n", "../1-2"])
def test_invalid_continue_of_logs_is_refused(tmp_path: Path, flight: PlannedFlight, token: str) -> None:
    with pytest.raises(InvalidContinue, match="continue: use the value of the previous page"):
        read_verdicts(tmp_path, flight, 10, token)


def test_node_without_logs_has_no_records(tmp_path: Path, flight: PlannedFlight) -> None:
    assert read_verdicts(tmp_path, flight, 10, "") == ([], None)
    with pytest.raises(NotRecorded):
        read_pictures(tmp_path / "none", flight, 10, "")


# -- pictures --


def jpeg(number: int) -> bytes:
    return b"\xff\xd8" + bytes([number]) * 50


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    recorded = [
        (-601, f"u/{VIEWER}", jpeg(0)), (1, f"u/{VIEWER}", jpeg(1)), (2, f"u/{FOREIGN}", jpeg(2)), (3, "", jpeg(3)),
        (4, VIEWER, jpeg(4)), (5, f"u/{VIEWER}", jpeg(5)),
    ]  # fmt: skip
    write_pictures(tmp_path / SEGMENT, recorded)
    write_pictures(tmp_path / "000002-20260601T121000Z.mcap", [(600, f"u/{VIEWER}", jpeg(6))])
    return tmp_path


def test_only_pictures_of_the_flight_are_returned(pictures: Path, flight: PlannedFlight) -> None:
    page = read_pictures(pictures, flight, 10, "")
    assert [picture.component for picture in page.items] == ["AerialViewer"] * 3
    found = [read_picture(pictures, flight, picture.id) for picture in page.items]
    assert found == [jpeg(1), jpeg(5), jpeg(6)]
    assert [picture.size_bytes for picture in page.items] == [52] * 3


def test_pictures_are_returned_in_pages(pictures: Path, flight: PlannedFlight) -> None:
    first = read_pictures(pictures, flight, 2, "")
    assert first.continue_ == first.items[-1].id
    second = read_pictures(pictures, flight, 2, first.continue_)
    assert (len(second.items), second.continue_) == (1, None)


def test_every_other_location_returns_no_picture(pictures: Path, flight: PlannedFlight) -> None:
    known = {picture.id for picture in read_pictures(pictures, flight, 10, "").items}
    size = (pictures / SEGMENT).stat().st_size
    for offset, number in itertools.product(range(0, size, 7), (0, 1, 2, 3)):
        if (id_ := f"1-{offset}-{number}") not in known:
            assert read_picture(pictures, flight, id_) is None


def test_pictures_are_returned_after_the_clock_was_set_back(pictures: Path, flight: PlannedFlight) -> None:
    write_pictures(pictures / "000003-20260601T020000Z.mcap", [(-36_000, f"u/{FOREIGN}", jpeg(7))])
    assert len(read_pictures(pictures, flight, 10, "").items) == 3


@pytest.mark.parametrize(
    "id_", ["", "..", "1", "1-2", "../../etc/passwd", "1-0-0/..", "9-8-0", "1-999999999999-0", "a-b-c"]
)
def test_invalid_id_returns_no_picture(pictures: Path, flight: PlannedFlight, id_: str) -> None:
    assert read_picture(pictures, flight, id_) is None


def test_large_pictures_are_not_read(pictures: Path, flight: PlannedFlight, monkeypatch: pytest.MonkeyPatch) -> None:
    write_pictures(pictures / "000003-20260601T121100Z.mcap", [(700, f"u/{VIEWER}", b"\xff\xd8" + bytes(9_500_000))])
    write_pictures(pictures / "000004-20260601T121200Z.mcap", [(800, f"u/{VIEWER}", jpeg(8))])
    assert len(read_pictures(pictures, flight, 10, "").items) == 4
    # The large picture is compressed to less than the limit.
    monkeypatch.setattr(picture_records, "MAX_PICTURE_RECORD_BYTES", 2**30)
    assert len(read_pictures(pictures, flight, 10, "").items) == 5


def test_damaged_recording_hides_no_other_recording(pictures: Path, flight: PlannedFlight) -> None:
    (pictures / SEGMENT).write_bytes(b"\x89MCAP0\r\n" + b"\x06" + (2**40).to_bytes(8, "little"))
    (pictures / "000009-99999999T999999Z.mcap").write_bytes(b"")
    assert len(read_pictures(pictures, flight, 10, "").items) == 1
