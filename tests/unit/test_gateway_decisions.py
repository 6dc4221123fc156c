"""The table of MAVLink decisions is complete. It refuses messages that could move, reconfigure or blind a drone unjudged."""

from __future__ import annotations

from importlib.resources import files

import pytest
from fractus_services.gateway import session
from fractus_services.gateway.decisions import DECISIONS, BadDecisions, read_decisions
from pymavlink.dialects.v20 import ardupilotmega as mavlink

TABLE = files("fractus_services.gateway").joinpath("decisions.tsv").read_text()

MESSAGES = {kind.id: kind.msgname for kind in mavlink.mavlink_map.values()}
COMMANDS = {value: entry.name.removeprefix("MAV_CMD_") for value, entry in mavlink.enums["MAV_CMD"].items()}

NEVER_HANDLED_MESSAGES = [
    82, 139, 69, 81, 70, 144, 149, 332, 333, 90, 91, 92, 93, 107, 113, 114, 115,  # motion
    246, 247, 132, 330, 11037, 134, 147, 33,  # avoidance and failsafes
    160, 175, 54, 243, 48, 5, 7,  # fence, home, authority
    232, 123, 233, 101, 102, 103, 104, 138, 331, 11011, 100, 106, 296,  # estimator
    323, 50, 110, 126, 385, 248, 386, 387, 388, 11000, 11002, 11004, 256, 151, 121, 299,  # configuration
    156, 157, 154, 155, 201, 282, 284, 288, 12900, 12901, 12902, 12903, 12904, 12905, 12915,  # camera and identity
]  # fmt: skip
NEVER_HANDLED_COMMANDS = [
    80, 94, 112, 113, 114, 186, 188, 189, 213, 252, 3000, 42702, 42703, 42001,  # motion
    92, 262, 218, 221, 222, 3001, 4000, 4001,  # authority
    179, 611, 5000, 5001, 5002, 5003, 5004, 5100, 42007, 43003,  # fence, home, estimator
    181, 182, 183, 184, 185, 187, 208, 209, 210, 211, 212, 216, 223, 42600, 30001, 30002,  # actuators
    180, 217, 241, 243, 245, 246, 420, 500, 610, 31000, 31014, 32000, 42424, 42428, 42650, 42700,  # configuration
    202, 204, 206, 214, 220, 530, 531, 532, 2500, 2501,  # privacy
]  # fmt: skip


@pytest.mark.parametrize("number", NEVER_HANDLED_MESSAGES)
def test_dangerous_message_is_refused(number: int) -> None:
    if number in MESSAGES:
        assert DECISIONS.received[MESSAGES[number]] == "refuse"


@pytest.mark.parametrize("number", NEVER_HANDLED_COMMANDS)
def test_dangerous_command_is_refused(number: int) -> None:
    if number in COMMANDS:
        assert DECISIONS.commands[COMMANDS[number]] == "refuse"


def test_every_message_and_command_of_the_dialect_has_a_decision() -> None:
    assert set(DECISIONS.received) == set(DECISIONS.sent) == set(MESSAGES.values())
    assert set(DECISIONS.commands) == {name for name in COMMANDS.values() if name != "ENUM_END"}


def test_table_without_an_entry_is_rejected() -> None:
    with pytest.raises(BadDecisions, match="no decision for GPS_INPUT"):
        read_decisions("\n".join(line for line in TABLE.splitlines() if "GPS_INPUT" not in line))


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ("message\t0\tHEARTBEAT\tconsume\treplace", "repeated"),
        ("message\t9999\tUNHEARD_OF\trefuse\twithhold", "does not define it"),
        ("message\t1\tSYS_STATUS", "5 columns"),
    ],
)
def test_table_with_an_unknown_entry_is_rejected(line: str, problem: str) -> None:
    with pytest.raises(BadDecisions, match=problem):
        read_decisions(TABLE + line + "\n")


def test_table_with_an_unknown_decision_is_rejected() -> None:
    with pytest.raises(BadDecisions, match="HEARTBEAT: forward is not a decision"):
        read_decisions(TABLE.replace("HEARTBEAT\tconsume", "HEARTBEAT\tforward", 1))


def test_every_response_and_translation_has_a_handler() -> None:
    responses = {name for name, decision in DECISIONS.received.items() if decision == "respond"}
    assert responses == set(session._RESPONSES)
    assert {name for name, decision in DECISIONS.commands.items() if decision == "respond"} == set(
        session._COMMAND_RESPONSES
    )
    translated = {name for name, decision in DECISIONS.commands.items() if decision == "translate"}
    assert translated == {*session._COMMANDS, *session._MISSION_COMMANDS, "DO_SET_MODE"}
