"""The table of messages against pymavlink's full dialect."""

from __future__ import annotations

import importlib
from typing import Any

import pytest
from fractus_services.mobility.mavlink.dialect import MESSAGES, Codec, message


@pytest.fixture(scope="module")
def full() -> Any:
    return importlib.import_module("pymavlink.dialects.v20.ardupilotmega")


def test_the_table_is_the_full_dialects(full: Any) -> None:
    for name, ours in MESSAGES.items():
        theirs = full.mavlink_map[ours.id]
        assert (theirs.msgname, theirs.crc_extra) == (name, ours.crc_extra)
        assert ours.unpacker.size == theirs.unpacker.size
        if ours.__module__.endswith("dialect"):
            assert list(ours.fieldnames) == list(theirs.ordered_fieldnames)
            types = dict(zip(theirs.fieldnames, theirs.fieldtypes, strict=True))
            assert [types[f] for f in ours.fieldnames] == list(ours.fieldtypes)


def test_frames_are_the_full_dialects(full: Any) -> None:
    ours = Codec(255, 191)
    theirs = full.MAVLink(None, srcSystem=1, srcComponent=1)
    theirs.robust_parsing = True
    sent = [
        message("COMMAND_INT", command=192, frame=6, x=393600000, y=-229500000, z=12.5, param1=-1.0, target_system=1),
        message("PARAM_SET", param_id=b"FS_GCS_ENABLE", param_value=1.0, param_type=9, target_system=1),
        message("HEARTBEAT", type=18, autopilot=8, system_status=4, mavlink_version=3),
        message("HOME_POSITION", latitude=1, longitude=2, altitude=3, q=[1.0, 0.0, 0.0, 0.0]),
    ]
    for outgoing in sent:
        (read,) = theirs.parse_buffer(ours.encode(outgoing))
        assert read.get_type() == outgoing.msgname
        for field in outgoing.fieldnames:
            want, got = getattr(outgoing, field), getattr(read, field)
            assert got == (want.decode() if isinstance(want, bytes) else want)
    back = full.MAVLink_global_position_int_message(1, 393600000, 229500000, 110000, 10000, -5, 6, -7, 35999).pack(
        theirs
    )
    text = full.MAVLink_statustext_message(3, b"PreArm: GPS 1: Bad fix").pack(theirs)
    alien = full.MAVLink_vfr_hud_message(1, 2, 3, 4, 5, 6).pack(theirs)
    position, said = ours.decode(back[:7]) + ours.decode(back[7:] + b"\x00noise" + alien + text)
    assert (position.lat, position.vz, position.hdg) == (393600000, -7, 35999)
    assert "Bad fix" in str(said.text)


def test_an_unknown_field_is_a_mistake() -> None:
    with pytest.raises(TypeError, match="altitude"):
        message("COMMAND_LONG", altitude=3)
