"""Decisions for each MAVLink message and command: `decisions.tsv` lists every id that the dialect defines."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from typing import Literal, get_args

from pymavlink.dialects.v20 import ardupilotmega as mavlink

Received = Literal["translate", "respond", "consume", "refuse"]
"""Handling of a message from a program.

translate: The gateway calls the mobility service, or refuses the contents of the message.
respond: The gateway replies from its own state.
consume: The message has no effect.
refuse: The message has no effect, and the program receives the reason.
"""

Sent = Literal["deliver", "replace", "withhold"]
"""Handling of a message for the program.

deliver: The gateway encodes the content of the vehicle's message again.
replace: The gateway creates the message. The vehicle's message is not delivered.
withhold: The message is not delivered.
"""

COLUMNS = ["kind", "id", "name", "received", "sent"]


class BadDecisions(Exception):
    """The table of decisions is incomplete or contains an unknown entry."""


@dataclass(frozen=True, slots=True)
class Decisions:
    """Decisions by name. A message or command without an entry is refused, and not sent to programs.

    Attributes:
        received: Handling of messages from programs.
        sent: Handling of messages for programs.
        commands: Handling of commands from programs, by the name of the MAV_CMD without its prefix.
    """

    received: Mapping[str, Received]
    sent: Mapping[str, Sent]
    commands: Mapping[str, Received]

    @property
    def delivered(self) -> tuple[str, ...]:
        """Names of the messages of the vehicle that programs receive."""
        return tuple(name for name, decision in self.sent.items() if decision == "deliver")


def read_decisions(text: str) -> Decisions:
    """Parse a table of decisions with one line for each message and each command of the dialect.

    Raises:
        BadDecisions: An entry is missing, repeated or unknown.
    """
    rows = csv.reader(text.splitlines(), delimiter="\t")
    if next(rows, None) != COLUMNS:
        raise BadDecisions(f"the first line must be {' '.join(COLUMNS)}, separated by tabs")
    received: dict[str, Received] = {}
    sent: dict[str, Sent] = {}
    commands: dict[str, Received] = {}
    missing = _defined()
    for row in rows:
        if len(row) != len(COLUMNS):
            raise BadDecisions(f"{' '.join(row)}: the line must have {len(COLUMNS)} columns")
        kind, number, name, incoming, outgoing = row
        if not number.isdecimal() or (kind, int(number), name) not in missing:
            raise BadDecisions(f"{kind} {number} {name} is repeated, or the dialect does not define it")
        missing.remove((kind, int(number), name))
        decision = next((value for value in get_args(Received) if value == incoming), None)
        if decision is None:
            raise BadDecisions(f"{name}: {incoming} is not a decision; use {', '.join(get_args(Received))}")
        if kind == "command":
            commands[name] = decision
            continue
        received[name] = decision
        telemetry = next((value for value in get_args(Sent) if value == outgoing), None)
        if telemetry is None:
            raise BadDecisions(f"{name}: {outgoing} is not a decision; use {', '.join(get_args(Sent))}")
        sent[name] = telemetry
    if missing:
        raise BadDecisions(f"no decision for {', '.join(sorted(name for _, _, name in missing))}")
    return Decisions(received, sent, commands)


def _defined() -> set[tuple[str, int, str]]:
    """Return kind, id and name of each message and command of the dialect."""
    defined = {("message", kind.id, kind.msgname) for kind in mavlink.mavlink_map.values()}
    for value, entry in mavlink.enums["MAV_CMD"].items():
        if not entry.name.endswith("_ENUM_END"):
            defined.add(("command", value, entry.name.removeprefix("MAV_CMD_")))
    return defined


DECISIONS = read_decisions(files(__package__).joinpath("decisions.tsv").read_text(encoding="utf-8"))
